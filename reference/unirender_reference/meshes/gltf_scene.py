"""The meshes of a glTF scene in world space (glTF 2.0, sections 3.5 and 3.7.2)."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int, Num

from unirender.errors import UnirenderError
from unirender_reference.meshes.folder import ModelFolder
from unirender_reference.meshes.gltf_accessors import DRACO, accessor_count, read_accessor, read_draco
from unirender_reference.meshes.gltf_document import Document
from unirender_reference.meshes.gltf_materials import Materials, vector
from unirender_reference.meshes.limits import MAX_NODES, check_faces, check_pieces, float32_step
from unirender_reference.meshes.normals import flat_normals
from unirender_reference.meshes.polygons import strip
from unirender_reference.meshes.surface import Model, Piece

TRIANGLES, STRIP, FAN = 4, 5, 6
UNIT_TOLERANCE = (
    0.0077  # of a quaternion's length: what signed bytes leave, as Khronos' validator allows; more would shear
)
VISIBILITY = "KHR_node_visibility"
INSTANCING = "EXT_mesh_gpu_instancing"  # where no reader must have it, its mesh stands once, where its node is


def read_gltf(path: Path, folder: ModelFolder) -> Model:
    """Reads a .glb or .gltf file.

    Skins are not applied (a skinned mesh keeps the pose and the place it is stored in), nor are morph targets.

    Args:
        path: the file.
        folder: where its buffers and pictures may lie.

    Raises:
        UnirenderError: the file is damaged, over a limit, or uses something that is not read here.
    """
    document = Document(path, folder)
    places: dict[int, list[Float[np.ndarray, "4 4"]]] = {}
    primitives: dict[int, list[dict[str, Any]]] = {}
    pieces_claimed = 0
    for mesh, matrix in _instances(document):
        places.setdefault(mesh, []).append(matrix)
        primitives[mesh] = document.item("meshes", mesh).get("primitives", [])
        pieces_claimed += len(primitives[mesh])
        check_pieces(pieces_claimed)
    solid = {
        mesh: [primitive for primitive in group if _mode(primitive) in (TRIANGLES, STRIP, FAN)]
        for mesh, group in primitives.items()
    }
    faces = {mesh: sum(_face_count(document, primitive) for primitive in group) for mesh, group in solid.items()}
    check_faces(sum(len(matrices) * faces[mesh] for mesh, matrices in places.items()))
    used = [primitive for group in solid.values() for primitive in group]
    materials = Materials(document, {primitive.get("material") for primitive in used})
    pieces: list[Piece] = []
    for mesh, matrices in places.items():
        for primitive in solid[mesh]:
            shape = _Shape(document, primitive, materials)
            if len(shape.faces):
                pieces += [shape.placed(matrix) for matrix in matrices]
    ignored = set(materials.ignored)
    if len(used) < sum(map(len, primitives.values())):
        ignored.add("points and lines")
    if any(INSTANCING in node.get("extensions", {}) for node in document.json.get("nodes", [])):
        ignored.add(INSTANCING.removeprefix("EXT_"))
    for primitive in used:
        ignored |= {"morph targets"} if "targets" in primitive else set()
        ignored |= {"tangents"} if "TANGENT" in primitive.get("attributes", {}) else set()
        ignored |= {"skin"} if "JOINTS_0" in primitive.get("attributes", {}) else set()
    return Model(pieces, frozenset(ignored))


def _instances(document: Document) -> Iterator[tuple[int, Float[np.ndarray, "4 4"]]]:
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
            yield node["mesh"], matrix
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

    def __init__(self, document: Document, primitive: dict[str, Any], materials: Materials) -> None:
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

    def placed(self, matrix: Float[np.ndarray, "4 4"]) -> Piece:
        """The piece in the world; a mirroring matrix turns the faces round, so that they stay outside."""
        linear = matrix[:3, :3]
        mirrored = np.linalg.det(linear) < 0
        turn = [0, 2, 1] if mirrored else [0, 1, 2]
        vertices = self._points @ linear.T + matrix[:3, 3]
        faces = self.faces[:, turn]
        if self._normals is None:
            normals = flat_normals(vertices, faces)  # glTF 2.0, section 3.7.2.1
        else:
            # The transposed cofactor matrix carries normals also where the matrix has no inverse.
            cofactor = np.stack([np.cross(linear[(i + 1) % 3], linear[(i + 2) % 3]) for i in range(3)])
            normals = (self._normals @ (-cofactor if mirrored else cofactor).T)[:, turn]
        return Piece(
            vertices=vertices,
            faces=faces,
            normals=normals,
            uv={i: values[:, turn] for i, values in self._uv.items()},
            colors=None if self._colors is None else self._colors[:, turn],
            material=self._material,
            step=self._step * float(np.linalg.norm(linear, 2)),
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
