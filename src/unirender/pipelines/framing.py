"""Any picture size <-> the model's square: cut out a small object, surround a large one or pad, resample; and back.

Pictures are resampled premultiplied and in linear light, so that no background bleeds in. A picture that has the
model's size passes through untouched, unless its object fills it. The square of a large or elongated picture, whose
padding may be many times the picture, is never there as a whole: along rows and along columns it is resampled in
strips, to the same bytes.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from scipy.ndimage import label

from unirender.blocks import by_rows, row_blocks
from unirender.camera import Camera
from unirender.intrinsics import Intrinsics
from unirender.light.resampling import resample_environment
from unirender.pipelines.masked_maps import divide, unit_normal

SMALL = 2 / 3  # an object whose square has at most this share of the picture's side is cut out
LARGE = 0.95  # share of the picture's side, from which an object gets a margin: it is then cut off, or nearly
FILL = 0.8  # of a square that is cut out; objects of the training data fill 0.7 to 0.9 of theirs
LEAST_CUT = 8  # pixels along the side of a square that is cut out
FAINT = 0.05  # coverage up to which nothing counts when an object is cut out: haze of a matte
STRAY = 0.001  # of what counts: parts of the mask that together hold less are not looked for
THUMBNAIL_SIDE = 32  # pixels

Maps = Mapping[str, Float[np.ndarray, "_ _ c"]]  # of several numbers of channels


@dataclass(frozen=True)
class Frame:
    """How a picture of `height` x `width` sits in the model's square.

    Attributes:
        height: of the picture, pixels.
        width: of the picture, pixels.
        size: of the model's square, pixels.
        cut: top, left and side of the square of the picture that is seen, in its pixels; it may stick out of the
            picture. None: the smallest one that holds the picture, which is in its middle.
    """

    height: int
    width: int
    size: int
    cut: tuple[int, int, int] | None = None

    @classmethod
    def around(cls, mask: Float[np.ndarray, "h w 1"], size: int) -> "Frame":
        """The whole picture, the square around its object where that is small, or more than it where that is large.

        A network sees objects that fill most of the frame; of one that does not, most pixels would be lost on the
        background, and objects without any background it has never seen: from `LARGE` on a margin grows, until an
        object as long as the picture fills `FILL` of the square. What is left out of the square has no surface: haze of
        a matte, and stray pixels away from the object that hold hardly any of the coverage (`visible_parts`).

        Args:
            mask: coverage.
            size: of the model's square, pixels.
        """
        height, width = mask.shape[:2]
        whole = cls(height, width, size)
        visible = np.where(mask > FAINT, mask, 0)
        if not visible.any():
            return whole
        extent = least_extent(visible)
        if extent > LARGE * whole.side:
            beyond = (extent / whole.side - LARGE) / (1 - LARGE)
            side = math.ceil(whole.side * (1 + beyond * (1 / FILL - 1)))
            return cls(height, width, size, ((height - side) // 2, (width - side) // 2, side))
        if whole.identity or extent > FILL * SMALL * whole.side:  # saves large pictures time
            return whole
        first_row, end_row, first_column, end_column = _box(visible[..., 0] > 0)
        seen = visible_parts(visible[first_row:end_row, first_column:end_column])
        top, bottom, left, right = np.add(_box(seen), (first_row, first_row, first_column, first_column)).tolist()
        side = max(math.ceil(max(bottom - top, right - left) / FILL), LEAST_CUT)
        if side > SMALL * whole.side:
            return whole
        return cls(height, width, size, ((top + bottom - side) // 2, (left + right - side) // 2, side))

    @classmethod
    def reduced(cls, mask: Float[np.ndarray, "h w 1"], most: int) -> "Frame":
        """The same for what is computed of maps: without a margin, which only a network needs, and with a square of at
        most `most` pixels a side; what is smaller is not enlarged."""
        frame = cls.around(mask, most)
        if frame.side > max(frame.height, frame.width):
            frame = replace(frame, cut=None)
        return replace(frame, size=min(most, frame.side))

    def seen(self, mask: Float[np.ndarray, "h w 1"]) -> Float[np.ndarray, "h w 1"]:
        """The coverage, and 0 outside the square."""
        if self.cut is None:
            return mask
        inside = self._slices()[0]
        seen = np.zeros_like(mask)
        seen[inside] = mask[inside]
        return seen

    @property
    def identity(self) -> bool:
        """Whether the picture is the square, which then passes through untouched."""
        return self.cut is None and self.height == self.width == self.size

    @property
    def side(self) -> int:
        """Side of the square that is seen, picture pixels."""
        return max(self.height, self.width) if self.cut is None else self.cut[2]

    @property
    def shown(self) -> int:
        """Pixels of the picture along the longer side of what is seen of it."""
        return min(self.side, max(self.height, self.width))

    @property
    def corner(self) -> tuple[int, int]:
        """Row and column of the picture where the square begins; negative where it is padded."""
        if self.cut is None:
            return -((self.side - self.height) // 2), -((self.side - self.width) // 2)
        return self.cut[:2]

    def camera(self, camera: Camera) -> Camera:
        """The same camera for the square."""
        return camera.of_square(*self.corner, self.side, self.height, self.width)

    def enter(
        self, picture: Float[np.ndarray, "h w c"], mask: Float[np.ndarray, "h w 1"] | None = None
    ) -> Float[np.ndarray, "s s c"]:
        """Picture -> square; for premultiplied pictures and coverage, and for others with the mask to multiply by."""
        if self.identity:
            return picture if mask is None else picture * mask
        seen, (there_rows, there_columns) = self._slices()
        part, weight = picture[seen], None if mask is None else mask[seen]
        narrow = np.zeros((self.side, self.size, picture.shape[-1]), np.float32)  # the square, resampled along its rows
        inside = narrow[there_rows]
        for rows in row_blocks(len(part), self.side):
            strip = np.zeros((rows.stop - rows.start, self.side, picture.shape[-1]), np.float32)
            strip[:, there_columns] = part[rows] if weight is None else part[rows] * weight[rows]
            inside[rows] = resize(strip, (len(strip), self.size))
        return resize(narrow, (self.size, self.size))

    def leave(self, picture: Float[np.ndarray, "s s c"]) -> Float[np.ndarray, "h w c"]:
        """Square -> picture; for premultiplied pictures and coverage. 0 outside the square."""
        if self.identity:
            return picture
        seen, (there_rows, there_columns) = self._slices()
        whole = np.zeros((self.height, self.width, picture.shape[-1]), np.float32)
        wide, inside = resize(picture, (self.size, self.side))[:, there_columns], whole[seen]
        for columns in row_blocks(wide.shape[1], self.side):
            strip = wide[:, columns]
            inside[:, columns] = resize(strip, (self.side, strip.shape[1]))[there_rows]
        return whole

    def _slices(self) -> tuple[tuple[slice, slice], tuple[slice, slice]]:
        """The part of the picture that the square shows, and where in the square that is."""
        spans = [
            (max(first, 0), min(first + self.side, length), first)
            for first, length in zip(self.corner, (self.height, self.width), strict=True)
        ]
        rows, columns = (slice(begin, end) for begin, end, _ in spans)
        there_rows, there_columns = (slice(begin - first, end - first) for begin, end, first in spans)
        return (rows, columns), (there_rows, there_columns)

    def enter_map(
        self, value: Float[np.ndarray, "h w c"], mask: Float[np.ndarray, "h w 1"]
    ) -> Float[np.ndarray, "s s c"]:
        """A map that is not premultiplied -> square: coverage-weighted mean, 0 without coverage."""
        return self.enter_maps({"map": value}, mask)["map"]

    def enter_maps(self, maps: Maps, mask: Float[np.ndarray, "h w 1"]) -> Maps:
        """Several of them, by name; the coverage enters once."""
        if self.identity:
            return maps
        inside = self.enter(mask)
        return {name: divide(self.enter(value, mask), inside) for name, value in maps.items()}

    def leave_map(
        self, value: Float[np.ndarray, "s s c"], mask: Float[np.ndarray, "h w 1"]
    ) -> Float[np.ndarray, "h w c"]:
        """A map that is not premultiplied -> picture; 0 where the picture's mask is 0."""
        return self.leave_maps({"map": value}, mask)["map"]

    def leave_maps(self, maps: Maps, mask: Float[np.ndarray, "h w 1"]) -> Maps:
        """Several of them, by name; the coverage enters and leaves once."""
        if self.identity:
            return {name: _covered(value, mask) for name, value in maps.items()}
        inside = self.enter(mask)
        back = self.leave(inside)
        return {name: by_rows(_left, self.leave(value * inside), back, mask) for name, value in maps.items()}

    def enter_intrinsics(self, intrinsics: Intrinsics, environment_size: tuple[int, int] | None = None) -> Intrinsics:
        """All maps and the camera -> square; the mask has to be known.

        Args:
            intrinsics: at the picture's size.
            environment_size: rows and columns that the environment gets; None: it stays as it is.
        """
        mask = intrinsics.require("mask")["mask"]
        maps = {name: value for name, value in intrinsics.maps.items() if name not in ("mask", "environment")}
        changes = dict(self.enter_maps(maps, mask))
        if "normal" in changes:
            changes["normal"] = unit_normal(changes["normal"])
        environment = intrinsics.environment
        if environment is not None and environment_size and environment.shape[:2] != environment_size:
            environment = resample_environment(environment, environment_size)
        mask, camera = np.clip(self.enter(mask), 0, 1), self.camera(intrinsics.camera)
        return Intrinsics(mask=mask, environment=environment, camera=camera).replace(**changes)


def _covered(value: Float[np.ndarray, "h w c"], mask: Float[np.ndarray, "h w 1"]) -> Float[np.ndarray, "h w c"]:
    """A map, and 0 where the mask is 0."""
    return np.where(mask > 0, value, 0).astype(np.float32)


def _left(
    premultiplied: Float[np.ndarray, "h w c"], back: Float[np.ndarray, "h w 1"], mask: Float[np.ndarray, "h w 1"]
) -> Float[np.ndarray, "h w c"]:
    """A map that came back beside its coverage, and 0 where the picture's mask is 0."""
    return _covered(divide(premultiplied, back), mask)


def resize(picture: Float[np.ndarray, "h w c"], size: tuple[int, int]) -> Float[np.ndarray, "h2 w2 c"]:
    """Bilinear, with an antialiasing support where it shrinks."""
    if picture.shape[1] == 1:  # of one column alone torch repeats the first value
        return resize(np.repeat(picture, 2, axis=1), (size[0], max(size[1], 2)))[:, : size[1]]
    tensor = torch.from_numpy(np.ascontiguousarray(picture, dtype=np.float32)).permute(2, 0, 1)[None]
    return F.interpolate(tensor, size=size, mode="bilinear", antialias=True)[0].permute(1, 2, 0).numpy()


def _box(seen: Bool[np.ndarray, "h w"]) -> tuple[int, int, int, int]:
    """First row, end row, first column and end column of what is seen, which is something."""
    rows, columns = (np.flatnonzero(seen.any(axis=axis)) for axis in (1, 0))
    return int(rows[0]), int(rows[-1]) + 1, int(columns[0]), int(columns[-1]) + 1


def least_extent(visible: Float[np.ndarray, "h w 1"]) -> int:
    """Longer side of a box, pixels, that no box is smaller than that leaves out less than `STRAY` of the coverage."""
    sides = []
    for axis in (1, 0):
        sums = np.cumsum(visible[..., 0].sum(axis=axis, dtype=np.float64))
        first, last = np.searchsorted(sums, (STRAY * sums[-1], (1 - STRAY) * sums[-1]))
        sides.append(int(last - first) + 1)
    return max(sides)


def visible_parts(visible: Float[np.ndarray, "h w 1"]) -> Bool[np.ndarray, "h w"]:
    """Where the object is: all that is covered, but for the least parts that together hold less than `STRAY` of it.

    Args:
        visible: coverage, 0 where it does not count. Pixels that touch, also at a corner, are one part.
    """
    parts = np.zeros(visible.shape[:2], np.int32)
    label(visible[..., 0] > 0, structure=np.ones((3, 3)), output=parts)
    count = int(parts.max())
    coverage = np.bincount(parts.ravel(), weights=visible.ravel(), minlength=count + 1)
    order = np.argsort(coverage[1:]) + 1
    kept = np.arange(count + 1) > 0  # 0 is what is not covered
    kept[order[np.cumsum(coverage[order]) < STRAY * coverage.sum()]] = False
    return kept[parts]


def thumbnail(picture: Float[np.ndarray, "h w 3"], mask: Float[np.ndarray, "h w 1"]) -> Float[np.ndarray, "th tw 3"]:
    """The display values of what is covered, at most `THUMBNAIL_SIDE` pixels a side."""
    height, width = (min(length, THUMBNAIL_SIDE) for length in mask.shape[:2])
    return resize(picture * mask, (height, width))
