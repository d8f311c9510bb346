"""The last resort for a material whose channels share no lookup: a block of texels of its own for every face.

It takes pictures on several sets of coordinates or with several transforms, and colours at the vertices. The block of a
face with corners a, b, c has a at its lower left, b at its lower right and c at its upper left texel. Without pictures
a block of 2 x 2 texels is exact: bilinear lookups between them are the linear interpolation of the corners. (Where the
fourth texel, b + c - a, lies in [0, 1]; it is clipped.) Pictures are resampled, as finely as the atlas has room.
"""

import numpy as np
from jaxtyping import Float

from unirender_reference.meshes.surface import Texture, unit_vectors
from unirender_reference.meshes.tiles import Patch, Tile, wrapped

MAX_BLOCK = 256
CHUNK = 200_000  # texels sampled at a time


def baked_tile(patch: Patch, texels: int) -> Tile:
    """A tile of square blocks, one for each face.

    Args:
        patch: with colours, pictures or both.
        texels: how many the tile may have; 4 for each face at least are taken.
    """
    count = len(patch.points)
    block = _block_size(patch, texels)
    columns = int(np.ceil(np.sqrt(count)))
    rows = -(-count // columns)
    step = np.arange(block) / (block - 1)
    beta, gamma = (axis.reshape(-1) for axis in np.meshgrid(step, step[::-1]))  # rows from above: c first
    weights = np.stack([1 - beta - gamma, beta, gamma], axis=-1)  # (block^2, 3)
    maps: dict[str, Float[np.ndarray, "h w c"]] = {}
    for name, channel in patch.material.channels.items():
        if not isinstance(channel, Texture) and (name != "albedo" or patch.colors is None):
            maps[name] = channel.reshape(1, 1, -1).astype(np.float32)
            continue
        width = 1 if name in ("roughness", "metallic") else 3
        blocks = np.zeros((rows * columns, block * block, width), np.float32)
        chunk = max(1, CHUNK // block**2)
        for i in range(0, count, chunk):
            blocks[i : min(i + chunk, count)] = _values(patch, name, weights, slice(i, i + chunk))
        if name == "normal":
            blocks[count:] = [0, 0, 1]
        grid = blocks.reshape(rows, columns, block, block, width).swapaxes(1, 2)
        maps[name] = grid.reshape(rows * block, columns * block, width)
    row, column = np.divmod(np.arange(count), columns)
    corner = np.array([[0.5, block - 0.5], [block - 0.5, block - 0.5], [0.5, 0.5]])  # a, b, c
    uv = (np.stack([column, row], -1)[:, None] * block + corner) / (np.array([columns, rows]) * block)
    return Tile(maps, uv)


def _block_size(patch: Patch, texels: int) -> int:
    """The longest edge of a face in texels of its pictures, as far as there is room."""
    longest = 1.0
    for texture in patch.textures.values():
        uv = patch.lookup(texture) * texture.texels.shape[1::-1]
        edges = np.linalg.norm(uv - np.roll(uv, 1, axis=1), axis=-1)
        longest = max(longest, float(np.quantile(edges.max(1), 0.99)))
    room = int(np.sqrt(texels / len(patch.points)))
    return int(np.clip(min(np.ceil(longest) + 1, room), 2, MAX_BLOCK))


def _values(patch: Patch, name: str, weights: Float[np.ndarray, "n 3"], part: slice) -> Float[np.ndarray, "m n c"]:
    """A channel on the blocks of some faces."""
    channel = patch.material.channels[name]
    if isinstance(channel, Texture):
        corners = patch.lookup(channel)[part]
        values = _bilinear(channel, np.einsum("nk,mkc->mnc", weights, corners))
        if name == "normal":
            return _turned(values, patch.points[part], corners)
    else:
        values = channel.reshape(1, 1, -1)
    if name == "albedo" and patch.colors is not None:
        values = np.clip(values * np.einsum("nk,mkc->mnc", weights, patch.colors[part]), 0, 1)
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
