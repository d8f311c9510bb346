"""One picture prepared for optimisation: its covered pixels, averaged to a size that the solver can afford."""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from unirender.camera import Camera
from unirender.color import image_srgb, srgb_encode, unpremultiply
from unirender.pictures import DISPLAY_WHITE
from unirender_reference.optimize.numerics.differences import side_by_side
from unirender_reference.optimize.surface.points import blocker, mapped_points, picture_points
from unirender_reference.optimize.transport.light_grid import LightGrid
from unirender_reference.optimize.transport.matrices import Transport, light_transport
from unirender_reference.shapes import MeshObject

POINTS = 4  # of a pixel on a known mesh


@dataclass(frozen=True)
class PicturePixels:
    """The n pixels of a (shrunk) picture that show the object.

    Attributes:
        transport: of its pixels, coverage included; the light is bilinear between texels.
        pixel: (n,) flat indices of the pixels in the shrunk picture.
        size: rows and columns of the shrunk picture.
        block: pixels of the picture along a side of a shrunk pixel.
        normal: (n, 3) mean of the pixel's shading normals, unit.
        coverage: (n, 1).
        radiance: (n, 3) linear, premultiplied.
        display: (n, 3) straight display values; above 1 where a linear picture is.
        saturated: (n, 3) whether the radiance is only a lower bound.
        maps: start values by name, (n, c).
        pairs: (2, k) neighbours.
    """

    transport: Transport
    pixel: Int[np.ndarray, " n"]
    size: tuple[int, int]
    block: int
    normal: Float[np.ndarray, "n 3"]
    coverage: Float[np.ndarray, "n 1"]
    radiance: Float[np.ndarray, "n 3"]
    display: Float[np.ndarray, "n 3"]
    saturated: np.ndarray
    maps: Mapping[str, Float[np.ndarray, "n _"]]
    pairs: Int[np.ndarray, "2 k"]

    def frame(self, values: Float[np.ndarray, "n c"]) -> Float[np.ndarray, "h w c"]:
        """Values of the pixels on their places in the shrunk picture, 0 elsewhere."""
        out = np.zeros((self.size[0] * self.size[1], values.shape[1]), np.float64)
        out[self.pixel] = values
        return out.reshape(*self.size, values.shape[1])


def make_picture(
    image_linear: Float[np.ndarray, "h w 3"],
    mask: Float[np.ndarray, "h w 1"],
    camera: Camera,
    maps: Mapping[str, Float[np.ndarray, "h w _"]],
    geometry: MeshObject | None,
    pixels: int,
    light_shape: tuple[int, int],
    hdr: bool,
    seed: int,
    clipped: Bool[np.ndarray, "h w 3"] | None = None,
) -> PicturePixels:
    """Shrinks a picture by whole blocks until at most about `pixels` covered ones are left, and traces their transport.

    Args:
        image_linear: premultiplied.
        mask: coverage.
        camera: of the picture.
        maps: straight start values: `normal` (used where no geometry is given), albedo, roughness, metallic.
        geometry: the object itself, or None.
        pixels: covered ones, at most (blocks are squares of whole pixels).
        light_shape: rows and columns of the light.
        hdr: no value is clipped.
        seed: of the points' places.
        clipped: where a value is only a lower bound; None: where its display value is 1, and nowhere if `hdr`.
    """
    height, width = mask.shape[:2]
    block = max(1, math.ceil(math.sqrt((mask > 0).sum() / pixels) - 0.05))
    coverage = shrink(mask, block)
    radiance = shrink(image_linear, block)
    small = {name: unpremultiply(shrink(values * mask, block), coverage) for name, values in maps.items()}
    if geometry is not None:
        scene = blocker(geometry)
        points = picture_points(scene, coverage, camera, (height / block, width / block), POINTS, seed)
    else:
        scene, view = None, _unit(shrink(camera.view_directions(height, width) * (mask > 0), block))
        points = mapped_points(coverage, _unit(small["normal"]), view)
    size, pixel = coverage.shape[:2], points.pixel
    grid = LightGrid(*light_shape)
    transport = light_transport(scene, points, grid, seed, coverage.reshape(-1)[pixel], bilinear=True)

    def chosen(values: np.ndarray) -> np.ndarray:
        return values.reshape(-1, values.shape[-1])[pixel].astype(np.float64)

    display = srgb_encode(unpremultiply(radiance, coverage)).astype(np.float64)
    if clipped is None:
        clipped = np.zeros(image_linear.shape, bool) if hdr else _clipped(image_linear, mask)
    saturated = chosen(shrink(clipped.astype(np.float32), block)) > 0
    return PicturePixels(
        transport,
        pixel,
        size,
        block,
        _unit(points.normal.sum(axis=1)),
        chosen(coverage),
        chosen(radiance),
        chosen(display),
        saturated,
        {name: chosen(values) for name, values in small.items()},
        neighbours(pixel, size),
    )


def shrink(values: Float[np.ndarray, "h w c"], block: int) -> Float[np.ndarray, "h2 w2 c"]:
    """Means over blocks; blocks that stick out of the picture are filled with 0."""
    height, width, channels = values.shape
    rows, columns = -(-height // block), -(-width // block)
    padded = np.zeros((rows * block, columns * block, channels), np.float64)
    padded[:height, :width] = values
    return padded.reshape(rows, block, columns, block, channels).mean(axis=(1, 3)).astype(np.float32)


def neighbours(pixel: Int[np.ndarray, " n"], size: tuple[int, int]) -> Int[np.ndarray, "2 k"]:
    """Pairs of indices of pixels that lie side by side."""
    index = np.full(size[0] * size[1], -1)
    index[pixel] = np.arange(len(pixel))
    pairs = side_by_side(index.reshape(size))
    return pairs[:, (pairs >= 0).all(axis=0)]


def _clipped(image_linear: Float[np.ndarray, "h w 3"], mask: Float[np.ndarray, "h w 1"]) -> Bool[np.ndarray, "h w 3"]:
    """Where a channel's display value is at its end."""
    return (image_srgb(unpremultiply(image_linear, mask)) >= DISPLAY_WHITE) & (mask > 0)


def _unit(values: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3"]:
    return (values / np.maximum(np.linalg.norm(values, axis=-1, keepdims=True), 1e-9)).astype(np.float32)
