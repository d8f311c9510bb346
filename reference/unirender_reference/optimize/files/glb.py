"""A textured object as binary glTF 2.0 (sections 3.6 to 3.9 and 4.4): one mesh, one material, its pictures inside.

Base colour is stored as sRGB, roughness in G and metallic in B of one linear picture, a normal map as (n + 1) / 2, all
in 8 bits a channel. Texture coordinates count from the first row here and in glTF alike.
"""

import importlib.metadata
import io
import json
import struct
from typing import Any

import numpy as np
from jaxtyping import UInt8
from PIL import Image

from unirender.color import eight_bits, srgb_encode
from unirender.errors import UnirenderError
from unirender_reference.meshes.tiles import refined
from unirender_reference.shapes import MeshObject, Sphere

FLOAT, UNSIGNED = 5126, 5125
ARRAY_BUFFER, ELEMENT_BUFFER = 34962, 34963
REPEAT, LINEAR = 10497, 9729
JSON_CHUNK, BINARY_CHUNK = 0x4E4F534A, 0x004E4942


def glb_bytes(obj: MeshObject, place: Sphere | None = None) -> bytes:
    """A GLB file; equal objects give equal bytes.

    Args:
        obj: with roughness and metallic; vertices are stored as they are, in the unit sphere.
        place: where the object stands in its own units: the node that holds the mesh moves it there.

    Raises:
        UnirenderError: the object lacks texture coordinates or a texture.
    """
    pictures = texture_pixels(obj)
    buffer = _Buffer()
    primitive = {**_geometry(obj, buffer), "material": 0}
    images = [
        {"bufferView": buffer.view(png_bytes(pixels)), "mimeType": "image/png", "name": name}
        for name, pixels in pictures.items()
    ]
    node: dict[str, Any] = {"mesh": 0, "name": obj.name}
    if place is not None:
        node |= {"translation": place.center.tolist(), "scale": [place.radius] * 3}
    document = {
        "asset": {"version": "2.0", "generator": f"unirender {importlib.metadata.version('unirender')}"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [node],
        "meshes": [{"primitives": [primitive]}],
        "materials": [_material(obj.name, list(pictures))],
        "textures": [{"source": k, "sampler": 0} for k in range(len(images))],
        "samplers": [{"magFilter": LINEAR, "minFilter": LINEAR, "wrapS": REPEAT, "wrapT": REPEAT}],
        "images": images,
        "accessors": buffer.accessors,
        "bufferViews": buffer.views,
        "buffers": [{"byteLength": len(buffer.body)}],
    }
    text = json.dumps(document, separators=(",", ":")).encode()
    return _container(text + b" " * (-len(text) % 4), bytes(buffer.body))


class _Buffer:
    """The binary chunk, and what the document says of its parts."""

    def __init__(self) -> None:
        self.body = bytearray()
        self.views: list[dict[str, int]] = []
        self.accessors: list[dict[str, Any]] = []

    def view(self, data: bytes, **more: int) -> int:
        """Appends a part; returns the index of its view."""
        self.views.append({"buffer": 0, "byteOffset": len(self.body), "byteLength": len(data), **more})
        self.body.extend(data + b"\0" * (-len(data) % 4))
        return len(self.views) - 1

    def accessor(self, values: np.ndarray, kind: str, component: int, target: int, **more: Any) -> int:
        """Appends an array; returns the index of its accessor."""
        where = self.view(np.ascontiguousarray(values).tobytes(), target=target)
        self.accessors.append(
            {"bufferView": where, "componentType": component, "count": len(values), "type": kind, **more}
        )
        return len(self.accessors) - 1


def _geometry(obj: MeshObject, buffer: _Buffer) -> dict[str, Any]:
    """Attributes and indices of the mesh's primitive, whose arrays go into the buffer."""
    assert obj.uv is not None  # texture_pixels has looked
    vertices = obj.vertices.astype("<f4")
    bounds = {"min": vertices.min(0).tolist(), "max": vertices.max(0).tolist()}
    attributes = {
        "POSITION": buffer.accessor(vertices, "VEC3", FLOAT, ARRAY_BUFFER, **bounds),
        "NORMAL": buffer.accessor(obj.normals.astype("<f4"), "VEC3", FLOAT, ARRAY_BUFFER),
        "TEXCOORD_0": buffer.accessor(obj.uv.astype("<f4"), "VEC2", FLOAT, ARRAY_BUFFER),
    }
    indices = buffer.accessor(obj.faces.astype("<u4").reshape(-1), "SCALAR", UNSIGNED, ELEMENT_BUFFER)
    return {"attributes": attributes, "indices": indices}


def _material(name: str, pictures: list[str]) -> dict[str, Any]:
    """The material, whose textures are the pictures of these names in their order."""
    index = {picture: {"index": k} for k, picture in enumerate(pictures)}
    material: dict[str, Any] = {
        "name": name,
        "doubleSided": True,
        "pbrMetallicRoughness": {
            "baseColorTexture": index["base_color"],
            "metallicRoughnessTexture": index["metallic_roughness"],
        },
    }
    if "normal" in index:
        material["normalTexture"] = index["normal"]
    return material


def _container(text: bytes, body: bytes) -> bytes:
    """The file of a JSON chunk and a binary one, whose lengths are multiples of 4."""
    chunks = struct.pack("<II", len(text), JSON_CHUNK) + text + struct.pack("<II", len(body), BINARY_CHUNK) + body
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


def texture_pixels(obj: MeshObject) -> dict[str, UInt8[np.ndarray, "_ _ 3"]]:
    """The pictures of the material: `base_color`, `metallic_roughness` and, where there is one, `normal`.

    Roughness and metallic share a picture: the smaller of them is interpolated to the size of the larger.

    Raises:
        UnirenderError: the object lacks texture coordinates or a texture.
    """
    if obj.uv is None or obj.albedo.ndim != 3 or obj.roughness is None or obj.metallic is None:
        raise UnirenderError(
            f"{obj.name}: has no uv, or no albedo, roughness or metallic texture; expected all of them"
        )
    height, width = np.max([obj.roughness.shape, obj.metallic.shape], axis=0).tolist()
    roughness, metallic = (refined(plane[..., None], height, width) for plane in (obj.roughness, obj.metallic))
    pixels = {
        "base_color": eight_bits(srgb_encode(obj.albedo)),
        "metallic_roughness": eight_bits(np.concatenate([np.zeros_like(roughness), roughness, metallic], axis=-1)),
    }
    if obj.normal_map is not None:
        pixels["normal"] = eight_bits((obj.normal_map + 1) / 2)
    return pixels


def png_bytes(pixels: UInt8[np.ndarray, "h w *c"]) -> bytes:
    """An 8-bit PNG."""
    stream = io.BytesIO()
    Image.fromarray(pixels).save(stream, format="PNG", optimize=False)
    return stream.getvalue()
