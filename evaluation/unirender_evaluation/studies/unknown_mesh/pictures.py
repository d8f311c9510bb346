"""A picture of what was found without a mesh, beside the truth, as held-out cameras see it."""

import numpy as np
from PIL import Image

from unirender.color import image_srgb, unpremultiply
from unirender.visualization import map_picture
from unirender_evaluation.figures.grid import Grid, Line, Tile, draw, over_white
from unirender_evaluation.multiview.scenes import MultiviewScene
from unirender_evaluation.multiview.scoring import Looks, true_looks
from unirender_evaluation.report.gallery import Picture

CAMERAS = 2  # of the held-out ones are shown
MAPS = ("albedo", "normal", "roughness", "metallic")


def found_strip(scene: MultiviewScene, looks: Looks) -> Image.Image:
    """Two lines for each of the first held-out cameras: what was found, and below it the truth, over white."""
    count = min(CAMERAS, len(scene.held_out_poses))
    ours, true = ([camera_panels(scene, one, camera) for camera in range(count)] for one in (looks, true_looks(scene)))
    lines = []
    for found, given in zip(ours, true, strict=True):
        lines.append(Line("unirender", tuple(map(Tile, found.values())), starts=True))
        lines.append(Line("Mitsuba", tuple(Tile(given[name]) for name in found)))
    return draw(Grid(tuple(ours[0]), tuple(lines)))


def camera_panels(scene: MultiviewScene, looks: Looks, camera: int) -> dict[str, Picture]:
    """Name -> what one held-out camera sees, as display values over white, cut out by the object's own coverage."""
    panels = {}
    for name, lit in (("image", looks.novel), ("relit", looks.relit)):
        mask = np.asarray(lit.mask(camera), np.float32)
        panels[name] = over_white(image_srgb(unpremultiply(lit.rgb(camera), mask)), mask)
    size = scene.resolution
    first = (len(scene.seen_poses) + camera) * size
    maps = looks.buffers.require("mask", *MAPS)
    mask = maps["mask"][first : first + size]
    return panels | {name: over_white(map_picture(name, maps[name][first : first + size]), mask) for name in MAPS}
