"""Adam on a pyramid: every level of a map moves by its own moments.

A gradient g of a map (h, w) is brought to coarser grids by the transposes of bilinear interpolation, U_k^T g; Adam
turns each into a step, and the map moves by the sum of U_k step_k. A coarse level sees the mean of many texels: it is
less noisy, and moves what neighbours have in common as fast as Adam moves one texel. With one level this is Adam
(Kingma and Ba 2015).
"""

from collections.abc import Sequence
from functools import lru_cache

import numpy as np
from jaxtyping import Float

FACTOR = 4  # between the sides of successive levels
BETA_1, EPSILON = 0.9, 1e-12

Map = Float[np.ndarray, "h w c"]
Moments = tuple[Float[np.ndarray, "..."], Float[np.ndarray, "..."]]


class PyramidAdam:
    """The moments of one map.

    Args:
        shape: (h, w, c) of the map.
        levels: how many grids, the map's own among them.
        circular: whether columns close to a circle.
        uniform: one second moment for all texels of a level: Adam's step then keeps the gradient's proportions, and
            texels that no picture shows well do not move as far as those that it does.
        beta_2: what is kept of the second moment in a step.
    """

    def __init__(
        self,
        shape: tuple[int, int, int],
        levels: int = 1,
        circular: bool = False,
        uniform: bool = False,
        beta_2: float = 0.99,
    ):
        self.uniform, self.beta_2, self.count = uniform, beta_2, 0
        height, width, channels = shape
        self._up: list[tuple[np.ndarray, np.ndarray] | None] = [None]
        sizes = [(height, width)]
        for _ in range(1, levels):
            size = (max(1, sizes[-1][0] // FACTOR), max(1, sizes[-1][1] // FACTOR))
            if size != sizes[-1]:
                sizes.append(size)
                rows = interpolation(height, size[0], circular=False)
                columns = interpolation(width, size[1], circular=circular)
                self._up.append((rows, columns))
        self.moments: list[Moments] = [(np.zeros((*s, channels)), np.zeros((*s, channels))) for s in sizes]

    def step(self, gradient: Map, rate: float) -> Map:
        """How far to move for a gradient, of the map's shape; moments are updated."""
        self.count += 1
        total = np.zeros_like(gradient)
        for level, up in enumerate(self._up):
            own = gradient if up is None else np.einsum("hi,hwc,wj->ijc", up[0], gradient, up[1], optimize=True)
            first, second = self.moments[level]
            first = BETA_1 * first + (1 - BETA_1) * own
            second = self.beta_2 * second + (1 - self.beta_2) * own**2
            self.moments[level] = first, second
            scale = second / (1 - self.beta_2**self.count)
            if self.uniform:
                scale = scale.mean(where=second > 0) if second.any() else 1.0
            move = -rate * first / (1 - BETA_1**self.count) / (np.sqrt(scale) + EPSILON)
            total += move if up is None else np.einsum("hi,ijc,wj->hwc", up[0], move, up[1], optimize=True)
        return total.astype(np.float32)

    def arrays(self) -> list[Float[np.ndarray, "..."]]:
        """The moments as a flat list, for a file."""
        return [array for pair in self.moments for array in pair]

    def restore(self, arrays: Sequence[Float[np.ndarray, "..."]], count: int) -> None:
        """Takes back what `arrays` gave."""
        self.moments = list(zip(arrays[::2], arrays[1::2], strict=True))
        self.count = count


@lru_cache(maxsize=64)
def interpolation(fine: int, coarse: int, *, circular: bool) -> Float[np.ndarray, "fine coarse"]:
    """The matrix of linear interpolation from `coarse` to `fine` texels of the same side; rows sum to 1."""
    place = (np.arange(fine) + 0.5) * coarse / fine - 0.5
    low = np.floor(place).astype(int)
    share = place - low
    matrix = np.zeros((fine, coarse))
    for index, weight in ((low, 1 - share), (low + 1, share)):
        index = index % coarse if circular else np.clip(index, 0, coarse - 1)
        np.add.at(matrix, (np.arange(fine), index), weight)
    return matrix
