"""Pictures to look at: the given views beside the found ones, a turntable, the object under other lights."""

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from PIL import Image

from unirender.camera import Camera
from unirender.color import image_srgb, luminance, srgb_encode
from unirender.lighting import mean_radiance, resample_environment
from unirender_reference.lights import bundled_light
from unirender_reference.multiview import pose_towards
from unirender_reference.optimize.solution import Solution
from unirender_reference.optimize.textured_scene import TexturedScene, maps_of
from unirender_reference.optimize.views import View, Views
from unirender_reference.passes import derive_seed
from unirender_reference.sheets import LIGHT, environment_preview, table_sheet

RELIT = ("blender-studio", "blender-sunset", "pmndrs-forest", "blender-night")
TURNS, ELEVATION_DEG = 8, 15.0
SHOWN_VIEWS, LEAST_SIDE = 8, 96
LANES = 1 << 23  # samples of a launch


def found_images(solution: Solution, views: Sequence[View], spp: int, seed: int = 0) -> Float[np.ndarray, "n h w 4"]:
    """The solution from the cameras of some views: premultiplied linear RGBA, in launches of bounded size."""
    pixels = views[0].mask.shape[0] * views[0].mask.shape[1]
    passes = -(-pixels * spp // LANES)
    together = max(1, LANES * passes // (pixels * spp))
    maps, images = maps_of(solution), []
    for start in range(0, len(views), together):
        scene = TexturedScene(solution, views[start : start + together])
        part = [scene.image(maps, -(-spp // passes), derive_seed(seed, start, k)) for k in range(passes)]
        images.append(np.mean(part, axis=0, dtype=np.float32))
    return np.concatenate(images)


def views_strip(views: Views, found: Float[np.ndarray, "n h w 4"]) -> Image.Image:
    """Given above found, for some of the views; those that are held out are marked.

    Args:
        views: seen, then held out.
        found: a picture for each of them.
    """
    every = (*views.seen, *views.held_out)
    chosen = sorted({round(k) for k in np.linspace(0, len(every) - 1, min(SHOWN_VIEWS, len(every)))})
    times = max(1, LEAST_SIDE // max(views.height, views.width))
    given = [_enlarged(_over(views.linear(every[k]), every[k].mask), times) for k in chosen]
    rendered = [_enlarged(_over(found[k][..., :3], found[k][..., 3:]), times) for k in chosen]
    labels = [f"view {k}" + ("\nheld out" if k >= len(views.seen) else "\n") for k in chosen]
    return table_sheet([given, rendered], ["given", "found"], labels)


def turntable(solution: Solution, side: int = 96, spp: int = 36) -> Image.Image:
    """The object all around: a row under the light that was found, and one under each light of `RELIT`.

    The other lights are turned up or down to the mean luminance of the found one.

    Args:
        solution: what is shown.
        side: pixels along each side of a tile.
        spp: samples per pixel.
    """
    views = [_blank_view(360.0 * k / TURNS, side) for k in range(TURNS)]
    brightness = _mean_luminance(solution.environment)
    lights = {"found light": solution.environment}
    for name in RELIT:
        light = bundled_light(name).environment
        lights[name] = light * (brightness / _mean_luminance(light))
    rows = []
    for light in lights.values():
        lit = dataclasses.replace(solution, environment=light.astype(np.float32))
        images = found_images(lit, views, spp)
        preview = environment_preview(resample_environment(light, (side // 2, side)))
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
    page = float(LIGHT.background)
    linear_page = ((page + 0.055) / 1.055) ** 2.4
    return image_srgb(image_linear + (1 - mask) * linear_page)


def psnr_db(views: Views, chosen: Sequence[View], found: Float[np.ndarray, "n h w 4"]) -> float:
    """Of display values over covered pixels; of linear views, of what a display would show."""
    total, weight = 0.0, 0.0
    for view, image in zip(chosen, found, strict=True):
        cover = np.maximum(view.mask, 1e-3)
        given, shown = (srgb_encode(np.clip(x / cover, 0, 1)) for x in (views.linear(view), image[..., :3]))
        total += float((((shown - given) ** 2) * view.mask).sum(dtype=np.float64))
        weight += 3 * float(view.mask.sum())
    return float(-10 * np.log10(max(total / max(weight, 1e-9), 1e-12)))
