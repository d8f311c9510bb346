"""Passes by effect: each is what it says on scenes where that is known apart, and their sum is the full render."""

import dataclasses

import numpy as np
import occluders
import pytest
import reference_scenes as scenes

from unirender.errors import UnirenderError
from unirender_reference.effects import EFFECTS, Effects, render_effects
from unirender_reference.passes import Estimate
from unirender_reference.render import DIRECT_DEPTH, IMAGE_DEPTH, Renderer
from unirender_reference.shapes import make_object
from unirender_reference.statistics import ZTest, z_test

SIZE = 24
SPP = 8 * 144
MATERIALS = {"glossy metal": (0.15, 1.0), "rough dielectric": (0.6, 0.0)}


def compare(a: Estimate, b: Estimate, mask: np.ndarray | None = None) -> ZTest:
    """z-test of radiance where the object is, at a chance of 1 in 1000 that equal pictures fail."""
    assert a.variance is not None
    assert b.variance is not None
    mask = b.mean[..., 3:] > 0.5 if mask is None else mask
    parts = (a.mean[..., :3], a.variance[..., :3], b.mean[..., :3], b.variance[..., :3])
    return z_test(*parts, mask.astype(np.float32), alpha=1e-3)


def scaled(estimate: Estimate, factor: float) -> Estimate:
    return dataclasses.replace(estimate, mean=estimate.mean * np.float32(factor))


def added(a: Estimate, b: Estimate, sign: float = 1) -> Estimate:
    assert a.variance is not None
    assert b.variance is not None
    return Estimate(a.mean + np.float32(sign) * b.mean, a.variance + b.variance)


@pytest.fixture(scope="module")
def torus() -> Renderer:
    return Renderer(occluders.torus(), resolution=SIZE)


def test_nothing_shadows_or_lights_a_convex_object() -> None:
    page = Renderer(occluders.book("left"), resolution=SIZE)
    effects = render_effects(page, scenes.environment(), 0.3, 0.5, 36, batches=4)
    assert not effects.shadow.mean[..., :3].any()
    assert not effects.interreflection.mean[..., :3].any()
    assert effects.unshadowed.mean[..., :3].max() > 0.1


@pytest.mark.parametrize("material", ["glossy metal", pytest.param("rough dielectric", marks=pytest.mark.long)])
def test_each_effect_of_an_open_book(material: str) -> None:
    """Pages alone have no shadow: their direct light is the unshadowed light of the book.

    The shadow is what the book's own direct light lacks of that, interreflection what more bounces add.
    """
    roughness, metallic = MATERIALS[material]
    light = scenes.environment(2)
    renderers = {sides: Renderer(occluders.book(sides), resolution=SIZE) for sides in occluders.BOOK_SIDES}
    effects = render_effects(renderers["both"], light, roughness, metallic, SPP, seed=1)
    direct = {
        sides: renderer.image(light, roughness, metallic, SPP, seed=index, depth=DIRECT_DEPTH)
        for index, (sides, renderer) in enumerate(renderers.items())
    }
    full = renderers["both"].image(light, roughness, metallic, SPP, seed=9)
    pages = added(direct["left"], direct["right"])
    mask = full.mean[..., 3:] > 0.5
    for got, expected, label in (
        (effects.unshadowed, pages, "unshadowed"),
        (effects.shadow, added(direct["both"], pages, -1), "shadow"),
        (effects.interreflection, added(full, direct["both"], -1), "interreflection"),
    ):
        assert compare(got, expected, mask).passed, f"{label}: {compare(got, expected, mask)}"
        assert not compare(scaled(got, 1.2), expected, mask).passed, label  # twin
        assert np.abs(got.mean[..., :3]).max() > 0.01, label


def test_signs_alpha_and_seeds(torus: Renderer) -> None:
    light = scenes.environment()
    effects = render_effects(torus, light, 0.4, 0.5, 36, seed=4, batches=4)
    assert effects.shadow.mean[..., :3].max() <= 0
    assert effects.unshadowed.mean.min() >= 0
    assert effects.interreflection.mean.min() >= 0
    mask = torus.geometry(64).mask
    assert mask is not None
    for name in EFFECTS:
        estimate = getattr(effects, name)
        assert np.abs(estimate.mean[..., 3:] - mask).max() < 0.4
        assert not estimate.mean[estimate.mean[..., 3] == 0].any()
    again = render_effects(torus, light, 0.4, 0.5, 36, seed=4, batches=4)
    other = render_effects(torus, light, 0.4, 0.5, 36, seed=5, batches=4)
    for name in EFFECTS:
        assert np.array_equal(getattr(effects, name).mean, getattr(again, name).mean)
        assert not np.array_equal(getattr(effects, name).mean, getattr(other, name).mean)
    # One estimator gives shadow and unshadowed light: with a common seed their noise would be the same.
    assert not np.array_equal(effects.unshadowed.mean[..., 3], effects.shadow.mean[..., 3])


def test_total_adds_radiance_and_variance_and_keeps_alpha() -> None:
    rng = np.random.default_rng(0)
    parts = [Estimate(*rng.random((2, 4, 5, 4)).astype(np.float32), nan_pixels=i) for i in range(3)]
    total = Effects(*parts).total()
    means, variances = (np.stack([getattr(part, name) for part in parts]) for name in ("mean", "variance"))
    np.testing.assert_allclose(total.mean[..., :3], means.sum(0)[..., :3], rtol=1e-6)
    np.testing.assert_allclose(total.mean[..., 3], means.mean(0)[..., 3], rtol=1e-6)
    assert total.variance is not None
    np.testing.assert_allclose(total.variance[..., :3], variances.sum(0)[..., :3], rtol=1e-6)
    np.testing.assert_allclose(total.variance[..., 3], variances.sum(0)[..., 3] / 9, rtol=1e-6)
    assert total.nan_pixels == 3
    assert Effects(parts[0], parts[1], Estimate(parts[2].mean, None)).total().variance is None


@pytest.mark.long
@pytest.mark.parametrize("material", MATERIALS)
@pytest.mark.parametrize("shape", ["torus", "assembly"])
def test_effects_add_up_to_the_full_render(shape: str, material: str, torus: Renderer) -> None:
    roughness, metallic = MATERIALS[material]
    if shape == "assembly":
        made = make_object(14, "train")
        assert made.family == "assembly"
        torus = Renderer(dataclasses.replace(made, uv=None, albedo=np.array(occluders.BRIGHT, np.float32)), None, SIZE)
    light = scenes.environment(1)
    full = torus.image(light, roughness, metallic, SPP, seed=1)
    effects = render_effects(torus, light, roughness, metallic, SPP, seed=2)
    result = compare(effects.total(), full)
    assert result.passed, str(result)
    if shape == "assembly":
        return
    shallow = render_effects(torus, light, roughness, metallic, SPP, seed=2, depth=IMAGE_DEPTH - 1)
    for label, twin in (
        ("no shadow", dataclasses.replace(effects, shadow=scaled(effects.shadow, 0))),
        ("one bounce less", dataclasses.replace(effects, interreflection=shallow.interreflection)),
        ("unshadowed + 2 %", dataclasses.replace(effects, unshadowed=scaled(effects.unshadowed, 1.02))),
    ):
        assert not compare(twin.total(), full).passed, label


@pytest.mark.long
def test_maps_and_bumped_normals_add_up_too() -> None:
    """Normals bent by a normal map are where lit directions lie under the surface."""
    renderer = Renderer(occluders.textured(occluders.torus(), bumps=0.6), resolution=SIZE)
    light = scenes.environment(1)
    full = renderer.image(light, None, None, SPP, seed=1)
    effects = render_effects(renderer, light, None, None, SPP, seed=2)
    result = compare(effects.total(), full)
    assert result.passed, str(result)
    twin = dataclasses.replace(effects, unshadowed=scaled(effects.unshadowed, 1.04))
    assert not compare(twin.total(), full).passed


def test_depth_two_has_no_interreflection_and_depth_one_is_refused(torus: Renderer) -> None:
    effects = render_effects(torus, scenes.environment(), 0.4, 0.5, 9, depth=DIRECT_DEPTH, batches=1)
    assert not effects.interreflection.mean[..., :3].any()
    assert effects.total().variance is None
    for depth in (1, 2**31):
        with pytest.raises(UnirenderError, match="expected a whole number from 2"):
            render_effects(torus, scenes.environment(), 0.4, 0.5, 16, depth=depth)
