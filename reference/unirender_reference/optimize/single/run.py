"""Inverse rendering of one picture by optimisation: albedo, roughness, metallic and light from an image and its mask.

The geometry is a known mesh (its normals, its shadows), or a normal map, or what the silhouette suggests. Where a
prediction is given (`init`), priors centre on it: what the picture does not decide stays as predicted. The result is a
complete `Intrinsics`: s and d belong to the light and the material that were found.
"""

import time
from collections.abc import Callable

import numpy as np
from jaxtyping import Bool, Float

from unirender.arguments import as_coverage, as_floats, as_instance
from unirender.camera import Camera
from unirender.color import srgb_decode
from unirender.errors import UnirenderError
from unirender.intrinsics import Intrinsics
from unirender.light.resampling import resample_environment
from unirender_reference.optimize.exposure import exposed, exposure_of
from unirender_reference.optimize.shape.placement import check_in_picture
from unirender_reference.optimize.single.config import COLD, SingleConfig
from unirender_reference.optimize.single.fit import Fit, Unknowns
from unirender_reference.optimize.single.inflate import silhouette_normals
from unirender_reference.optimize.single.pixels import PicturePixels, make_picture
from unirender_reference.optimize.single.result import result
from unirender_reference.optimize.single.search import anneal, descend
from unirender_reference.optimize.views import Step
from unirender_reference.shapes import MeshObject

LEAST_RADIANCE = 0.02  # of a predicted light: its logarithm is what changes

OnStep = Callable[[Step], None]  # it only hears


def optimize_image(
    image: Float[np.ndarray, "h w 3"],
    mask: Float[np.ndarray, "h w 1"],
    camera: Camera,
    config: SingleConfig,
    *,
    normal: Float[np.ndarray, "h w 3"] | None = None,
    geometry: MeshObject | None = None,
    init: Intrinsics | None = None,
    hdr: bool = False,
    clipped: Bool[np.ndarray, "h w 3"] | None = None,
    on_step: OnStep | None = None,
) -> Intrinsics:
    """Finds the maps and the light whose rendering is the picture.

    Args:
        image: straight display values in [0, 1], as in a PNG with alpha; linear radiance of any scale if `hdr`.
        mask: coverage, [0, 1].
        camera: of the picture.
        config: priors, steps, sizes.
        normal: camera axes, unit; None: those of the mesh, of `init`, or of the inflated silhouette, in this order.
        geometry: the object itself before the contract's camera, under the mask: normals and shadows are taken from it.
        init: a prediction with albedo, roughness, metallic and environment, centre of the priors; None: grey, half
            metallic and half rough, under even light.
        hdr: the picture is linear and no value is clipped; the light that is found has its scale, as that of `init`.
        clipped: where a value is only a lower bound (of a picture that was reduced); None: where it is 1.
        on_step: hears of every step.

    Returns:
        All maps, at the picture's size; the environment has `config.light_rows` rows.

    Raises:
        UnirenderError: sizes differ, the mask is empty, values are out of range, `init` lacks a map, or the mesh does
            not lie under the mask; or the light takes more memory than the machine has.
    """
    as_instance(config, SingleConfig, "optimize: config")
    as_instance(camera, Camera, "optimize: camera")
    image, mask = as_floats(image, "image"), as_coverage(mask, "mask")
    linear = _checked(image, mask, hdr)
    config.require_memory(int((mask > 0).sum()))
    if geometry is not None:
        check_in_picture(mask, camera, geometry)
    exposure = exposure_of(linear, mask) if hdr else 1.0
    linear, init = linear / np.float32(exposure), None if init is None else exposed(init, 1 / exposure)
    began, count = time.monotonic(), 0

    def report(values: dict[str, float]) -> None:
        nonlocal count
        count += 1
        if on_step is not None:
            on_step(Step("single view", count, time.monotonic() - began, values))

    maps = _start_maps(mask, init)
    priors, trust = config.resolved(geometry is not None, init is not None)
    maps["normal"] = _start_normals(mask, camera, normal, geometry, init)
    shape = (config.light_rows, 2 * config.light_rows)

    def prepared(pixels: int) -> PicturePixels:
        return make_picture(linear, mask, camera, maps, geometry, pixels, shape, hdr, config.seed, clipped)

    coarse = prepared(config.coarse_pixels)
    fit = Fit(coarse, _start_light(init, shape), priors, config.noise[0])
    fit.log_light = fit.log_light + fit.level()
    at = anneal(fit, config.steps, config.noise, config.noise_factor, report)
    fine = prepared(config.pixels) if coarse.block > 1 else coarse
    last = Fit(fine, fit.log_light, priors, fit.noise)
    material = at.metallic * trust.metallic, at.roughness * trust.roughness
    at = Unknowns(last.start().pixel, at.light, at.gain, *material)
    at = descend(last, at, config.fine_steps, ("metallic", "roughness"), report)
    return exposed(result(last, at, linear, mask, camera, maps, init, geometry is not None, trust), exposure)


def _checked(
    image: Float[np.ndarray, "h w 3"], mask: Float[np.ndarray, "h w 1"], hdr: bool
) -> Float[np.ndarray, "h w 3"]:
    """The picture, linear and premultiplied."""
    if mask.ndim != 3 or mask.shape[2] != 1 or image.shape != (*mask.shape[:2], 3):
        raise UnirenderError(
            f"single view: got an image {image.shape} and a mask {mask.shape}, expected (h, w, 3) and (h, w, 1); "
            "a mask [h, w] becomes one by mask[..., None]"
        )
    if not (mask.min() >= 0 and mask.max() <= 1) or not mask.any():
        raise UnirenderError(
            "single view: the mask is empty or leaves [0, 1], expected the object's coverage; divide an "
            "8-bit mask by 255"
        )
    most = np.inf if hdr else 1.001
    if not np.isfinite(image).all() or image.min() < 0 or image.max() > most:
        raise UnirenderError(
            f"single view: got image values in [{image.min():.3g}, {image.max():.3g}], expected "
            f"{'radiance >= 0' if hdr else 'display values in [0, 1]; linear pictures are `hdr`'}"
        )
    straight = image if hdr else srgb_decode(np.clip(image, 0, 1))
    return (straight * mask).astype(np.float32)


def _start_maps(mask: Float[np.ndarray, "h w 1"], init: Intrinsics | None) -> dict[str, np.ndarray]:
    if init is None:
        sizes = {"albedo": 3, "roughness": 1, "metallic": 1}
        return {name: np.full((*mask.shape[:2], sizes[name]), value, np.float32) for name, value in COLD.items()}
    maps = init.require("albedo", "roughness", "metallic", "environment")
    if maps["albedo"].shape != (*mask.shape[:2], 3):
        raise UnirenderError(
            f"single view: init has maps of {maps['albedo'].shape[:-1]}, expected the picture's size {mask.shape[:2]}; "
            "decompose this very picture"
        )
    return {name: maps[name] for name in COLD}


def _start_normals(
    mask: Float[np.ndarray, "h w 1"],
    camera: Camera,
    normal: Float[np.ndarray, "h w 3"] | None,
    geometry: MeshObject | None,
    init: Intrinsics | None,
) -> Float[np.ndarray, "h w 3"]:
    """The normals that are given, else those of `init`, else of the silhouette; 0 where a mesh has its own."""
    if normal is None and geometry is None and init is not None:
        normal = init.normal
    if normal is None:
        return silhouette_normals(mask, camera) if geometry is None else np.zeros((*mask.shape[:2], 3), np.float32)
    if normal.shape != (*mask.shape[:2], 3):
        raise UnirenderError(
            f"single view: got normals {normal.shape}, expected {(*mask.shape[:2], 3)}, those of this picture; "
            "leave them out for those of the silhouette"
        )
    return normal


def _start_light(init: Intrinsics | None, shape: tuple[int, int]) -> Float[np.ndarray, "j 3"]:
    """Log radiance of the start; even light where nothing is predicted."""
    if init is None:
        return np.zeros((shape[0] * shape[1], 3))
    environment = resample_environment(init.require("environment")["environment"], shape)
    return np.log(np.maximum(environment.reshape(-1, 3), LEAST_RADIANCE)).astype(np.float64)
