"""Dim light: the picture shrinks as the light does, is nearer to the truth for it, and keeps what lies above white."""

import numpy as np
import pytest
from tiny_models import make_pipeline

from unirender.color import image_srgb
from unirender.composite import split_sum_image
from unirender.intrinsics import Intrinsics
from unirender.pipelines.dim_light import DIM, DIMMEST, MOST, darkened, gain_of_dim
from unirender.pipelines.unirender_pipeline import UniRenderPipeline
from unirender_evaluation.metrics import psnr
from unirender_evaluation.suites.suite import load_suite


def ball(side: int, level: float) -> Intrinsics:
    """A grey ball in a light under which white is that bright in its middle."""
    y, x = (np.mgrid[:side, :side] + 0.5 - side / 2) / (0.45 * side)
    z = np.sqrt(np.maximum(1 - x**2 - y**2, 0))
    mask = (z > 0)[..., None].astype(np.float32)
    normal = np.stack([x, -y, z], axis=-1).astype(np.float32) * mask
    light = np.repeat(np.float32(level) * normal[..., 2:], 3, axis=-1)
    grey = np.full((side, side, 1), 0.5, np.float32) * mask
    return Intrinsics(
        albedo=grey.repeat(3, axis=-1),
        normal=normal,
        roughness=grey,
        metallic=grey,
        specular=light,
        diffuse=light,
        environment=np.full((16, 32, 3), level, np.float32),
        mask=mask,
    )


@pytest.mark.parametrize("missing", ["environment", "albedo"])
@pytest.mark.parametrize("enlarged", [1, 3])
def test_a_dim_picture_is_linear_in_the_light(enlarged: int, missing: str) -> None:
    pipeline = make_pipeline()
    side = enlarged * pipeline.dual_stream.config["sample_size"]
    dim, dimmer = (pipeline.render(ball(side, level).replace(**{missing: None})) for level in (0.05, 0.001))
    assert dim.max() > 0.005
    np.testing.assert_allclose(50 * dimmer, dim, rtol=1e-3, atol=1e-5)


def test_light_as_bright_as_some_that_was_taught_stays() -> None:
    assert gain_of_dim(ball(32, 1.02 * DIM)) == 1
    assert gain_of_dim(ball(32, 0.98 * DIM)) == pytest.approx(1, abs=0.06), "a fading light does not flicker"
    assert gain_of_dim(ball(32, 0.49 * DIM)) == pytest.approx(4 / 0.49, rel=0.02)
    assert gain_of_dim(ball(32, 1e-9)) == MOST
    assert gain_of_dim(ball(32, 0.001).replace(diffuse=None)) == 1
    assert gain_of_dim(ball(32, 0.0)) == 1


def test_a_lamp_on_a_part_of_the_object_is_not_dim() -> None:
    dim = ball(32, 0.01)
    lit = dim.require("diffuse")["diffuse"].copy()
    lit[12:18, 12:18] = DIMMEST
    assert gain_of_dim(dim.replace(diffuse=lit)) == 1


def test_what_the_network_cuts_off_at_white_is_in_the_closed_form() -> None:
    mask = np.array([[[1.0], [1.0], [0.5]]], np.float32)
    rendered = np.array([[[1.0], [0.4], [0.5]]], np.float32).repeat(3, axis=-1)
    closed_form = np.array([[[3.0], [0.5], [2.5]]], np.float32).repeat(3, axis=-1)
    image = darkened(rendered, closed_form, mask, 10.0)
    np.testing.assert_allclose(image[0, :, 0], [0.3, 0.04, 0.25], rtol=1e-6)


def test_dim_renders_are_as_near_to_the_truth_as_the_closed_form() -> None:
    """To half a decibel; what the network renders of such light as it is lies some 7 dB below."""
    pipeline = UniRenderPipeline.from_pretrained("tiny")
    pipeline.set_progress_bar_config(disable=True)
    suite, dim = load_suite("tiny"), 1 / 64
    for scene in suite.scenes[::16]:
        truth = suite.intrinsics(scene, suite.spec.base)
        light = {name: truth.maps[name] * np.float32(dim) for name in ("specular", "diffuse")}
        maps = truth.replace(**light, environment=None)
        mask = suite.mask(scene)
        expected = image_srgb(dim * suite.image(scene, suite.spec.base))
        found, closed_form = (image_srgb(image) for image in (pipeline.render(maps), split_sum_image(maps)))
        assert psnr(found, expected, mask) > psnr(closed_form, expected, mask) - 0.5
