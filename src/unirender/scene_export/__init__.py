"""A decomposition as a scene for other programs: a flat card that carries the maps, under the predicted light.

    export_scene("scene", intrinsics)

| file | content |
|---|---|
| `card.gltf` | the card with its PBR material and, where the principal point is central, the camera |
| `base_color.png` | albedo through sRGB; alpha is the mask |
| `metallic_roughness.png` | roughness in G, metallic in B, as glTF wants them |
| `normal.png` | tangent-space normals (n + 1) / 2, green up |
| `scene.xml` | the same card for Mitsuba 3, with `card.ply`, `roughness.png`, `metallic.png`, `opacity.png` |
| `environment.exr` | the light on Mitsuba's lat-long grid, in the scene's axes: no rotation; finer for a bright pole |
| `environment.pfm` | the same bits, for `scene.xml`: with one thread Mitsuba hangs over an EXR |
| `latlong.exr` | the same light as most programs read a map: rows are areas between the poles |
| `meta.json` | camera, size, distance and where the maps come from |

Axes: those of the camera, moved to the middle of the object: +x right, +y up, +z towards the viewer. The camera stands
on +z at `Camera.distance()`, where a unit sphere fills 0.9 of the frame's height, and the card is the plane z = 0. The
middle of the light's map is +z. Light is in display units: a render at exposure 1 shows through sRGB what the picture
showed. Mitsuba draws directions by the texels times sin(theta) and would miss light of the first or the last row that
has little beside it: such a light is written with a row between each two (`unirender.light.for_mitsuba.drawable`).

What a card cannot show: it has one depth, so that nothing casts a shadow and the maps hold from the camera's place
only; and normals that face away from the viewer are bent until they do not (a renderer would show them black or
flipped). A normal map, moreover, reaches the 90 degrees around the card's own normal only, and a renderer may drop
light that comes from behind the card. `scene.xml` has no such loss: there the normals belong to the vertices of a grid,
one to a pixel, and light from all sides counts. Normals of pictures of more than 1024 pixels along a side are stored
for 1024 of them.
"""

from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

from unirender.arguments import check_switches
from unirender.files import write_meta
from unirender.intrinsics import Intrinsics
from unirender.new_folders import new_folder
from unirender.scene_export.card import Card
from unirender.scene_export.gltf import write_gltf
from unirender.scene_export.mitsuba_scene import write_mitsuba

__all__ = ["export_scene", "write_scene"]


def export_scene(folder: str | Path, intrinsics: Intrinsics, *, overwrite: bool = False) -> None:
    """Writes the scene of a decomposition into a new folder, which appears complete or not at all.

    Args:
        folder: where.
        intrinsics: one picture's albedo, normal, roughness, metallic and environment; without a mask the whole frame.
        overwrite: replace an earlier result that stands there.

    Raises:
        UnirenderError: a map is missing, or the folder is in the way.
    """
    check_switches(overwrite=overwrite)
    with new_folder(folder, overwrite=overwrite) as temporary:
        write_scene(temporary, intrinsics)


def write_scene(folder: Path, intrinsics: Intrinsics, meta: Mapping[str, Any] = MappingProxyType({})) -> None:
    """Writes the scene into an existing (temporary) folder.

    Args:
        folder: where; see `unirender.new_folders.new_folder`.
        intrinsics: as in `export_scene`.
        meta: facts on where the maps come from, for `meta.json`.

    Raises:
        UnirenderError: a map is missing.
    """
    card = Card.of(intrinsics)
    write_gltf(card, folder)
    write_mitsuba(card, folder)
    facts = {"height": card.height, "width": card.width, "distance": card.distance}
    write_meta(folder, {**meta, **facts}, card.camera)
