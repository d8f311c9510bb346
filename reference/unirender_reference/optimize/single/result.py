"""From a single-view fit to a complete `Intrinsics` at the picture's own size.

What was found on blocks of pixels is interpolated; a grey start, which has no detail, takes that of the picture. s and
d are those of the light that was found: with shadows on a known mesh. A predicted s and d move towards them; without a
mesh they change by the ratio of the two lights on the normals, since the prediction knows something of shadows. A
predicted albedo keeps its mean in each channel, a grey start that of all channels, and the light makes up for it, and
for what is not trusted of the change. On a known mesh a light between a predicted one and the fit's gets its level from
the picture.
"""

import numpy as np
from jaxtyping import Float

from unirender.camera import Camera
from unirender.color import unpremultiply
from unirender.intrinsics import Intrinsics
from unirender.light.resampling import resample_environment
from unirender_reference.optimize.single.config import Trust
from unirender_reference.optimize.single.fit import DARKEST, Fit, Unknowns
from unirender_reference.optimize.single.inflate import nearest
from unirender_reference.optimize.single.pixels import PicturePixels, shrink

MOST_GAIN = 4.0
DARK = 1e-4  # least radiance whose logarithm counts
FLOOR = 0.01  # radiance below which a ratio says nothing


def result(
    fit: Fit,
    at: Unknowns,
    image_linear: Float[np.ndarray, "h w 3"],
    mask: Float[np.ndarray, "h w 1"],
    camera: Camera,
    maps: dict[str, Float[np.ndarray, "h w _"]],
    init: Intrinsics | None,
    known_mesh: bool,
    trust: Trust,
) -> Intrinsics:
    """The maps and the light of a point of the search.

    Args:
        fit: of the (shrunk) picture.
        at: the point.
        image_linear: the picture at its own size, premultiplied.
        mask: its coverage.
        camera: its camera.
        maps: start values of albedo, normal, roughness and metallic at its own size.
        init: the prediction, or None.
        known_mesh: normals and shadows are the mesh's.
        trust: what part of the changes of albedo and of a predicted light is kept.
    """
    size = mask.shape[:2]
    change = enlarge(fit.picture, np.log(fit.model(at).albedo + DARKEST) - fit.log_albedo, size)
    whole, albedo = (_changed(maps["albedo"], kept * change) for kept in (1.0, trust.albedo))
    if init is None and fit.picture.block > 1:
        straight = unpremultiply(image_linear, mask)
        detail = _ratio(straight, _blurred(fit.picture, image_linear, mask))
        whole, albedo = whole * detail, albedo * detail
    gauge = _mean(albedo, mask) / np.maximum(_mean(maps["albedo"], mask), DARK)
    if init is None:
        gauge = np.full(3, gauge.mean())
    kept_back = np.maximum(_mean(whole, mask), DARK) / np.maximum(_mean(albedo, mask), DARK)
    light = fit.environment(at) * gauge * kept_back
    specular, diffuse = _shading(fit, at, light, init, known_mesh, trust, size)
    found = {
        "albedo": np.clip(albedo / np.maximum(gauge, DARK), 0, 1),
        "normal": _mesh_normal(fit.picture, size) if known_mesh else maps["normal"],
        "roughness": np.clip(maps["roughness"] + at.roughness, 0, 1),
        "metallic": np.clip(maps["metallic"] + at.metallic, 0, 1),
        "specular": specular,
        "diffuse": diffuse,
    }
    found = {name: np.where(mask > 0, values, 0).astype(np.float32) for name, values in found.items()}
    kept = _trusted_light(fit, light, init, trust)
    if known_mesh and init is not None and trust.light > 0:
        kept = kept * _level(fit, at, kept, found["albedo"], mask)
    environment = fit.picture.transport.grid.environment(kept)
    return Intrinsics(**found, environment=environment, mask=mask, camera=camera)


def _changed(albedo: Float[np.ndarray, "h w 3"], change: Float[np.ndarray, "h w 3"]) -> Float[np.ndarray, "h w 3"]:
    """An albedo whose log has changed."""
    return np.clip(np.exp(np.log(albedo + DARKEST) + change) - DARKEST, 0, 1)


def _trusted_light(
    fit: Fit, light: Float[np.ndarray, "j 3"], init: Intrinsics | None, trust: Trust
) -> Float[np.ndarray, "j 3"]:
    """The light that was found, between it and a predicted one."""
    if init is None or init.environment is None:
        return light
    grid = fit.picture.transport.grid
    predicted = resample_environment(init.environment, (grid.rows, grid.columns)).reshape(light.shape)
    return np.maximum(predicted, DARK) ** (1 - trust.light) * light**trust.light


def _level(
    fit: Fit,
    at: Unknowns,
    light: Float[np.ndarray, "j 3"],
    albedo: Float[np.ndarray, "h w 3"],
    mask: Float[np.ndarray, "h w 1"],
) -> Float[np.ndarray, "3"]:
    """What a light between a prediction's and the fit's lacks for the maps to be as bright as the picture."""
    blocks = unpremultiply(shrink(albedo * mask, fit.picture.block), shrink(mask, fit.picture.block))
    factor = fit.brightness(at, blocks.reshape(-1, 3)[fit.picture.pixel], light)
    return np.clip(factor, 1 / MOST_GAIN, MOST_GAIN)


def _shading(
    fit: Fit,
    at: Unknowns,
    light: Float[np.ndarray, "j 3"],
    init: Intrinsics | None,
    known_mesh: bool,
    trust: Trust,
    size: tuple[int, int],
) -> tuple[Float[np.ndarray, "h w 3"], Float[np.ndarray, "h w 3"]]:
    """s and d under the light that was found; predicted ones move towards them."""
    specular, diffuse = (enlarge(fit.picture, values, size) for values in light_buffers(fit, at, light))
    if init is None or init.specular is None or init.diffuse is None:
        return specular, diffuse
    before = (init.specular, init.diffuse)
    if not known_mesh:  # what a normal map cannot show of the light stands in the prediction alone
        start = fit.start()
        before = (enlarge(fit.picture, own, size) for own in light_buffers(fit, start, fit.environment(start)))
    specular, diffuse = (
        own * _ratio(new, old) ** trust.shading
        for own, new, old in zip((init.specular, init.diffuse), (specular, diffuse), before, strict=True)
    )
    return specular, diffuse


def _mesh_normal(picture: PicturePixels, size: tuple[int, int]) -> Float[np.ndarray, "h w 3"]:
    """The mesh's normals at the picture's own size."""
    normal = enlarge(picture, picture.normal, size)
    return normal / np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-9)


def light_buffers(
    fit: Fit, at: Unknowns, light: Float[np.ndarray, "j 3"]
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]:
    """s and d of the picture's pixels under a light, with the roughness of a point; not premultiplied."""
    light, coverage = light.astype(np.float32), fit.picture.coverage
    return (fit.model(at).lobes.gloss @ light) / coverage, (fit.picture.transport.white @ light) / coverage


def enlarge(
    picture: PicturePixels, values: Float[np.ndarray, "n c"], size: tuple[int, int]
) -> Float[np.ndarray, "h w c"]:
    """Values of blocks at the pixels of a picture of `size`: bilinear; blocks without one have their neighbour's."""
    import scipy.ndimage as ndimage

    known = np.zeros(picture.size[0] * picture.size[1], bool)
    known[picture.pixel] = True
    filled = picture.frame(values)[nearest(known.reshape(picture.size))]
    if picture.block == 1:
        return filled
    rows, columns = ((np.arange(n) + 0.5) / picture.block - 0.5 for n in size)
    places = np.stack(np.meshgrid(rows, columns, indexing="ij"))
    layers = [ndimage.map_coordinates(layer, places, order=1, mode="nearest") for layer in np.moveaxis(filled, -1, 0)]
    return np.stack(layers, axis=-1)


def _mean(values: Float[np.ndarray, "h w 3"], mask: Float[np.ndarray, "h w 1"]) -> Float[np.ndarray, "3"]:
    return (values * mask).sum(axis=(0, 1)) / mask.sum()


def _blurred(
    picture: PicturePixels, image_linear: Float[np.ndarray, "h w 3"], mask: Float[np.ndarray, "h w 1"]
) -> Float[np.ndarray, "h w 3"]:
    """The picture as its blocks show it, straight."""
    coverage = shrink(mask, picture.block)
    blocks = unpremultiply(shrink(image_linear, picture.block), coverage)
    return enlarge(picture, blocks.reshape(-1, 3)[picture.pixel], mask.shape[:2])


def _ratio(new: Float[np.ndarray, "h w 3"], old: Float[np.ndarray, "h w 3"]) -> Float[np.ndarray, "h w 3"]:
    return np.clip((new + FLOOR) / (old + FLOOR), 1 / MOST_GAIN, MOST_GAIN)
