"""The meshes of a glTF scene in world space (glTF 2.0, sections 3.5 and 3.7.2)."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int, Num

from unirender.errors import UnirenderError
from unirender_reference.meshes.folder import ModelFolder
from unirender_reference.meshes.gltf_accessors import DRACO, accessor_count, read_accessor, read_draco
from unirender_reference.meshes.gltf_document import Document
from unirender_reference.meshes.gltf_materials import Materials, vector
from unirender_reference.meshes.gltf_skins import Skin, cofactors, read_skin
from unirender_reference.meshes.limits import MAX_NODES, check_faces, check_pieces, float32_step
from unirender_reference.meshes.normals import flat_normals
from unirender_reference.meshes.polygons import strip
from unirender_reference.meshes.surface import Model, Piece

TRIANGLES, STRIP, FAN = 4, 5, 6
UNIT_TOLERANCE = (
    0.0077  # of a quaternion's length: what signed bytes leave, as Khronos' validator allows; more would shear
)
VARIANTS = "KHR_materials_variants"
VISIBILITY = "KHR_node_visibility"
INSTANCING = "EXT_mesh_gpu_instancing"  # where no reader must have it, its mesh stands once, where its node is


def read_gltf(path: Path, folder: ModelFolder) -> Model:
    """Reads a .glb or .gltf file.

    Skinned meshes are in the pose in which their joints' nodes stand; morph targets are not applied.

    Args:
        path: the file.
        folder: where its buffers and pictures may lie.

    Raises:
        UnirenderError: the file is damaged, over a limit, or uses something that is not read here.
    """
    document = Document(path, folder)
    places: dict[int, list[_Place]] = {}
    primitives: dict[int, list[dict[str, Any]]] = {}
    pieces_claimed = 0
    for mesh, place in _instances(document):
        places.setdefault(mesh, []).append(place)
        primitives[mesh] = document.item("meshes", mesh).get("primitives", [])
        pieces_claimed += len(primitives[mesh])
        check_pieces(pieces_claimed)
    solid = {
        mesh: [primitive for primitive in group if _mode(primitive) in (TRIANGLES, STRIP, FAN)]
        for mesh, group in primitives.items()
    }
    faces = {mesh: sum(_face_count(document, primitive) for primitive in group) for mesh, group in solid.items()}
    check_faces(sum(len(stands) * faces[mesh] for mesh, stands in places.items()))
    used = [primitive for group in solid.values() for primitive in group]
    materials = Materials(document, {primitive.get("material") for primitive in used})
    pieces: list[Piece] = []
    world = _World(document)
    for mesh, stands in places.items():
        skins = {place.skin: read_skin(document, place.skin, world.place) for place in stands if place.skin is not None}
        for primitive in solid[mesh]:
            shape = _Shape(document, primitive, materials, skinned=bool(skins))
            if len(shape.faces):
                pieces += [shape.placed(place.matrix, skins.get(place.skin)) for place in stands]
    ignored = set(materials.ignored)
    if len(used) < sum(map(len, primitives.values())):
        ignored.add("points and lines")
    ignored |= {"other scenes"} if len(document.json.get("scenes", [])) > 1 else set()
    if any(INSTANCING in node.get("extensions", {}) for node in document.json.get("nodes", [])):
        ignored.add(INSTANCING.removeprefix("EXT_"))
    for primitive in used:
        ignored |= {"morph targets"} if "targets" in primitive else set()
        ignored |= {"material variants"} if VARIANTS in primitive.get("extensions", {}) else set()
        ignored |= {"tangents"} if "TANGENT" in primitive.get("attributes", {}) else set()
    return Model(pieces, frozenset(ignored))


@dataclass(frozen=True)
class _Place:
    """Where a mesh stands: the matrix of its node in the world; of a mesh with a skin (its index) the joints say it."""

    matrix: Float[np.ndarray, "4 4"]
    skin: object


class _World:
    """Where nodes stand, whatever scene they belong to."""

    def __init__(self, document: Document) -> None:
        self._document = document
        self._count = len(document.json.get("nodes", []))
        children = ((i, document.item("nodes", i).get("children", [])) for i in range(self._count))
        self._parent: dict[object, int] = {child: i for i, below in children for child in below}
        self._known: dict[object, Float[np.ndarray, "4 4"]] = {}

    def place(self, index: object) -> Float[np.ndarray, "4 4"]:
        """The matrix of a node.

        Raises:
            UnirenderError: there is no such node, or it is its own parent.
        """
        above: list[object] = []
        at: object = index
        while at is not None and at not in self._known:
            above.append(at)
            if len(above) > self._count:
                raise UnirenderError(f"nodes[{index}] is its own parent, expected a tree; export it again")
            at = self._parent.get(at)
        matrix = np.eye(4) if at is None else self._known[at]
        for node in reversed(above):
            matrix = self._known[node] = matrix @ _local(self._document.item("nodes", node))
        return matrix


def _instances(document: Document) -> Iterator[tuple[int, _Place]]:
    """Each mesh of the scene that is visible, with its place in the world; a tree, as the specification has it."""
    nodes = document.json.get("nodes", [])
    if len(nodes) > MAX_NODES:
        raise UnirenderError(f"has {len(nodes):,} nodes, expected at most {MAX_NODES:,}; merge its meshes")
    if document.json.get("scenes"):
        roots = document.item("scenes", document.json.get("scene", 0)).get("nodes", [])
    else:
        children = {child for node in nodes for child in node.get("children", [])}
        roots = [i for i in range(len(nodes)) if i not in children]
    waiting = [(root, np.eye(4)) for root in reversed(roots)]
    seen: set[int] = set()
    while waiting:
        index, parent = waiting.pop()
        node = document.item("nodes", index)
        if index in seen:
            raise UnirenderError(f"nodes[{index}] has two parents or is its own, expected a tree; export it again")
        seen.add(index)
        if node.get("extensions", {}).get(VISIBILITY, {}).get("visible") is False:
            continue  # it and all below it
        matrix = parent @ _local(node)
        if "mesh" in node:
            yield node["mesh"], _Place(matrix, node.get("skin"))
        waiting += [(child, matrix) for child in reversed(node.get("children", []))]


def _local(node: dict[str, Any]) -> Float[np.ndarray, "4 4"]:
    """The node's own transform: its matrix, or translation, rotation (a unit quaternion) and scale."""
    if "matrix" in node:
        return vector(node, "matrix", [0.0] * 16).reshape(4, 4).T
    x, y, z, w = quaternion = vector(node, "rotation", [0, 0, 0, 1])
    length = np.linalg.norm(quaternion)
    if abs(length - 1) > UNIT_TOLERANCE:
        raise UnirenderError(
            f"a node's rotation has the length {length:.3g}, expected a unit quaternion; export it again"
        )
    rotation = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )
    matrix = np.eye(4)
    matrix[:3, :3] = rotation * vector(node, "scale", [1, 1, 1])
    matrix[:3, 3] = vector(node, "translation", [0, 0, 0])
    return matrix


def _mode(primitive: dict[str, Any]) -> int:
    """What its vertices make up: points, lines (1 to 3), triangles."""
    mode = primitive.get("mode", TRIANGLES)
    if mode not in range(FAN + 1):
        raise UnirenderError(f"a primitive has the mode {mode!r}, expected 0 to {FAN}; export it again")
    return mode


def _face_count(document: Document, primitive: dict[str, Any]) -> int:
    """By arithmetic: nothing is read."""
    attributes = primitive.get("attributes", {})
    if "POSITION" not in attributes:
        return 0
    count = accessor_count(document, primitive.get("indices", attributes["POSITION"]))
    return count // 3 if _mode(primitive) == TRIANGLES else max(count - 2, 0)


class _Shape:
    """The arrays of a primitive, in its own space, of the vertices that its faces use."""

    def __init__(
        self, document: Document, primitive: dict[str, Any], materials: Materials, skinned: bool = False
    ) -> None:
        names = primitive.get("attributes", {})
        self.faces: Int[np.ndarray, "m 3"] = np.zeros((0, 3), np.int64)
        if "POSITION" not in names:
            return
        packed = read_draco(document, primitive) if DRACO in primitive.get("extensions", {}) else {}
        total = accessor_count(document, names["POSITION"])
        if "indices" in packed:
            indices = packed["indices"][:, 0]
        elif "indices" in primitive:
            indices = read_accessor(document, primitive["indices"])[:, 0]
        else:
            indices = np.arange(total)
        faces = _triangles(indices.astype(np.int64), _mode(primitive), total)
        rows, index = np.unique(faces, return_inverse=True)

        def attribute(name: str, *widths: int) -> Num[np.ndarray, "n width"] | None:
            if name not in names:
                return None
            count = accessor_count(document, names[name])
            values = packed[name][rows] if name in packed else None
            if values is None:
                values = read_accessor(document, names[name], rows if count == total else rows[:0])
            if values.shape[1] not in widths or count != total:
                raise UnirenderError(
                    f"{name} is {count:,} times {values.shape[1]}, expected {total:,} times {widths}; export it again"
                )
            return values

        stored = attribute("POSITION", 3)
        assert stored is not None
        self._points = stored.astype(np.float64)
        self._step = float32_step(self._points) if stored.dtype.kind == "f" else 0.0
        self.faces = index.reshape(-1, 3)
        normals = attribute("NORMAL", 3)
        self._normals = None if normals is None else normals.astype(np.float64)[self.faces]
        self._at_vertices = normals if skinned else None
        self._bones = self._read_bones(attribute, names) if skinned and "JOINTS_0" in names else None
        material = primitive.get("material")
        uv = {i: attribute(f"TEXCOORD_{i}", 2) for i in materials.sets(material)}
        self._uv = {
            i: values.astype(np.float64)[self.faces]
            for i, values in uv.items()
            if values is not None and np.isfinite(values).all()
        }
        colors = attribute("COLOR_0", 3, 4)
        self._colors = None
        if colors is not None:
            self._colors = np.clip(np.nan_to_num(colors[:, :3].astype(np.float64)), 0, 1)[self.faces]
        self._material = materials.of(material, frozenset(self._uv))

    @staticmethod
    def _read_bones(
        attribute: "Callable[..., Num[np.ndarray, 'n width'] | None]", names: dict[str, Any]
    ) -> tuple[Int[np.ndarray, "n k"], Float[np.ndarray, "n k"]]:
        """The joints of each vertex, four for each set that the primitive has, and their weights."""
        sets = range(sum(name.startswith("JOINTS_") for name in names))
        joints, weights = ([attribute(f"{kind}_{i}", 4) for i in sets] for kind in ("JOINTS", "WEIGHTS"))
        found = [(j, w) for j, w in zip(joints, weights, strict=True) if j is not None and w is not None]
        if len(found) < len(sets):
            raise UnirenderError("has JOINTS without WEIGHTS of the same number; export it again")
        return (
            np.concatenate([j.astype(np.int64) for j, _ in found], axis=1),
            np.concatenate([w.astype(np.float64) for _, w in found], axis=1),
        )

    def placed(self, matrix: Float[np.ndarray, "4 4"], skin: Skin | None) -> Piece:
        """The piece in the world; a mirroring matrix turns the faces round, so that they stay outside."""
        normals: Float[np.ndarray, "m 3 3"] | None = None
        if skin is not None and self._bones is not None:
            at = self._at_vertices
            vertices, posed, mirrored = skin.pose(self._points, at, *self._bones)
            normals = None if posed is None else posed[self.faces]
            stretch = max(float(np.linalg.norm(linear, 2)) for linear in skin.matrices[:, :3, :3])
        else:
            linear = matrix[:3, :3]
            mirrored = bool(np.linalg.det(linear) < 0)
            vertices = self._points @ linear.T + matrix[:3, 3]
            if self._normals is not None:
                normals = self._normals @ (-cofactors(linear) if mirrored else cofactors(linear)).T
            stretch = float(np.linalg.norm(linear, 2))
        turn = [0, 2, 1] if mirrored else [0, 1, 2]
        faces = self.faces[:, turn]
        return Piece(
            vertices=vertices,
            faces=faces,
            normals=flat_normals(vertices, faces) if normals is None else normals[:, turn],  # glTF 2.0, 3.7.2.1
            uv={i: values[:, turn] for i, values in self._uv.items()},
            colors=None if self._colors is None else self._colors[:, turn],
            material=self._material,
            step=self._step * stretch,
        )


def _triangles(indices: Int[np.ndarray, " n"], mode: int, points: int) -> Int[np.ndarray, "m 3"]:
    """Triangles of a list, a strip (every second one turned round) or a fan."""
    if len(indices) and (indices.max() >= points or indices.min() < 0):
        raise UnirenderError(
            f"its faces name vertex {indices.max():,}, but it has {points:,} vertices; export it again"
        )
    if mode == TRIANGLES:
        if len(indices) % 3:
            raise UnirenderError(f"has {len(indices):,} indices, expected triples; export it again")
        return indices.reshape(-1, 3)
    if len(indices) < 3:
        return np.zeros((0, 3), np.int64)
    if mode == FAN:
        return np.stack([np.full(len(indices) - 2, indices[0]), indices[1:-1], indices[2:]], axis=1)
    return strip(indices)
