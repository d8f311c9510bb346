"""The list of checks, and how one is run."""

import dataclasses
import time
from collections.abc import Callable

from unirender.errors import UnirenderError
from unirender_reference.checks import bsdf_checks, closed_forms, invariants, light_checks, sums
from unirender_reference.checks.outcome import Check

CHECKS: dict[str, Callable[[int], Check]] = {
    "bsdf-values": bsdf_checks.bsdf_values,
    "bsdf-gradients": bsdf_checks.bsdf_gradients,
    "bsdf-sampler": bsdf_checks.bsdf_sampler,
    "furnace-dielectric": closed_forms.furnace_dielectric,
    "furnace-metal": closed_forms.furnace_metal,
    "lambert-constant": closed_forms.lambert_constant,
    "lambert-directional": closed_forms.lambert_directional,
    "mirror": closed_forms.mirror,
    "camera": closed_forms.camera,
    "orientation": light_checks.orientation,
    "diffuse-buffer": light_checks.diffuse_buffer,
    "specular-buffer": light_checks.specular_buffer,
    "image-quadrature": light_checks.image_quadrature,
    "exposure": invariants.exposure,
    "superposition": invariants.superposition,
    "scalar-variant": invariants.scalar_variant,
    "effects-sum": sums.effects_sum,
    "lobes-composition": sums.lobes_composition,
    "sweep": sums.sweep,
}

# For each check a perturbation that it must not pass: the twins of the tests.
TWIN = {
    "bsdf-values": "roughness",
    "bsdf-gradients": "roughness",
    "bsdf-sampler": "roughness",
    "furnace-dielectric": "gamma",
    "furnace-metal": "roughness",
    "lambert-constant": "albedo",
    "lambert-directional": "normals",
    "mirror": "light-texel",
    "camera": "fov",
    "orientation": "unwrapped",
    "diffuse-buffer": "light-texel",
    "specular-buffer": "roughness",
    "image-quadrature": "albedo",
    "exposure": "gamma",
    "superposition": "gamma",
    "scalar-variant": "light-texel",
    "effects-sum": "bounces",
    "lobes-composition": "metallic",
    "sweep": "metallic",
}


def run_check(name: str, seed: int = 0) -> Check:
    """Runs one check, timed, with one torch thread.

    Raises:
        UnirenderError: no such check.
    """
    if name not in CHECKS:
        raise UnirenderError(f"check: got {name!r}, expected one of {', '.join(CHECKS)}")
    from unirender_reference import principled

    start = time.perf_counter()
    with principled.one_thread():
        check = CHECKS[name](seed)
    return dataclasses.replace(check, seconds=time.perf_counter() - start)
