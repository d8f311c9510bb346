"""The closed-form image of an `Intrinsics`: what the paper's s and d give without tracing a ray.

    L(x, v) = integral of f(x, v, l) E(x, l) max(n . l, 0) dl                          (Eq. 1)
    I = (1 - metallic) * albedo * d + F(albedo, metallic) * s,    F = 0.04 * (1 - metallic) + albedo * metallic

I stands for L, the paper's rendering equation: d and s are its integral over the light for two surfaces that know
neither albedo nor metallic, which weigh them here. It leaves out interreflection, the angle in the Fresnel term and the
retro-reflection of the principled diffuse lobe: about 4 % of a pixel's radiance. The functions are plain arithmetic and
take numpy arrays and torch tensors alike, as long as single-channel maps broadcast against three-channel ones.

The *split-sum* composite (numpy only) puts the angle back: its F is Schlick's reflectance averaged over the lobe
(`unirender.environment_brdf`).
"""

from typing import Any

import numpy as np
from jaxtyping import Float, Int

from unirender.arguments import as_instance
from unirender.blocks import by_rows
from unirender.environment_brdf import mean_fresnel
from unirender.errors import UnirenderError
from unirender.intrinsics import Intrinsics, unit_normals
from unirender.vectors import dots

DIELECTRIC_F0 = 0.04  # reflectance at normal incidence of the principled BSDF's default ior, 1.5
BLOCK = 2**16  # pixels whose split sum is made at a time: some 200 bytes each


def fresnel(albedo: Any, metallic: Any) -> Any:
    """Reflectance at normal incidence, F."""
    return DIELECTRIC_F0 * (1 - metallic) + albedo * metallic


def composite(albedo: Any, metallic: Any, diffuse: Any, specular: Any) -> Any:
    """Radiance from maps in linear units; not multiplied by the mask."""
    return lobes(albedo, metallic, diffuse, specular, fresnel(albedo, metallic))


def lobes(albedo: Any, metallic: Any, diffuse: Any, specular: Any, reflectance: Any) -> Any:
    """The diffuse and the specular lobe at a given reflectance of the latter; not multiplied by the mask."""
    return (1 - metallic) * albedo * diffuse + reflectance * specular


def composite_image(intrinsics: Intrinsics) -> Float[np.ndarray, "h w 3"]:
    """The composite of an `Intrinsics`, linear and premultiplied by its mask.

    Raises:
        UnirenderError: one of albedo, metallic, diffuse, specular or mask is unknown.
    """
    maps = _maps(intrinsics, "albedo", "metallic", "diffuse", "specular", "mask")
    return by_rows(_composite, *maps.values())


def _composite(*maps: Float[np.ndarray, "h w _"]) -> Float[np.ndarray, "h w 3"]:
    """The premultiplied composite of some rows; the last of the maps is the mask."""
    return (composite(*maps[:-1]) * maps[-1]).astype(np.float32)


def split_sum_image(intrinsics: Intrinsics) -> Float[np.ndarray, "h w 3"]:
    """The split-sum composite of an `Intrinsics`, linear and premultiplied by its mask; n.v along the true view rays.

    Raises:
        UnirenderError: one of albedo, normal, roughness, metallic, diffuse, specular or mask is unknown.
    """
    maps = _maps(intrinsics, "albedo", "normal", "roughness", "metallic", "diffuse", "specular", "mask")
    view = intrinsics.camera.view_directions(intrinsics.height, intrinsics.width)
    covered = np.flatnonzero(maps["mask"])
    image = np.zeros((maps["mask"].size, 3), np.float32)
    for start in range(0, len(covered), BLOCK):
        which = covered[start : start + BLOCK]
        seen = {name: _pixels(value, which) for name, value in maps.items()}
        image[which] = _split_sum(**seen, view=_pixels(view, which))
    return image.reshape(view.shape)


def _split_sum(
    albedo: Float[np.ndarray, "n 3"],
    normal: Float[np.ndarray, "n 3"],
    roughness: Float[np.ndarray, "n 1"],
    metallic: Float[np.ndarray, "n 1"],
    diffuse: Float[np.ndarray, "n 3"],
    specular: Float[np.ndarray, "n 3"],
    mask: Float[np.ndarray, "n 1"],
    view: Float[np.ndarray, "n 3"],
) -> Float[np.ndarray, "n 3"]:
    """The split-sum composite of some pixels; `view`: directions towards the viewer."""
    reflectance = mean_fresnel(fresnel(albedo, metallic), dots(unit_normals(normal), view), roughness)
    return lobes(albedo, metallic, diffuse, specular, reflectance) * mask


def _pixels(picture: Float[np.ndarray, "h w c"], which: Int[np.ndarray, " n"]) -> Float[np.ndarray, "n c"]:
    """Those pixels, by their place in the flat picture."""
    flat = picture.reshape(-1, picture.shape[-1])
    return flat if len(which) == len(flat) else flat.take(which, axis=0)


def _maps(intrinsics: Intrinsics, *names: str) -> dict[str, np.ndarray]:
    as_instance(intrinsics, Intrinsics, "composite")
    maps = {name: getattr(intrinsics, name) for name in names}
    missing = [name for name, value in maps.items() if value is None]
    if missing:
        raise UnirenderError(
            f"composite: maps {', '.join(missing)} are missing, expected {', '.join(names[:-1])} and {names[-1]}; "
            "derive specular and diffuse from an environment with unirender.light.surface_light"
        )
    return maps
