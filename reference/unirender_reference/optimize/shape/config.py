"""Options of the reconstruction; light to import."""

from dataclasses import dataclass

from unirender_reference.optimize.machine import require_memory
from unirender_reference.option_checks import require_least

POINT_BYTES = 180.0  # of memory for a point of the grid: measured with 64 to 192 cells


@dataclass(frozen=True)
class ShapeConfig:
    """How a mesh is found from pictures with masks, and refined by what they show."""

    cells: int = 64
    """Cells of the grid along each side of a cube around the object: the mesh's triangles are about as large."""
    mask_steps: int = 6
    """Gauss-Newton steps towards the masks; 0 leaves the visual hull."""
    smoothness: float = 1.0
    """Weight of the thin plate in the first steps towards the masks."""
    final_smoothness: float = 0.3
    """Weight of the thin plate in the last third of these steps."""
    carve: bool = True
    """Look for hollows that no outline shows, where colours disagree; kept where they explain the pictures better."""
    image_steps: int = 12
    """Gauss-Newton steps towards the pictures, with light and materials given."""
    image_weight: float = 1.0
    """Weight of a picture's squared error (display values) against that of the masks."""
    image_smoothness: float = 0.1
    """Weight of the thin plate in the steps towards the pictures."""
    stiffness: float = 0.3
    """Weight of the thin plate on a step towards the pictures, which keeps it smooth; it rises to 5 times as much."""
    spp: int = 8
    """Samples per pixel of the pictures that a step compares with; shading derivatives take twice as many."""
    depth: int = 4
    """Light bounces of these pictures and one: 2 is direct light."""
    seed: int = 0
    """Of all samples."""

    def __post_init__(self) -> None:
        counts = {"cells": 8, "mask_steps": 0, "image_steps": 0, "spp": 1, "depth": 2, "seed": 0}
        require_least(self, "shape", counts | {"stiffness": 0})
        weights = ("smoothness", "final_smoothness", "image_weight", "image_smoothness")
        require_least(self, "shape", dict.fromkeys(weights, 0), above=True)
        require_memory({f"--shape.cells {self.cells}": POINT_BYTES * (self.cells + 1) ** 3})
