"""The lobes of the principled BSDF times the light's cosine, for arrays of directions (Dr.Jit).

Notation, all cosines: `facing` of normal and viewer, `incident` of normal and light, `normal` of normal and half
vector, `angle` of half vector and light. Roughness is perceptual, alpha = roughness^2. Sources:
`unirender_reference.principled`, which has the same lobes in double precision.
"""

from typing import Any

F0 = 0.04  # of the dielectric, in Schlick's approximation


def diffuse_lobes(facing: Any, incident: Any, angle: Any) -> tuple[Any, Any, Any]:
    """Disney's diffuse lobe at base colour 1, as coefficients of 1, r and r^2."""
    import drjit as dr

    viewer, light = schlick(facing), schlick(incident)
    retro = 2 * angle**2
    lambert = (1 - 0.5 * viewer) * (1 - 0.5 * light)
    cosine = incident / dr.pi
    return cosine * lambert, cosine * retro * (viewer + light - viewer * light), cosine * retro**2 * viewer * light


def schlick(cosine: Any) -> Any:
    """(1 - cosine)^5."""
    return (1 - cosine) ** 5


def gloss_lobe(roughness: Any, normal: Any, facing: Any, incident: Any) -> Any:
    """D G1 G1 / (4 cos): GGX with reflectance 1."""
    return visible_density(roughness, normal, facing) * _shadowing(roughness, incident)


def visible_density(roughness: Any, normal: Any, facing: Any) -> Any:
    """Probability density of directions reflected at visible normals."""
    return _distribution(roughness, normal) * _shadowing(roughness, facing) / (4 * facing)


def _distribution(roughness: Any, normal: Any) -> Any:
    import drjit as dr

    squared = roughness**4
    return squared / (dr.pi * (normal**2 * (squared - 1) + 1) ** 2)


def _shadowing(roughness: Any, cosine: Any) -> Any:
    import drjit as dr

    squared = roughness**4
    return 2 * cosine / (cosine + dr.sqrt(squared + (1 - squared) * cosine**2))
