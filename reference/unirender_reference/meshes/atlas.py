"""All materials of a model in one atlas, whose channels share their texture coordinates."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from unirender_reference.meshes.bake import baked_tile
from unirender_reference.meshes.limits import MAX_ATLAS_TEXELS, texture_side
from unirender_reference.meshes.surface import Material, unit_vectors
from unirender_reference.meshes.tiles import Patch, Tile, constant_tile, refined, unrolled_tile

FLAT = np.array([[[0, 0, 1]]], np.float32)  # the normal map of a material without one, beside one that has it
FLAT_COLOR = 1 / 512  # colours closer than this are one colour


@dataclass(frozen=True)
class Atlas:
    """The channels of a model and where its faces look.

    Attributes:
        maps: (h, w, c) of each channel, (1, 1, c) where it is the same everywhere.
        uv: (m, 3, 2) of every corner; None where every channel is constant.
        tiles: how many.
        averaged, baked: how many of them show a mean, or were resampled face by face.
    """

    maps: dict[str, Float[np.ndarray, "h w c"]]
    uv: Float[np.ndarray, "m 3 2"] | None
    tiles: int
    averaged: int
    baked: int


def build_atlas(patches: Sequence[Patch]) -> Atlas:
    """Packs the materials of the patches; faces keep the order of the patches."""
    textured = sum(bool(patch.textures) or patch.colors is not None for patch in patches)
    made = [_tile(patch, textured) for patch in patches]
    tiles = [tile for tile, _ in made]
    names = {name: None for tile in tiles for name in tile.maps}
    place, (height, width) = shelves([tile.size for tile in tiles])
    maps = {}
    for name in names:
        parts = [tile.maps.get(name, FLAT) for tile in tiles]
        if all(part.shape[:2] == (1, 1) and np.array_equal(part, parts[0]) for part in parts):
            maps[name] = parts[0]
            continue
        if len(tiles) == 1:
            maps[name] = np.ascontiguousarray(parts[0])
            continue
        maps[name] = np.empty((height, width, parts[0].shape[-1]), np.float32)
        maps[name][:] = parts[0][0, 0]  # between the tiles, where nothing looks
        for (top, left), tile, part in zip(place, tiles, parts, strict=True):
            h, w = tile.size
            maps[name][top : top + h, left : left + w] = refined(part, h, w)
        if name == "normal":
            maps[name] = unit_vectors(maps[name], 1.0)
    placed = [
        (tile.uv * tile.size[::-1] + [left, top]) / [width, height]
        for (top, left), tile in zip(place, tiles, strict=True)
    ]
    uv = np.concatenate(placed)
    constant = all(texels.shape[:2] == (1, 1) for texels in maps.values())
    averaged, baked = sum(tile.averaged for tile in tiles), sum(baked for _, baked in made)
    return Atlas(maps, None if constant else uv, len(tiles), averaged, baked)


def _tile(patch: Patch, textured: int) -> tuple[Tile, bool]:
    """The tile of a patch, one of `textured` in the atlas, and whether its pictures were resampled face by face."""
    side, room = texture_side(textured), MAX_ATLAS_TEXELS // max(textured, 1)
    patch = _with_flat_color(patch)
    textures = list(patch.textures.values())
    if patch.colors is not None:
        return baked_tile(patch, room), bool(textures)
    if not textures:
        return constant_tile(patch.material.channels, len(patch.points)), False
    lookups = [patch.lookup(texture) for texture in textures]
    inside = all(uv.min() >= -1e-4 and uv.max() <= 1 + 1e-4 for uv in lookups)
    same = all(np.array_equal(uv, lookups[0]) for uv in lookups[1:])
    if same and (inside or len({texture.wrap for texture in textures}) == 1):
        return unrolled_tile(patch, side), False
    return baked_tile(patch, room), True


def _with_flat_color(patch: Patch) -> Patch:
    """The same patch, without vertex colours where they are one colour: it becomes a factor."""
    if patch.colors is None or np.ptp(patch.colors.reshape(-1, 3), axis=0).max() >= FLAT_COLOR:
        return patch
    factor = patch.colors.reshape(-1, 3).mean(0).astype(np.float32)
    if np.ptp(factor) == 0 and factor[0] == 1:
        return Patch(patch.points, patch.uv, None, patch.material)
    channels = dict(patch.material.channels)
    albedo = channels["albedo"]
    channels["albedo"] = albedo.scaled(factor) if not isinstance(albedo, np.ndarray) else albedo * factor
    return Patch(patch.points, patch.uv, None, Material(channels))


def shelves(sizes: Sequence[tuple[int, int]]) -> tuple[Int[np.ndarray, "k 2"], tuple[int, int]]:
    """Packs rectangles (height, width), tallest first, in rows: their (top, left), and the size of the sheet."""
    width = max(max(w for _, w in sizes), int(np.ceil(np.sqrt(sum(h * w for h, w in sizes)))))
    corners = np.zeros((len(sizes), 2), np.int64)
    top = left = shelf = reach = 0
    for i in sorted(range(len(sizes)), key=lambda i: sizes[i], reverse=True):
        h, w = sizes[i]
        if left + w > width:
            top, left, shelf = top + shelf, 0, 0
        corners[i] = top, left
        left, shelf, reach = left + w, max(shelf, h), max(reach, left + w)
    return corners, (top + shelf, reach)
