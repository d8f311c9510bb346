"""Users' meshes: GLB, glTF, OBJ, PLY (whatever trimesh reads) to a `MeshObject`.

The scene graph is flattened. A mesh's base colour is, in this order: its base-colour texture (glTF: times its factor;
OBJ: alone, as Blender reads it), its vertex or face colours, its factor or OBJ `Kd`, else `DEFAULT_ALBEDO`. Textures
and the colours of OBJ and PLY files are sRGB-coded and are decoded; glTF's factors and vertex colours are linear
already (trimesh keeps factors in 8 bits). Metallic and roughness of the file are not read: scenes give them.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from jaxtyping import Float, Int
from PIL import Image
from trimesh.visual.material import PBRMaterial, SimpleMaterial

from unirender.color import srgb_decode
from unirender.errors import UnirenderError
from unirender_reference.shapes import MeshObject, unit_sphere
from unirender_reference.shapes.surface import corner_normals, pack_textures, split_corners

DEFAULT_ALBEDO = 0.5
MAX_TEXTURE = 1024
MAX_ATLAS = 4096
MAX_REPEATS = 8
CREASE_DEG = 40.0
SUFFIXES = (".glb", ".gltf", ".obj", ".ply", ".stl", ".off")
GLTF = (".glb", ".gltf")


@dataclass(frozen=True)
class Piece:
    """One mesh of the scene graph in world space; `normals` (n, 3) of any length, or None where the file has none."""

    vertices: Float[np.ndarray, "n 3"]
    faces: Int[np.ndarray, "m 3"]
    normals: Float[np.ndarray, "n 3"] | None
    mesh: trimesh.Trimesh


@dataclass(frozen=True)
class Colored:
    """A linear texture (1 x 1 for one colour), the corners' uv (v from the first row), whether it is only a mean."""

    texture: Float[np.ndarray, "h w 3"]
    uv: Float[np.ndarray, "m 3 2"]
    averaged: bool = False


def load_mesh(path: str | Path) -> MeshObject:
    """Loads a mesh, moved and scaled into the unit sphere; its own normals are kept where it has them.

    Args:
        path: a GLB, glTF, OBJ, PLY, STL or OFF file; +y is up and +z faces the camera, as in glTF.

    Returns:
        The object; several textures are packed side by side, each at most `MAX_TEXTURE` pixels on a side.

    Raises:
        UnirenderError: missing or unreadable file, no faces, NaN or infinite vertices, zero extent.
    """
    path = Path(path)
    if not path.is_file():
        raise UnirenderError(f"mesh {path}: no such file; expected one of {', '.join(SUFFIXES)}")
    if path.suffix.lower() not in SUFFIXES:
        raise UnirenderError(f"mesh {path}: got suffix {path.suffix!r}, expected one of {', '.join(SUFFIXES)}")
    try:
        scene = trimesh.load_scene(path, process=False)
        pieces = _pieces(scene)
    except Exception as error:  # the loaders raise whatever their parsers raise
        raise UnirenderError(
            f"mesh {path}: cannot be read as {path.suffix.lower()} ({type(error).__name__}: {error}); export it again"
        ) from error
    if not pieces:
        raise UnirenderError(f"mesh {path}: has no faces, expected a triangle mesh; is it a point cloud?")
    for piece in pieces:
        count = len(piece.vertices)
        if piece.faces.min() < 0 or piece.faces.max() >= count:
            raise UnirenderError(f"mesh {path}: faces index outside the {count} vertices; export it again")
        if not np.isfinite(piece.vertices).all():
            bad = int((~np.isfinite(piece.vertices)).sum())
            raise UnirenderError(f"mesh {path}: {bad} vertex coordinates are NaN or infinite; repair the mesh")
    return _joined(path, pieces)


def _pieces(scene: trimesh.Scene) -> list[Piece]:
    """The scene graph, flattened. (Not `scene.dump()`: its copies lose a textured mesh's vertex colours.)"""
    pieces = []
    for node in scene.graph.nodes_geometry:
        matrix, name = scene.graph[node]
        mesh = scene.geometry[name]
        if not isinstance(mesh, trimesh.Trimesh) or not len(mesh.faces):
            continue
        linear = np.asarray(matrix)[:3, :3]
        mirrored = np.linalg.det(linear) < 0
        normals = None
        if "vertex_normals" in mesh._cache:  # from the file; trimesh would compute them otherwise
            cofactor = np.linalg.det(linear) * np.linalg.inv(linear).T
            normals = np.asarray(mesh.vertex_normals, np.float64) @ (-cofactor if mirrored else cofactor).T
        faces = np.asarray(mesh.faces)[:, [0, 2, 1] if mirrored else [0, 1, 2]]
        vertices = np.asarray(mesh.vertices, np.float64) @ linear.T + np.asarray(matrix)[:3, 3]
        pieces.append(Piece(vertices, faces, normals, mesh))
    return pieces


def _joined(path: Path, pieces: list[Piece]) -> MeshObject:
    used = np.concatenate([piece.vertices[np.unique(piece.faces)] for piece in pieces])
    if not np.ptp(used, axis=0).max() > 0:
        raise UnirenderError(f"mesh {path}: has zero extent, all its vertices are one point; give another mesh")
    images = {id(image) for piece in pieces if (image := _image(getattr(piece.mesh.visual, "material", None)))}
    limit = min(MAX_TEXTURE, MAX_ATLAS // max(len(images), 1))
    colored = [_base_color(piece, path.suffix.lower() in GLTF, limit) for piece in pieces]
    keys = [(part.texture.shape, part.texture.tobytes()) for part in colored]
    distinct = {key: part.texture for key, part in zip(keys, colored, strict=True)}
    if len(distinct) == 1 and colored[0].texture.shape == (1, 1, 3):
        albedo, corner_uv = colored[0].texture[0, 0], None
    else:
        albedo, frames = pack_textures(list(distinct.values()))
        frame = dict(zip(distinct, frames, strict=True))
        corner_uv = np.concatenate([frame[key].place(part.uv) for key, part in zip(keys, colored, strict=True)])
    starts = np.cumsum([0] + [len(piece.vertices) for piece in pieces[:-1]])
    vertices, faces, normals, uv = split_corners(
        unit_sphere(used, np.concatenate([piece.vertices for piece in pieces])),
        np.concatenate([piece.faces + start for piece, start in zip(pieces, starts, strict=True)]),
        np.concatenate([_corner_normals(piece) for piece in pieces]),
        corner_uv,
    )
    return MeshObject(
        name=path.stem.replace(".", "-"),
        family="mesh",
        vertices=vertices,
        faces=faces,
        normals=normals,
        uv=uv,
        albedo=np.clip(albedo, 0, 1).astype(np.float32),
        provenance={
            "source": "file",
            "file": path.name,
            "meshes": str(len(pieces)),
            "textures": str(len(distinct)),
            "textures_averaged": str(sum(part.averaged for part in colored)),
        },
    )


def _corner_normals(piece: Piece) -> Float[np.ndarray, "m 3 3"]:
    """The file's normals where it has valid ones; else creased normals over vertices welded by position."""
    if piece.normals is not None:
        normals = piece.normals[piece.faces]
        length = np.linalg.norm(normals, axis=-1, keepdims=True)
        if np.isfinite(normals).all() and length.min() > 1e-9 * length.max():
            return normals / length
    extent = max(float(np.ptp(piece.vertices, axis=0).max()), 1e-30)
    rounded = np.rint((piece.vertices - piece.vertices.min(0)) / extent * 1e6).astype(np.int64)
    _, first, welded = np.unique(rounded, axis=0, return_index=True, return_inverse=True)
    return corner_normals(piece.vertices[first], welded.reshape(-1)[piece.faces], CREASE_DEG)


def _base_color(piece: Piece, gltf: bool, limit: int) -> Colored:
    mesh, faces = piece.mesh, piece.faces
    visual: Any = mesh.visual
    material = getattr(visual, "material", None)
    uv, image, colors = getattr(visual, "uv", None), _image(material), _vertex_colors(mesh)
    factor = _factor(material, gltf, colored=image is not None or colors is not None)
    if image is not None and uv is not None and np.shape(uv) == (len(mesh.vertices), 2) and np.isfinite(uv).all():
        texture = srgb_decode(_pixels(image, limit)) * factor
        return _repeated(texture, np.stack([uv[:, 0], 1 - uv[:, 1]], axis=-1)[faces])  # trimesh counts v from below
    if colors is not None:
        return _corner_texture((colors if gltf else srgb_decode(colors))[faces] * factor)
    if getattr(visual, "kind", None) == "face":
        linear = srgb_decode(np.asarray(visual.face_colors, np.float32)[:, :3] / 255)
        return _corner_texture(np.repeat(linear[:, None], 3, axis=1))
    return Colored(factor.reshape(1, 1, 3).astype(np.float32), np.full((len(faces), 3, 2), 0.5))


def _factor(material: Any, gltf: bool, colored: bool) -> Float[np.ndarray, "3"]:
    if isinstance(material, PBRMaterial):
        factor = material.baseColorFactor
        if factor is None:
            return np.ones(3, np.float32)
        linear = np.asarray(factor, np.float32)[:3] / 255
        return linear if gltf else srgb_decode(linear)
    if isinstance(material, SimpleMaterial):
        return np.ones(3, np.float32) if colored else srgb_decode(np.asarray(material.diffuse, np.float32)[:3] / 255)
    return np.full(3, 1.0 if colored else DEFAULT_ALBEDO, np.float32)


def _image(material: Any) -> Image.Image | None:
    if isinstance(material, PBRMaterial):
        return material.baseColorTexture
    return material.image if isinstance(material, SimpleMaterial) else None


def _pixels(image: Image.Image, limit: int) -> Float[np.ndarray, "h w 3"]:
    """Display values in [0, 1], shrunk to at most `limit` pixels on a side."""
    image = image.convert("RGB")
    if max(image.size) > limit:
        scale = limit / max(image.size)
        size = max(1, round(image.width * scale)), max(1, round(image.height * scale))
        image = image.resize(size, Image.Resampling.BOX)
    return np.asarray(image, np.float32) / 255


def _vertex_colors(mesh: trimesh.Trimesh) -> Float[np.ndarray, "n 3"] | None:
    """Colours in [0, 1] as stored, or None."""
    visual: Any = mesh.visual
    stored = getattr(visual, "vertex_attributes", {}).get("color")
    colors = visual.vertex_colors if getattr(visual, "kind", None) == "vertex" else stored
    if colors is None or len(colors) != len(mesh.vertices):
        return None
    colors = np.asarray(colors)
    scale = float(np.iinfo(colors.dtype).max) if colors.dtype.kind in "ui" else 1.0
    return (colors[:, :3] / scale).astype(np.float32)


def _repeated(texture: Float[np.ndarray, "h w 3"], uv: Float[np.ndarray, "m 3 2"]) -> Colored:
    """Unrolls a repeating texture: each face is moved next to the origin, then the texture is tiled as far as it goes.

    Beyond `MAX_REPEATS` tiles on a side no pixel of ours resolves the pattern: those textures become their mean colour.
    """
    uv = uv - np.floor(uv.min(axis=1, keepdims=True) + 1e-6)
    tiles = np.maximum(np.ceil(uv.max((0, 1)) - 1e-4), 1).astype(int)
    if tiles.max() > MAX_REPEATS:
        return Colored(texture.mean((0, 1), keepdims=True).astype(np.float32), np.full(uv.shape, 0.5), averaged=True)
    if tiles.max() > 1:
        texture = texture[:: tiles[1], :: tiles[0]] if min(texture.shape[:2]) > 8 * tiles.max() else texture
        texture = np.tile(texture, (tiles[1], tiles[0], 1))
    size = np.array([texture.shape[1], texture.shape[0]])
    inset = (uv / tiles * (size - 1) + 0.5) / size  # half a texel inside, so that neighbours in the atlas cannot bleed
    return Colored(texture.astype(np.float32), np.clip(inset, 0, 1))


def _corner_texture(colors: Float[np.ndarray, "m 3 3"]) -> Colored:
    """2 x 2 texels for each face: bilinear lookups between them are the linear interpolation of its corners.

    (Exactly so where the fourth texel, b + c - a, is within [0, 1]; it is clipped.)
    """
    if np.ptp(colors.reshape(-1, 3), axis=0).max() < 1 / 512:
        return Colored(colors[0, :1].reshape(1, 1, 3).astype(np.float32), np.full((len(colors), 3, 2), 0.5))
    columns = int(np.ceil(np.sqrt(len(colors))))
    rows = -(-len(colors) // columns)
    a, b, c = np.moveaxis(colors, 1, 0)
    blocks = np.zeros((rows * columns, 2, 2, 3), np.float32)
    blocks[: len(colors)] = np.stack([np.stack([a, b], 1), np.stack([c, np.clip(b + c - a, 0, 1)], 1)], 1)
    texture = blocks.reshape(rows, columns, 2, 2, 3).swapaxes(1, 2).reshape(2 * rows, 2 * columns, 3)
    row, column = np.divmod(np.arange(len(colors)), columns)
    corner = np.stack([2 * column, 2 * row], -1)[:, None, :] + np.array([[0.5, 0.5], [1.5, 0.5], [0.5, 1.5]])
    return Colored(texture, corner / np.array([2 * columns, 2 * rows]))
