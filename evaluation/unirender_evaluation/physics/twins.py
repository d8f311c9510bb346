"""What each physics test must refuse: the composite, the true maps or Mitsuba's posterior, broken in one place."""

import numpy as np

from unirender.intrinsics import Intrinsics
from unirender_evaluation.methods.composite import Composite
from unirender_evaluation.methods.method import Image
from unirender_evaluation.physics.ambiguity import POSTERIOR, Points
from unirender_evaluation.physics.stage import Stage
from unirender_evaluation.suites.suite import Material
from unirender_evaluation.truth.render import item_seed

_PERFECT = Composite().render


def gamma(maps: Intrinsics) -> Image:
    """Radiance to the power 0.8: not linear in the light."""
    return (_PERFECT(maps) ** 0.8).astype(np.float32)


def darkening(maps: Intrinsics) -> Image:
    """0.8 of the radiance: loses energy."""
    return (0.8 * _PERFECT(maps)).astype(np.float32)


def gradient(maps: Intrinsics) -> Image:
    """A left-to-right gradient: neither mirror nor turn leaves it alone."""
    image = _PERFECT(maps)
    return (image * np.linspace(0.7, 1.3, image.shape[1])[None, :, None]).astype(np.float32)


def squared_metallic(maps: Intrinsics) -> Image:
    """Metallic squared."""
    return _PERFECT(maps.replace(metallic=maps.require("metallic")["metallic"] ** 2))


def blind_to_roughness(maps: Intrinsics) -> Image:
    """s replaced by d."""
    return _PERFECT(maps.replace(specular=maps.require("diffuse")["diffuse"]))


def dents_for_bumps(stage: Stage, material: Material, _: Image) -> Intrinsics:
    """The true maps, each normal turned by half a turn about the view axis: lit from the other side."""
    maps = stage.true_maps(material)
    return maps.replace(normal=maps.require("normal")["normal"] * np.array([-1, -1, 1], np.float32))


def constant_material(stage: Stage, material: Material, _: Image) -> Intrinsics:
    """The true albedo and normal, metallic and roughness 0.5 whatever the picture."""
    return stage.true_maps((0.5, 0.5)).replace(albedo=stage.true_maps(material).albedo)


def too_sure(stage: Stage, *_: object) -> Points:
    """Mitsuba's posterior, shrunk to a tenth about its mean."""
    samples = stage.explanations.posterior
    return samples.mean(axis=0) + 0.1 * (samples - samples.mean(axis=0))


def anything(stage: Stage, *_: object) -> Points:
    """Any material, whatever the picture."""
    return np.random.default_rng(item_seed("anything", stage.scene.key)).random((POSTERIOR, 3))
