"""The closed-form image of an `Intrinsics`: what the paper's s and d give without tracing a ray.

    I = (1 - metallic) * albedo * d + F(albedo, metallic) * s,    F = 0.04 * (1 - metallic) + albedo * metallic

It leaves out interreflection, the angle in the Fresnel term and the retro-reflection of the principled diffuse lobe:
about 4 % of a pixel's radiance. The functions are plain arithmetic and take numpy arrays and torch tensors alike, as
long as single-channel maps broadcast against three-channel ones.
"""

from typing import Any

import numpy as np
from jaxtyping import Float

from unirender.errors import UnirenderError
from unirender.intrinsics import Intrinsics

DIELECTRIC_F0 = 0.04  # reflectance at normal incidence of the principled BSDF's default ior, 1.5


def fresnel(albedo: Any, metallic: Any) -> Any:
    """Reflectance at normal incidence, F."""
    return DIELECTRIC_F0 * (1 - metallic) + albedo * metallic


def composite(albedo: Any, metallic: Any, diffuse: Any, specular: Any) -> Any:
    """Radiance from maps in linear units; not multiplied by the mask."""
    return (1 - metallic) * albedo * diffuse + fresnel(albedo, metallic) * specular


def composite_image(intrinsics: Intrinsics) -> Float[np.ndarray, "h w 3"]:
    """The composite of an `Intrinsics`, linear and premultiplied by its mask.

    Raises:
        UnirenderError: one of albedo, metallic, diffuse, specular or mask is unknown.
    """
    maps = {name: getattr(intrinsics, name) for name in ("albedo", "metallic", "diffuse", "specular", "mask")}
    missing = [name for name, value in maps.items() if value is None]
    if missing:
        raise UnirenderError(
            f"composite: maps {', '.join(missing)} are missing, expected albedo, metallic, diffuse, specular and mask; "
            "derive specular and diffuse from an environment with unirender.lighting"
        )
    mask = maps.pop("mask")
    return (composite(**maps) * mask).astype(np.float32)
