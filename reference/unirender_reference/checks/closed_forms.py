"""Renders of a sphere against closed forms: constant light, one direction, mirror, silhouette.

The sphere is convex: what its surface reflects never meets it again.
"""

import functools
from typing import Any

import numpy as np
from jaxtyping import Float

from unirender.camera import Camera
from unirender.light.environment import sample_environment
from unirender_reference import materials, scene, sensors
from unirender_reference.backend import mitsuba
from unirender_reference.checks.ball import ALBEDO, ball, ball_view
from unirender_reference.checks.outcome import BATCHES, Check, against_truth
from unirender_reference.passes import Counters, Estimate, derive_seed, mean_estimate, render_passes
from unirender_reference.render import DIRECT_DEPTH, Renderer

SIZE = 32
SPP = 256
FURNACE = (0.5, 0.8, 1.3)  # radiance
FURNACE_ROUGHNESS = (0.1, 0.3, 0.6, 1.0)
SUN = np.array([0.48, 0.64, 0.6])  # towards the light
IRRADIANCE = (3.0, 2.0, 1.0)  # on a surface that faces it
WHITE = (1.0, 1.0, 1.0)
COSINES = np.linspace(0.02, 1, 60)


def furnace_dielectric(seed: int) -> Check:
    """White furnace: a white rough dielectric under constant light shows its directional albedo."""
    return _furnace("furnace-dielectric", 0.0, seed)


def furnace_metal(seed: int) -> Check:
    """White furnace: a white rough metal loses what single scattering loses, no more and no less."""
    return _furnace("furnace-metal", 1.0, seed)


def lambert_constant(seed: int) -> Check:
    """A Lambertian sphere under constant light: radiance = albedo L everywhere."""
    size, light = 24, _constant(FURNACE)
    loaded = scene.load_scene(ball(), _lambertian(), light, Camera(), size)
    view = ball_view(Camera(), size, 4)
    truth = np.broadcast_to(np.multiply(ALBEDO, FURNACE), (*view.full.shape, 3))
    estimate = _render(loaded, 4 * SPP, derive_seed(seed, "lambert-constant"))
    return against_truth("lambert-constant", [estimate], [truth], view.full, "radiance = albedo L")


def lambert_directional(seed: int) -> Check:
    """A Lambertian sphere under one direction: radiance = albedo E max(0, n.l) / pi."""
    mi = mitsuba()
    parts: dict[str, Any] = {
        "type": "scene",
        "sensor": sensors.sensor_dict(Camera(), SIZE, SIZE),
        "light": {"type": "directional", "direction": list(-SUN), "irradiance": {"type": "rgb", "value": IRRADIANCE}},
        "object": scene.mesh_shape(ball(), _lambertian()),
    }
    view = ball_view(Camera(), SIZE, 16)
    cosine = np.maximum(view.normal @ SUN, 0)
    truth = view.pixel_mean(cosine[:, None] * np.multiply(ALBEDO, IRRADIANCE) / np.pi)
    # facets, not the sphere, decide where the terminator is
    lit = view.full & (view.pixel_mean((view.normal @ SUN)[:, None])[..., 0] > 0.1)
    estimate = _render(mi.load_dict(parts), SPP, derive_seed(seed, "lambert-directional"))
    return against_truth("lambert-directional", [estimate], [truth], lit, "radiance = albedo E n.l / pi", 5e-4)


def mirror(seed: int) -> Check:
    """s of a sphere of roughness 0: the environment in the reflected direction, on texels and between them."""
    size, rng = 48, np.random.default_rng(seed)
    light = rng.random((32, 64, 3)).astype(np.float32) ** 3
    view = ball_view(Camera(), size, 12)
    reflected = 2 * view.cosine[:, None] * view.normal - view.view
    truth = view.pixel_mean(sample_environment(light, reflected))
    estimate = Renderer(ball(), resolution=size).specular(light, 0.0, SPP, derive_seed(seed, "mirror"), BATCHES)
    note = "32 x 64 random texels, bilinear, in the reflected direction"
    return against_truth("mirror", [estimate], [truth], view.full, note, 3e-3)


def camera(seed: int) -> Check:
    """Coverage of the sphere's silhouette by a camera off the axis, all pixels."""
    lens = Camera(50.0, (0.46, 0.53))
    truth = ball_view(lens, SIZE, 32).coverage
    light = _constant(FURNACE)
    own = derive_seed(seed, "camera")
    image = Renderer(ball(), lens, SIZE).image(light, 0.5, 0.5, 4 * SPP, own, batches=BATCHES)
    assert image.variance is not None
    alpha = Estimate(image.mean[..., 3:], image.variance[..., 3:])
    border = (truth[..., 0] > 0.01) & (truth[..., 0] < 0.99)
    return against_truth("camera", [alpha], [truth], border, "coverage of border pixels, fov 50, off axis", 2e-3)


def _furnace(name: str, metallic: float, seed: int) -> Check:
    """A white sphere under constant light against our BSDF's directional albedo, at each of `FURNACE_ROUGHNESS`."""
    view = ball_view(Camera(), SIZE, 4)
    renderer = Renderer(ball(WHITE), resolution=SIZE)
    light = _constant(FURNACE)
    estimates, truths = [], []
    for index, roughness in enumerate(FURNACE_ROUGHNESS):
        albedo = np.interp(view.cosine, COSINES, _albedo(roughness, metallic))
        own = derive_seed(seed, name, index)
        estimates.append(renderer.image(light, roughness, metallic, SPP, own, batches=BATCHES))
        truths.append(view.pixel_mean(albedo[:, None] * np.array(FURNACE)))
    means = ", ".join(f"{truth[view.full].mean() / np.mean(FURNACE):.3f}" for truth in truths)
    levels = " ".join(f"{roughness:g}" for roughness in FURNACE_ROUGHNESS)
    note = f"roughness {levels}: mean albedo {means}"
    return against_truth(name, estimates, truths, view.full, note, 1e-3)


@functools.lru_cache(maxsize=2 * len(FURNACE_ROUGHNESS))
def _albedo(roughness: float, metallic: float) -> Float[np.ndarray, " n"]:
    """Directional albedo of the white surface at `COSINES`."""
    from unirender_reference import principled

    _, weights = principled.lobe_weights(WHITE, roughness, metallic, nodes=64)(COSINES)
    return weights[..., 0].sum(axis=1)


def _lambertian() -> dict[str, Any]:
    inner = {"type": "diffuse", "reflectance": materials.base_color_bitmap(np.array(ALBEDO, np.float32))}
    return {"type": "twosided", "surface": inner}


def _render(loaded: Any, spp: int, seed: int) -> Estimate:
    return mean_estimate(*render_passes(loaded, DIRECT_DEPTH, spp, seed, BATCHES, Counters()), BATCHES)


def _constant(radiance: tuple[float, float, float]) -> np.ndarray:
    return np.full((8, 16, 3), radiance, np.float32)
