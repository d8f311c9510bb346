"""Where the meshes of a glTF scene stand: its nodes (glTF 2.0, section 3.5) and `EXT_mesh_gpu_instancing`."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from unirender.errors import UnirenderError
from unirender_reference.meshes.gltf_accessors import read_accessor
from unirender_reference.meshes.gltf_document import Document
from unirender_reference.meshes.gltf_materials import vector
from unirender_reference.meshes.limits import MAX_NODES, check_pieces

UNIT_TOLERANCE = (
    0.0077  # of a quaternion's length: what signed bytes leave, as Khronos' validator allows; more would shear
)
VISIBILITY = "KHR_node_visibility"
INSTANCING = "EXT_mesh_gpu_instancing"
AT_REST = {"TRANSLATION": [0.0, 0.0, 0.0], "ROTATION": [0.0, 0.0, 0.0, 1.0], "SCALE": [1.0, 1.0, 1.0]}


@dataclass(frozen=True)
class Place:
    """Where a mesh stands, and in which shape.

    Attributes:
        matrix: of its node in the world.
        skin: its index: of a mesh with a skin the joints say where it stands.
        weights: of its morph targets; empty: 0.
    """

    matrix: Float[np.ndarray, "4 4"]
    skin: object
    weights: tuple[float, ...]

    def is_hidden(self) -> bool:
        """Whether it is scaled to nothing along all axes, as animations hide a mesh (glTF 2.0, section 3.5.3)."""
        return self.skin is None and not self.matrix[:3, :3].any()


class World:
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


def mesh_places(document: Document) -> Iterator[tuple[int, Place]]:
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
            weights = _weights(node, document.item("meshes", node["mesh"]))
            for own in _instances(document, node):
                place = Place(matrix @ own, node.get("skin"), weights)
                if not place.is_hidden():
                    yield node["mesh"], place
        waiting += [(child, matrix) for child in reversed(node.get("children", []))]


def _weights(*owners: dict[str, Any]) -> tuple[float, ...]:
    """Those of the morph targets, from the first that has some: a node's go before its mesh's."""
    found: list[Any] = next((owner["weights"] for owner in owners if "weights" in owner), [])
    return tuple(vector({"weights": found}, "weights", [0.0] * len(found)).tolist())


def _instances(document: Document, node: dict[str, Any]) -> Iterator[Float[np.ndarray, "4 4"]]:
    """Where a mesh stands in the space of its node: once, or where the extension has it."""
    attributes = node.get("extensions", {}).get(INSTANCING, {}).get("attributes", {})
    stored = {name: read_accessor(document, attributes[name]) for name in AT_REST if name in attributes}
    if not stored:
        yield np.eye(4)
        return
    count = len(next(iter(stored.values())))
    check_pieces(count)
    for name, values in stored.items():
        if values.shape != (count, len(AT_REST[name])):
            raise UnirenderError(
                f"{name} of its instances is {len(values):,} times {values.shape[1]}, expected {count:,} times "
                f"{len(AT_REST[name])}; export it again"
            )
    for i in range(count):
        own = {name: values[i].tolist() for name, values in stored.items()}
        yield _matrix(*(vector(own, name, at_rest) for name, at_rest in AT_REST.items()))


def _local(node: dict[str, Any]) -> Float[np.ndarray, "4 4"]:
    """The node's own transform: its matrix, or translation, rotation (a unit quaternion) and scale."""
    if "matrix" in node:
        return vector(node, "matrix", [0.0] * 16).reshape(4, 4).T
    return _matrix(*(vector(node, name.lower(), at_rest) for name, at_rest in AT_REST.items()))


def _matrix(
    translation: Float[np.ndarray, "3"], quaternion: Float[np.ndarray, "4"], scale: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "4 4"]:
    x, y, z, w = quaternion
    length = np.linalg.norm(quaternion)
    if abs(length - 1) > UNIT_TOLERANCE:
        raise UnirenderError(
            f"a node's or instance's rotation has the length {length:.3g}, expected a unit quaternion; export it again"
        )
    rotation = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )
    matrix = np.eye(4)
    matrix[:3, :3] = rotation * scale
    matrix[:3, 3] = translation
    return matrix
