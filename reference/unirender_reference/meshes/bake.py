"""The last resort for a material whose channels share no lookup: a block of texels of its own for every face.

It takes pictures on several sets of coordinates or with several transforms, and colours at the vertices. The block of a
face with corners a, b, c has a at its lower left, b at its lower right and c at its upper left texel. Bilinear lookups
between its texels are the linear interpolation of the corners wherever the texel beyond the diagonal, b + c - a in a
block of 2 x 2, lies in [0, 1]; elsewhere it is clipped. So each face begins at a corner for which it does, and one that
has none gets a larger block, whose clipped texels lie nearer to the diagonal. Pictures are resampled at `FINEST` points
for each of their texels, or as finely as the atlas has room.
"""

from dataclasses import replace

import numpy as np
from jaxtyping import Float, Int

from unirender.errors import UnirenderError
from unirender_reference.meshes.surface import Texture, unit_vectors
from unirender_reference.meshes.tiles import Patch, Tile, wrapped

FINEST = 8.0
CLIPPED_EDGE = 4.0  # texels that an edge counts as in a face whose colours are clipped from every corner
INVISIBLE = 1 / 255  # beyond [0, 1]: clipping so much changes a lookup by a quarter of it
COARSER = 0.8  # a step towards what there is room for
SIZES = np.unique(np.round(2 ** np.arange(1, 8.1, 0.25))).astype(int)  # of blocks: 2, 3, 4, 5, 6, 7, 8, 10 ... 256
CHUNK = 200_000  # texels sampled at a time


def baked_tile(patch: Patch, texels: int) -> Tile:
    """A tile of square blocks, one for each face.

    Args:
        patch: with colours, pictures or both.
        texels: how many the tile may have; 4 for each face at least are taken.
    """
    patch, order, clipped = _from_best_corner(patch)
    sizes = _block_sizes(patch, clipped, texels)
    corner, (height, width) = _laid_out(sizes)
    maps: dict[str, Float[np.ndarray, "h w c"]] = {}
    for name, channel in patch.material.channels.items():
        if not isinstance(channel, Texture) and (name != "albedo" or patch.colors is None):
            maps[name] = channel.reshape(1, 1, -1).astype(np.float32)
            continue
        maps[name] = np.zeros((height, width, 1 if name in ("roughness", "metallic") else 3), np.float32)
        if name == "normal":
            maps[name][:] = [0, 0, 1]
        for size in np.unique(sizes):
            _fill(maps[name], patch, name, np.flatnonzero(sizes == size), corner, int(size))
    low, high = np.full(len(sizes), 0.5), sizes - 0.5
    inside = np.stack([np.stack(xy, -1) for xy in ((low, high), (high, high), (low, low))], axis=1)  # a, b, c
    uv = np.empty((len(sizes), 3, 2))
    np.put_along_axis(uv, order[..., None], (corner[:, None, ::-1] + inside) / [width, height], axis=1)
    return Tile(maps, uv)


def _from_best_corner(patch: Patch) -> tuple[Patch, Int[np.ndarray, "m 3"], np.ndarray]:
    """The faces from the corner that clips their colours least; which corners those are; whether clipping shows."""
    count = len(patch.points)
    turns = (np.arange(3)[:, None] + np.arange(3)) % 3
    if patch.colors is None:
        return patch, np.broadcast_to(turns[0], (count, 3)), np.zeros(count, bool)
    albedo = patch.material.channels["albedo"]
    colors = patch.colors if isinstance(albedo, Texture) else patch.colors * albedo
    beyond = colors.sum(1, keepdims=True) - 2 * colors  # b + c - a, for each corner as a
    excess = np.maximum(np.maximum(-beyond, beyond - 1), 0).max(-1)
    order = turns[excess.argmin(1)]

    def turned(values: Float[np.ndarray, "m 3 k"]) -> Float[np.ndarray, "m 3 k"]:
        return np.take_along_axis(values, order[..., None], axis=1)

    uv = {number: turned(values) for number, values in patch.uv.items()}
    own = replace(patch, points=turned(patch.points), uv=uv, colors=turned(patch.colors))
    return own, order, excess.min(1) > INVISIBLE


def _block_sizes(patch: Patch, clipped: np.ndarray, texels: int) -> Int[np.ndarray, " m"]:
    """The side of each face's block: by its longest edge in texels of its pictures, as far as there is room."""
    longest = np.where(clipped, CLIPPED_EDGE, 0)
    for texture in patch.textures.values():
        uv = patch.lookup(texture) * texture.texels.shape[1::-1]
        longest = np.maximum(longest, np.linalg.norm(uv - np.roll(uv, 1, axis=1), axis=-1).max(1))
    if not np.isfinite(longest).all():
        raise UnirenderError("mesh: texture coordinates are not finite, or leave the range of float32; export it again")
    density = FINEST
    while True:
        chosen = np.minimum(np.searchsorted(SIZES, density * longest + 1), len(SIZES) - 1)
        counts = np.bincount(chosen, minlength=len(SIZES))
        if counts[0] == len(longest) or np.prod(_sheet(counts)) <= texels:
            return SIZES[chosen]
        density *= COARSER


def _sheet(counts: Int[np.ndarray, " s"]) -> tuple[int, int]:
    """Height and width of blocks in rows of equal ones, given how many there are of each of `SIZES`."""
    largest = int(SIZES[counts > 0].max())
    width = largest * int(np.ceil(np.sqrt((counts * SIZES**2).sum()) / largest))
    return int((SIZES * -(-counts // np.maximum(width // SIZES, 1))).sum()), width


def _laid_out(sizes: Int[np.ndarray, " m"]) -> tuple[Int[np.ndarray, "m 2"], tuple[int, int]]:
    """The (top, left) of each block, largest first, and the size of the sheet."""
    height, width = _sheet(np.bincount(np.searchsorted(SIZES, sizes), minlength=len(SIZES)))
    corner = np.empty((len(sizes), 2), np.int64)
    top = 0
    for size in np.unique(sizes)[::-1]:
        faces = np.flatnonzero(sizes == size)
        row, column = np.divmod(np.arange(len(faces)), width // size)
        corner[faces] = np.stack([top + row * size, column * size], axis=-1)
        top += (row[-1] + 1) * size
    return corner, (height, width)


def _fill(
    sheet: Float[np.ndarray, "h w c"],
    patch: Patch,
    name: str,
    faces: Int[np.ndarray, " m"],
    corner: Int[np.ndarray, "k 2"],
    size: int,
) -> None:
    """Draws the blocks of some faces: those of their texels that lookups in the triangle need."""
    row, column = (axis.reshape(-1) for axis in np.mgrid[:size, :size])
    needed = column <= row + 1  # c is above: the diagonal is row = column
    row, column = row[needed], column[needed]
    beta, gamma = column / (size - 1), 1 - row / (size - 1)
    weights = np.stack([1 - beta - gamma, beta, gamma], axis=-1)
    chunk = max(1, CHUNK // len(row))
    for i in range(0, len(faces), chunk):
        part = faces[i : i + chunk]
        top, left = corner[part].T
        sheet[top[:, None] + row, left[:, None] + column] = _values(patch, name, weights, part)


def _values(
    patch: Patch, name: str, weights: Float[np.ndarray, "n 3"], part: Int[np.ndarray, " m"]
) -> Float[np.ndarray, "m n c"]:
    """A channel on the blocks of some faces."""
    channel = patch.material.channels[name]
    if isinstance(channel, Texture):
        corners = patch.lookup(channel)[part]
        values = _bilinear(channel, weights @ corners)
        if name == "normal":
            return _turned(values, patch.points[part], corners)
    else:
        values = channel.reshape(1, 1, -1)
    if name == "albedo" and patch.colors is not None:
        values = np.clip(values * (weights @ patch.colors[part]), 0, 1)
    return np.asarray(values, np.float32)


def _bilinear(texture: Texture, uv: Float[np.ndarray, "m n 2"]) -> Float[np.ndarray, "m n c"]:
    height, width, _ = texture.texels.shape
    place = uv * [width, height] - 0.5
    low = np.floor(place)
    share = (place - low).astype(np.float32)
    columns = [wrapped(low[..., 0] + k, width, texture.wrap[0]) for k in (0, 1)]
    rows = [wrapped(low[..., 1] + k, height, texture.wrap[1]) for k in (0, 1)]
    upper, lower = (
        texture.texels[row, columns[0]] * (1 - share[..., :1]) + texture.texels[row, columns[1]] * share[..., :1]
        for row in rows
    )
    return upper * (1 - share[..., 1:]) + lower * share[..., 1:]


def _turned(
    vectors: Float[np.ndarray, "m n 3"], points: Float[np.ndarray, "m 3 3"], uv: Float[np.ndarray, "m 3 2"]
) -> Float[np.ndarray, "m n 3"]:
    """Tangent-space vectors from the frame of a picture's coordinates to the frame of the block (x along b - a)."""
    first, second = points[:, 1] - points[:, 0], points[:, 2] - points[:, 0]
    up1, up2 = uv[:, 0, 1] - uv[:, 1, 1], uv[:, 0, 1] - uv[:, 2, 1]  # upwards in the picture
    mirrored = (uv[:, 1, 0] - uv[:, 0, 0]) * up2 < (uv[:, 2, 0] - uv[:, 0, 0]) * up1
    across = (first * up2[:, None] - second * up1[:, None]) * np.where(mirrored, -1, 1)[:, None]  # along +u
    normal = np.cross(first, second)
    side = np.cross(normal, first)
    x = np.einsum("mi,mi->m", across, first) / np.maximum(np.linalg.norm(first, axis=1), 1e-30)
    y = np.einsum("mi,mi->m", across, side) / np.maximum(np.linalg.norm(side, axis=1), 1e-30)
    length = np.hypot(x, y)
    cosine, sine = (np.where(length > 1e-30, axis / np.maximum(length, 1e-30), 0)[:, None] for axis in (x, y))
    across_u, up = vectors[..., 0], vectors[..., 1] * np.where(mirrored, -1, 1)[:, None]
    turned = np.stack([cosine * across_u - sine * up, sine * across_u + cosine * up, vectors[..., 2]], axis=-1)
    return unit_vectors(turned.astype(np.float32), 1.0)
