"""The composite and the shipped model against Mitsuba renders of tiny scenes that neither was fitted to.

Thresholds are loose floors with twins that must fail; the benchmark measures how good the model is.
"""

from dataclasses import dataclass

import numpy as np
import pytest

from unirender.color import image_srgb
from unirender.composite import composite_image
from unirender.intrinsics import Intrinsics
from unirender.pipelines.unirender_pipeline import UniRenderPipeline
from unirender_reference.lights import make_light
from unirender_reference.render import Renderer, Sample, SceneSpec, render_sample
from unirender_reference.shapes import make_object

pytestmark = pytest.mark.slow
SPP = 256
SCENES = ((900, 0.3, 0.2), (901, 0.7, 0.8), (902, 0.5, 0.5))  # test seed, roughness, metallic; beyond the tiny suite's


@dataclass(frozen=True)
class Scene:
    sample: Sample
    inside: np.ndarray

    @property
    def truth(self) -> Intrinsics:
        return self.sample.intrinsics

    def psnr(self, image_linear: np.ndarray) -> float:
        error = image_srgb(image_linear)[self.inside] - image_srgb(self.sample.image_linear)[self.inside]
        return float(-10 * np.log10(np.mean(np.square(error))))

    @property
    def picture(self) -> np.ndarray:
        """What a camera would store: straight display values in 8 bits."""
        mask = self.truth.require("mask")["mask"]
        straight = np.where(mask > 0, self.sample.image_linear / np.maximum(mask, 1e-6), 0)
        return np.round(image_srgb(straight) * 255).astype(np.float32) / 255


@pytest.fixture(scope="module")
def scenes() -> list[Scene]:
    found = []
    for seed, roughness, metallic in SCENES:
        obj = make_object(seed, "test")
        spec = SceneSpec(obj, make_light(seed, "test"), roughness=roughness, metallic=metallic, exposure_seed=seed)
        sample = render_sample(spec, spp=SPP, seed=seed, renderer=Renderer(obj))
        mask = sample.intrinsics.require("mask")["mask"]
        found.append(Scene(sample, mask[..., 0] > 0.99))
    return found


@pytest.fixture(scope="module")
def pipeline() -> UniRenderPipeline:
    return UniRenderPipeline.from_pretrained()


def test_composite_explains_a_render(scenes: list[Scene]) -> None:
    scores = [scene.psnr(composite_image(scene.truth)) for scene in scenes]
    assert np.mean(scores) > 27, scores


@pytest.mark.parametrize("wrong", ["specular", "diffuse", "metallic"])
def test_composite_twin_with_a_wrong_map_is_told_apart(scenes: list[Scene], wrong: str) -> None:
    """Half the light, or metal for plastic. (The composite lacks interreflection: *more* light can bring it closer.)"""
    losses = []
    for scene in scenes:
        value = scene.truth.require(wrong)[wrong]
        broken = scene.truth.replace(**{wrong: 1 - value if wrong == "metallic" else 0.5 * value})
        losses.append(scene.psnr(composite_image(scene.truth)) - scene.psnr(composite_image(broken)))
    assert np.mean(losses) > 1, losses


def test_model_renders_true_maps(scenes: list[Scene], pipeline: UniRenderPipeline) -> None:
    scores = [scene.psnr(pipeline.render(scene.truth)) for scene in scenes]
    assert np.mean(scores) > 27, scores


def test_model_twin_another_objects_light_is_told_apart(scenes: list[Scene], pipeline: UniRenderPipeline) -> None:
    for scene in scenes:
        swapped = scene.truth.replace(
            specular=scene.truth.require("specular")["specular"][..., ::-1].copy(),
            diffuse=scene.truth.require("diffuse")["diffuse"] * 0.5,
        )
        assert scene.psnr(pipeline.render(swapped)) < scene.psnr(pipeline.render(scene.truth)) - 3


def test_model_decomposes_better_than_trivial_answers(scenes: list[Scene], pipeline: UniRenderPipeline) -> None:
    gains = {"albedo": [], "normal": []}
    for scene in scenes:
        mask = scene.truth.require("mask")["mask"]
        found = pipeline.decompose(scene.picture, mask).intrinsics.require("albedo", "normal")
        true = scene.truth.require("albedo", "normal")
        albedo = [image_srgb(x)[scene.inside] for x in (found["albedo"], true["albedo"])]
        input_error = np.mean(np.square(scene.picture[scene.inside] - albedo[1]))
        gains["albedo"].append(input_error / np.mean(np.square(albedo[0] - albedo[1])))
        cosine = np.sum(found["normal"] * true["normal"], axis=-1)[scene.inside].mean()
        gains["normal"].append((1 - true["normal"][scene.inside][:, 2].mean()) / (1 - cosine))  # facing the viewer
    assert np.exp(np.mean(np.log(gains["albedo"]))) > 1.2, gains
    assert np.exp(np.mean(np.log(gains["normal"]))) > 1.2, gains


def test_the_cycle_comes_back_to_the_picture(scenes: list[Scene], pipeline: UniRenderPipeline) -> None:
    for scene in scenes:
        mask = scene.truth.require("mask")["mask"]
        found = pipeline.decompose(scene.picture, mask).intrinsics
        mean = scene.sample.image_linear[scene.inside].mean(axis=0) * mask
        assert scene.psnr(pipeline.render(found)) > scene.psnr(mean.astype(np.float32)) + 3
