"""The learned model as the start of single-view optimisation, against a grey start, on a picture by Mitsuba."""

import numpy as np
import pytest

from unirender import UniRenderPipeline
from unirender.camera import Camera
from unirender.color import image_srgb, unpremultiply
from unirender.intrinsics import Intrinsics
from unirender.light.resampling import resample_environment
from unirender_reference.lights import make_light
from unirender_reference.optimize.single.config import SingleConfig
from unirender_reference.optimize.single.run import optimize_image
from unirender_reference.render import Renderer
from unirender_reference.shapes import make_object

SEED, ROUGHNESS, METALLIC = 700002, 0.4, 0.6


def decibels(found: Intrinsics, truth: Intrinsics) -> float:
    """Masked PSNR of the albedo's display values."""
    maps, true = found.require("albedo"), truth.require("albedo", "mask")
    squared = np.square(image_srgb(maps["albedo"]) - image_srgb(true["albedo"])) * true["mask"]
    return float(-10 * np.log10(squared.sum() / true["mask"].sum() / 3))


@pytest.mark.long
def test_a_learned_start_beats_a_grey_one_at_the_same_steps() -> None:
    obj = make_object(SEED, "train")
    renderer = Renderer(obj, resolution=64)
    truth = renderer.geometry(64)
    mask = truth.require("mask")["mask"]
    light = resample_environment(make_light(810004, "train").environment, (16, 32))
    white = renderer.diffuse(light, 16).mean
    light = light * np.float32(0.7 / np.percentile(white[mask[..., 0] > 0.9], 95))
    image = renderer.image(light, ROUGHNESS, METALLIC, 64).mean[..., :3]
    picture = (np.round(image_srgb(unpremultiply(image, mask)) * 255) / 255).astype(np.float32)
    pipeline = UniRenderPipeline.from_pretrained()
    prediction = pipeline.decompose(picture, mask).intrinsics
    config = SingleConfig(coarse_pixels=200, pixels=450)
    warm = optimize_image(picture, mask, Camera(), config, geometry=obj, init=prediction)
    cold = optimize_image(picture, mask, Camera(), config, geometry=obj)
    assert decibels(warm, truth) > decibels(cold, truth)
    assert decibels(warm, truth) > decibels(prediction, truth) - 0.5
