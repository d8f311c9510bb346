"""What the physics tests ask of a decomposer or a posterior on one scene, and of a renderer beyond `physics`.

A decomposer is a function `(stage, material, picture) -> maps`, a posterior the same for samples of the material.
"""

from collections.abc import Callable
from typing import Literal

import numpy as np

from unirender.intrinsics import Intrinsics
from unirender_evaluation.methods.method import Image
from unirender_evaluation.metrics import METRICS, metric_key, weighted_mean
from unirender_evaluation.physics import formulas, region
from unirender_evaluation.physics.ambiguity import Points
from unirender_evaluation.physics.stage import LEVELS, ROUGH, Light, Shader, Stage
from unirender_evaluation.suites.suite import MetallicRoughness

Decompose = Callable[[Stage, MetallicRoughness, Image], Intrinsics]
Posterior = Callable[[Stage, MetallicRoughness, Image], Points]  # samples of the object's material
PSNR_KEY = metric_key("loop", METRICS["psnr"])


def roughness_response(render: formulas.Render, stage: Stage) -> float:
    """Correlation of the renderer's with Mitsuba's change from the least to the highest roughness of the edits."""
    suite, scene, m = stage.suite, stage.scene, stage.suite.spec.base[0]
    low, high = (m, min(suite.spec.specular_roughness)), (m, max(suite.spec.specular_roughness))
    return formulas.roughness_response(
        render,
        suite.intrinsics(scene, low),
        suite.intrinsics(scene, high),
        suite.image(scene, low),
        suite.image(scene, high),
    )


def decomposition(decompose: Decompose, stage: Stage, material: MetallicRoughness) -> Intrinsics:
    """What is found in the true picture of a material."""
    return decompose(stage, material, stage.image(material))


def loop(shader: Shader, light: Light, decompose: Decompose, stage: Stage) -> float:
    """dB of the closed loop of the base material's picture."""
    return _loop_psnr(decompose, stage, shader, light, stage.suite.spec.base)


def _loop_psnr(decompose: Decompose, stage: Stage, shader: Shader, light: Light, material: MetallicRoughness) -> float:
    maps = decomposition(decompose, stage, material)
    return stage.loop_values(maps, shader, light, material, "loop")[PSNR_KEY]


def true_maps(stage: Stage, material: MetallicRoughness, _: Image) -> Intrinsics:
    """The decomposer whose closed loop is the ceiling of all others."""
    return stage.true_maps(material)


def loss(light: Light, decompose: Decompose, stage: Stage) -> float:
    """dB that the found maps lose against the true ones in Mitsuba's loop of the base material's picture."""
    return loop("shade", light, true_maps, stage) - loop("shade", light, decompose, stage)


def loop_by_roughness(decompose: Decompose, stage: Stage, *, rough: bool) -> float:
    """Mean dB of Mitsuba's loops under both lights, over the stored pictures of roughness >= `ROUGH`, or below."""
    materials = [m for m in stage.pictures if (m[1] >= ROUGH) == rough]
    lights: tuple[Light, ...] = ("input", "heldout")
    return float(np.mean([_loop_psnr(decompose, stage, "shade", light, m) for m in materials for light in lights]))


def rough_loss(decompose: Decompose, stage: Stage) -> float:
    """dB that the found maps lose against the true ones in the primary closed loop."""
    return loop_by_roughness(true_maps, stage, rough=True) - loop_by_roughness(decompose, stage, rough=True)


def tau(parameter: Literal["metallic", "roughness"], decompose: Decompose, stage: Stage) -> float:
    """Kendall's tau of the found against the true parameter over the 11 pictures of its sweep."""
    m, r = stage.suite.spec.base
    sweep = [(level, r) if parameter == "metallic" else (m, level) for level in LEVELS]
    maps = (decomposition(decompose, stage, at).require(parameter)[parameter] for at in sweep)
    found = [weighted_mean(values, stage.mask) for values in maps]
    return formulas.kendall_tau(LEVELS, found)


def share_inside(posterior: Posterior, stage: Stage) -> float:
    """Share of the materials that explain the picture that lie inside the posterior's region."""
    return float(region.inside(_samples(posterior, stage), stage.explanations.materials).mean())


def region_volume(posterior: Posterior, stage: Stage) -> float:
    """Share of the unit cube that the posterior's region covers."""
    return region.volume(_samples(posterior, stage))


def _samples(posterior: Posterior, stage: Stage) -> Points:
    return posterior(stage, stage.own_material, stage.image(stage.own_material))
