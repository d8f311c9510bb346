"""glTF files written byte by byte from the specification, with pictures whose texels are known, and broken ones.

All good files show the quad [-1, 1]^2 in the plane z = 0 to the viewer; `QuadFile` says what each of its points is.
"""

import base64
import io
import json
import struct
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from unirender.color import srgb_decode

CORNERS = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], np.float32)
QUAD_UV = np.array([[0, 1], [1, 1], [1, 0], [0, 0]], np.float32)  # v = 0 is the picture's first row
QUAD_FACES = np.array([0, 1, 2, 0, 2, 3], np.uint16)
COMPONENTS = {"b": 5120, "B": 5121, "h": 5122, "H": 5123, "I": 5125, "f": 5126}
WIDTHS = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4"}


class GltfWriter:
    """Collects accessors, pictures and materials; writes them as GLB, or as .gltf with its buffers where told."""

    def __init__(self) -> None:
        self.body = b""
        self.json: dict[str, Any] = {"asset": {"version": "2.0"}, "scene": 0}
        for key in ("bufferViews", "accessors", "images", "textures", "samplers", "materials", "meshes", "nodes"):
            self.json[key] = []

    def _add(self, key: str, value: Any) -> int:
        self.json[key].append(value)
        return len(self.json[key]) - 1

    def view(self, data: bytes, **more: Any) -> int:
        start = len(self.body)
        self.body += data + b"\0" * (-len(data) % 4)
        return self._add("bufferViews", {"buffer": 0, "byteOffset": start, "byteLength": len(data), **more})

    def accessor(self, values: np.ndarray, normalized: bool = False, **more: Any) -> int:
        values = np.atleast_2d(values.T).T
        extra = {"normalized": True} if normalized else {}
        kind = {"componentType": COMPONENTS[values.dtype.char.replace("L", "I")], "type": WIDTHS[values.shape[1]]}
        view = self.view(np.ascontiguousarray(values).tobytes())
        return self._add("accessors", {"bufferView": view, "count": len(values), **kind, **extra, **more})

    def texture(self, pixels: np.ndarray, wrap: tuple[int, int] | None = None, uri: str | None = None) -> int:
        """A PNG of uint8 pixels, inside the buffer or named by `uri`."""
        image = {"uri": uri} if uri else {"bufferView": self.view(png(pixels)), "mimeType": "image/png"}
        texture = {"source": self._add("images", image)}
        if wrap:
            texture["sampler"] = self._add("samplers", {"wrapS": wrap[0], "wrapT": wrap[1]})
        return self._add("textures", texture)

    def material(self, **material: Any) -> int:
        return self._add("materials", material)

    def mesh(self, *primitives: dict[str, Any], **node: Any) -> None:
        self._add("nodes", {"mesh": self._add("meshes", {"primitives": list(primitives)}), **node})

    def quad(self, material: int | None, corners: np.ndarray = CORNERS, uv: np.ndarray = QUAD_UV) -> dict[str, Any]:
        """A primitive of two triangles."""
        attributes = {"POSITION": self.accessor(corners), "TEXCOORD_0": self.accessor(uv)}
        primitive = {"attributes": attributes, "indices": self.accessor(QUAD_FACES)}
        return primitive | ({} if material is None else {"material": material})

    def document(self) -> dict[str, Any]:
        self.json["scenes"] = [{"nodes": list(range(len(self.json["nodes"])))}]
        self.json["buffers"] = [{"byteLength": len(self.body)}]
        return {key: value for key, value in self.json.items() if value != []}

    def glb(self, path: Path) -> Path:
        text = json.dumps(self.document()).encode()
        text += b" " * (-len(text) % 4)
        body = self.body + b"\0" * (-len(self.body) % 4)
        chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(body), b"BIN\0") + body
        path.write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks)
        return path

    def gltf(self, path: Path, external: bool) -> Path:
        """With the buffer in a file of its own or in a data URI."""
        document = self.document()
        if external:
            path.with_suffix(".bin").write_bytes(self.body)
            document["buffers"][0]["uri"] = path.with_suffix(".bin").name
        else:
            content = base64.b64encode(self.body).decode()
            document["buffers"][0]["uri"] = f"data:application/octet-stream;base64,{content}"
        path.write_text(json.dumps(document))
        return path


def png(pixels: np.ndarray) -> bytes:
    stream = io.BytesIO()
    Image.fromarray(pixels).save(stream, "PNG")
    return stream.getvalue()


def random_pixels(seed: int, height: int, width: int) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (height, width, 3), dtype=np.uint8)


def bilinear(texels: np.ndarray, uv: np.ndarray, wrap: tuple[str, str] = ("repeat", "repeat")) -> np.ndarray:
    """What a renderer shows at uv (v from the first row): the four texels around it, by distance."""
    size = texels.shape[1::-1]
    place = uv * size - 0.5
    near = np.floor(place).astype(int)
    out = np.zeros((len(uv), texels.shape[2]))
    for step in np.ndindex(2, 2):
        index = near + step
        weight = 1 - np.abs(place - index)
        column, row = (fold(index[:, k], size[k], wrap[k]) for k in (0, 1))
        out += weight.prod(1)[:, None] * texels[row, column]
    return out


def fold(index: np.ndarray, count: int, wrap: str) -> np.ndarray:
    """The texel that an index means, from a picture unrolled eight times to either side."""
    if wrap == "clamp":
        texel = np.repeat([0, *range(count), count - 1], [8 * count, *[1] * count, 7 * count])
    else:
        texel = np.tile([*range(count), *(reversed(range(count)) if wrap == "mirror" else range(count))], 8)
    return texel[index + 8 * count]


@dataclass(frozen=True)
class QuadFile:
    """A file and, for points (x, y) of the quad, what its channels are there (normals in tangent space, y up)."""

    path: Path
    channels: dict[str, Callable[[np.ndarray], np.ndarray]]
    pixels: dict[str, np.ndarray] = field(default_factory=dict)  # as stored


def quad_uv(points: np.ndarray) -> np.ndarray:
    return np.stack([(points[:, 0] + 1) / 2, (1 - points[:, 1]) / 2], axis=-1)


def unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def constant(*values: float) -> Callable[[np.ndarray], np.ndarray]:
    return lambda points: np.tile(np.array(values), (len(points), 1))


def write_metallic_roughness(folder: Path) -> QuadFile:
    """GLB: sRGB base colour times a linear factor; roughness in G, metallic in B, rubbish in R; factors."""
    base, both = random_pixels(1, 8, 8), random_pixels(2, 8, 8)
    factor = np.array([0.5, 1.0, 0.25])
    writer = GltfWriter()
    pbr = {
        "baseColorTexture": {"index": writer.texture(base)},
        "baseColorFactor": [*factor, 1.0],
        "metallicRoughnessTexture": {"index": writer.texture(both)},
        "roughnessFactor": 0.75,
        "metallicFactor": 0.5,
    }
    writer.mesh(writer.quad(writer.material(pbrMetallicRoughness=pbr)))
    albedo, scalars = srgb_decode(base / 255) * factor, both[..., 1:] / 255 * [0.75, 0.5]
    channels = {
        "albedo": lambda points: bilinear(albedo, quad_uv(points)),
        "roughness": lambda points: bilinear(scalars, quad_uv(points))[:, :1],
        "metallic": lambda points: bilinear(scalars, quad_uv(points))[:, 1:],
    }
    return QuadFile(writer.glb(folder / "metallic_roughness.glb"), channels, {"base": base, "both": both})


def write_normal_mapped(folder: Path) -> QuadFile:
    """GLB: a normal map with a scale, seen upright on the left half of the quad and mirrored on its right half."""
    stored = random_pixels(3, 8, 8)
    stored[..., 2] = 190 + stored[..., 2] // 4
    scale = 0.5
    writer = GltfWriter()
    material = writer.material(
        pbrMetallicRoughness={"baseColorFactor": [0.5, 0.5, 0.5, 1], "metallicFactor": 0, "roughnessFactor": 0.5},
        normalTexture={"index": writer.texture(stored), "scale": scale},
    )
    left, right = CORNERS.copy(), CORNERS.copy()
    left[[1, 2], 0] = 0
    right[[0, 3], 0] = 0
    writer.mesh(
        writer.quad(material, left),
        writer.quad(material, right, QUAD_UV * np.array([-1, 1], np.float32) + np.array([1, 0], np.float32)),
    )
    vectors = unit((stored / 255 * 2 - 1) * [scale, scale, 1])

    def tangent(points: np.ndarray) -> np.ndarray:
        return unit(bilinear(vectors, mirrored_uv(points)))

    channels = {"albedo": constant(0.5, 0.5, 0.5), "roughness": constant(0.5), "metallic": constant(0.0)}
    return QuadFile(writer.glb(folder / "normal_mapped.glb"), channels | {"normal": tangent}, {"normal": stored})


def mirrored_uv(points: np.ndarray) -> np.ndarray:
    """Coordinates of `write_normal_mapped`: 0 to 1 over the left half, 1 to 0 over the right half."""
    return np.stack([1 - np.abs(points[:, 0]), (1 - points[:, 1]) / 2], axis=-1)


def write_transformed(folder: Path) -> QuadFile:
    """.gltf with a .bin and a PNG of 8 x 4 texels: all of KHR_texture_transform, mirrored repeat and clamp."""
    base = random_pixels(4, 4, 8)
    (folder / "base colour.png").write_bytes(png(base))
    offset, angle, scale = np.array([0.3, -0.2]), 0.4, np.array([1.7, 1.2])
    writer = GltfWriter()
    transform = {"offset": list(offset), "rotation": angle, "scale": list(scale)}
    info = {
        "index": writer.texture(base, (33648, 33071), uri="base%20colour.png"),
        "extensions": {"KHR_texture_transform": transform},
    }
    pbr = {"baseColorTexture": info, "roughnessFactor": 0.25, "metallicFactor": 1.0}
    writer.json |= {"extensionsUsed": ["KHR_texture_transform"], "extensionsRequired": ["KHR_texture_transform"]}
    writer.mesh(writer.quad(writer.material(pbrMetallicRoughness=pbr)))
    albedo = srgb_decode(base / 255)

    def color(points: np.ndarray) -> np.ndarray:
        uv = quad_uv(points) * scale
        # counter-clockwise on the screen, where v runs down
        turned = np.stack(
            [np.cos(angle) * uv[:, 0] + np.sin(angle) * uv[:, 1], np.cos(angle) * uv[:, 1] - np.sin(angle) * uv[:, 0]],
            1,
        )
        return bilinear(albedo, turned + offset, ("mirror", "clamp"))

    channels = {"albedo": color, "roughness": constant(0.25), "metallic": constant(1.0)}
    return QuadFile(writer.gltf(folder / "transformed.gltf", external=True), channels, {"base": base})


def write_colored(folder: Path) -> QuadFile:
    """.gltf with a data URI: a strip with interleaved positions and normalised 16-bit colours, times a factor."""
    colors = np.array(
        [[0.4, 0.3, 0.5], [0.9, 0.5, 0.4], [0.2, 0.6, 0.7], [0.8, 0.2, 0.6]]
    )  # of (-1,-1), (1,-1), (-1,1), (1,1)
    stored = np.round(colors * 65535).astype(np.uint16)
    strip = CORNERS[[0, 1, 3, 2]]
    writer = GltfWriter()
    rows = np.zeros(4, np.dtype([("position", "<f4", 3), ("color", "<u2", 4)]))
    rows["position"], rows["color"][:, :3], rows["color"][:, 3] = strip, stored, 65535
    view = writer.view(rows.tobytes(), byteStride=rows.itemsize)
    for kind, component, offset, extra in (("VEC3", 5126, 0, {}), ("VEC4", 5123, 12, {"normalized": True})):
        accessor = {"bufferView": view, "byteOffset": offset, "count": 4, "type": kind, "componentType": component}
        writer.json["accessors"].append(accessor | extra)
    factor = [0.5, 0.8, 1.0]
    material = writer.material(pbrMetallicRoughness={"baseColorFactor": [*factor, 1.0]})
    writer.mesh({"attributes": {"POSITION": 0, "COLOR_0": 1}, "mode": 5, "material": material})

    def color(points: np.ndarray) -> np.ndarray:
        """Linear in each triangle of the strip: (0, 1, 2) below the diagonal, (1, 3, 2) above it."""
        x, y = ((points + 1) / 2).T[..., None]
        lower = colors[0] + x * (colors[1] - colors[0]) + y * (colors[2] - colors[0])
        upper = colors[3] + (1 - x) * (colors[2] - colors[3]) + (1 - y) * (colors[1] - colors[3])
        return np.where(x + y <= 1, lower, upper) * factor

    channels = {"albedo": color, "roughness": constant(1.0), "metallic": constant(1.0)}
    return QuadFile(writer.gltf(folder / "colored.gltf", external=False), channels)


def write_two_materials(folder: Path) -> QuadFile:
    """GLB: the left half with pictures on TEXCOORD_1, the right half plain, in a mirrored node."""
    base, both = random_pixels(5, 8, 8), random_pixels(6, 8, 8)
    writer = GltfWriter()
    textured = writer.material(
        pbrMetallicRoughness={
            "baseColorTexture": {"index": writer.texture(base), "texCoord": 1},
            "metallicRoughnessTexture": {"index": writer.texture(both), "texCoord": 1},
        }
    )
    plain = writer.material(
        pbrMetallicRoughness={"baseColorFactor": [0.1, 0.2, 0.3, 1], "roughnessFactor": 0.4, "metallicFactor": 0.6}
    )
    left = CORNERS.copy()
    left[[1, 2], 0] = 0
    primitive = writer.quad(textured, left, np.zeros((4, 2), np.float32))
    primitive["attributes"]["TEXCOORD_1"] = writer.accessor(QUAD_UV)
    writer.mesh(primitive)
    writer.mesh(writer.quad(plain, left), scale=[-1, 1, 1])  # lands on the right half, faces turned round
    albedo, scalars = srgb_decode(base / 255), both[..., 1:] / 255

    def sides(picture: np.ndarray, value: list[float]) -> Callable[[np.ndarray], np.ndarray]:
        def at(points: np.ndarray) -> np.ndarray:
            uv = np.stack([points[:, 0] + 1, (1 - points[:, 1]) / 2], axis=-1)
            return np.where(points[:, :1] < 0, bilinear(picture, uv), value)

        return at

    channels = {
        "albedo": sides(albedo, [0.1, 0.2, 0.3]),
        "roughness": sides(scalars[..., :1], [0.4]),
        "metallic": sides(scalars[..., 1:], [0.6]),
    }
    return QuadFile(writer.glb(folder / "two_materials.glb"), channels, {"base": base, "both": both})


GOOD = (write_metallic_roughness, write_normal_mapped, write_transformed, write_colored, write_two_materials)
