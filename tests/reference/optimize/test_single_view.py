"""Single-view optimisation: what it finds of made pictures, what it leaves alone, and what it refuses."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import reference_scenes as scenes

from unirender.camera import Camera
from unirender.color import image_srgb, srgb_decode, unpremultiply
from unirender.errors import UnirenderError, UsageError
from unirender.intrinsics import MAPS, Intrinsics
from unirender.light.resampling import resample_environment
from unirender.system import machine
from unirender_reference.optimize.single.config import (
    COLD,
    COLD_MESH,
    WARM_NORMALS,
    Priors,
    SingleConfig,
    Trust,
    kept_note,
)
from unirender_reference.optimize.single.fit import Fit, Unknowns
from unirender_reference.optimize.single.pixels import make_picture
from unirender_reference.optimize.single.run import optimize_image
from unirender_reference.optimize.transport.config import MATRIX_BYTES
from unirender_reference.optimize.views import Step
from unirender_reference.render import Renderer
from unirender_reference.shade import shade

SIZE, ROUGHNESS = 32, 0.3
CAMERA = Camera()
QUICK = SingleConfig(light_rows=8, steps=(4, 4), noise=(0.1, 0.03), fine_steps=3)


@pytest.fixture(scope="module")
def truth() -> Intrinsics:
    """A half-metallic sphere with upright stripes under a light with lamps, and its true maps."""
    maps = Renderer(scenes.sphere(), resolution=SIZE).geometry(64)
    assert maps.mask is not None
    assert maps.normal is not None
    stripes = np.where((np.arange(SIZE) // 4 % 2)[:, None] > 0, [1.0, 1.0, 1.0], [0.3, 0.7, 1.5])
    inside = (maps.mask > 0).astype(np.float32)
    return Intrinsics(
        albedo=np.array([0.7, 0.5, 0.3]) * stripes * inside,
        normal=maps.normal,
        roughness=ROUGHNESS * inside,
        metallic=0.5 * inside,
        environment=resample_environment(1.5 * scenes.environment(3), (8, 16)),
        mask=maps.mask,
    )


@pytest.fixture(scope="module")
def picture(truth: Intrinsics) -> np.ndarray:
    """Display values, as a method is shown them."""
    assert truth.mask is not None
    shown = image_srgb(unpremultiply(shade(truth, spp=400), truth.mask))
    return (np.round(shown * 255) / 255).astype(np.float32)


@pytest.fixture(scope="module")
def prediction(truth: Intrinsics) -> Intrinsics:
    """The truth with a smooth light, one albedo and too much roughness."""
    maps = truth.require("albedo", "roughness", "environment", "mask")
    weight = maps["mask"] / maps["mask"].sum()
    one = (weight * maps["albedo"]).sum(axis=(0, 1))
    even = maps["environment"].mean(axis=(0, 1), keepdims=True) * np.ones_like(maps["environment"])
    return truth.replace(
        albedo=one * (maps["mask"] > 0),
        roughness=np.clip(maps["roughness"] * 2, 0, 1),
        environment=0.5 * maps["environment"] + 0.5 * even,
    )


@pytest.fixture(scope="module")
def small_fit(truth: Intrinsics, prediction: Intrinsics) -> Fit:
    """Of a linear picture of 200 pixels, with pixels held (a stiff prior) and a wide misfit."""
    maps = prediction.require("albedo", "roughness", "metallic", "normal", "mask", "environment")
    start = {name: maps[name] for name in ("albedo", "roughness", "metallic", "normal")}
    small = make_picture(shade(truth, spp=64), maps["mask"], CAMERA, start, None, 200, (8, 16), True, 0)
    return Fit(small, np.log(maps["environment"].reshape(-1, 3).astype(np.float64)), Priors(albedo=1e-5), 0.5)


def albedo_error(found: Intrinsics, truth: Intrinsics) -> float:
    """Root mean square of display values inside the mask."""
    maps, true = found.require("albedo"), truth.require("albedo", "mask")
    squared = np.square(image_srgb(maps["albedo"]) - image_srgb(true["albedo"])) * true["mask"]
    return float(np.sqrt(squared.sum() / true["mask"].sum() / 3))


def object_value(maps: Intrinsics, name: str) -> float:
    return float(maps.maps[name].max())


def test_a_prediction_is_refined_and_what_is_not_trusted_stays(
    truth: Intrinsics, picture: np.ndarray, prediction: Intrinsics
) -> None:
    mask = truth.require("mask")["mask"]
    trusting = replace(QUICK, trust=Trust())
    steps: list[Step] = []
    found = optimize_image(picture, mask, CAMERA, trusting, init=prediction, on_step=steps.append)
    assert found.present == tuple(MAPS)
    assert albedo_error(found, truth) < 0.6 * albedo_error(prediction, truth)
    wrong = object_value(prediction, "roughness") - ROUGHNESS
    assert abs(object_value(found, "roughness") - ROUGHNESS) < 0.8 * wrong
    misfit = [step.values["misfit"] for step in steps]
    assert misfit[-1] < 0.5 * misfit[0]
    assert [step.iteration for step in steps] == list(range(1, len(steps) + 1))
    untrusting = replace(QUICK, trust=Trust(0, 0, 0, 0, 0))
    same = optimize_image(picture, mask, CAMERA, untrusting, init=prediction)
    for name in ("albedo", "roughness", "metallic", "environment"):
        np.testing.assert_allclose(same.maps[name], prediction.maps[name], rtol=0, atol=2e-4)


def test_what_is_not_believed_of_the_paint_goes_into_the_light(
    truth: Intrinsics, picture: np.ndarray, prediction: Intrinsics
) -> None:
    """A predicted albedo too dark in level and tint that is kept: its light makes up for both, channel by channel."""
    maps = prediction.require("albedo", "mask")
    dark = prediction.replace(albedo=maps["albedo"] * np.array([0.4, 0.5, 0.7], np.float32))
    loose = Priors(brightness=1, tint=1, light_level=0.05, light_tint=0.05)  # the fit moves the paint
    trust = Trust(albedo=0, metallic=0, roughness=0, shading=0)
    config = replace(QUICK, priors=loose, trust=trust, steps=(6,), noise=(0.1,), fine_steps=1)
    found = optimize_image(picture, maps["mask"], CAMERA, config, init=dark)
    np.testing.assert_allclose(found.require("albedo")["albedo"], dark.require("albedo")["albedo"], atol=1e-5)
    seen = srgb_decode(picture) * maps["mask"]
    rendered = shade(found, spp=64)
    np.testing.assert_allclose(rendered.mean(axis=(0, 1)), seen.mean(axis=(0, 1)), rtol=0.15)


@pytest.mark.long
def test_the_result_renders_to_the_picture(truth: Intrinsics, picture: np.ndarray, prediction: Intrinsics) -> None:
    mask = truth.require("mask")["mask"]

    def error(maps: Intrinsics) -> float:
        shown = image_srgb(unpremultiply(shade(maps, spp=256), mask))
        return float(np.sqrt((np.square(shown - picture) * mask).sum() / mask.sum() / 3))

    found = optimize_image(picture, mask, CAMERA, replace(QUICK, trust=Trust()), init=prediction)
    assert error(found) < 0.03
    assert error(prediction) > 0.06


@pytest.mark.long
def test_a_known_mesh_gives_normals_and_needs_no_start(truth: Intrinsics, picture: np.ndarray) -> None:
    maps = truth.require("mask", "normal")
    found = optimize_image(picture, maps["mask"], CAMERA, QUICK, geometry=scenes.sphere())
    assert found.present == tuple(MAPS)
    cosine = np.sum(found.require("normal")["normal"] * maps["normal"], axis=-1)
    whole = maps["mask"][..., 0] > 0.99
    assert cosine[whole].min() > 0.99
    assert abs(object_value(found, "roughness") - ROUGHNESS) < 0.2
    flat = optimize_image(
        picture, maps["mask"], CAMERA, replace(QUICK, trust=Trust(roughness=0)), geometry=scenes.sphere()
    )
    assert object_value(flat, "roughness") == 0.5


@pytest.mark.long
def test_on_a_known_mesh_maps_and_light_are_as_bright_as_the_picture(
    truth: Intrinsics, picture: np.ndarray, prediction: Intrinsics
) -> None:
    """Of a predicted light that is far too dark a part is kept, but not of its level."""
    mask = truth.require("mask")["mask"]
    dark = prediction.replace(environment=0.05 * prediction.require("environment")["environment"])
    found = optimize_image(picture, mask, CAMERA, QUICK, geometry=scenes.sphere(), init=dark)
    rendered = shade(found, spp=64, geometry=scenes.sphere())
    seen = srgb_decode(picture) * mask
    np.testing.assert_allclose(rendered.mean(axis=(0, 1)), seen.mean(axis=(0, 1)), rtol=0.1)


@pytest.mark.long
def test_a_start_without_a_prediction_keeps_its_level_and_metallic_and_finds_the_rest(
    truth: Intrinsics, picture: np.ndarray
) -> None:
    """The mean albedo is the start's whatever the exposure, the tint is found, and roughness moves towards the truth;
    metallic, which the fit prefers to be 1, stays."""
    mask = truth.require("mask")["mask"]

    def mean(maps: Intrinsics) -> np.ndarray:
        return (maps.require("albedo")["albedo"] * mask).sum(axis=(0, 1)) / mask.sum()

    dark = image_srgb(0.3 * srgb_decode(picture))
    for image in (picture, dark):
        found = optimize_image(image, mask, CAMERA, QUICK)
        assert mean(found).mean() == pytest.approx(COLD["albedo"], rel=0.02)
        assert mean(found)[0] > 1.1 * mean(found)[2], "the truth is reddish"
        assert object_value(found, "metallic") == COLD["metallic"]
        assert ROUGHNESS < object_value(found, "roughness") < COLD["roughness"] - 0.005
    trusting = optimize_image(picture, mask, CAMERA, replace(QUICK, trust=Trust()))
    assert object_value(trusting, "metallic") > COLD["metallic"] + 0.2


def test_a_mesh_that_is_not_under_the_mask_is_refused(truth: Intrinsics, picture: np.ndarray) -> None:
    mask, ball = truth.require("mask")["mask"], scenes.sphere()
    flat = replace(ball, vertices=ball.vertices * np.array([1, 0.7, 1], np.float32))
    half = replace(ball, faces=ball.faces[ball.vertices[ball.faces].mean(axis=1)[:, 0] > 0])
    for mesh in (flat, half):
        with pytest.raises(UnirenderError, match="IoU"):
            optimize_image(picture, mask, CAMERA, QUICK, geometry=mesh)


def test_a_silhouette_is_enough_for_a_picture_of_any_size(picture: np.ndarray, truth: Intrinsics) -> None:
    mask = truth.require("mask")["mask"]
    image, cover = (np.kron(x, np.ones((2, 2, 1), np.float32))[:61] for x in (picture, mask))
    config = replace(QUICK, pixels=200, coarse_pixels=100)
    found = optimize_image(image, cover, CAMERA, config)
    assert found.present == tuple(MAPS)
    assert found.require("albedo")["albedo"].shape == image.shape


@pytest.mark.long
def test_the_scale_of_a_linear_picture_is_the_lights_alone(truth: Intrinsics, prediction: Intrinsics) -> None:
    """A picture eight times as bright (a power of two: no rounding), most of it above a display's 1, has the same maps
    under eight times the light, and renders to itself; the same values as a display shows them, clipped, do not."""
    mask = truth.require("mask")["mask"]
    linear = unpremultiply(shade(truth, spp=400), mask)

    def found(factor: float) -> Intrinsics:
        light = prediction.require("environment")["environment"] * np.float32(factor)
        start, config = prediction.replace(environment=light), replace(QUICK, trust=Trust())
        return optimize_image(linear * np.float32(factor), mask, CAMERA, config, init=start, hdr=True)

    def error(maps: Intrinsics) -> float:
        shown = image_srgb(unpremultiply(shade(maps, spp=256), mask) / 8)
        return float(np.sqrt((np.square(shown - image_srgb(linear)) * mask).sum() / mask.sum() / 3))

    one, eight = found(1), found(8)
    assert (8 * linear > 1).sum() > 1.5 * mask.sum(), "half of the values"
    for name, values in one.maps.items():
        factor = 8 if name in ("specular", "diffuse", "environment") else 1
        np.testing.assert_allclose(eight.maps[name], factor * values, rtol=1e-5, atol=1e-6, err_msg=name)
    assert error(eight) < 0.03
    clipped = optimize_image(image_srgb(8 * linear), mask, CAMERA, QUICK)
    assert error(clipped) > 0.06


def test_what_cannot_be_used_is_refused(picture: np.ndarray, truth: Intrinsics, prediction: Intrinsics) -> None:
    mask = truth.require("mask")["mask"]
    for image, cover, init, reason in (
        (picture + 1, mask, None, "`hdr`"),
        (picture, np.zeros_like(mask), None, "mask is empty"),
        (picture, mask, prediction.replace(albedo=None), "albedo missing"),
        (picture[:16], mask[:16], prediction, "picture's size"),
    ):
        with pytest.raises(UnirenderError, match=reason):
            optimize_image(image, cover, CAMERA, QUICK, init=init)
    wrong: tuple[tuple[dict[str, Any], str], ...] = (
        ({"steps": (1, 2), "noise": (0.1,)}, "--single.steps 1 2, --single.noise 0.1: expected as many"),
        ({"steps": (), "noise": ()}, "expected as many"),
        ({"noise": (0.1, 0.0, 0.1)}, "--single.noise 0.1 0 0.1: expected more than 0"),
        ({"noise": (0.1, math.nan, 0.1)}, "expected more than 0"),
        ({"pixels": 8}, "--single.pixels 8: expected 16 or more"),
        ({"light_rows": 2}, "--single.light-rows 2: expected 4 or more"),
    )
    for options, reason in wrong:
        with pytest.raises(UsageError, match=reason):
            SingleConfig(**options)


def test_a_light_that_the_memory_does_not_hold_is_refused(
    picture: np.ndarray, truth: Intrinsics, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By the pixels of the last stage, which are more than those of the search, or by all that are covered."""
    mask = truth.require("mask")["mask"]
    covered = int((mask > 0).sum())
    for pixels, taken in ((covered // 2, covered // 2), (10 * covered, covered)):
        config = replace(QUICK, light_rows=64, coarse_pixels=16, pixels=pixels)
        monkeypatch.setattr(machine, "memory_bytes", lambda taken=taken: MATRIX_BYTES * taken * 2 * 64**2 - 1)
        with pytest.raises(UnirenderError, match=r"--single\.light-rows 64: would take about"):
            optimize_image(picture, mask, CAMERA, config)
        monkeypatch.setattr(machine, "memory_bytes", lambda taken=taken: MATRIX_BYTES * taken * 2 * 64**2)
        config.require_memory(covered)  # the twin


def test_what_a_result_has_of_its_start_is_named() -> None:
    told, colours = "since one picture does not tell it: ", "; colours of albedo and light may be exchanged"
    assert kept_note(COLD_MESH, warm=False) == f"assumed, {told}metallic (0.5), the mean of albedo (0.25){colours}"
    assert kept_note(Trust(), warm=False) == f"assumed, {told}the mean of albedo (0.25){colours}"
    assert kept_note(WARM_NORMALS, warm=True) == f"as predicted, {told}metallic, roughness, albedo"


def test_the_brightness_of_a_light_is_that_of_the_picture(small_fit: Fit) -> None:
    """A light whose channels are 3, 1 and 1/2 times that of the picture: the inverse, whatever the albedo."""
    at, albedo = small_fit.start(), 0.5 * small_fit.picture.maps["albedo"]
    u, v = small_fit.model(at).mixed
    light, factor = np.exp(small_fit.log_light), np.array([3, 1, 0.5])
    seen = replace(small_fit.picture, radiance=albedo * (u @ light.astype(np.float32)) + v @ light.astype(np.float32))
    fit = Fit(seen, small_fit.log_light, small_fit.priors, small_fit.noise)
    np.testing.assert_allclose(fit.brightness(at, albedo, factor * light), 1 / factor, rtol=1e-5)
    np.testing.assert_array_equal(fit.brightness(at, albedo, 0 * light), 1)


def test_the_gradient_is_that_of_the_cost(small_fit: Fit) -> None:
    """Against central differences, with pixels held and without Huber's corner."""
    fit, small = small_fit, small_fit.picture
    rng = np.random.default_rng(0)
    base = rng.normal(0, 0.05, 3 * fit.coarse + 5)
    base[-1] = 0.03  # between two nodes of the roughness table

    def at(theta: np.ndarray) -> Unknowns:
        c = 3 * fit.coarse
        zero = np.zeros((len(small.coverage), 3))
        return Unknowns(zero, theta[:c], theta[c : c + 3], float(theta[-2]), float(theta[-1]))

    def cost(theta: np.ndarray) -> float:
        return fit.cost(at(theta), fit.model(at(theta)))

    half = fit.normal_equations(at(base), fit.model(at(base)), 0.0)[1]
    brightest = int(np.argmax(np.abs(half[: 3 * fit.coarse])))
    for index in (brightest, brightest // 2, -5, -4, -3, -2, -1):
        step = np.zeros_like(base)
        step[index] = 1e-3
        found = (cost(base + step) - cost(base - step)) / 2e-3
        assert 2 * half[index] == pytest.approx(found, rel=2e-2, abs=1e-2 * np.abs(half).max())
