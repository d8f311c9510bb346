"""The meshes of a glTF scene in world space (glTF 2.0, section 3.7.2)."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int, Num

from unirender.errors import UnirenderError
from unirender_reference.meshes.folder import ModelFolder
from unirender_reference.meshes.gltf_accessors import DRACO, accessor_count, read_accessor, read_draco
from unirender_reference.meshes.gltf_document import Document
from unirender_reference.meshes.gltf_materials import Materials
from unirender_reference.meshes.gltf_nodes import Place, World, mesh_places
from unirender_reference.meshes.gltf_skins import Skin, cofactors, read_skin
from unirender_reference.meshes.limits import check_faces, check_pieces, float32_step
from unirender_reference.meshes.normals import flat_normals
from unirender_reference.meshes.polygons import strip
from unirender_reference.meshes.surface import Model, Piece

TRIANGLES, STRIP, FAN = 4, 5, 6
VARIANTS = "KHR_materials_variants"


def read_gltf(path: Path, folder: ModelFolder) -> Model:
    """Reads a .glb or .gltf file.

    Skinned meshes are in the pose in which their joints' nodes stand, morphed ones have the file's own weights.

    Args:
        path: the file.
        folder: where its buffers and pictures may lie.

    Raises:
        UnirenderError: the file is damaged, over a limit, or uses something that is not read here.
    """
    document = Document(path, folder)
    places: dict[int, list[Place]] = {}
    primitives: dict[int, list[dict[str, Any]]] = {}
    pieces_claimed = 0
    for mesh, place in mesh_places(document):
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
    world = World(document)
    for mesh, stands in places.items():
        skins = {place.skin: read_skin(document, place.skin, world.place) for place in stands if place.skin is not None}
        for primitive in solid[mesh]:
            shape = _Shape(document, primitive, materials, skinned=bool(skins))
            if len(shape.faces):
                pieces += [shape.placed(place, skins.get(place.skin)) for place in stands]
    ignored = set(materials.ignored)
    if len(used) < sum(map(len, primitives.values())):
        ignored.add("points and lines")
    ignored |= {"other scenes"} if len(document.json.get("scenes", [])) > 1 else set()
    for primitive in used:
        ignored |= {"material variants"} if VARIANTS in primitive.get("extensions", {}) else set()
        ignored |= {"tangents"} if "TANGENT" in primitive.get("attributes", {}) else set()
    return Model(pieces, frozenset(ignored))


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
        self._document, self._primitive, self._packed, self._total = document, primitive, packed, total
        if "indices" in packed:
            indices = packed["indices"][:, 0]
        elif "indices" in primitive:
            indices = read_accessor(document, primitive["indices"])[:, 0]
        else:
            indices = np.arange(total)
        faces = _triangles(indices.astype(np.int64), _mode(primitive), total)
        self._rows, index = np.unique(faces, return_inverse=True)
        stored = self._attribute(names, "POSITION", 3)
        assert stored is not None
        self._points = stored.astype(np.float64)
        self._step = float32_step(self._points) if stored.dtype.kind == "f" else 0.0
        self.faces = index.reshape(-1, 3)
        normals = self._attribute(names, "NORMAL", 3)
        self._normals = None if normals is None else normals.astype(np.float64)
        self._bones = self._read_bones(names) if skinned and "JOINTS_0" in names else None
        material = primitive.get("material")
        uv = {i: self._attribute(names, f"TEXCOORD_{i}", 2) for i in materials.sets(material)}
        self._uv = {
            i: values.astype(np.float64)[self.faces]
            for i, values in uv.items()
            if values is not None and np.isfinite(values).all()
        }
        colors = self._attribute(names, "COLOR_0", 3, 4)
        self._colors = None
        if colors is not None and colors.dtype.kind in "iu":  # not marked as normalised, which colours have to be
            self._colors = np.clip(colors[:, :3] / np.iinfo(colors.dtype).max, 0, 1)[self.faces]
        elif colors is not None:
            self._colors = np.clip(np.nan_to_num(colors[:, :3].astype(np.float64)), 0, 1)[self.faces]
        self._material = materials.of(material, frozenset(self._uv))

    def _attribute(self, names: dict[str, Any], name: str, *widths: int) -> Num[np.ndarray, "n width"] | None:
        """An attribute of the primitive or of one of its morph targets, at the vertices that its faces use."""
        if name not in names:
            return None
        count = accessor_count(self._document, names[name])
        if names is self._primitive["attributes"] and name in self._packed:
            values = self._packed[name][self._rows]
        else:
            values = read_accessor(self._document, names[name], self._rows if count == self._total else self._rows[:0])
        if values.shape[1] not in widths or count != self._total:
            raise UnirenderError(
                f"{name} is {count:,} times {values.shape[1]}, expected {self._total:,} times {widths}; export it again"
            )
        return values

    def _read_bones(self, names: dict[str, Any]) -> tuple[Int[np.ndarray, "n k"], Float[np.ndarray, "n k"]]:
        """The joints of each vertex, four for each set that the primitive has, and their weights."""
        sets = range(sum(name.startswith("JOINTS_") for name in names))
        joints, weights = ([self._attribute(names, f"{kind}_{i}", 4) for i in sets] for kind in ("JOINTS", "WEIGHTS"))
        found = [(j, w) for j, w in zip(joints, weights, strict=True) if j is not None and w is not None]
        if len(found) < len(sets):
            raise UnirenderError("has JOINTS without WEIGHTS of the same number; export it again")
        return (
            np.concatenate([j.astype(np.int64) for j, _ in found], axis=1),
            np.concatenate([w.astype(np.float64) for _, w in found], axis=1),
        )

    def placed(self, place: Place, skin: Skin | None) -> Piece:
        """The piece in the world; a mirroring matrix turns the faces round, so that they stay outside."""
        points, normals = self._morphed(place.weights)
        if skin is not None and self._bones is not None:
            vertices, normals, mirrored = skin.pose(points, normals, *self._bones)
            stretch = max(float(np.linalg.norm(linear, 2)) for linear in skin.matrices[:, :3, :3])
        else:
            linear = place.matrix[:3, :3]
            mirrored = bool(np.linalg.det(linear) < 0)
            vertices = points @ linear.T + place.matrix[:3, 3]
            if normals is not None:
                normals = normals @ (-cofactors(linear) if mirrored else cofactors(linear)).T
            stretch = float(np.linalg.norm(linear, 2))
        turn = [0, 2, 1] if mirrored else [0, 1, 2]
        faces = self.faces[:, turn]
        return Piece(
            vertices=vertices,
            faces=faces,
            normals=flat_normals(vertices, faces) if normals is None else normals[faces],  # glTF 2.0, 3.7.2.1
            uv={i: values[:, turn] for i, values in self._uv.items()},
            colors=None if self._colors is None else self._colors[:, turn],
            material=self._material,
            step=self._step * stretch,
        )

    def _morphed(self, weights: Sequence[float]) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"] | None]:
        """Points and normals with the morph targets added (glTF 2.0, section 3.7.2.2)."""
        points, normals = self._points, self._normals
        if not any(weights):
            return points, normals
        targets = self._primitive.get("targets", [])
        if len(weights) != len(targets):
            raise UnirenderError(
                f"has {len(targets)} morph targets and {len(weights)} weights, expected one for each; export it again"
            )
        for weight, target in zip(weights, targets, strict=True):
            if weight == 0:
                continue
            further, turned = (self._attribute(target, name, 3) for name in ("POSITION", "NORMAL"))
            points = points if further is None else points + weight * further
            normals = normals if normals is None or turned is None else normals + weight * turned
        return points, normals


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
