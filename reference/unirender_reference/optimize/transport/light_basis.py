"""What the columns of the transport matrices stand for: two readings of a grid of light.

`Cells`: radiance is constant within each cell of `LightGrid`. `Texels`: radiance is that of Mitsuba's `envmap`,
bilinear between texels. Under a given map of 8 x 16 texels, `Texels` are within 5 % of Mitsuba's image and `Cells` 7 to
25 % off; a light that is itself solved for explains pictures as well by either, and with `Cells` the matrices are made
in about a third of the time. One picture, whose light may be a prediction, has `Texels`; several views have `Cells`.

Either has directions that cover the sphere (one in each of `count` cells of its own), which the matrices are integrated
over, and says which columns the light of any other direction belongs to. Directions are Dr.Jit arrays in world axes.
"""

from collections.abc import Sequence
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Float

from unirender.light.resampling import hat_weights
from unirender_reference.backend import mitsuba
from unirender_reference.optimize.transport.light_grid import LightGrid

FINE = (32, 64)  # directions of `Texels`: midpoints of equal steps in theta and phi


class Cells:
    """Constant radiance in each cell of a grid.

    Attributes:
        count: cells that cover the sphere, with a direction each: here the grid's own.
    """

    def __init__(self, grid: LightGrid) -> None:
        self.count = grid.count
        self._grid = grid

    def direction(self, cell: Any, u: Any, v: Any) -> Any:
        """A direction in the cell of each index, for (u, v) in [0, 1]^2."""
        return self._grid.direction(cell, u, v)

    def solid_angle(self, cell: Any) -> Any:
        """Of the cells, in steradian."""
        import drjit as dr

        mi = mitsuba()
        rows = mi.Float(self._grid.solid_angles.astype(np.float32))
        return dr.gather(mi.Float, rows, cell // self._grid.columns)

    def cell_of(self, direction: Any) -> Any:
        """Index of the cell that a direction lies in."""
        return self._grid.cell_of(direction)

    def columns(self, values: Float[np.ndarray, "n cells"]) -> Float[np.ndarray, "n j"]:
        """Integrals over the cells as integrals over the columns of the light."""
        return values

    def shares(self, direction: Any) -> Sequence[tuple[Any, Any]]:
        """The columns that the light of a direction belongs to: index and weight."""
        return [(self.cell_of(direction), 1.0)]


class Texels:
    """Radiance bilinear between the texels of a grid, as `light.environment` has them; methods as those of `Cells`.

    Attributes:
        count: cells that cover the sphere: `FINE`, finer than the grid.
    """

    def __init__(self, grid: LightGrid) -> None:
        self.count = FINE[0] * FINE[1]
        self._rows, self._columns = grid.rows, grid.columns

    def direction(self, cell: Any, u: Any, v: Any) -> Any:
        """The cell's middle, whatever u and v."""
        import drjit as dr

        mi = mitsuba()
        theta = (mi.Float(cell // FINE[1]) + 0.5) * (dr.pi / FINE[0])
        phi = (mi.Float(cell % FINE[1]) + 0.5) * (dr.two_pi / FINE[1])
        return mi.Vector3f(dr.sin(theta) * dr.sin(phi), dr.cos(theta), -dr.sin(theta) * dr.cos(phi))

    def solid_angle(self, cell: Any) -> Any:
        import drjit as dr

        edge = mitsuba().Float(cell // FINE[1]) * (dr.pi / FINE[0])
        return (dr.cos(edge) - dr.cos(edge + dr.pi / FINE[0])) * (dr.two_pi / FINE[1])

    def cell_of(self, direction: Any) -> Any:
        """One of the right row: cells of a row are alike."""
        import drjit as dr

        mi = mitsuba()
        row = dr.minimum(mi.UInt32(dr.safe_acos(direction.y) / dr.pi * FINE[0]), FINE[0] - 1)
        return row * FINE[1]

    def columns(self, values: Float[np.ndarray, "n cells"]) -> Float[np.ndarray, "n j"]:
        return (self._hats.T @ values.T).T

    def shares(self, direction: Any) -> Sequence[tuple[Any, Any]]:
        import drjit as dr

        mi = mitsuba()
        row = dr.safe_acos(direction.y) / dr.pi * (self._rows - 1)
        column = dr.atan2(direction.x, -direction.z) / dr.two_pi * self._columns - 0.5
        top, left = dr.clip(dr.floor(row), 0, self._rows - 2), dr.floor(column)
        found = []
        for down in (0, 1):
            for right in (0, 1):
                x = mi.UInt32(left + (right + self._columns)) % self._columns
                weight = (1 - dr.abs(row - top - down)) * (1 - dr.abs(column - left - right))
                found.append(((mi.UInt32(top) + down) * self._columns + x, weight))
        return found

    @cached_property
    def _hats(self) -> Any:
        """(cells, j): what the texels count in each cell's direction."""
        import scipy.sparse as sp

        theta = (np.arange(FINE[0]) + 0.5) / FINE[0] * (self._rows - 1)
        phi = (np.arange(FINE[1]) + 0.5) / FINE[1] * self._columns - 0.5
        rows, columns = hat_weights(theta, self._rows), hat_weights(phi, self._columns, wrap=True)
        return sp.csr_array(sp.kron(rows, columns)).astype(np.float32)


LightBasis = Cells | Texels
