"""Two traces of one object's mask, albedo and normal, compared within stated tolerances; and wrong maps that the
comparison has to refuse."""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from unirender.errors import UnirenderError
from unirender.intrinsics import Intrinsics

ALBEDO_TWIN = 0.02  # of every value
ALBEDO_TWIN_ADDED = 0.05  # added where a factor changes nothing, or less than edges tolerate
BLACK = 1e-3  # below this mean a factor of the albedo is no error that can be found
NORMAL_TWIN_DEG = 8.0
INSIDE = 0.99  # coverage above which a pixel is not an edge
FAINT = 0.1  # edges with less coverage hold too few of the samples to compare
TOLERANCE_SPP = 256  # with fewer samples of a trace tolerances grow as its noise does
# Largest differences between two traces of the same geometry; three times or more what 24 objects show at 256 samples.
TOLERANCES: Mapping[str, float] = {
    "mask, mean": 0.004,  # over covered pixels
    "mask, max": 0.08,
    "albedo, bias": 0.005,  # of a channel's mean over inside pixels, relative
    "albedo inside, mean": 0.004,
    "albedo inside, max": 0.04,
    "albedo edge, mean": 0.02,
    "normal inside, mean deg": 0.4,
    "normal inside, max deg": 15.0,
    "normal edge, mean deg": 2.0,
}


@dataclass(frozen=True)
class GeometryTest:
    """Differences between two traces of one object's mask, albedo and normal, by the names of `TOLERANCES`."""

    differences: Mapping[str, float]
    factor: float = 1.0  # of all tolerances

    def tolerance(self, name: str) -> float:
        """The largest difference of a name that is allowed."""
        return TOLERANCES[name] * self.factor

    @property
    def exceeded(self) -> tuple[str, ...]:
        return tuple(name for name, value in self.differences.items() if not value <= self.tolerance(name))

    @property
    def passed(self) -> bool:
        return not self.exceeded

    def __str__(self) -> str:
        worst = max(self.differences, key=lambda name: self.differences[name] / TOLERANCES[name])
        state = "passed" if self.passed else f"FAILED on {', '.join(self.exceeded)}"
        return f"geometry {state}: {worst} {self.differences[worst]:.4g} (tolerance {self.tolerance(worst):.2g})"


def compare_geometry(stored: Intrinsics, again: Intrinsics, spp: int = TOLERANCE_SPP) -> GeometryTest:
    """Compares two traces of mask, albedo and normal: strictly inside, where both cover the pixel, loosely at edges.

    Raises:
        UnirenderError: the object covers no pixel in either.
    """
    a, b = (maps.require("mask", "albedo", "normal") for maps in (stored, again))
    low, high = (f(a["mask"], b["mask"])[..., 0] for f in (np.minimum, np.maximum))
    inside, edge = low > INSIDE, (low > FAINT) & (low <= INSIDE)
    mask = np.abs(a["mask"] - b["mask"])[..., 0][high > 0]
    albedo = np.abs(a["albedo"] - b["albedo"]).max(axis=-1)
    chord = np.linalg.norm(a["normal"].astype(np.float64) - b["normal"], axis=-1)
    angle = np.degrees(2 * np.arcsin(np.clip(chord / 2, 0, 1)))
    found = {"mask, mean": mask.mean(), "mask, max": mask.max()} if mask.size else {}
    if inside.any():
        mean_a, mean_b = (np.mean(maps["albedo"][inside], axis=0, dtype=np.float64) for maps in (a, b))
        found["albedo, bias"] = np.max(np.abs(mean_b - mean_a) / np.maximum(mean_a, BLACK))
        found |= {"albedo inside, mean": albedo[inside].mean(), "albedo inside, max": albedo[inside].max()}
        found |= {"normal inside, mean deg": angle[inside].mean(), "normal inside, max deg": angle[inside].max()}
    if edge.any():
        found |= {"albedo edge, mean": albedo[edge].mean(), "normal edge, mean deg": angle[edge].mean()}
    if not found:
        raise UnirenderError("truth check: the object covers no pixel in either trace, expected at least one")
    factor = math.sqrt(max(1.0, TOLERANCE_SPP / spp))
    return GeometryTest({name: float(value) for name, value in found.items()}, factor)


def twin_geometry(maps: Intrinsics) -> dict[str, Intrinsics]:
    """Wrong maps that the comparison has to refuse, whatever the object: each error moves away from what it cannot
    change.

    The albedo is 2 % brighter, or darker where that would be brighter than white; black, and an object that covers no
    pixel wholly, gets another albedo instead. The normal is turned about the x or the y axis, whichever it is less
    along: a picture that is its own mirror image shows that too.
    """
    good = maps.require("mask", "albedo", "normal")
    albedo, inside = good["albedo"], good["mask"][..., 0] > INSIDE
    if inside.any() and albedo[inside].mean(axis=0).max() >= BLACK:
        factor = 1 + ALBEDO_TWIN if albedo.max() * (1 + ALBEDO_TWIN) <= 1 else 1 - ALBEDO_TWIN
        name, wrong = f"albedo {ALBEDO_TWIN:.0%} off", albedo * factor
    else:
        inwards = np.where(albedo < 0.5, ALBEDO_TWIN_ADDED, -ALBEDO_TWIN_ADDED)
        name, wrong = f"albedo {ALBEDO_TWIN_ADDED:g} off", albedo + inwards * (good["mask"] > 0)
    return {
        name: maps.replace(albedo=wrong.astype(np.float32)),
        f"normal turned by {NORMAL_TWIN_DEG:g} degrees": maps.replace(normal=_turned(good["normal"])),
    }


def _turned(normal: Float[np.ndarray, "h w 3"]) -> Float[np.ndarray, "h w 3"]:
    """Normals turned by `NORMAL_TWIN_DEG` about x or y."""
    axis = int(np.argmin(np.square(normal[..., :2], dtype=np.float64).mean(axis=(0, 1))))
    turn = Rotation.from_euler("xy"[axis], NORMAL_TWIN_DEG, degrees=True).as_matrix()
    return (normal @ turn.T).astype(np.float32)
