"""Mitsuba shades an `Intrinsics` under an environment, and differentiates what it shaded: numpy in, numpy out.

The equation, and what differentiation holds fixed, stand in `shader`. Without geometry nothing is hidden; with the
object that the picture shows, light that it blocks is left out. Either way there is one bounce, and one normal and
material per pixel where a render averages many. `shade` of the true maps is therefore a row of its own in the tables,
and the ceiling of every closed loop.

An optimiser alternates two calls, with a seed of its own for each:

    image = shade(maps, light, spp, seed=2 * step)
    gradients = shade_gradients(maps, light, loss_gradient(image), spp, seed=2 * step + 1)

The gradient of a loss that is not linear in the image is biased if both use the same samples: image noise and gradient
noise are then correlated.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from numbers import Integral

import numpy as np
from jaxtyping import Float

from unirender.arguments import as_instance
from unirender.errors import UnirenderError
from unirender.intrinsics import Intrinsics, as_numbers
from unirender.light.environment import as_light
from unirender.shown import short_repr
from unirender_reference.envmap import envmap_data
from unirender_reference.passes import NAN_ATTEMPTS, Counters, derive_seed, finite_pass
from unirender_reference.sample_counts import SAMPLES_PER_PASS, pass_count
from unirender_reference.shader import PARAMETERS, Parameter, Shader, gradient, tensors
from unirender_reference.shapes import MeshObject

GRADIENT_SAMPLES_PER_PASS = SAMPLES_PER_PASS // 4


@dataclass(frozen=True)
class Gradients:
    """Derivatives of a loss, each of the shape of its map; 0 outside the mask; None where it was not asked for.

    `normal` is the derivative with respect to the three numbers of a normal, of any length: it is perpendicular to the
    normal, since length does not count. A material that is one number per object has the sum of its map as derivative.
    """

    albedo: Float[np.ndarray, "h w 3"] | None = None
    normal: Float[np.ndarray, "h w 3"] | None = None
    roughness: Float[np.ndarray, "h w 1"] | None = None
    metallic: Float[np.ndarray, "h w 1"] | None = None
    environment: Float[np.ndarray, "eh ew 3"] | None = None

    __repr__ = short_repr


def shade(
    intrinsics: Intrinsics,
    environment: Float[np.ndarray, "eh ew 3"] | None = None,
    spp: int = 256,
    seed: int = 0,
    counters: Counters | None = None,
    geometry: MeshObject | None = None,
) -> Float[np.ndarray, "h w 3"]:
    """The image of given maps under a light: linear, premultiplied by the mask (all ones where the mask is None).

    Args:
        intrinsics: needs albedo, normal, roughness and metallic; normals of 0 give black.
        environment: lat-long radiance in camera axes, display units; the intrinsics' own if None.
        spp: samples per pixel (each one light sample and one BSDF sample).
        seed: equal seeds give equal images.
        counters: if given, its `nan_pixels` grows by the points that came out NaN or infinite in some pass and were
            shaded again with another seed.
        geometry: the object in the picture: light that it blocks is left out. None: nothing is hidden.

    Raises:
        UnirenderError: an argument of another type, a map is missing, the environment is not usable, or a point stays
            NaN.
    """
    maps, light, mask = _arguments(intrinsics, environment, spp, geometry)
    image = np.zeros((*mask.shape[:2], 3), np.float64)
    if not mask.any() or not light.any():
        return image.astype(np.float32)
    shader = Shader(mask, intrinsics.camera, geometry)
    made = tensors({**maps, "environment": light})
    passes = pass_count(spp, 1, max(1, SAMPLES_PER_PASS // shader.points))
    for index in range(passes):

        def draw(attempt: int, index: int = index) -> Float[np.ndarray, "h w 3"]:
            return np.array(shader.image(made, made["environment"], spp // passes, _pass_seed(seed, index, attempt)))

        image += finite_pass(draw, counters or Counters(), "shade")
    return (image / passes).astype(np.float32)


def shade_gradients(
    intrinsics: Intrinsics,
    image_gradient: Float[np.ndarray, "h w 3"],
    environment: Float[np.ndarray, "eh ew 3"] | None = None,
    spp: int = 64,
    seed: int = 0,
    counters: Counters | None = None,
    geometry: MeshObject | None = None,
    wrt: Parameter | Sequence[Parameter] = PARAMETERS,
) -> Gradients:
    """Derivatives of a loss with respect to maps and light, from its derivative with respect to the image.

    Unbiased, by reverse differentiation of `shade`, some samples at a time: memory does not grow with `spp`.

    Args:
        intrinsics, environment, geometry: as in `shade`.
        image_gradient: derivative of the loss with respect to the image that `shade` returns (linear, premultiplied).
        spp: samples per pixel.
        seed: `shade` with the same seed and samples draws the same directions.
        counters: its `nan_pixels` grows by the pixels and texels whose derivative came out NaN or infinite in some
            pass; that pass was made again with another seed.
        wrt: what to differentiate with respect to, one name or several. Under a black light the maps' derivatives
            are 0.

    Raises:
        UnirenderError: as in `shade`; the image gradient has another size or is not finite; `wrt` names no parameter.
    """
    wrt = (wrt,) if isinstance(wrt, str) else wrt
    if not wrt or not set(wrt) <= set(PARAMETERS):
        raise UnirenderError(f"shade_gradients: got wrt={tuple(wrt)}, expected some of {', '.join(PARAMETERS)}")
    maps, light, mask = _arguments(intrinsics, environment, spp, geometry)
    image_gradient = as_numbers("image gradient", image_gradient)
    if image_gradient.shape != (*mask.shape[:2], 3) or not np.isfinite(image_gradient).all():
        raise UnirenderError(
            f"shade_gradients: got an image gradient of shape {image_gradient.shape}, expected finite "
            f"{(*mask.shape[:2], 3)}, as the picture that `shade` returns; has it an alpha channel, or NaN?"
        )
    given = {**maps, "environment": light}
    totals = {name: np.zeros(given[name].shape, np.float64) for name in wrt}
    wanted = tuple(totals)
    if not light.any():  # the image is linear in the light: any light has the same derivative with respect to it
        given["environment"] = np.ones_like(light)
        wanted = tuple(name for name in wanted if name == "environment")
    if mask.any() and wanted:
        shader = Shader(mask, intrinsics.camera, geometry)
        weights = tensors({"image": image_gradient})["image"]
        passes = pass_count(spp, 1, max(1, GRADIENT_SAMPLES_PER_PASS // shader.points))
        for index in range(passes):

            def draw(attempt: int, index: int = index) -> dict[str, np.ndarray]:
                made = tensors(given, wanted)
                shader.backward(made, made["environment"], weights, spp // passes, _pass_seed(seed, index, attempt))
                return {name: gradient(made[name]) for name in wanted}

            for name, values in _finite(draw, counters or Counters()).items():
                totals[name] += values / passes
    return Gradients(**{name: total.astype(np.float32) for name, total in totals.items()})


def _arguments(
    intrinsics: Intrinsics,
    environment: Float[np.ndarray, "eh ew 3"] | None,
    spp: int,
    geometry: MeshObject | None,
) -> tuple[dict[str, Float[np.ndarray, "h w c"]], Float[np.ndarray, "eh ew 3"], Float[np.ndarray, "h w 1"]]:
    """Maps, light (checked; it may be black), and the mask: 0 where there is no normal."""
    as_instance(intrinsics, Intrinsics, "shade")
    if not isinstance(spp, Integral):
        raise UnirenderError(f"spp: got {spp!r:.60}, expected a whole number of samples, at least 1")
    if geometry is not None and not isinstance(geometry, MeshObject):
        raise UnirenderError(f"geometry: got {geometry!r:.60}, expected an object, as make_object or load_mesh gives")
    maps = intrinsics.require("albedo", "normal", "roughness", "metallic")
    if environment is None:
        environment = intrinsics.require("environment")["environment"]
    if maps["normal"].ndim != 3:
        raise UnirenderError(
            f"shade: got maps of shape {maps['normal'].shape}, expected one picture (h, w, c); call it for each"
        )
    light = as_light(environment)
    envmap_data(light if light.any() else np.ones_like(light))  # checks
    inside = np.any(maps["normal"] != 0, axis=-1, keepdims=True)
    return maps, light, np.where(inside, 1 if intrinsics.mask is None else intrinsics.mask, 0).astype(np.float32)


def _pass_seed(seed: int, index: int, attempt: int) -> int:
    return derive_seed(seed, *(("shade", index, attempt) if attempt else ("shade", index)))


def _finite(draw: Callable[[int], Mapping[str, np.ndarray]], counters: Counters) -> Mapping[str, np.ndarray]:
    """The derivatives of a pass, made again with other seeds until all are finite."""
    bad = 0
    for attempt in range(NAN_ATTEMPTS + 1):
        found = draw(attempt)
        bad = sum(int((~np.isfinite(values)).any(axis=-1).sum()) for values in found.values())
        if not bad:
            return found
        counters.nan_pixels += bad
    raise UnirenderError(
        f"shade_gradients: {bad} derivatives stay NaN after {NAN_ATTEMPTS} seeds, expected finite values; check the "
        "normals and the light"
    )
