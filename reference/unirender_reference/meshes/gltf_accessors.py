"""glTF accessors as arrays: strides, normalised integers, sparse values, Draco (glTF 2.0, section 3.6.2)."""

from typing import Any

import numpy as np
from jaxtyping import Int, Num

from unirender.errors import UnirenderError
from unirender_reference.meshes.gltf_document import Document, size
from unirender_reference.meshes.limits import MAX_VERTICES

TYPES = {5120: np.int8, 5121: np.uint8, 5122: np.int16, 5123: np.uint16, 5125: np.uint32, 5126: np.float32}
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}
DRACO = "KHR_draco_mesh_compression"


def read_accessor(
    document: Document, index: object, rows: Int[np.ndarray, " n"] | None = None
) -> Num[np.ndarray, "n width"]:
    """The values of an accessor; normalised integers become float32, others keep their type.

    Args:
        document: the file.
        index: of the accessor.
        rows: the elements to read, sorted, each once and within the accessor; None: all. Memory goes with their number.

    Raises:
        UnirenderError: the accessor is of an unknown type, too long, or does not lie within its buffer view.
    """
    accessor = document.item("accessors", index)
    width, dtype, count = _layout(accessor, index)
    if "bufferView" in accessor and count:
        view = document.view(accessor["bufferView"])
        stride = size(document.item("bufferViews", accessor["bufferView"]), "byteStride", 0)
        stored = _strided(view, size(accessor, "byteOffset", 0), stride, count, width, dtype, index)
        values = stored if rows is None else stored[rows]
    else:
        values = np.zeros((count if rows is None else len(rows), width), dtype)
    if "sparse" in accessor:
        values = values.copy()
        _patch(document, values, np.arange(count) if rows is None else rows, count, accessor["sparse"], index)
    return _normalized(values) if accessor.get("normalized") else values


def accessor_count(document: Document, index: object) -> int:
    """How many elements an accessor claims; nothing is read."""
    return _layout(document.item("accessors", index), index)[2]


def _layout(accessor: dict[str, Any], index: object) -> tuple[int, Any, int]:
    kind, component, count = accessor.get("type"), accessor.get("componentType"), size(accessor, "count")
    if kind not in WIDTHS or component not in TYPES:
        raise UnirenderError(
            f"accessors[{index}] has type {kind} of {component}, which is not read here; export it again"
        )
    if count > MAX_VERTICES:
        raise UnirenderError(
            f"accessors[{index}] counts {count:,} elements, expected at most {MAX_VERTICES:,}; decimate the mesh"
        )
    return WIDTHS[kind], np.dtype(TYPES[component]).newbyteorder("<"), count


def _strided(
    view: memoryview, offset: int, stride: int, count: int, width: int, dtype: Any, index: object
) -> Num[np.ndarray, "count width"]:
    item = width * dtype.itemsize
    stride = stride or item
    needed = offset + (count - 1) * stride + item
    if stride < item or needed > len(view):
        raise UnirenderError(
            f"accessors[{index}] needs {needed:,} bytes for {count:,} elements, its view has {len(view):,}: cut off; "
            "export it again"
        )
    return np.ndarray((count, width), dtype, view, offset, (stride, dtype.itemsize))


def _patch(
    document: Document,
    values: Num[np.ndarray, "n width"],
    rows: Int[np.ndarray, " n"],
    total: int,
    sparse: dict[str, Any],
    index: object,
) -> None:
    """Writes the sparse values over the dense ones, which are those of some rows of the accessor."""
    count, where, what = size(sparse, "count"), sparse.get("indices", {}), sparse.get("values", {})
    if not 0 < count <= total or where.get("componentType") not in (5121, 5123, 5125):
        raise UnirenderError(f"accessors[{index}] has {count} sparse values for {total} elements; export it again")
    place = np.dtype(TYPES[where["componentType"]]).newbyteorder("<")
    at = _strided(document.view(where.get("bufferView")), size(where, "byteOffset", 0), 0, count, 1, place, index)[:, 0]
    if at.max() >= total:
        raise UnirenderError(
            f"accessors[{index}] has a sparse value at {at.max():,}, but {total:,} elements; export it again"
        )
    view, offset = document.view(what.get("bufferView")), size(what, "byteOffset", 0)
    new = _strided(view, offset, 0, count, values.shape[1], values.dtype, index)
    slot = np.minimum(np.searchsorted(rows, at), max(len(rows) - 1, 0))
    wanted = rows[slot] == at if len(rows) else np.zeros(count, bool)
    values[slot[wanted]] = new[wanted]


def _normalized(values: Num[np.ndarray, "count width"]) -> Num[np.ndarray, "count width"]:
    if values.dtype.kind not in "iu":
        return values
    return np.maximum(values.astype(np.float32) / np.iinfo(values.dtype).max, -1)


def read_draco(document: Document, primitive: dict[str, Any]) -> dict[str, Num[np.ndarray, "count width"]]:
    """The attributes of a Draco-compressed primitive by name, and its `indices`.

    Raises:
        UnirenderError: DracoPy is not installed, or the data is damaged or does not fit its accessors.
    """
    try:
        import DracoPy
    except ImportError as error:
        raise UnirenderError("is compressed with Draco: install DracoPy (pip install DracoPy) to read it") from error
    extension = primitive["extensions"][DRACO]
    names = {ident: name for name, ident in extension.get("attributes", {}).items()}
    accessors = {name: document.item("accessors", i) for name, i in primitive.get("attributes", {}).items()}
    for name, accessor in accessors.items():
        _layout(accessor, primitive["attributes"][name])  # so that no claim is decoded that is refused anyway
    try:
        decoded = DracoPy.decode(bytes(document.view(extension.get("bufferView"))))
    except UnirenderError:
        raise
    except Exception as error:  # what DracoPy raises is not documented
        raise UnirenderError(f"its Draco data is damaged ({error}); export it again") from error
    arrays: dict[str, Num[np.ndarray, "count width"]] = {}
    for attribute in decoded.attributes:
        name = names.get(attribute["unique_id"], "")
        if name in accessors:
            values = np.asarray(attribute["data"])
            values = values.reshape(len(values), -1)
            if len(values) != accessors[name].get("count"):
                raise UnirenderError(
                    f"its Draco data holds {len(values):,} {name}, expected {accessors[name]['count']:,}; "
                    "export it again"
                )
            arrays[name] = _normalized(values) if accessors[name].get("normalized") else values
    faces = getattr(decoded, "faces", None)
    if faces is None or not len(faces):
        raise UnirenderError("its Draco data has no faces, expected a triangle mesh; is it a point cloud?")
    claimed = accessor_count(document, primitive["indices"]) if "indices" in primitive else len(faces) * 3
    if np.size(faces) > claimed:
        raise UnirenderError(f"its Draco data holds {np.size(faces):,} indices, expected {claimed:,}; export it again")
    arrays["indices"] = np.asarray(faces).reshape(-1, 1)
    return arrays
