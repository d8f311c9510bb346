"""The three surfaces of the contract, as Mitsuba plugins.

- `principled_bsdf`: the object itself; every parameter that a scene edits (base colour, roughness, metallic) exists
  from the start with a value that is not 0, because Mitsuba leaves out lobes whose parameter is 0 when it loads.
- `mirror_bsdf`: the perfect mirror-tinted reflector that defines s (base_color 1, metallic 1, the same roughness).
- `white_bsdf`: the white Lambertian that defines d.

All are wrapped in `twosided`: `principled` is black from behind. Roughness is perceptual; Mitsuba squares it.
"""

from typing import Any

import numpy as np
from jaxtyping import Float

from unirender.errors import UnirenderError
from unirender_reference.backend import mitsuba

INNER = "brdf_0"  # what Mitsuba calls the BSDF inside `twosided`


def base_color_bitmap(albedo_linear: Float[np.ndarray, "*size 3"]) -> dict[str, Any]:
    """A base-colour texture; `uv` counts rows from the first one (see `shapes.MeshObject`), as Mitsuba does.

    Args:
        albedo_linear: one colour (3,) or a picture (h, w, 3), linear Rec.709 in [0, 1]. One colour becomes a 2 x 2
            picture, so that every object runs the same compiled kernel.
    """
    albedo = np.asarray(albedo_linear, dtype=np.float32)
    if albedo.ndim == 1:
        albedo = np.broadcast_to(albedo, (2, 2, 3))
    if albedo.ndim != 3 or albedo.shape[-1] != 3:
        raise UnirenderError(f"albedo: got shape {albedo.shape}, expected (3,) or (height, width, 3)")
    if not np.isfinite(albedo).all() or albedo.min() < 0 or albedo.max() > 1:
        raise UnirenderError(
            f"albedo: got values in [{albedo.min():.4g}, {albedo.max():.4g}], expected finite linear values in [0, 1]"
        )
    bitmap = mitsuba().Bitmap(np.ascontiguousarray(albedo))
    return {"type": "bitmap", "bitmap": bitmap, "raw": True, "filter_type": "bilinear", "wrap_mode": "repeat"}


def principled_bsdf(
    albedo_linear: Float[np.ndarray, "*size 3"], roughness: float = 0.5, metallic: float = 0.5
) -> dict[str, Any]:
    """The principled BSDF of the contract (default `specular` 0.5: ior 1.5, F0 0.04)."""
    inner = {
        "type": "principled",
        "base_color": base_color_bitmap(albedo_linear),
        "roughness": roughness,
        "metallic": metallic,
    }
    return {"type": "twosided", "surface": inner}


def mirror_bsdf(roughness: float = 0.5) -> dict[str, Any]:
    """What s is defined on: principled, base_color 1, metallic 1."""
    base_color = {"type": "rgb", "value": 1.0}
    inner = {"type": "principled", "base_color": base_color, "roughness": roughness, "metallic": 1.0}
    return {"type": "twosided", "surface": inner}


def white_bsdf() -> dict[str, Any]:
    """What d is defined on: Lambertian, reflectance 1."""
    return {"type": "twosided", "surface": {"type": "diffuse", "reflectance": {"type": "rgb", "value": 1.0}}}
