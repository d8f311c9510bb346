"""How a unit vector varies inside a pixel, from the pixels around it.

A map holds the mean over each pixel. Between the centres of pixels it is taken to be bilinear, and the values at the
centres are chosen so that the means come out as the map has them: the middle of a rounded edge that is a pixel wide is
sharper than the mean of its pixel. A neighbour that is not there (background, the end of the frame) or is of another
surface is replaced by the continuation of the pixel's own.

Notation: the *surroundings* of a pixel are the values at its own centre and those of its eight neighbours, row by row.
Arrays have the component of a vector first.
"""

from collections.abc import Iterator

import numpy as np
from jaxtyping import Bool, Float

EDGE = 1.0  # distance of two unit vectors, 60 degrees: neighbours that differ by more are of different surfaces
CONCAVE_EDGE = 0.5  # the same where they turn to each other: where one surface hides another they mostly do
REFINEMENTS = 2  # of the values at the centres; more double the noise of predicted normals
MEAN_WEIGHTS = np.outer([1 / 8, 3 / 4, 1 / 8], [1 / 8, 3 / 4, 1 / 8]).ravel().astype(np.float32)  # of the surroundings
MIRRORED = (2, 1, 0, 5, 4, 3, 8, 7, 6)  # the surroundings with left and right exchanged
_OFFSETS = tuple((y, x) for y in (-1, 0, 1) for x in (-1, 0, 1))
_CHUNK = 1 << 15  # pixels at a time


class Surroundings:
    """The surroundings of pixels of a map, in the order of its rows."""

    def __init__(
        self,
        normal: Float[np.ndarray, "h w 3"],
        there: Bool[np.ndarray, "h w"],
        wanted: Bool[np.ndarray, "h w"] | None = None,
    ) -> None:
        """Refines the values at the centres.

        Args:
            normal: camera axes, unit where there is a surface.
            there: where that is.
            wanted: pixels whose surroundings are asked for, all there if None.
        """
        padded, padded_there = np.pad(normal, ((1, 1), (1, 1), (0, 0))), np.pad(there, 1)
        self._centres = np.moveaxis(padded, -1, 0).astype(np.float32)
        wanted = there if wanted is None else wanted & there
        # refining looks one pixel further each time
        self._select(_widened(wanted, REFINEMENTS) & there, padded, padded_there)
        mean = self._centres[:, self._rows + 1, self._columns + 1]
        for _ in range(REFINEMENTS):
            found = np.empty_like(mean)
            for part in self.parts():
                found[:, part] = self.of(part) @ MEAN_WEIGHTS
            found /= np.maximum(np.linalg.norm(found, axis=0), np.float32(1e-6))
            self._centres[:, self._rows + 1, self._columns + 1] += mean - found
        self._select(wanted, padded, padded_there)

    def _select(self, pixels: Bool[np.ndarray, "h w"], padded: np.ndarray, there: Bool[np.ndarray, "h2 w2"]) -> None:
        """Sets the pixels that are spoken of, and which of their neighbours are of the same surface."""
        self._rows, self._columns = np.nonzero(pixels)
        self._same = np.empty((len(self._rows), 9), dtype=np.bool_)
        mean = padded[self._rows + 1, self._columns + 1].T
        for i, (y, x) in enumerate(_OFFSETS):
            at = self._rows + 1 + y, self._columns + 1 + x
            step = padded[at].T - mean
            bound = np.where(x * step[0] - y * step[1] > 0, EDGE, CONCAVE_EDGE)
            self._same[:, i] = there[at] & (np.sum(np.square(step), axis=0) <= np.square(bound))

    def parts(self) -> Iterator[slice]:
        """The pixels, some at a time."""
        return (slice(i, i + _CHUNK) for i in range(0, len(self._rows), _CHUNK))

    def of(self, part: slice) -> Float[np.ndarray, "3 p 9"]:
        """Surroundings of some of the pixels: of about unit length."""
        around = gather(self._centres, self._rows[part], self._columns[part])
        same = self._same[part]
        grid, known = around.reshape(3, -1, 3, 3), same.reshape(-1, 3, 3)
        middle = around[..., 4]
        sides = {at: around[..., at] for at in (1, 3, 5, 7)}
        for at, value in sides.items():
            continued = 2 * middle - np.where(same[:, 8 - at], sides[8 - at], middle)
            around[..., at] = np.where(same[:, at], value, continued)
        for y in (0, 2):
            for x in (0, 2):
                continued = grid[..., y, 1] + grid[..., 1, x] - middle
                grid[..., y, x] = np.where(known[:, y, x], grid[..., y, x], continued)
        return around

    def of_smooth(self, vectors: Float[np.ndarray, "h w 3"], part: slice) -> Float[np.ndarray, "3 p 9"]:
        """The same pixels' surroundings in a map without edges, such as the view directions."""
        padded = np.pad(vectors, ((1, 1), (1, 1), (0, 0)), mode="reflect", reflect_type="odd")
        return gather(np.moveaxis(padded, -1, 0), self._rows[part], self._columns[part])


def _widened(pixels: Bool[np.ndarray, "h w"], steps: int) -> Bool[np.ndarray, "h w"]:
    """The pixels and those up to so many steps away, also diagonally."""
    for _ in range(steps):
        padded = np.pad(pixels, 1)
        rows = padded[:-2] | padded[1:-1] | padded[2:]
        pixels = rows[:, :-2] | rows[:, 1:-1] | rows[:, 2:]
    return pixels


def gather(padded: Float[np.ndarray, "3 h2 w2"], rows: np.ndarray, columns: np.ndarray) -> Float[np.ndarray, "3 p 9"]:
    """The 3 x 3 values around each pixel of a map that is padded by one."""
    return np.stack([padded[:, rows + 1 + y, columns + 1 + x] for y, x in _OFFSETS], axis=-1)


def inside(
    around: Float[np.ndarray, "c p 9"], x: Float[np.ndarray, " s"], y: Float[np.ndarray, " s"]
) -> Float[np.ndarray, "c p s"]:
    """Values at points of each pixel; x and y in [-1/2, 1/2] of its width and height, y down."""
    along_y, along_x = (np.stack([np.maximum(-t, 0), 1 - np.abs(t), np.maximum(t, 0)]) for t in (y, x))
    weights = (along_y[:, None] * along_x[None]).reshape(9, -1)
    return around @ weights.astype(np.float32)
