r"""The direct image in closed form: light buffers of the four lobes of the principled BSDF.

For one direction of light the contract's surface (specular 0.5, so eta 1.5; no sheen, clearcoat, transmission,
flatness, anisotropy) is linear in four lobes that know neither base colour nor metallic:

    f = (1 - m) b D  +  (1 - m) S_F  +  m b S_1  +  m (1 - b) S_w          b: base colour, m: metallic

    diffuse_lobe    D    Disney's diffuse and retro-reflection at base colour 1
    dielectric_lobe S_F  GGX with the Fresnel reflectance of eta
    mirror          S_1  GGX with reflectance 1: the paper's s
    schlick_lobe    S_w  GGX with Schlick's weight (1 - cos)^5

So is the image of direct light, sample by sample: I = sum over lobes of mean(w L), with w the factor of the lobe above,
L its radiance, and the mean taken over the pixel. A pixel's mean of a product is not the product of means where colour
and light vary together, so a buffer is the weighted mean that makes the product exact:

    buffer = mean(w L) / mean(w),    weight = mean(w),    I = sum over lobes of weight * buffer

`weighting="object"` takes w from the object's base colour (and its metallic map). `weighting="plain"` takes w = 1: the
buffers are then those of the shape under the light, whatever it is made of, and any base colour and metallic can be put
in; exact where both are constant over the pixel.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from jaxtyping import Float

from unirender.errors import UnirenderError
from unirender.shown import short_repr
from unirender_reference.backend import mitsuba
from unirender_reference.integrators import path_integrator, python_integrator
from unirender_reference.passes import (
    TRUTH_BATCHES,
    Estimate,
    channels,
    derive_seed,
    integrator_passes,
    mean_estimate,
    weighted_estimate,
)
from unirender_reference.render import DIRECT_DEPTH, Renderer

Name = Literal["diffuse_lobe", "dielectric_lobe", "mirror", "schlick_lobe"]  # surfaces of `materials`
LOBES: tuple[Name, ...] = ("diffuse_lobe", "dielectric_lobe", "mirror", "schlick_lobe")
# A lobe's factor is (a + b * base colour) * (a' + b' * metallic), with these (a, b) and (a', b').
COLOR_TERMS = {"diffuse_lobe": (0, 1), "dielectric_lobe": (1, 0), "mirror": (0, 1), "schlick_lobe": (1, -1)}
METALLIC_TERMS = {"diffuse_lobe": (1, -1), "dielectric_lobe": (1, -1), "mirror": (0, 1), "schlick_lobe": (0, 1)}
ONE = (1, 0)
Weighting = Literal["object", "plain"]


@dataclass(frozen=True)
class Lobe:
    """One lobe's light.

    Attributes:
        buffer: (h, w, 3) weighted mean of its radiance, mean(w L) / mean(w), 0 where the weight is 0.
        weight: (h, w, 3) mean(w) over the pixel, coverage included.
        variance: (h, w, 3) variance of weight * buffer, or None when one pass was asked for.
    """

    buffer: Estimate
    weight: Float[np.ndarray, "h w 3"]
    variance: Float[np.ndarray, "h w 3"] | None

    __repr__ = short_repr


@dataclass(frozen=True)
class Lobes:
    """The light buffers of an object under one light.

    Attributes:
        lobes: one entry for each name in `LOBES`.
        weighting: what the weights hold. "object": the object's base colour, and its metallic where that is a map.
            "plain": coverage alone.
        metallic: with "object", the scalar metallic of the object, which the weights leave out; None: it is a map.
    """

    lobes: Mapping[Name, Lobe]
    weighting: Weighting
    metallic: float | None


def color_weight(name: Name, base: Any) -> Any:
    """The factor of a lobe that depends on base colour (a number or an array)."""
    constant, slope = COLOR_TERMS[name]
    return constant + slope * base


def metallic_weight(name: Name, metallic: Any) -> Any:
    """The factor of a lobe that depends on metallic (a number or an array)."""
    constant, slope = METALLIC_TERMS[name]
    return constant + slope * metallic


def render_lobes(
    renderer: Renderer,
    environment: Float[np.ndarray, "h w 3"],
    roughness: float | None,
    metallic: float | None,
    spp: int,
    seed: int = 0,
    batches: int = TRUTH_BATCHES,
    weighting: Weighting = "object",
) -> Lobes:
    """The four light buffers, each by its own render and seed; direct light only.

    Args:
        renderer: of the object.
        environment: linear radiance, camera axes.
        roughness: perceptual, [0, 1]; None: the object's map.
        metallic: [0, 1], used with "object" weights; None: the object's map.
        spp: samples per pixel for each lobe.
        seed: equal seeds give equal buffers.
        batches: passes that the variance is taken from.
        weighting: see `Lobes`.

    Raises:
        UnirenderError: `weighting` is neither of the two, or as `Renderer.image`.
    """
    material: dict[str, float | None] = {"roughness": roughness}
    if weighting not in ("object", "plain"):
        raise UnirenderError(f"lobes: got weighting {weighting!r}, expected 'object' or 'plain'")
    if weighting == "object":
        material["metallic"] = metallic
    surface = renderer.scene.parameters("principled", material)
    for name in LOBES:  # all there before the first render: each that comes later would compile the kernel again
        renderer.scene.parameters(name, {"roughness": roughness})
    lobes = {}
    for name in LOBES:
        color = COLOR_TERMS[name] if weighting == "object" else ONE
        mapped = METALLIC_TERMS[name] if weighting == "object" and metallic is None else ONE
        scene = renderer.lit(name, {"roughness": roughness}, environment)
        integrator = _weighted_direct(surface, color, mapped)
        own = derive_seed(seed, "lobe", name)
        lobes[name] = _lobe(*integrator_passes(scene, integrator, spp, own, batches, renderer.counters), batches)
    return Lobes(lobes, weighting, metallic if weighting == "object" else None)


def compose(
    lobes: Lobes,
    albedo: Float[np.ndarray, "h w 3"] | Float[np.ndarray, "3"] | None = None,
    metallic: float | Float[np.ndarray, "h w 1"] | None = None,
) -> Estimate:
    """The direct image in closed form: sum over lobes of weight * buffer, premultiplied, linear.

    Args:
        lobes: the light buffers.
        albedo: base colour, linear, for "plain" buffers; "object" buffers hold their own.
        metallic: in [0, 1], for "plain" buffers; with "object" buffers another scalar than the object's: an exact edit.

    Returns:
        The image (h, w, 3) and its variance, from the variances of the buffers.

    Raises:
        UnirenderError: a value is missing, or given where the buffers hold it already; albedo or metallic lie outside
            [0, 1].
    """
    for name, value in (("albedo", albedo), ("metallic", metallic)):
        if value is not None and not (np.min(value) >= 0 and np.max(value) <= 1):
            raise UnirenderError(
                f"compose: got {name} in [{np.min(value):.4g}, {np.max(value):.4g}], expected values in [0, 1]"
            )
    if lobes.weighting == "plain":
        if albedo is None or metallic is None:
            raise UnirenderError("compose: plain buffers hold no material; give albedo and metallic")
    elif albedo is not None or (metallic is not None and lobes.metallic is None):
        held = "metallic" if albedo is None else "albedo"
        raise UnirenderError(
            f"compose: these buffers are weighted by the object's own {held}; to put in another, render them with "
            "weighting='plain'"
        )
    elif metallic is not None and np.ndim(metallic) > 0:
        raise UnirenderError(
            f"compose: got metallic of shape {np.shape(metallic)} for buffers weighted by the object's own albedo, "
            "expected one value; render them with weighting='plain' for values per pixel"
        )
    factors = {}
    for name in LOBES:
        color = 1 if albedo is None else color_weight(name, np.asarray(albedo, np.float32))
        amount = lobes.metallic if metallic is None else metallic
        factors[name] = color * (1 if amount is None else metallic_weight(name, amount))
    parts = [(lobes.lobes[name], np.asarray(factor, np.float32)) for name, factor in factors.items()]
    mean = np.sum([factor * lobe.weight * lobe.buffer.mean for lobe, factor in parts], axis=0)
    spread = [factor**2 * lobe.variance for lobe, factor in parts if lobe.variance is not None]
    variance = np.sum(spread, axis=0) if len(spread) == len(parts) else None
    return Estimate(mean, variance, sum(lobe.buffer.nan_pixels for lobe, _ in parts))


def _weighted_direct(surface: Any, color: tuple[int, int], metallic: tuple[int, int]) -> Any:
    """Direct light times a lobe's weight, read from `surface` at the first hit; the weight itself as AOVs."""
    import drjit as dr

    mi = mitsuba()
    path = path_integrator(DIRECT_DEPTH)
    terms = [dr.opaque(mi.Float, term) for term in (*color, *metallic)]  # literals: a kernel for each lobe

    def radiance(scene: Any, sampler: Any, ray: Any, active: Any) -> tuple[Any, Any, list[Any]]:
        light, hit, _ = path.sample(scene, sampler, ray, None, active)
        point = scene.ray_intersect(ray, active)
        base = surface.eval_attribute_3("base_color", point, hit)
        amount = surface.eval_attribute_1("metallic", point, hit)
        weight = dr.select(hit, (terms[0] + terms[1] * base) * (terms[2] + terms[3] * amount), 0)
        return light * weight, hit, list(weight)

    return python_integrator(radiance, [f"weight.{component}" for component in "RGB"])


def _lobe(passes: list[Float[np.ndarray, "h w 7"]], nan_pixels: int, batches: int) -> Lobe:
    light, weight = channels(passes, slice(0, 3)), channels(passes, slice(4, 7))
    return Lobe(
        buffer=weighted_estimate(light, weight, nan_pixels, batches),
        weight=mean_estimate(weight, nan_pixels, 1).mean,
        variance=mean_estimate(light, nan_pixels, batches).variance,
    )
