"""Environment light on a sphere: orientation, d, s and the image against quadrature."""

import functools

import numpy as np
from jaxtyping import Float

from unirender.camera import Camera
from unirender.light.environment import environment_directions, sample_environment
from unirender.light.surface_light import diffuse_light
from unirender_reference.checks.ball import ALBEDO, ball, ball_view
from unirender_reference.checks.outcome import BATCHES, Check, against_truth
from unirender_reference.passes import derive_seed
from unirender_reference.render import Renderer

SIZE = 16
SPP = 256
FINE = 3
FINER = 24  # rows and columns of the quadrature, for each of the map
TEXELS = ((4, 0), (7, 23), (3, 12), (8, 17))  # rows and columns of a 12 x 24 map: both borders, both sides
# roughness, metallic, and the quadrature: rays along a pixel, nodes of a lobe. Narrow lobes need rays, wide ones nodes.
IMAGE_MATERIALS = ((0.15, 0.9, 4, 12), (0.4, 0.5, 3, 20), (0.8, 0.0, 2, 20))
MIRROR_MATERIALS = ((0.1, 1.0, 5, 12), (0.3, 1.0, 3, 32), (0.7, 1.0, 2, 32))


def orientation(seed: int) -> Check:
    """d under one bright texel after another: its bilinear hat, integrated, from the side where it belongs."""
    renderer, view = Renderer(ball(), resolution=SIZE), ball_view(Camera(), SIZE, 4)
    estimates, truths, masks = [], [], []
    for index, (row, column) in enumerate(TEXELS):
        light = np.zeros((12, 24, 3), np.float32)
        light[row, column] = (20, 30, 40)
        directions, radiance = _lit_directions(light)
        truth = view.pixel_mean(np.maximum(view.normal @ directions.T, 0) @ radiance / np.pi)
        # where the texel is about to set, the facets decide
        masks.append(view.full & (truth[..., 0] > 0.1 * truth[..., 0].max()))
        estimates.append(renderer.diffuse(light, SPP, derive_seed(seed, "orientation", index), BATCHES))
        truths.append(truth)
    return against_truth(
        "orientation", estimates, truths, np.stack(masks), f"d under {len(TEXELS)} single texels", 2e-3
    )


def diffuse_buffer(seed: int) -> Check:
    """d of the convex sphere is irradiance / pi, as `unirender.light.surface_light` has it."""
    view, light = ball_view(Camera(), SIZE, FINE), _lobes(seed)
    closed = diffuse_light(view.normal[None].astype(np.float32), light)[0]
    own = derive_seed(seed, "diffuse-buffer")
    estimate = Renderer(ball(), resolution=SIZE).diffuse(light, 4 * SPP, own, BATCHES)
    note = "d = irradiance / pi of unirender.light.surface_light"
    return against_truth("diffuse-buffer", [estimate], [view.pixel_mean(closed)], view.full, note, 3e-3)


def specular_buffer(seed: int) -> Check:
    """s of the convex sphere is the white metal's lobe integrated over the light."""
    light, renderer = _lobes(seed), Renderer(ball(), resolution=SIZE)
    estimates = [
        renderer.specular(light, r, SPP, derive_seed(seed, "specular-buffer", index), BATCHES)
        for index, (r, *_) in enumerate(MIRROR_MATERIALS)
    ]
    truths = [_closed_image(seed, (1.0, 1.0, 1.0), *material) for material in MIRROR_MATERIALS]
    note = "roughness " + " ".join(f"{r:g}" for r, *_ in MIRROR_MATERIALS)
    return against_truth("specular-buffer", estimates, truths, _inside(), note, 3e-3)


def image_quadrature(seed: int) -> Check:
    """The image of the convex sphere is our own BSDF integrated over the light, pixel by pixel."""
    light, renderer = _lobes(seed), Renderer(ball(), resolution=SIZE)
    estimates = [
        renderer.image(light, r, m, SPP, derive_seed(seed, "image-quadrature", index), batches=BATCHES)
        for index, (r, m, *_) in enumerate(IMAGE_MATERIALS)
    ]
    truths = [_closed_image(seed, ALBEDO, *material) for material in IMAGE_MATERIALS]
    note = "roughness/metallic " + " ".join(f"{r:g}/{m:g}" for r, m, *_ in IMAGE_MATERIALS)
    return against_truth("image-quadrature", estimates, truths, _inside(), note, 3e-3)


@functools.lru_cache(maxsize=8)
def _closed_image(
    seed: int,
    base_color: tuple[float, float, float],
    roughness: float,
    metallic: float,
    fine: int,
    nodes: int,
) -> Float[np.ndarray, "s s 3"]:
    """The sphere's picture under `_lobes(seed)` by our own BSDF: quadrature over each pixel and over the light."""
    from unirender_reference import principled

    view, light = ball_view(Camera(), SIZE, fine), _lobes(seed)
    weights = principled.lobe_weights(base_color, roughness, metallic, nodes)
    return view.pixel_mean(view.reflected(weights, lambda wo: sample_environment(light, wo)))


def _inside() -> np.ndarray:
    """Pixels that the sphere covers wholly."""
    return ball_view(Camera(), SIZE, 8).full


def _lobes(seed: int) -> Float[np.ndarray, "32 64 3"]:
    """A dim room with four coloured lobes of 15 to 30 degrees: smooth enough for quadrature, steep enough to see."""
    rng = np.random.default_rng(seed)
    towards = rng.normal(size=(4, 3))
    towards /= np.linalg.norm(towards, axis=-1, keepdims=True)
    lobes = np.exp(rng.uniform(6, 20, 4) * (environment_directions(32, 64) @ towards.T - 1))
    return (lobes @ rng.uniform(1, 6, (4, 3)) + rng.uniform(0.1, 0.3, 3)).astype(np.float32)


def _lit_directions(light: Float[np.ndarray, "h w 3"]) -> tuple[np.ndarray, np.ndarray]:
    """Directions of a grid `FINER` times finer than the map where it shines, and radiance times solid angle there."""
    rows, columns = (light.shape[0] - 1) * FINER, light.shape[1] * FINER
    theta = (np.arange(rows) + 0.5) * np.pi / rows
    phi = (np.arange(columns) + 0.5) * 2 * np.pi / columns
    theta, phi = (grid.ravel() for grid in np.meshgrid(theta, phi, indexing="ij"))
    directions = np.stack([np.sin(theta) * np.sin(phi), np.cos(theta), -np.sin(theta) * np.cos(phi)], axis=-1)
    radiance = sample_environment(light, directions)
    lit = radiance.max(axis=-1) > 0
    solid_angle = 2 * np.sin(np.pi / rows / 2) * np.sin(theta[lit]) * 2 * np.pi / columns
    return directions[lit], radiance[lit] * solid_angle[:, None]
