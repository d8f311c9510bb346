"""The pictures of one material as a tile of the atlas, with everything that a lookup needs around them.

Notation: a *tile* holds all channels over one area; its `uv` run over [0, 1] of that area. A texture that is
looked up outside [0, 1] is unrolled by its own wrap modes as far as the faces go, and one texel further on each side:
a bilinear lookup in the tile is then the same as one in the texture, and neighbours in the atlas cannot bleed in.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from unirender_reference.meshes.images import resized
from unirender_reference.meshes.limits import MAX_REPEATS
from unirender_reference.meshes.surface import Channel, Material, Texture, Wrap, unit_vectors

PERIOD: dict[Wrap, int] = {"repeat": 1, "mirror": 2}


@dataclass(frozen=True)
class Patch:
    """All faces of one material.

    Attributes:
        points: (m, 3, 3) corners in space.
        uv: (m, 3, 2) of each corner, by set; v from the first row.
        colors: (m, 3, 3) linear, or None.
        material: the channels.
    """

    points: Float[np.ndarray, "m 3 3"]
    uv: Mapping[int, Float[np.ndarray, "m 3 2"]]
    colors: Float[np.ndarray, "m 3 3"] | None
    material: Material

    @property
    def textures(self) -> dict[str, Texture]:
        """The channels that are pictures."""
        return {name: channel for name, channel in self.material.channels.items() if isinstance(channel, Texture)}

    def lookup(self, texture: Texture) -> Float[np.ndarray, "m 3 2"]:
        """Where the corners look into a picture, in its own coordinates."""
        return self.uv[texture.texcoord] @ texture.transform[:, :2].T + texture.transform[:, 2]


@dataclass(frozen=True)
class Tile:
    """Part of the atlas.

    Attributes:
        maps: the channels, each on a grid of its own over the same area; (1, 1, c) where a channel is constant.
        uv: (m, 3, 2) of the patch's corners, in [0, 1].
        averaged: whether a texture was replaced by its mean.
    """

    maps: Mapping[str, Float[np.ndarray, "h w c"]]
    uv: Float[np.ndarray, "m 3 2"]
    averaged: bool = False

    @property
    def size(self) -> tuple[int, int]:
        """Height and width in texels of the finest channel."""
        height, width = np.max([texels.shape[:2] for texels in self.maps.values()], axis=0)
        return int(height), int(width)


def constant_tile(channels: Mapping[str, Channel], count: int, averaged: bool = False) -> Tile:
    """One texel: every channel is one value, a picture counts as its mean."""
    maps = {}
    for name, channel in channels.items():
        value = channel.texels.mean((0, 1)) if isinstance(channel, Texture) else channel
        maps[name] = value.reshape(1, 1, -1).astype(np.float32)
        if name == "normal":
            maps[name] = unit_vectors(maps[name], 1.0)
    return Tile(maps, np.full((count, 3, 2), 0.5), averaged)


def unrolled_tile(patch: Patch, side: int) -> Tile:
    """The tile of a patch whose pictures all share one lookup.

    Args:
        patch: with one picture at least.
        side: largest side of the tile in texels.
    """
    textures = patch.textures
    first = next(iter(textures.values()))
    uv = _near_origin(patch.lookup(first), first.wrap)
    low, high = uv.min((0, 1)), uv.max((0, 1))
    if (high - low).max() > MAX_REPEATS:
        return constant_tile(patch.material.channels, len(uv), averaged=True)
    shape = np.max([texture.texels.shape[:2] for texture in textures.values()], axis=0)
    finest = np.maximum(np.minimum(shape, np.floor(side / np.maximum((high - low)[::-1], 1))), 1).astype(int)
    shrunk = {name: _at_most(texture.texels, *finest.tolist()) for name, texture in textures.items()}
    sizes = np.array([texels.shape[:2] for texels in shrunk.values()])
    lattice = sizes.min(0) if not (sizes % sizes.min(0)).any() else finest  # texels of the coarsest picture
    start = np.floor(low[::-1] * lattice + 1e-3).astype(int) - 1  # along v, u
    stop = np.maximum(np.ceil(high[::-1] * lattice - 1e-3).astype(int) + 1, start + 3)
    maps = {}
    for name, channel in patch.material.channels.items():
        if not isinstance(channel, Texture):
            maps[name] = channel.reshape(1, 1, -1).astype(np.float32)
            continue
        texels = shrunk[name]
        ratio = np.maximum(np.array(texels.shape[:2]) // lattice, 1)
        for axis in (0, 1):
            index = np.arange(start[axis] * ratio[axis], stop[axis] * ratio[axis])
            texels = along(texels, (index + 0.5) / (lattice[axis] * ratio[axis]), axis, first.wrap[1 - axis])
        maps[name] = unit_vectors(texels, 1.0) if name == "normal" else texels
    return Tile(maps, np.clip((uv * lattice[::-1] - start[::-1]) / (stop - start)[::-1], 0, 1))


def along(
    texels: Float[np.ndarray, "h w c"], position: Float[np.ndarray, " n"], axis: int, wrap: Wrap
) -> Float[np.ndarray, "i j c"]:
    """Linear interpolation along one axis of a picture; at texel centres the texels themselves.

    Args:
        texels: the picture.
        position: in units of the picture's side; texel i has its centre at (i + 0.5) / n.
        axis: 0 for rows, 1 for columns.
        wrap: outside [0, 1].
    """
    count = texels.shape[axis]
    place = position * count - 0.5
    low = np.floor(place + 1e-6)
    share = np.maximum(place - low, 0).astype(np.float32)
    share[share < 1e-5] = 0
    share = share.reshape(-1, 1, 1) if axis == 0 else share.reshape(1, -1, 1)
    first, second = (texels.take(wrapped(low + k, count, wrap), axis) for k in (0, 1))
    return first + (second - first) * share


def refined(texels: Float[np.ndarray, "h w c"], height: int, width: int) -> Float[np.ndarray, "{height} {width} c"]:
    """A map interpolated on a finer grid; one texel stays one value."""
    for axis, count in ((0, height), (1, width)):
        if texels.shape[axis] != count:
            texels = along(texels, (np.arange(count) + 0.5) / count, axis, "clamp")
    return texels


def wrapped(index: Float[np.ndarray, "*n"], count: int, wrap: Wrap) -> Int[np.ndarray, "*n"]:
    """Which texel of `count` an index outside [0, count) means."""
    index = index.astype(np.int64)
    if wrap == "clamp":
        return np.clip(index, 0, count - 1)
    if wrap == "mirror":
        index = index % (2 * count)
        return np.minimum(index, 2 * count - 1 - index)
    return index % count


def _near_origin(uv: Float[np.ndarray, "m 3 2"], wrap: tuple[Wrap, Wrap]) -> Float[np.ndarray, "m 3 2"]:
    """Each face moved by whole periods of its texture, next to the origin."""
    uv = uv.copy()
    for k in (0, 1):
        period = PERIOD.get(wrap[k])
        if period:
            uv[..., k] -= np.floor((uv[..., k].min(axis=1, keepdims=True) + 1e-6) / period) * period
    return uv


def _at_most(texels: Float[np.ndarray, "h w c"], height: int, width: int) -> Float[np.ndarray, "i j c"]:
    height, width = min(height, texels.shape[0]), min(width, texels.shape[1])
    return texels if texels.shape[:2] == (height, width) else resized(texels, height, width)
