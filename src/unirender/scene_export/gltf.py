"""The card as glTF 2.0 (sections 3.6 to 3.10): four corners, one PBR material, its pictures beside the file."""

import base64
import json
import math
from pathlib import Path
from typing import Any

import numpy as np

import unirender
from unirender.scene_export.card import Card
from unirender.visualization import write_png

FLOAT, UNSIGNED_SHORT = 5126, 5123
CLAMP, LINEAR = 33071, 9729


def write_gltf(card: Card, folder: Path) -> None:
    """Writes `card.gltf` with `base_color.png`, `metallic_roughness.png` and `normal.png`."""
    write_png(folder / "base_color.png", card.base_color_srgb())
    write_png(folder / "metallic_roughness.png", card.metallic_roughness())
    write_png(folder / "normal.png", card.tangent_normal())
    (folder / "card.gltf").write_text(json.dumps(document(card), indent=2) + "\n")


def document(card: Card) -> dict[str, Any]:
    """The file's JSON; the corners are in it as base64."""
    u, v = (np.array(values, np.float32) for values in ([0, 1, 1, 0], [0, 0, 1, 1]))  # clockwise from the top left
    points = card.points(u, v)
    arrays = {
        "POSITION": points,
        "NORMAL": np.tile(np.array([0, 0, 1], "<f4"), (4, 1)),
        "TANGENT": np.tile(np.array([1, 0, 0, 1], "<f4"), (4, 1)),  # bitangent: normal x tangent = +y, green up
        "TEXCOORD_0": np.stack([u, v], axis=-1),  # glTF counts v from the first row
        "indices": np.array([0, 3, 2, 0, 2, 1], "<u2"),
    }
    body, views, accessors = bytearray(), [], []
    for name, values in arrays.items():
        data = values.astype(values.dtype.newbyteorder("<")).tobytes()
        views.append({"buffer": 0, "byteOffset": len(body), "byteLength": len(data)})
        body.extend(data)  # every array is a multiple of four bytes long
        kind = "SCALAR" if values.ndim == 1 else f"VEC{values.shape[1]}"
        component = UNSIGNED_SHORT if name == "indices" else FLOAT
        accessors.append({"bufferView": len(views) - 1, "componentType": component, "count": len(values), "type": kind})
    accessors[0] |= {"min": points.min(0).tolist(), "max": points.max(0).tolist()}
    material = {
        "name": "decomposition",
        "alphaMode": "BLEND",
        "pbrMetallicRoughness": {"baseColorTexture": {"index": 0}, "metallicRoughnessTexture": {"index": 1}},
        "normalTexture": {"index": 2},
    }
    attributes = {name: index for index, name in enumerate(arrays) if name != "indices"}
    primitive = {"attributes": attributes, "indices": len(attributes), "material": 0}
    cameras = _cameras(card)
    nodes: list[dict[str, Any]] = [{"name": "card", "mesh": 0}]
    nodes += [{"name": "camera", "camera": 0, "translation": [0, 0, card.distance]}] if cameras else []
    uri = "data:application/octet-stream;base64," + base64.b64encode(bytes(body)).decode()
    return {
        "asset": {"version": "2.0", "generator": f"unirender {unirender.__version__}"},
        "scene": 0,
        "scenes": [{"nodes": list(range(len(nodes)))}],
        "nodes": nodes,
        **({"cameras": cameras} if cameras else {}),
        "meshes": [{"name": "card", "primitives": [primitive]}],
        "materials": [material],
        "textures": [{"source": k, "sampler": 0} for k in range(3)],
        "samplers": [{"magFilter": LINEAR, "minFilter": LINEAR, "wrapS": CLAMP, "wrapT": CLAMP}],
        "images": [{"uri": f"{name}.png"} for name in ("base_color", "metallic_roughness", "normal")],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"uri": uri, "byteLength": len(body)}],
    }


def _cameras(card: Card) -> list[dict[str, Any]]:
    """The picture's camera; none where its principal point is off the middle, which glTF cannot say."""
    if card.camera.principal != (0.5, 0.5):
        return []
    perspective = {
        "yfov": math.radians(card.camera.fov_deg),
        "aspectRatio": card.width / card.height,
        "znear": 0.01,
    }
    return [{"type": "perspective", "perspective": perspective}]
