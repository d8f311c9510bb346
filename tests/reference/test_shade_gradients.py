"""Derivatives of `shade`: against autograd of an independent BSDF and against finite differences."""

import inspect
from typing import Any

import numpy as np
import pytest
import reference_scenes as scenes
import torch
from occluders import book

from unirender.camera import Camera
from unirender.errors import UnirenderError
from unirender.intrinsics import Intrinsics
from unirender.light.environment import sample_environment
from unirender_reference import principled
from unirender_reference import shade as shading
from unirender_reference import shader as shader_module
from unirender_reference.passes import Counters
from unirender_reference.render import Renderer
from unirender_reference.shade import Gradients, shade, shade_gradients
from unirender_reference.shader import PARAMETERS, Parameter, Shader, gradient, tensors
from unirender_reference.shapes import MeshObject
from unirender_reference.statistics import ZTest, z_test

MAPS = PARAMETERS[:4]
ENDS: tuple[Parameter, ...] = ("albedo", "roughness", "metallic")
SIDE, LIGHT_SHAPE = 4, (6, 12)
BATCHES = 16


def scattered(seed: int = 0, metallic: float | None = None) -> Intrinsics:
    """A small picture of unrelated pixels: random normals towards the viewer, random materials, no mask."""
    rng = np.random.default_rng(seed)
    view = Camera().view_directions(SIDE, SIDE)
    normal = view + 0.6 * rng.normal(size=view.shape)
    normal = np.where((normal * view).sum(-1, keepdims=True) > 0.2, normal, view)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    single = (SIDE, SIDE, 1)
    return Intrinsics(
        albedo=rng.uniform(0.1, 0.9, (SIDE, SIDE, 3)).astype(np.float32),
        normal=normal.astype(np.float32),
        roughness=rng.uniform(0.3, 0.9, single).astype(np.float32),
        metallic=(rng.uniform(0, 1, single) if metallic is None else np.full(single, metallic)).astype(np.float32),
    )


def soft_light(seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(0.1, 2, (*LIGHT_SHAPE, 3)).astype(np.float32)


def texel_quadrature(nodes: int = 8) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Directions, solid angles, and the weight of every texel in the bilinear light: Gauss points in every cell."""
    rows, columns = LIGHT_SHAPE
    x, w = np.polynomial.legendre.leggauss(nodes)
    theta = ((np.arange(rows - 1)[:, None] + (x + 1) / 2) * np.pi / (rows - 1)).ravel()
    phi = ((np.arange(columns)[:, None] + 0.5 + (x + 1) / 2) * 2 * np.pi / columns).ravel()
    measure = np.outer(np.tile(w, rows - 1) * np.sin(theta), np.tile(w, columns)) / 4
    measure *= np.pi / (rows - 1) * 2 * np.pi / columns
    theta, phi = (grid.ravel() for grid in np.meshgrid(theta, phi, indexing="ij"))
    towards = np.stack([np.sin(theta) * np.sin(phi), np.cos(theta), -np.sin(theta) * np.cos(phi)], -1)
    texels = np.eye(rows * columns, dtype=np.float32).reshape(-1, rows, columns, 1)
    hats = np.stack([sample_environment(np.repeat(texel, 3, -1), towards)[:, 0] for texel in texels], -1)
    return torch.from_numpy(towards), torch.from_numpy(measure.ravel()), torch.from_numpy(hats).double()


def autograd(intrinsics: Intrinsics, light: np.ndarray, weights: np.ndarray) -> tuple[np.ndarray, Gradients]:
    """The image by quadrature over the sphere, with our own BSDF in double precision, and its derivatives."""
    towards, measure, hats = texel_quadrature()
    given = {**intrinsics.require(*MAPS), "environment": light}
    leaf = {name: torch.from_numpy(value).double().requires_grad_() for name, value in given.items()}
    normal = torch.nn.functional.normalize(leaf["normal"].reshape(-1, 3), dim=-1)
    helper = torch.tensor([0.3, 0.8, -0.5], dtype=torch.float64).expand_as(normal)
    x = torch.nn.functional.normalize(torch.linalg.cross(helper, normal), dim=-1)
    frame = torch.stack([x, torch.linalg.cross(normal, x), normal], 1)  # rows: the axes of the shading frame
    view = torch.from_numpy(intrinsics.camera.view_directions(SIDE, SIDE).reshape(-1, 3)).double()
    wi, wo = torch.einsum("pij,pj->pi", frame, view), torch.einsum("pij,sj->psi", frame, towards)
    albedo, roughness, metallic = (
        leaf[name].reshape(len(normal), 1, -1) for name in ("albedo", "roughness", "metallic")
    )
    value = principled.evaluate(wi[:, None].expand_as(wo), wo, albedo, roughness[..., 0], metallic[..., 0])
    value = value * (wo[..., 2:] > 0)
    radiance = hats @ leaf["environment"].reshape(-1, 3)
    image = torch.einsum("psc,sc,s->pc", value, radiance, measure).reshape(SIDE, SIDE, 3)
    (image * torch.from_numpy(weights)).sum().backward()
    slopes = {name: tensor.grad for name, tensor in leaf.items()}
    found = {name: slope.numpy() for name, slope in slopes.items() if slope is not None}
    return image.detach().numpy(), Gradients(**found)


def compare(drawn: np.ndarray, expected: np.ndarray) -> ZTest:
    """z-test of the mean over the first axis against an exact answer, up to the quadrature's own error."""
    mean, variance = drawn.mean(0), drawn.var(0, ddof=1) / len(drawn)
    flat = (array.reshape(-1, 1, 1) for array in (mean, variance, expected, np.zeros_like(expected)))
    return z_test(*flat, batches_a=len(drawn), batches_b=2, rounding=2e-3)


def together(gradients: Gradients, without: str = "") -> np.ndarray:
    """All derivatives in a row, those of one map left out (0, as if it had been detached)."""
    values = ((name, np.asarray(getattr(gradients, name), np.float64)) for name in PARAMETERS)
    return np.concatenate([(value * (name != without)).ravel() for name, value in values])


@pytest.mark.slow
def test_image_and_derivatives_agree_with_an_independent_bsdf() -> None:
    """Every derivative of every map and texel: Mitsuba's samples against quadrature and autograd."""
    intrinsics, light = scattered(), soft_light()
    weights = np.random.default_rng(1).normal(size=(SIDE, SIDE, 3)).astype(np.float32)
    image, expected = autograd(intrinsics, light, weights)
    images = np.stack([shade(intrinsics, light, 1024, seed) for seed in range(BATCHES)]).astype(np.float64)
    gradients = [shade_gradients(intrinsics, weights, light, 1024, seed) for seed in range(BATCHES)]
    found = np.stack([together(each) for each in gradients])
    assert compare(images, image).passed
    result = compare(found, together(expected))
    assert result.passed, str(result)
    rougher = intrinsics.replace(roughness=intrinsics.require("roughness")["roughness"] * np.float32(1.1))
    wrong_image, wrong = autograd(rougher, light, weights)
    assert not compare(images, wrong_image).passed
    assert not compare(found, together(wrong)).passed
    for name in PARAMETERS:
        detached = np.stack([together(each, without=name) for each in gradients])
        assert not compare(detached, together(expected)).passed, name


def corners() -> Intrinsics:
    """All 8 materials with base colour 0 or 1, roughness 0.02 or 1, metallic 0 or 1, each at two normals."""
    index = np.arange(SIDE**2).reshape(SIDE, SIDE, 1)
    albedo, rough, metallic = ((index >> bit & 1).astype(np.float32) for bit in range(3))
    return scattered().replace(
        albedo=albedo.repeat(3, -1), roughness=np.where(rough, 1, 0.02).astype(np.float32), metallic=metallic
    )


def furnace(intrinsics: Intrinsics, weights: np.ndarray) -> Gradients:
    """Derivatives under a light of 1 everywhere, with respect to the maps in `ENDS`.

    Quadrature that follows the lobes, however sharp they are; its directions move with the roughness, and rough ones
    cross the horizon: that derivative comes from directions that stay where they are.
    """
    leaf = {name: torch.from_numpy(intrinsics.require(name)[name]).double().requires_grad_() for name in ENDS}
    view = intrinsics.camera.view_directions(SIDE, SIDE)
    cosine = torch.from_numpy((view * intrinsics.require("normal")["normal"]).sum(-1).ravel()).double()
    wi = torch.stack([(1 - cosine**2).sqrt(), torch.zeros_like(cosine), cosine], -1)
    rows = leaf["albedo"].reshape(-1, 3), leaf["roughness"].reshape(-1), leaf["metallic"].reshape(-1)
    _, light = principled.light_quadrature(wi, *rows)
    (light.sum(1) * torch.from_numpy(weights.reshape(-1, 3))).sum().backward()
    found = {name: np.asarray(tensor.grad) for name, tensor in leaf.items()}
    _, fixed = autograd(intrinsics, np.ones((*LIGHT_SHAPE, 3), np.float32), weights)
    return Gradients(albedo=found["albedo"], roughness=fixed.roughness, metallic=found["metallic"])


@pytest.mark.slow
def test_derivatives_at_the_ends_of_every_range(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where a lobe has a weight of 0, the derivative of the weight still counts."""
    intrinsics, light = corners(), np.ones((*LIGHT_SHAPE, 3), np.float32)
    weights = np.random.default_rng(1).normal(size=(SIDE, SIDE, 3)).astype(np.float32)
    expected = furnace(intrinsics, weights)

    def found(name: Parameter) -> np.ndarray:
        drawn = [shade_gradients(intrinsics, weights, light, 1024, seed, wrt=(name,)) for seed in range(BATCHES)]
        return np.stack([getattr(each, name) for each in drawn]).astype(np.float64)

    for name in ENDS:
        result = compare(found(name), getattr(expected, name))
        assert result.passed, f"{name}: {result}"
    monkeypatch.setattr(shader_module, "MOST_METALLIC", 1)
    assert expected.metallic is not None
    assert not compare(found("metallic"), expected.metallic).passed


def test_dark_directions_are_shadowed_too() -> None:
    """The derivative with respect to texels that are black now: what they would add to the image, were they lit."""
    intrinsics, obj = textured_book()
    light = scenes.environment(4)
    upper = np.arange(len(light))[:, None, None] < len(light) // 2
    lit, dark = light * ~upper, light * upper
    weights = np.ones((12, 12, 3), np.float32)

    def gain(geometry: MeshObject | None) -> float:
        found = [shade_gradients(intrinsics, weights, lit, 256, s, None, geometry, ("environment",)) for s in range(4)]
        return float(np.mean([(each.environment * dark).sum(dtype=np.float64) for each in found]))

    truth = shade(intrinsics, dark, 1024, geometry=obj).sum(dtype=np.float64)
    assert abs(gain(obj) / truth - 1) < 0.02, gain(obj) / truth
    assert abs(gain(None) / truth - 1) > 0.1, gain(None) / truth


def textured_book() -> tuple[Intrinsics, MeshObject]:
    """True maps of two pages that shadow each other, with a material that varies."""
    obj = book(albedo=(0.7, 0.5, 0.3))
    geometry = Renderer(obj, resolution=12).geometry(64)
    mask = geometry.require("mask")["mask"]
    ramp = np.linspace(0.3, 0.8, 12, dtype=np.float32)[:, None, None] * np.ones_like(mask)
    return geometry.replace(roughness=ramp * (mask > 0), metallic=ramp.transpose(1, 0, 2) * (mask > 0)), obj


@pytest.mark.slow
def test_derivatives_with_shadows_agree_with_finite_differences() -> None:
    """Central differences of whole renders with common random numbers, along random directions of every parameter."""
    intrinsics, obj = textured_book()
    light = scenes.environment(3)
    rng = np.random.default_rng(0)
    weights = rng.uniform(0, 1, (12, 12, 3)).astype(np.float32)
    given = {**intrinsics.require(*MAPS), "environment": light}
    directions = {name: rng.uniform(0, 0.04, value.shape).astype(np.float32) for name, value in given.items()}
    directions["environment"] = (0.1 * light * rng.uniform(0, 1, light.shape)).astype(np.float32)
    directions["normal"] = rng.normal(0, 0.02, given["normal"].shape).astype(np.float32)
    directions = {
        name: change * (np.abs(given[name]).sum(-1, keepdims=True) > 0) for name, change in directions.items()
    }

    def loss(name: str, sign: int, seed: int) -> float:
        moved = {name: given[name] + np.float32(sign) * directions[name]}
        maps, sky = intrinsics, light
        if name == "environment":
            sky = moved[name]
        else:
            length = np.maximum(np.linalg.norm(moved[name], axis=-1, keepdims=True), 1) if name == "normal" else 1
            maps = intrinsics.replace(**{name: moved[name] / length})
        return float((shade(maps, sky, 256, seed, geometry=obj) * weights).sum(dtype=np.float64))

    seeds = range(6)
    slopes = np.array([[(loss(name, 1, s) - loss(name, -1, s)) / 2 for name in PARAMETERS] for s in seeds])

    def projected(geometry: MeshObject | None) -> np.ndarray:
        drawn = [shade_gradients(intrinsics, weights, light, 256, 10 + s, geometry=geometry) for s in seeds]
        return np.array([[(getattr(d, name) * directions[name]).sum() for name in PARAMETERS] for d in drawn])

    def gap(found: np.ndarray) -> np.ndarray:
        """Difference of the means in standard deviations, up to 0.3 % for the curvature that differences see."""
        noise = (found.var(0, ddof=1) + slopes.var(0, ddof=1)) / len(seeds) + np.square(3e-3 * slopes.mean(0))
        return np.abs(found.mean(0) - slopes.mean(0)) / np.sqrt(noise)

    assert gap(projected(obj)).max() < 4, dict(zip(PARAMETERS, gap(projected(obj)), strict=True))
    assert (gap(projected(None))[[0, 4]] > 8).all()  # derivatives that know no shadows


def test_extreme_materials_have_finite_derivatives() -> None:
    intrinsics, light = scattered(), soft_light()
    light[2:4] = 0
    corners = np.array([(r, m) for r in (0, 0.03, 0.5, 1) for m in (0, 0.5, 1, 1)], np.float32).reshape(SIDE, SIDE, 2)
    grazing = Camera().view_directions(SIDE, SIDE)[..., [1, 2, 0]]  # some at right angles to the view, some behind
    albedo = np.round(intrinsics.require("albedo")["albedo"])
    extreme = intrinsics.replace(
        albedo=albedo, roughness=corners[..., :1], metallic=corners[..., 1:], normal=np.ascontiguousarray(grazing)
    )
    counters = Counters()
    found = shade_gradients(extreme, np.ones((SIDE, SIDE, 3), np.float32), light, 64, counters=counters)
    assert counters.nan_pixels == 0
    assert all(np.isfinite(getattr(found, name)).all() for name in PARAMETERS)
    assert found.environment is not None
    assert (found.environment[2:4] > 0).any(), "dark texels have derivatives, too: BSDF samples find them"


@pytest.mark.parametrize(
    ("name", "end", "beyond"), [("roughness", 1, 1.2), ("metallic", 1, 1.2), ("metallic", 1, 1e4), ("metallic", 0, -1)]
)
def test_values_outside_their_range_have_the_derivative_of_the_end(name: str, end: float, beyond: float) -> None:
    """An optimiser that steps over the end is not stuck there."""
    intrinsics, light = scattered(metallic=0.5), soft_light()
    given = {**intrinsics.require(*MAPS), "environment": light}
    shader = Shader(np.ones((SIDE, SIDE, 1), np.float32), intrinsics.camera)
    found = []
    for value in (end, beyond):
        made = tensors({**given, name: np.full((SIDE, SIDE, 1), value)}, (name,))
        shader.backward(made, made["environment"], tensors({"w": np.ones((SIDE, SIDE, 3))})["w"], 64, 0)
        found.append(gradient(made[name]))
    assert np.abs(found[0]).min() > 0
    np.testing.assert_allclose(found[1], found[0], rtol=1e-5)


def test_only_what_is_asked_for_is_differentiated() -> None:
    found = shade_gradients(scattered(), np.ones((SIDE, SIDE, 3), np.float32), soft_light(), 16, wrt=("albedo",))
    assert found.albedo is not None
    assert found.albedo.min() > 0
    assert (found.normal, found.roughness, found.metallic, found.environment) == (None, None, None, None)


def test_pixels_outside_the_mask_have_no_derivative() -> None:
    mask = np.ones((SIDE, SIDE, 1), np.float32)
    mask[0], mask[1] = 0, 0.5
    weights = np.ones((SIDE, SIDE, 3), np.float32)
    whole = shade_gradients(scattered(), weights, soft_light(), 256)
    cut = shade_gradients(scattered().replace(mask=mask), weights, soft_light(), 256)
    for name in MAPS:
        assert not getattr(cut, name)[0].any()
    assert whole.albedo is not None
    assert cut.albedo is not None
    np.testing.assert_allclose(cut.albedo[1].sum() / whole.albedo[1].sum(), 0.5, rtol=0.05)


def test_many_passes_are_one_gradient(monkeypatch: pytest.MonkeyPatch) -> None:
    """Memory is bounded by the samples of a pass; the passes add up to the gradient of all samples."""
    intrinsics, light, weights = scattered(), soft_light(), np.ones((SIDE, SIDE, 3), np.float32)
    whole = shade_gradients(intrinsics, weights, light, 1024)
    genuine, sizes = Shader.backward, []

    def backward(*args: Any) -> None:
        sizes.append(args[-2])
        genuine(*args)

    monkeypatch.setattr(Shader, "backward", backward)
    monkeypatch.setattr(shading, "GRADIENT_SAMPLES_PER_PASS", 64 * SIDE**2)
    split = shade_gradients(intrinsics, weights, light, 1024)
    assert sizes == [64] * 16
    assert whole.albedo is not None
    assert split.albedo is not None
    np.testing.assert_allclose(split.albedo.sum(), whole.albedo.sum(), rtol=0.01)
    assert not np.array_equal(split.albedo, whole.albedo)


def test_a_pass_with_nan_derivatives_is_made_again(monkeypatch: pytest.MonkeyPatch) -> None:
    intrinsics, light, weights = scattered(), soft_light(), np.ones((SIDE, SIDE, 3), np.float32)
    genuine, calls = gradient, []

    def spoilt(tensor: Any) -> np.ndarray:
        calls.append(1)
        values = genuine(tensor)
        return (
            np.where(np.arange(values.size).reshape(values.shape) == 5, np.nan, values) if len(calls) == 1 else values
        )

    monkeypatch.setattr(shading, "gradient", spoilt)
    counters = Counters()
    repaired = shade_gradients(intrinsics, weights, light, 16, counters=counters)
    assert counters.nan_pixels == 1
    assert np.isfinite(together(repaired)).all()
    monkeypatch.setattr(shading, "gradient", lambda tensor: genuine(tensor) * np.nan)
    with pytest.raises(UnirenderError, match="stay NaN after 8 seeds"):
        shade_gradients(intrinsics, weights, light, 16)


def test_wrong_image_gradients_are_refused() -> None:
    with pytest.raises(
        UnirenderError, match=r"got an image gradient of shape \(2, 4, 3\), expected finite \(4, 4, 3\)"
    ):
        shade_gradients(scattered(), np.ones((2, SIDE, 3), np.float32), soft_light())
    with pytest.raises(UnirenderError, match="finite"):
        shade_gradients(scattered(), np.full((SIDE, SIDE, 3), np.nan, np.float32), soft_light())


def test_unknown_parameters_are_refused() -> None:
    untyped = inspect.unwrap(shade_gradients)  # the tests' type checker would refuse them first
    for wrt in (("normals",), ("albedo", "light"), ()):
        with pytest.raises(UnirenderError, match=r"got wrt=.*, expected some of albedo, normal, roughness, metallic"):
            untyped(scattered(), np.ones((SIDE, SIDE, 3), np.float32), soft_light(), wrt=wrt)


def test_under_a_black_light_only_the_light_has_derivatives() -> None:
    """The image is linear in the light: its derivative there is the one anywhere, and times a light it is the image."""
    weights, black = np.ones((SIDE, SIDE, 3), np.float32), np.zeros((*LIGHT_SHAPE, 3), np.float32)
    found = shade_gradients(scattered(), weights, black, 1024)
    for name in MAPS:
        assert not getattr(found, name).any(), name
    assert found.environment is not None
    for light in (soft_light(0), soft_light(0) ** 2):
        image = shade(scattered(), light, 1024)
        np.testing.assert_allclose((found.environment * light).sum(), image.sum(), rtol=0.01)
    assert abs((found.environment * soft_light(0)).sum() / image.sum() - 1) > 0.1
    only = shade_gradients(scattered(), weights, black, 16, wrt=("albedo",))
    assert only.albedo is not None
    assert not only.albedo.any()
