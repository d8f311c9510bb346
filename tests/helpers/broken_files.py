"""Files that nobody should render, and for each the reason that a user should read: broken ones, and greedy ones."""

import json
import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from gltf_files import CORNERS, GltfWriter, random_pixels


def _textured(writer: GltfWriter, **texture: Any) -> dict[str, Any]:
    texture = {"index": writer.texture(random_pixels(0, 4, 4), **texture)}
    return writer.quad(writer.material(pbrMetallicRoughness={"baseColorTexture": texture}))


def truncated(folder: Path) -> Path:
    writer = GltfWriter()
    writer.mesh(_textured(writer))
    path = writer.glb(folder / "truncated.glb")
    path.write_bytes(path.read_bytes()[:-200])
    return path


def wrong_magic(folder: Path) -> Path:
    path = folder / "wrong_magic.glb"
    path.write_bytes(b"PK\x03\x04" + bytes(200))
    return path


def no_faces(folder: Path) -> Path:
    writer = GltfWriter()
    writer.mesh({"attributes": {"POSITION": writer.accessor(CORNERS)}, "mode": 0})
    return writer.glb(folder / "no_faces.glb")


def nan_vertices(folder: Path) -> Path:
    writer = GltfWriter()
    corners = CORNERS.copy()
    corners[1, 2] = np.nan
    writer.mesh(writer.quad(None, corners))
    return writer.glb(folder / "nan_vertices.glb")


def zero_area(folder: Path) -> Path:
    writer = GltfWriter()
    writer.mesh(writer.quad(None, CORNERS * np.array([1, 0, 0], np.float32)))
    return writer.glb(folder / "zero_area.glb")


def missing_texture(folder: Path) -> Path:
    writer = GltfWriter()
    writer.mesh(_textured(writer, uri="nowhere.png"))
    return writer.glb(folder / "missing_texture.glb")


def texture_bomb(folder: Path) -> Path:
    """A PNG of 60,000 x 60,000 grey pixels (3.6 GB) in 14 kB."""
    packer = zlib.compressobj(9)
    row = bytes(60_001)
    data = (
        b"".join(packer.compress(row) for _ in range(200)) + packer.flush()
    )  # the rest of the rows is never asked for

    def chunk(kind: bytes, content: bytes) -> bytes:
        return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))

    header = struct.pack(">IIBBBBB", 60_000, 60_000, 8, 0, 0, 0, 0)
    png = b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", data) + chunk(b"IEND", b"")
    (folder / "bomb.png").write_bytes(png)
    writer = GltfWriter()
    writer.mesh(_textured(writer, uri="bomb.png"))
    return writer.gltf(folder / "texture_bomb.gltf", external=False)


def huge_scale(folder: Path) -> Path:
    writer = GltfWriter()
    writer.mesh(writer.quad(None), scale=[1e9, 1e9, 1e9])
    return writer.glb(folder / "huge_scale.glb")


def huge_index(folder: Path) -> Path:
    writer = GltfWriter()
    primitive = writer.quad(None)
    primitive["indices"] = writer.accessor(np.array([0, 1, 4_000_000_000], np.uint32))
    writer.mesh(primitive)
    return writer.glb(folder / "huge_index.glb")


def outside(folder: Path) -> Path:
    (folder.parent / "secret.png").write_bytes(b"not for you")
    writer = GltfWriter()
    writer.mesh(_textured(writer, uri="..%2Fsecret.png"))
    return writer.glb(folder / "outside.glb")


BROKEN: dict[Callable[[Path], Path], str] = {
    truncated: r"truncated: has [\d,]+ bytes, its header says [\d,]+",
    wrong_magic: r"starts with b'PK\\x03\\x04', expected b'glTF'",
    no_faces: "has no faces, expected a triangle mesh",
    nan_vertices: "1 of 6 corner points are NaN or infinite",
    zero_area: "zero area: all 2 faces are points or lines",
    missing_texture: "texture 'nowhere.png' is missing from the model's folder",
    texture_bomb: "texture 'bomb.png': 3,600,000,000 pixels, expected at most 67,108,864",
    huge_scale: r"extent 2e\+09 units, expected 1e-08 to 1e\+08",
    huge_index: "name vertex 4,000,000,000, but it has 4 vertices",
    outside: r"texture '..%2Fsecret.png' lies outside the model's folder",
}


def _write_gltf(path: Path, **document: Any) -> Path:
    path.write_text(json.dumps({"asset": {"version": "2.0"}, **document}))
    return path


def vertices_of_no_bytes(folder: Path) -> Path:
    """14 kB: 300 primitives that each claim the 3 million zero vertices of an accessor without data."""
    primitive = {"attributes": {"POSITION": 0}, "indices": 1}
    accessors = [
        {"type": "VEC3", "componentType": 5126, "count": 3_000_000},
        {"type": "SCALAR", "componentType": 5125, "count": 3},
    ]
    meshes = [{"primitives": [primitive] * 300}]
    return _write_gltf(folder / "vertices.gltf", accessors=accessors, meshes=meshes, nodes=[{"mesh": 0}])


def primitives_times_nodes(folder: Path) -> Path:
    """1 MB: a mesh of 20,000 empty primitives, in 50,000 nodes."""
    meshes = [{"primitives": [{"attributes": {}}] * 20_000}]
    return _write_gltf(folder / "primitives.gltf", meshes=meshes, nodes=[{"mesh": 0}] * 50_000)


def one_file_as_many_buffers(folder: Path) -> Path:
    """Twenty buffers that name one file of 64 MiB."""
    with (folder / "zeros.bin").open("wb") as file:
        file.truncate(2**26)
    accessor = {"componentType": 5126, "count": 3, "type": "VEC3"}
    return _write_gltf(
        folder / "buffers.gltf",
        buffers=[{"byteLength": 36, "uri": "zeros.bin"}] * 20,
        bufferViews=[{"buffer": i, "byteLength": 36} for i in range(20)],
        accessors=[accessor | {"bufferView": i} for i in range(20)],
        meshes=[{"primitives": [{"attributes": {"POSITION": i}} for i in range(20)]}],
        nodes=[{"mesh": 0}],
    )


def long_line(folder: Path) -> Path:
    """A polygon of 20 million corners on one line."""
    path = folder / "line.obj"
    path.write_bytes(b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf " + b"1 " * 20_000_000 + b"\n")
    return path


GREEDY: dict[Callable[[Path], Path], str] = {
    vertices_of_no_bytes: "zero extent",
    primitives_times_nodes: "has more than 50,000 primitives in all instances; merge its meshes",
    one_file_as_many_buffers: "zero extent",
    long_line: "line 4 has more than 1,048,576 bytes",
}
