"""glTF 2.0 containers: the JSON, its objects by index, and the bytes of buffers (glTF 2.0, sections 3.6 and 4)."""

import base64
import binascii
import json
import struct
from pathlib import Path
from typing import Any, NoReturn

from unirender.errors import UnirenderError
from unirender_reference.meshes.folder import ModelFolder
from unirender_reference.meshes.limits import MAX_TEXT_BYTES, check_bytes

READABLE = {
    "EXT_mesh_gpu_instancing",
    "KHR_draco_mesh_compression",
    "KHR_materials_pbrSpecularGlossiness",
    "KHR_mesh_quantization",
    "KHR_node_visibility",
    "KHR_texture_transform",
    "EXT_texture_avif",
    "EXT_texture_webp",
}
ADVICE = {  # by extension that is not read: what to do; of others the file is to be exported without them
    "EXT_meshopt_compression": "export it without compression, or with Draco",
    "KHR_meshopt_compression": "export it without compression, or with Draco",
    "KHR_texture_basisu": "export its textures as PNG or JPEG",
    "MSFT_texture_dds": "export its textures as PNG or JPEG",
}
JSON_CHUNK, BINARY_CHUNK = b"JSON", b"BIN\0"


class Document:
    """The JSON of a glTF file, with its buffers on request.

    Args:
        path: a .glb or .gltf file.
        folder: where its buffers and pictures may lie.

    Raises:
        UnirenderError: cut off, no glTF 2.0, broken JSON, or an extension is required that we cannot read.
    """

    def __init__(self, path: Path, folder: ModelFolder) -> None:
        self.folder = folder
        text, self._binary = _glb(path) if path.suffix.lower() == ".glb" else (_text(path), None)
        self._buffers: dict[str | None, bytes] = {}  # by uri: several may name one file
        try:
            self.json = json.loads(text, parse_constant=_no_constant)
        except (ValueError, RecursionError) as error:
            raise UnirenderError(f"its JSON is broken ({error}); export it again") from error
        version = self.json.get("asset", {}).get("version") if isinstance(self.json, dict) else None
        if not str(version).startswith("2."):
            raise UnirenderError(f"glTF version {version}, expected 2.0; convert it")
        required = sorted(set(self.json.get("extensionsRequired", [])) - READABLE - _harmless(self.json))
        if required:
            advice = dict.fromkeys(ADVICE.get(name, "export it without") for name in required)
            raise UnirenderError(f"requires {', '.join(required)}, not read here; {'; '.join(advice)}")

    def item(self, kind: str, index: object) -> dict[str, Any]:
        """One object of an array of the JSON.

        Raises:
            UnirenderError: there is no such object.
        """
        items = self.json.get(kind, [])
        if not isinstance(items, list):
            raise UnirenderError(f"its {kind} are {str(items)[:20]}, expected a list; export it again")
        if not isinstance(index, int) or not 0 <= index < len(items):
            raise UnirenderError(f"names {kind}[{index}], but has {len(items)} of them; export it again")
        if not isinstance(items[index], dict):
            raise UnirenderError(f"{kind}[{index}] is {str(items[index])[:20]}, expected an object; export it again")
        return items[index]

    def view(self, index: object) -> memoryview:
        """The bytes of a buffer view.

        Raises:
            UnirenderError: it does not lie within its buffer.
        """
        view = self.item("bufferViews", index)
        data = self._buffer(view.get("buffer"))
        offset, length = size(view, "byteOffset", 0), size(view, "byteLength")
        if offset + length > len(data):
            raise UnirenderError(
                f"bufferViews[{index}] needs bytes {offset:,} to {offset + length:,}, the buffer has {len(data):,}; "
                "copy it again"
            )
        return memoryview(data)[offset : offset + length]

    def resource(self, uri: str, what: str) -> bytes:
        """The bytes of a data URI or of a file in the model's folder.

        Raises:
            UnirenderError: a broken data URI, or a file that cannot be read or lies elsewhere.
        """
        if not uri.startswith("data:"):
            return self.folder.read(uri, what, uri=True)
        header, _, content = uri.partition(",")
        if not header.endswith(";base64"):
            raise UnirenderError(f"{what} {uri[:40]!r}: expected a base64 data URI; export it as GLB")
        try:
            return base64.b64decode(content, validate=True)
        except binascii.Error as error:
            raise UnirenderError(f"{what}: its data URI is broken ({error}); export it again") from error

    def _buffer(self, index: object) -> bytes:
        """The bytes of a buffer, read once; all buffers of a model together have a limit."""
        buffer = self.item("buffers", index)
        uri = buffer.get("uri")
        if uri is None and (packed := sorted(set(buffer.get("extensions", {})) & ADVICE.keys())):
            raise UnirenderError(f"buffers[{index}] stands for {packed[0]}, not read here; {ADVICE[packed[0]]}")
        if uri is None and (index != 0 or self._binary is None):
            raise UnirenderError(f"buffers[{index}] has no data, expected a uri or a binary chunk; export it again")
        if uri not in self._buffers:
            held = len(self._binary or b"") + sum(len(data) for key, data in self._buffers.items() if key is not None)
            if uri is not None and not uri.startswith("data:"):
                check_bytes(held + self.folder.path(uri, "buffer", uri=True).stat().st_size, "the sum of its buffers")
            self._buffers[uri] = (self._binary or b"") if uri is None else self.resource(uri, "buffer")
        data = self._buffers[uri]
        if len(data) < size(buffer, "byteLength"):
            raise UnirenderError(
                f"truncated: buffers[{index}] holds {len(data):,} bytes, expected {buffer['byteLength']:,}; "
                "copy it again"
            )
        return data


def size(owner: dict[str, Any], key: str, default: int | None = None) -> int:
    """A non-negative integer of a JSON object.

    Raises:
        UnirenderError: it is something else.
    """
    value = owner.get(key, default)
    if not isinstance(value, int) or value < 0:
        raise UnirenderError(f"has {key} {value!r}, expected a non-negative integer; export it again")
    return value


def _no_constant(name: str) -> NoReturn:
    raise ValueError(f"{name} is not a number of JSON")


def _harmless(document: dict[str, Any]) -> set[str]:
    """Extensions that only add to a material or a scene: what they add is ignored and listed as such."""
    return {
        name for name in document.get("extensionsRequired", []) if name.startswith(("KHR_materials_", "KHR_lights_"))
    }


def _text(path: Path) -> bytes:
    length = path.stat().st_size
    if length > MAX_TEXT_BYTES:
        raise UnirenderError(f"has {length / 2**20:.0f} MiB of JSON, expected at most {MAX_TEXT_BYTES >> 20}; use GLB")
    return path.read_bytes()


def _glb(path: Path) -> tuple[bytes, bytes | None]:
    """The two chunks of a binary file."""
    actual = path.stat().st_size
    check_bytes(actual, "the file")
    with path.open("rb") as file:
        header = file.read(12)
        if header[:4] != b"glTF":
            raise UnirenderError(f"starts with {header[:4]!r}, expected b'glTF': no GLB file; export it again")
        if len(header) < 12:
            raise UnirenderError(f"truncated: has {actual} bytes, expected a header of 12; copy it again")
        _, version, length = struct.unpack("<4sII", header)
        if version != 2:
            raise UnirenderError(f"glTF version {version}, expected 2.0; convert it")
        if length > actual:
            raise UnirenderError(f"truncated: has {actual:,} bytes, its header says {length:,}; copy it again")
        chunks: dict[bytes, bytes] = {}
        while file.tell() + 8 <= length:
            count, kind = struct.unpack("<I4s", file.read(8))
            if file.tell() + count > length:
                raise UnirenderError(
                    f"truncated: chunk {kind!r} says {count:,} bytes, {length - file.tell():,} are left; copy it again"
                )
            if kind == JSON_CHUNK and count > MAX_TEXT_BYTES:
                raise UnirenderError(
                    f"has {count >> 20} MiB of JSON, expected at most {MAX_TEXT_BYTES >> 20}; merge its nodes"
                )
            data = file.read(count)
            chunks.setdefault(kind, data)
    if JSON_CHUNK not in chunks:
        raise UnirenderError("has no JSON chunk, expected one; export it again")
    return chunks[JSON_CHUNK], chunks.get(BINARY_CHUNK)
