"""The unknown light as cells: piecewise constant radiance around the texels of Mitsuba's `envmap`.

Texel (i, j) of an `envmap` of H x W texels lies at theta = pi i / (H - 1) from +y and at the azimuth
phi = (j + 1/2) 2 pi / W; its cell reaches halfway to its neighbours. Directions are in world axes: (sin phi sin theta,
cos theta, -cos phi sin theta).
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import scipy.sparse as sp
from jaxtyping import Float

from unirender.errors import UnirenderError
from unirender_reference.optimize.numerics.descent import interpolation
from unirender_reference.optimize.numerics.differences import difference_matrix, side_by_side

LEAST_SINE = 0.15  # of theta, in the weights of differences: columns meet at the poles


@dataclass(frozen=True)
class LightGrid:
    """A grid of `rows` x `columns` cells; J = rows * columns, rows outermost."""

    rows: int = 16
    columns: int = 32

    def __post_init__(self) -> None:
        if self.rows < 4 or self.columns < 4:
            raise UnirenderError(f"light: got {self.rows} x {self.columns} cells, expected at least 4 x 4")

    @property
    def count(self) -> int:
        return self.rows * self.columns

    @cached_property
    def cosines(self) -> tuple[Float[np.ndarray, " rows"], Float[np.ndarray, " rows"]]:
        """cos(theta) at the upper and at the lower border of each row."""
        borders = (np.arange(self.rows + 1) - 0.5) / (self.rows - 1)
        cosine = np.cos(np.pi * np.clip(borders, 0, 1))
        return cosine[:-1], cosine[1:]

    @cached_property
    def solid_angles(self) -> Float[np.ndarray, " rows"]:
        """Solid angle of one cell of each row, in steradian."""
        upper, lower = self.cosines
        return (upper - lower) * 2 * np.pi / self.columns

    def cell_of(self, direction: Any) -> Any:
        """Index of the cell of world directions (Dr.Jit)."""
        import drjit as dr

        from unirender_reference.backend import mitsuba

        mi = mitsuba()
        theta, phi = dr.safe_acos(direction.y), dr.atan2(direction.x, -direction.z)
        phi = dr.select(phi < 0, phi + 2 * dr.pi, phi)
        row = dr.minimum(mi.UInt32(theta / dr.pi * (self.rows - 1) + 0.5), self.rows - 1)
        column = dr.minimum(mi.UInt32(phi / (2 * dr.pi) * self.columns), self.columns - 1)
        return row * self.columns + column

    def direction(self, cell: Any, u: Any, v: Any) -> Any:
        """World directions, uniform over the solid angle of cells for (u, v) uniform in [0, 1]^2 (Dr.Jit)."""
        import drjit as dr

        from unirender_reference.backend import mitsuba

        mi = mitsuba()
        row = cell // self.columns
        upper, lower = (dr.gather(mi.Float, mi.Float(border.astype(np.float32)), row) for border in self.cosines)
        cosine = dr.lerp(upper, lower, u)
        sine = dr.safe_sqrt(1 - cosine * cosine)
        phi = (mi.Float(cell % self.columns) + v) / self.columns * 2 * dr.pi
        return mi.Vector3f(dr.sin(phi) * sine, cosine, -dr.cos(phi) * sine)

    @cached_property
    def differences(self) -> sp.csr_matrix:
        """(k, J) differences of neighbouring cells, weighted so that their squares integrate |gradient|^2."""
        theta = np.pi * np.arange(self.rows) / (self.rows - 1)
        sine, between = (np.maximum(np.sin(angle), LEAST_SINE) for angle in (theta, (theta[1:] + theta[:-1]) / 2))
        along, down = np.repeat(1 / np.sqrt(sine), self.columns), np.repeat(np.sqrt(between), self.columns)
        pairs = side_by_side(np.arange(self.count).reshape(self.rows, self.columns), around=True)
        return difference_matrix(pairs, self.count, np.concatenate([along, down]))

    def environment(self, cells: Float[np.ndarray, "j 3"]) -> Float[np.ndarray, "rows columns 3"]:
        """The cells as an environment map on Mitsuba's grid (which interpolates between texels)."""
        return cells.reshape(self.rows, self.columns, 3).astype(np.float32)


def interpolated_light(environment: Float[np.ndarray, "h w 3"], rows: int) -> Float[np.ndarray, "rows columns 3"]:
    """The light on a finer grid of Mitsuba's `envmap`, interpolated as the renderer does."""
    height, width = environment.shape[:2]
    columns = width * rows // height
    place = np.linspace(0, height - 1, rows)
    low = np.minimum(place.astype(int), height - 2)
    share = (place - low)[:, None, None]
    taller = environment[low] * (1 - share) + environment[low + 1] * share
    return np.einsum("jw,hwc->hjc", interpolation(columns, width, circular=True), taller).astype(np.float32)
