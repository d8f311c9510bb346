"""The maps and scenes that a visitor takes along, as zip archives in memory."""

import io
import tempfile
import zipfile
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from unirender.files import write_result
from unirender.scene_export import write_scene
from unirender_evaluation.demo.session import View

# What belongs to glTF alone and to both formats; the rest of a scene is Mitsuba's.
GLTF_ONLY = {"card.gltf", "metallic_roughness.png", "normal.png"}
SHARED = {"base_color.png", "meta.json"}


def archives(seen: View, meta: Mapping[str, Any]) -> dict[str, bytes]:
    """`maps.zip` (EXR and PNG), `gltf.zip` and `mitsuba.zip` of what is seen; nothing stays on the disk."""
    with tempfile.TemporaryDirectory(prefix="unirender-demo-") as folder:
        maps, scene = Path(folder) / "maps", Path(folder) / "scene"
        for part in (maps, scene):
            part.mkdir()
        write_result(maps, seen.intrinsics, meta, seen.image_linear)
        write_scene(scene, seen.intrinsics, meta)
        files = {path.name for path in scene.iterdir()}
        return {
            "maps.zip": _packed(maps.iterdir()),
            "gltf.zip": _packed(scene / name for name in GLTF_ONLY | SHARED),
            "mitsuba.zip": _packed(scene / name for name in files - GLTF_ONLY),
        }


def _packed(paths: Iterable[Path]) -> bytes:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive:
        for path in sorted(paths):
            archive.write(path, path.name)
    return stream.getvalue()
