"""Specular-glossiness materials as metallic-roughness ones.

The conversion of the Khronos archive (KHR_materials_pbrSpecularGlossiness, "convert between workflows"): the metallic
value is the root of a quadratic that keeps the perceived brightness of diffuse and specular colour.
"""

import numpy as np
from jaxtyping import Float

DIELECTRIC = 0.04
EPSILON = 1e-6
BRIGHTNESS = np.array([0.299, 0.587, 0.114], np.float32)


def metallic_roughness(
    diffuse: Float[np.ndarray, "h w 3"],
    specular: Float[np.ndarray, "h w 3"],
    glossiness: Float[np.ndarray, "h w 1"],
) -> tuple[Float[np.ndarray, "h w 3"], Float[np.ndarray, "h w 1"], Float[np.ndarray, "h w 1"]]:
    """Linear colours and glossiness in [0, 1] -> albedo (linear), perceptual roughness, metallic."""
    left = 1 - specular.max(-1, keepdims=True)
    metallic = _metallic(_brightness(diffuse), _brightness(specular), left)
    from_diffuse = diffuse * (left / (1 - DIELECTRIC) / np.maximum(1 - metallic, EPSILON))
    from_specular = (specular - DIELECTRIC * (1 - metallic)) / np.maximum(metallic, EPSILON)
    share = metallic**2
    albedo = np.clip(share * from_specular + (1 - share) * from_diffuse, 0, 1)
    roughness = np.clip(1 - glossiness, 0, 1)
    return albedo.astype(np.float32), roughness.astype(np.float32), metallic.astype(np.float32)


def _brightness(color: Float[np.ndarray, "h w 3"]) -> Float[np.ndarray, "h w 1"]:
    return np.sqrt(color**2 @ BRIGHTNESS)[..., None]


def _metallic(
    diffuse: Float[np.ndarray, "h w 1"], specular: Float[np.ndarray, "h w 1"], left: Float[np.ndarray, "h w 1"]
) -> Float[np.ndarray, "h w 1"]:
    b = diffuse * left / (1 - DIELECTRIC) + specular - 2 * DIELECTRIC
    c = DIELECTRIC - specular
    root = (-b + np.sqrt(np.maximum(b * b - 4 * DIELECTRIC * c, EPSILON))) / (2 * DIELECTRIC)
    return np.where(specular < DIELECTRIC, 0, np.clip(root, 0, 1))
