"""Pictures to look at: the given views beside the found ones, a turntable, the object under other lights."""

import dataclasses
from collections.abc import Sequence
from pathlib import PurePosixPath

import numpy as np
from jaxtyping import Float
from PIL import Image

from unirender.camera import Camera
from unirender.color import image_srgb, luminance, srgb_decode
from unirender.light.environment import mean_radiance
from unirender.light.resampling import resample_environment
from unirender_reference.lights import bundled_light
from unirender_reference.multiview import pose_towards
from unirender_reference.optimize.solution import Solution
from unirender_reference.optimize.solution_scene import solution_images
from unirender_reference.optimize.views import View, Views
from unirender_reference.sheets import BACKGROUND, environment_preview, table_sheet

RELIT = ("blender-studio", "blender-sunset", "pmndrs-forest", "blender-night")
TURNS, ELEVATION_DEG = 8, 15.0
TILE, TILE_SPP = 96, 36  # pixels along each side of a picture of the turntable, and its samples per pixel
SHOWN_VIEWS, LEAST_SIDE = 8, 96
MOST_LETTERS = 18  # of a picture's name above its column


def views_strip(views: Views, found: Float[np.ndarray, "n h w 4"]) -> Image.Image:
    """Given above found, for some of the views under their names; those that are held out are marked.

    Args:
        views: seen, then held out.
        found: a picture for each of them.
    """
    every = (*views.seen, *views.held_out)
    chosen = sorted({round(k) for k in np.linspace(0, len(every) - 1, min(SHOWN_VIEWS, len(every)))})
    times = -(-LEAST_SIDE // max(views.height, views.width))
    given = [_enlarged(_over(views.linear(every[k]), every[k].mask), times) for k in chosen]
    rendered = [_enlarged(_over(found[k][..., :3], found[k][..., 3:]), times) for k in chosen]
    names = short_names([view.name for view in every])
    labels = [names[k] + ("\nheld out" if k >= len(views.seen) else "\n") for k in chosen]
    return table_sheet([given, rendered], ["given", "found"], labels)


def short_names(names: Sequence[str]) -> list[str]:
    """Names of pictures without folder and suffix, where these still differ; of long ones, the end."""
    stems = [PurePosixPath(name).stem for name in names]
    shown = stems if len(set(stems)) == len(set(names)) else names
    return [name if len(name) <= MOST_LETTERS else f"…{name[1 - MOST_LETTERS :]}" for name in shown]


def turntable(solution: Solution) -> Image.Image:
    """The object all around: a row under the light that was found, and one under each light of `RELIT`.

    The other lights are turned up or down to the mean luminance of the found one.
    """
    views = [_blank_view(360.0 * k / TURNS, TILE) for k in range(TURNS)]
    brightness = _mean_luminance(solution.environment)
    lights = {"found light": solution.environment}
    for name in RELIT:
        light = bundled_light(name).environment
        lights[name] = light * (brightness / _mean_luminance(light))
    rows = []
    for light in lights.values():
        lit = dataclasses.replace(solution, environment=light.astype(np.float32))
        images = solution_images(lit, views, TILE_SPP)
        preview = environment_preview(resample_environment(light, (TILE // 2, TILE)))
        rows.append([preview, *(_over(image[..., :3], image[..., 3:]) for image in images)])
    turns = [f"{360 * k // TURNS}°" for k in range(TURNS)]
    return table_sheet(rows, list(lights), ["light", *turns])


def _mean_luminance(environment: Float[np.ndarray, "h w 3"]) -> float:
    return float(luminance(mean_radiance(environment)[None])[0])


def _blank_view(azimuth_deg: float, side: int) -> View:
    camera = Camera()
    pose = pose_towards(azimuth_deg, ELEVATION_DEG, camera)
    return View(np.zeros((side, side, 3)), np.zeros((side, side, 1)), camera, pose, f"turn {azimuth_deg:g}")


def _enlarged(tile: Float[np.ndarray, "h w 3"], times: int) -> Float[np.ndarray, "i j 3"]:
    """Every pixel as a square."""
    return tile.repeat(times, axis=0).repeat(times, axis=1)


def _over(image_linear: Float[np.ndarray, "h w 3"], mask: Float[np.ndarray, "h w 1"]) -> Float[np.ndarray, "h w 3"]:
    """A premultiplied picture over the page: display values."""
    page = srgb_decode(np.full((1, 1, 1), BACKGROUND, np.float32))
    return image_srgb(image_linear + (1 - mask) * page)
