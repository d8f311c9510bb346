"""How a map is turned, mirrored and tilted before it lights a scene; what was drawn stands in the light's provenance.

placement = Placement.parse(light.provenance)
environment = placement.apply(load_light("my_hall_8k.hdr").environment)   # the same light, from the original file
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from unirender.errors import UnirenderError
from unirender.light.environment import mirror_environment, rotate_environment

TILTED = 0.15  # share of the maps that are tilted
MOST_TILT_DEG = 20.0


@dataclass(frozen=True)
class Placement:
    """First a turn about the vertical, then perhaps a mirroring, then perhaps a tilt.

    Attributes:
        yaw_columns: columns by which the map moves to the right (towards larger azimuths).
        columns: of the map that `yaw_columns` counts in.
        mirrored: left and right are exchanged.
        tilt_deg: rotation about a horizontal axis; 0: none.
        tilt_azimuth_rad: of that axis, (cos, 0, sin) in camera axes.
    """

    yaw_columns: int
    columns: int
    mirrored: bool
    tilt_deg: float = 0.0
    tilt_azimuth_rad: float = 0.0

    def apply(self, environment: Float[np.ndarray, "h w 3"]) -> Float[np.ndarray, "h w 3"]:
        """The placed map. Turn and mirroring are exact at a multiple of `columns`, else to half a column of the map."""
        shift = round(self.yaw_columns * environment.shape[1] / self.columns)
        placed = np.roll(environment, shift, axis=1)
        if self.mirrored:
            placed = mirror_environment(placed)
        return tilted(placed, self.tilt_deg, self.tilt_azimuth_rad) if self.tilt_deg else placed

    def provenance(self) -> dict[str, str]:
        """As text; tilt only where there is one."""
        said = {
            "yaw_columns": str(self.yaw_columns),
            "map_columns": str(self.columns),
            "mirrored": "yes" if self.mirrored else "no",
        }
        if self.tilt_deg:
            said |= {
                "tilt_deg": repr(self.tilt_deg),
                "tilt_azimuth_deg": repr(float(np.degrees(self.tilt_azimuth_rad))),
            }
        return said

    @classmethod
    def parse(cls, provenance: Mapping[str, str]) -> "Placement":
        """The inverse of `provenance`.

        Raises:
            UnirenderError: the light was not placed: drawn by an earlier version, or from numbers.
        """
        try:
            turn, columns = int(provenance["yaw_columns"]), int(provenance["map_columns"])
            tilt, azimuth = (float(provenance.get(key, "0")) for key in ("tilt_deg", "tilt_azimuth_deg"))
            return cls(turn, columns, provenance["mirrored"] == "yes", tilt, float(np.radians(azimuth)))
        except (KeyError, ValueError) as error:
            raise UnirenderError(
                f"placement of a light: got {dict(provenance)}, expected yaw_columns and mirrored, as the provenance "
                "of a drawn map has them"
            ) from error


def random_turn(rng: np.random.Generator, columns: int) -> Placement:
    """A random yaw by whole columns and a random mirroring: both exact, so that nothing blurs."""
    return Placement(int(rng.integers(columns)), columns, bool(rng.random() < 0.5))


def random_placement(rng: np.random.Generator, columns: int) -> Placement:
    """A random turn; `TILTED` of them tilted by up to 20 degrees about a random horizontal axis."""
    turn = random_turn(rng, columns)
    if rng.random() >= TILTED:
        return turn
    tilt_deg, azimuth = rng.uniform(-MOST_TILT_DEG, MOST_TILT_DEG), rng.uniform(0, 2 * np.pi)
    return Placement(turn.yaw_columns, columns, turn.mirrored, float(tilt_deg), float(azimuth))


def tilted(environment: Float[np.ndarray, "h w 3"], tilt_deg: float, azimuth_rad: float) -> Float[np.ndarray, "h w 3"]:
    """The light turned by `tilt_deg` about the horizontal axis (cos(azimuth), 0, sin(azimuth))."""
    angle = np.radians(tilt_deg)
    x, z = np.cos(azimuth_rad), np.sin(azimuth_rad)
    cross = np.array([[0, -z, 0], [z, 0, -x], [0, x, 0]])
    return rotate_environment(environment, np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross)
