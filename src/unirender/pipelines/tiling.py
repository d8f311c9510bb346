"""Tiles of a large picture: the network sees each at the picture's own resolution, and they are blended.

The network was taught whole objects. What needs the whole (light in every form, materials, the level of the other maps)
is therefore taken from its pass over the whole picture, and the tiles add only what that pass is too coarse to show:

    result = G + (B - down_up(B))

Notation: G a map of the whole picture, brought up to its size; B the tiles' maps, blended; down_up: to the network's
size and back, as G came. Where a map depends on the pixel alone, this is exact.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from unirender.camera import Camera
from unirender.intrinsics import Intrinsics
from unirender.pipelines.framing import Frame
from unirender.pipelines.masked_maps import unit_normal

TILED = ("albedo", "normal")  # not s and d: a crop shows too little of what is lit to say how (docs/pipeline.md)
TILES_AT_ONCE = 16

# premultiplied linear crops [t t 3], their masks [t t 1] and cameras -> for each crop the maps of each sample
Predict = Callable[[Sequence[np.ndarray], Sequence[np.ndarray], Sequence[Camera]], list[list[dict[str, np.ndarray]]]]


@dataclass(frozen=True)
class Tile:
    """A square of a picture.

    Attributes:
        top: first row.
        left: first column.
        size: pixels along each side; it may reach beyond a picture that is smaller.
    """

    top: int
    left: int
    size: int

    @property
    def slices(self) -> tuple[slice, slice]:
        """The part of the picture that it shows."""
        return slice(self.top, self.top + self.size), slice(self.left, self.left + self.size)

    def crop(self, picture: Float[np.ndarray, "h w c"]) -> Float[np.ndarray, "t t c"]:
        """The tile; 0 beyond the picture."""
        part = picture[self.slices]
        missing = [(0, self.size - part.shape[0]), (0, self.size - part.shape[1]), (0, 0)]
        return np.pad(part, missing)

    def camera(self, camera: Camera, height: int, width: int) -> Camera:
        """The camera of a picture of `height` x `width`, for the tile."""
        return camera.of_square(self.top, self.left, self.size, height, width)


def tiles(height: int, width: int, size: int) -> Iterator[Tile]:
    """Squares that cover a picture and overlap by half or more."""
    for top in _starts(height, size):
        for left in _starts(width, size):
            yield Tile(top, left, size)


def tiles_of(mask: Float[np.ndarray, "h w 1"], size: int) -> list[Tile]:
    """Those that show something of an object."""
    height, width = mask.shape[:2]
    return [tile for tile in tiles(height, width, size) if mask[tile.slices].any()]


def _starts(length: int, size: int) -> list[int]:
    count = 1 + max(0, math.ceil((length - size) / (size // 2)))
    return [round(i * (length - size) / (count - 1)) for i in range(count)] if count > 1 else [0]


def window(size: int) -> Float[np.ndarray, "t t 1"]:
    """Weights of a tile's pixels in the blend: sin^2, near 0 along its border, where it knows least around it."""
    ramp = np.sin(np.pi * (np.arange(size) + 0.5) / size) ** 2
    return (ramp[:, None] * ramp)[..., None].astype(np.float32)


def blend_tiles(
    image_linear: Float[np.ndarray, "h w 3"],
    mask: Float[np.ndarray, "h w 1"],
    camera: Camera,
    size: int,
    predict: Predict,
) -> list[dict[str, np.ndarray]]:
    """The maps of `TILED` at the picture's own resolution, not multiplied by the mask; for each sample.

    Tiles without any of the object are left out; their pixels are 0.

    Args:
        image_linear: premultiplied, linear.
        mask: coverage.
        camera: of the picture.
        size: of the tiles, pixels.
        predict: the network.
    """
    height, width = mask.shape[:2]
    seen = tiles_of(mask, size)
    weight, total = window(size), np.zeros_like(mask)
    sums: list[dict[str, np.ndarray]] = []
    for first in range(0, len(seen), TILES_AT_ONCE):
        batch = seen[first : first + TILES_AT_ONCE]
        found = predict(
            [tile.crop(image_linear) for tile in batch],
            [tile.crop(mask) for tile in batch],
            [tile.camera(camera, height, width) for tile in batch],
        )
        for tile, samples in zip(batch, found, strict=True):
            rows, columns = min(size, height - tile.top), min(size, width - tile.left)
            inside = weight[:rows, :columns]
            total[tile.slices] += inside
            sums = sums or [{name: np.zeros((height, width, 3), np.float32) for name in TILED} for _ in samples]
            for into, maps in zip(sums, samples, strict=True):
                for name, value in into.items():
                    value[tile.slices] += inside * maps[name][:rows, :columns]
    total[total == 0] = 1
    for maps in sums:
        for value in maps.values():
            value /= total
    return sums


def add_detail(whole: Intrinsics, blended: dict[str, np.ndarray], frame: Frame) -> Intrinsics:
    """The maps of the whole picture with the detail of the tiles.

    Args:
        whole: at the picture's size, with the maps of `TILED` and a mask; its other maps stay as they are.
        blended: what `blend_tiles` gave.
        frame: how the whole picture came into the network.
    """
    mask = whole.require("mask")["mask"]
    changed = {}
    for name, value in whole.require(*TILED).items():
        fine = np.where(frame.seen(mask) > 0, unit_normal(blended[name]) if name == "normal" else blended[name], 0)
        changed[name] = np.where(mask > 0, value + fine - frame.leave_map(frame.enter_map(fine, mask), mask), 0)
    changed["normal"] = unit_normal(changed["normal"])
    changed["albedo"] = np.clip(changed["albedo"], 0, 1)
    return whole.replace(**changed)
