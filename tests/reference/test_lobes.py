"""The four lobes: the BSDF is their sum for every direction, and the composed image is the direct render."""

import dataclasses

import numpy as np
import occluders
import pytest
import reference_scenes as scenes

from unirender.errors import UnirenderError
from unirender_reference.backend import mitsuba
from unirender_reference.lobes import LOBES, Lobe, Lobes, Name, color_weight, compose, metallic_weight, render_lobes
from unirender_reference.passes import Estimate, mean_estimate, render_passes
from unirender_reference.render import DIRECT_DEPTH, Renderer
from unirender_reference.scene import load_scene
from unirender_reference.shapes import make_object
from unirender_reference.statistics import ZTest, z_test

SIZE = 24
SPP = 8 * 64
ROUGHNESS = 0.1
LIGHT = scenes.environment(1)
COPPER = (0.7, 0.4, 0.2)
DIELECTRIC = {"type": "principled", "base_color": {"type": "rgb", "value": 0.0}, "metallic": 0.0}


def compare(composed: Estimate, direct: Estimate) -> ZTest:
    assert composed.variance is not None
    assert direct.variance is not None
    mask = (direct.mean[..., 3:] > 0.5).astype(np.float32)
    radiance, variance = direct.mean[..., :3], direct.variance[..., :3]
    return z_test(composed.mean, composed.variance, radiance, variance, mask, alpha=1e-3)


def replaced(lobes: Lobes, name: Name, buffer: Estimate) -> Lobes:
    lobe = lobes.lobes[name]
    return dataclasses.replace(lobes, lobes={**lobes.lobes, name: dataclasses.replace(lobe, buffer=buffer)})


@pytest.fixture(scope="module")
def sphere() -> Renderer:
    return Renderer(scenes.sphere(), resolution=SIZE)


@pytest.fixture(scope="module")
def torus() -> Renderer:
    return Renderer(occluders.torus(COPPER), resolution=SIZE)


@pytest.fixture(scope="module")
def plain(torus: Renderer) -> Lobes:
    return render_lobes(torus, LIGHT, ROUGHNESS, None, SPP, seed=1, weighting="plain")


def directions(n: int = 4000):
    """A surface interaction with random views from the front, and random directions of light on all sides."""
    import drjit as dr

    mi = mitsuba()
    rng = np.random.default_rng(0)
    view, light = rng.normal(size=(2, 3, n)).astype(np.float32)
    view[2] = np.abs(view[2])
    si = dr.zeros(mi.SurfaceInteraction3f, n)
    si.sh_frame, si.n, si.uv = mi.Frame3f(mi.Vector3f(0, 0, 1)), mi.Normal3f(0, 0, 1), mi.Point2f(0.5)
    si.wi = dr.normalize(mi.Vector3f(view))
    return si, dr.normalize(mi.Vector3f(light))


def values(bsdf) -> np.ndarray:
    """(n, 3) BSDF times cosine for `directions`."""
    return np.array(bsdf.eval(mitsuba().BSDFContext(), *directions()), np.float64).T


@pytest.mark.parametrize("metallic", [0.0, 0.35, 1.0])
@pytest.mark.parametrize("roughness", [0.0, 0.2, 0.6, 1.0])
def test_bsdf_is_the_sum_of_its_lobes(sphere: Renderer, roughness: float, metallic: float) -> None:
    material = {"roughness": roughness, "metallic": metallic}
    whole = values(sphere.scene.parameters("principled", material))
    base = np.asarray(sphere.obj.albedo, np.float64)
    lobes = {name: values(sphere.scene.parameters(name, {"roughness": roughness})) for name in LOBES}
    factors = {name: color_weight(name, base) * metallic_weight(name, metallic) for name in LOBES}

    def error(changed: dict[str, np.ndarray]) -> float:
        total = sum(factors[name] * value for name, value in {**lobes, **changed}.items())
        return float((np.abs(total - whole) / np.maximum(whole, 1e-6)).max())

    assert error({}) < 1e-6
    assert whole.max() > 0.05
    mi = mitsuba()
    eta = mi.load_dict({"type": "twosided", "surface": {**DIELECTRIC, "roughness": roughness, "eta": 1.45}})
    if metallic > 0:
        assert error({"schlick_lobe": 0 * whole}) > 1e-2
    if metallic < 1:
        assert error({"dielectric_lobe": values(eta)}) > 1e-2
        assert error({"diffuse_lobe": values(sphere.scene.parameters("white"))}) > 1e-2


def test_paper_s_is_the_mirror_buffer(torus: Renderer, plain: Lobes) -> None:
    specular, mirror = torus.specular(LIGHT, ROUGHNESS, SPP, seed=2), plain.lobes["mirror"]
    assert mirror.buffer.variance is not None
    assert specular.variance is not None
    mask = (mirror.weight[..., :1] > 0.5).astype(np.float32)
    parts = (mirror.buffer.mean, mirror.buffer.variance, specular.mean, specular.variance)
    result = z_test(*parts, mask, alpha=1e-3)
    assert result.passed, str(result)


def test_plain_buffers_compose_a_metal(torus: Renderer, plain: Lobes) -> None:
    """They know no material, any may be put in; without Schlick's lobe, or with a little more metal, it fails."""
    base, metallic = np.array(COPPER, np.float32), 0.8
    direct = torus.image(LIGHT, ROUGHNESS, metallic, SPP, seed=1, depth=DIRECT_DEPTH)
    result = compare(compose(plain, base, metallic), direct)
    assert result.passed, str(result)
    black = dataclasses.replace(plain.lobes["schlick_lobe"].buffer, mean=np.zeros((SIZE, SIZE, 3), np.float32))
    assert not compare(compose(replaced(plain, "schlick_lobe", black), base, metallic), direct).passed
    assert not compare(compose(plain, base, metallic + 0.05), direct).passed


def test_plain_buffers_compose_a_dielectric_of_another_colour(torus: Renderer, plain: Lobes) -> None:
    """With the paper's Lambertian d in place of Disney's lobe, or with 5 % more albedo, it fails."""
    base = np.array(occluders.BRIGHT, np.float32)
    bright = Renderer(occluders.torus(occluders.BRIGHT), resolution=SIZE)
    direct = bright.image(LIGHT, ROUGHNESS, 0.0, SPP, seed=2, depth=DIRECT_DEPTH)
    result = compare(compose(plain, base, 0.0), direct)
    assert result.passed, str(result)
    lambertian = replaced(plain, "diffuse_lobe", torus.diffuse(LIGHT, SPP, seed=3))
    assert not compare(compose(lambertian, base, 0.0), direct).passed
    assert not compare(compose(plain, base * np.float32(1.05), 0.0), direct).passed


def test_another_index_of_refraction_fails(torus: Renderer, plain: Lobes) -> None:
    """eta 1.45 in place of 1.5, on a black dielectric, which has no other lobe."""
    for eta in (1.5, 1.45):
        bsdf = {"type": "twosided", "surface": {**DIELECTRIC, "roughness": ROUGHNESS, "eta": eta}}
        scene = load_scene(torus.obj, bsdf, LIGHT, torus.camera, SIZE)
        direct = mean_estimate(*render_passes(scene, DIRECT_DEPTH, SPP, 3, 8, torus.counters), 8)
        result = compare(compose(plain, np.zeros(3, np.float32), 0.0), direct)
        assert result.passed == (eta == 1.5), f"eta {eta}: {result}"


@pytest.mark.long
def test_textures_under_the_pixel_need_weighted_means() -> None:
    """Colour, metallic, roughness and normal change inside every pixel: there the product of means is not the mean."""
    renderer = Renderer(occluders.textured(scenes.sphere(), texels=64), resolution=SIZE)
    direct = renderer.image(LIGHT, None, None, SPP, seed=1, depth=DIRECT_DEPTH)
    lobes = render_lobes(renderer, LIGHT, None, None, SPP, seed=2)
    result = compare(compose(lobes), direct)
    assert result.passed, str(result)
    unweighted = render_lobes(renderer, LIGHT, None, None, SPP, seed=3, weighting="plain")
    for name in LOBES:
        lobes = replaced(lobes, name, unweighted.lobes[name].buffer)
    assert not compare(compose(lobes), direct).passed


def test_metallic_of_a_textured_object_is_edited_exactly() -> None:
    renderer = Renderer(make_object(14, "train"), resolution=SIZE)
    assert renderer.obj.albedo.ndim == 3
    lobes = render_lobes(renderer, LIGHT, ROUGHNESS, 0.0, SPP, seed=2)
    direct = renderer.image(LIGHT, ROUGHNESS, 0.7, SPP, seed=1, depth=DIRECT_DEPTH)
    result = compare(compose(lobes, metallic=0.7), direct)
    assert result.passed, str(result)
    assert not compare(compose(lobes), direct).passed
    assert not compare(compose(lobes, metallic=0.65), direct).passed


def test_weights_are_those_of_the_formula(sphere: Renderer) -> None:
    lobes = render_lobes(sphere, LIGHT, 0.4, 0.3, 64, batches=1)
    inner = slice(SIZE // 2 - 3, SIZE // 2 + 3)
    base = np.asarray(sphere.obj.albedo)
    expected: dict[Name, np.ndarray] = {
        "diffuse_lobe": base,
        "dielectric_lobe": np.ones(3),
        "mirror": base,
        "schlick_lobe": 1 - base,
    }
    for name, weight in expected.items():
        np.testing.assert_allclose(
            lobes.lobes[name].weight[inner, inner], np.broadcast_to(weight, (6, 6, 3)), rtol=1e-5
        )
        assert not lobes.lobes[name].weight[0, 0].any()
        assert not lobes.lobes[name].buffer.mean[0, 0].any()
    assert compose(lobes).variance is None


def test_compose_is_the_formula() -> None:
    rng = np.random.default_rng(0)

    def lobe() -> Lobe:
        mean, weight, variance = rng.random((3, 4, 5, 3)).astype(np.float32)
        return Lobe(Estimate(mean, variance, 1), weight, variance)

    lobes = Lobes({name: lobe() for name in LOBES}, "plain", None)
    base, m = rng.random((4, 5, 3)).astype(np.float32), 0.3
    d, f, s, w = (lobes.lobes[name].weight * lobes.lobes[name].buffer.mean for name in LOBES)
    expected = (1 - m) * base * d + (1 - m) * f + m * (base * (s - w) + w)
    composed = compose(lobes, base, m)
    np.testing.assert_allclose(composed.mean, expected, rtol=1e-5)
    assert composed.nan_pixels == 4
    assert composed.variance is not None
    d, f, s, w = (np.asarray(lobes.lobes[name].variance) for name in LOBES)
    squared = ((1 - m) * base) ** 2 * d + (1 - m) ** 2 * f + (m * base) ** 2 * s + (m * (1 - base)) ** 2 * w
    np.testing.assert_allclose(composed.variance, squared, rtol=1e-5)


def test_compose_says_what_is_missing_or_held_already() -> None:
    nothing = np.zeros((2, 2, 3), np.float32)
    parts = dict.fromkeys(LOBES, Lobe(Estimate(nothing, None), nothing, None))
    with pytest.raises(UnirenderError, match="plain buffers hold no material"):
        compose(Lobes(parts, "plain", None), nothing)
    with pytest.raises(UnirenderError, match="weighted by the object's own albedo"):
        compose(Lobes(parts, "object", 0.5), nothing)
    with pytest.raises(UnirenderError, match="weighted by the object's own metallic"):
        compose(Lobes(parts, "object", None), metallic=0.5)


def test_the_material_of_a_composition_is_checked() -> None:
    lobe = Lobe(Estimate(np.ones((2, 2, 3), np.float32), None), np.ones((2, 2, 3), np.float32), None)
    parts = dict.fromkeys(LOBES, lobe)
    base, each = np.full(3, 0.5, np.float32), np.full((2, 2, 1), 0.5, np.float32)
    for wrong in (3.0, -0.1, float("nan"), each - 0.6):
        with pytest.raises(UnirenderError, match=r"metallic in \[.*expected values in \[0, 1\]"):
            compose(Lobes(parts, "plain", None), base, wrong)
    for wrong in (base + 1.5, base - 0.6):
        with pytest.raises(UnirenderError, match=r"albedo in \[.*expected values in \[0, 1\]"):
            compose(Lobes(parts, "plain", None), wrong, 0.5)
    with pytest.raises(UnirenderError, match=r"shape \(2, 2, 1\).*expected one value"):
        compose(Lobes(parts, "object", 0.5), metallic=each)
    plain = compose(Lobes(parts, "plain", None), base, each).mean
    np.testing.assert_array_equal(plain, compose(Lobes(parts, "plain", None), base, 0.5).mean)
