"""A small optimisation that tests run, kill and resume: `python optimizer_runs.py FOLDER` runs it, too."""

import dataclasses
import functools
import sys
from pathlib import Path
from typing import Any

import numpy as np
from posed_views import textured_object
from reference_scenes import environment

from unirender.camera import Camera
from unirender.color import image_srgb, unpremultiply
from unirender_reference.multiview import orbit
from unirender_reference.optimize.multiview.config import OptimizeConfig
from unirender_reference.optimize.multiview.run import optimize
from unirender_reference.optimize.refine.config import RefineConfig
from unirender_reference.optimize.solution import Solution
from unirender_reference.optimize.solution_scene import solution_images
from unirender_reference.optimize.views import View, Views
from unirender_reference.shapes import MeshObject

REFINE = RefineConfig(iterations=8, spp=4, spp_gradient=4, depth=2, held_out_every=2)
CONFIG = OptimizeConfig(refine=REFINE, save_seconds=0.0)


@functools.cache
def truth(seed: int = 3) -> Solution:
    return Solution(textured_object(seed), environment(1) * np.float32(0.3))


def rendered_views(solution: Solution, seen: int = 2, held_out: int = 1, side: int = 20, hdr: bool = False) -> Views:
    """Pictures of a solution from cameras around it."""
    camera = Camera()
    poses = orbit(seen + held_out, camera)
    blank = np.zeros((side, side, 3), np.float32)
    images = solution_images(solution, [View(blank, blank[..., :1], camera, pose) for pose in poses], 64)
    views = []
    for index, (image, pose) in enumerate(zip(images, poses, strict=True)):
        mask = np.clip(image[..., 3:], 0, 1)
        straight = unpremultiply(image[..., :3], mask)
        shown = straight if hdr else np.round(image_srgb(straight) * 255) / 255
        views.append(View(shown, mask, camera, pose, f"view {index}"))
    return Views(tuple(views[:seen]), tuple(views[seen:]), hdr)


def flat_start(obj: MeshObject, size: int = 16) -> Solution:
    """Grey, half rough, half metallic, under a constant light."""
    half = np.full((size, size), 0.5, np.float32)
    grey = np.repeat(half[..., None], 3, axis=-1)
    textured = dataclasses.replace(obj, albedo=grey, roughness=half, metallic=half.copy())
    return Solution(textured, np.full((8, 16, 3), 0.3, np.float32))


@functools.cache
def _pictures() -> Views:
    return rendered_views(truth())


def run(out: Path | None, config: OptimizeConfig = CONFIG, **options: Any) -> Solution:
    """The run, on one thread; equal bytes whenever it is run."""
    solution = truth()
    start = flat_start(solution.obj)
    options = {"init": start, "threads": 1, "pictures": False, **options}
    return optimize(_pictures(), None, config, out, **options)


if __name__ == "__main__":
    run(Path(sys.argv[1]))
