"""Refinement: it improves on its start, its state resumes exactly, ingredients do what they say."""

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import refine_problems as problems

from unirender.color import srgb_encode
from unirender.errors import UnirenderError, UsageError
from unirender_reference import backend
from unirender_reference.optimize.multiview.config import OptimizeConfig
from unirender_reference.optimize.refine.config import RefineConfig
from unirender_reference.optimize.refine.parameters import Name
from unirender_reference.optimize.refine.run import Fit, refine
from unirender_reference.optimize.refine.scene import TexturedScene, maps_of
from unirender_reference.optimize.refine.state import RefineState
from unirender_reference.optimize.solution import Solution
from unirender_reference.optimize.transport.config import TransportConfig
from unirender_reference.optimize.transport.light_grid import interpolated_light
from unirender_reference.optimize.transport.solve import solve_appearance
from unirender_reference.optimize.views import Step, Views

FAST = RefineConfig(iterations=6, spp=4, spp_gradient=4, depth=2)


@pytest.fixture(scope="module")
def truth() -> Solution:
    return problems.solution()


@pytest.fixture(scope="module")
def views(truth: Solution) -> Views:
    return problems.rendered_views(truth, 4, held_out=1)


def grey(truth: Solution) -> Solution:
    """True but for the base colour, which is one grey."""
    return Solution(dataclasses.replace(truth.obj, albedo=np.full_like(truth.obj.albedo, 0.4)), truth.environment)


def albedo_psnr(found: Solution, truth: Solution) -> float:
    """Of texels that the ball shows, in display values."""
    inside = slice(1, -1)
    error = srgb_encode(found.obj.albedo) - srgb_encode(truth.obj.albedo)
    return float(-10 * np.log10((error[inside, inside] ** 2).mean()))


def differences(one: Solution, other: Solution) -> float:
    a, b = maps_of(one), maps_of(other)
    return max(float(np.abs(a[name] - b[name]).max()) for name in a)


@pytest.mark.slow
def test_it_finds_the_base_colour_where_the_rest_is_known(views: Views, truth: Solution) -> None:
    config = RefineConfig(
        iterations=30, depth=2, spp=4, albedo_rate=0.1, roughness_rate=0, metallic_rate=0, light_rate=0
    )
    start, steps = grey(truth), []

    def note(step: Step) -> bool:
        steps.append(step)
        return True

    found = refine(views, start, config, note)
    assert albedo_psnr(start, truth) < 20
    assert albedo_psnr(found, truth) > 25
    assert [step.iteration for step in steps] == list(range(1, 31))
    assert steps[0].stage == "refine"
    assert np.mean([step.values["psnr"] for step in steps[-5:]]) > steps[0].values["psnr"] + 2
    np.testing.assert_allclose(found.environment, start.environment, rtol=1e-5)  # rates of 0 move nothing
    np.testing.assert_allclose(maps_of(found)["roughness"], maps_of(truth)["roughness"], atol=1e-6)


@pytest.mark.slow
def test_a_saved_state_resumes_exactly(views: Views, truth: Solution, tmp_path: Path) -> None:
    """Up to the order in which threads add up a gradient: two runs from the start differ as much."""
    start = grey(truth)
    whole, again = refine(views, start, FAST), refine(views, start, FAST)
    state, path = RefineState.begin(start, FAST), tmp_path / "state.npz"

    def stop(step: Step) -> bool:
        state.save(path)
        return step.iteration < 3

    refine(views, start, FAST, stop, state)
    assert state.iteration == 3
    loaded = RefineState.load(path, start, FAST)
    assert loaded.iteration == 3
    rest: list[int] = []

    def note(step: Step) -> bool:
        rest.append(step.iteration)
        return True

    resumed = refine(views, start, FAST, note, loaded)
    assert rest == [4, 5, 6]
    tolerance = max(10 * differences(whole, again), 1e-4)
    assert differences(resumed, whole) <= tolerance
    forgetful = RefineState.load(path, start, FAST)  # the twin: Adam's moments are lost
    forgetful.moments = RefineState.begin(start, FAST).moments
    assert differences(refine(views, start, FAST, state=forgetful), whole) > tolerance


def test_a_state_of_something_else_is_refused(truth: Solution, tmp_path: Path) -> None:
    path = tmp_path / "state.npz"
    RefineState.begin(truth, FAST).save(path)
    for levels in (1, 3):  # of 2
        with pytest.raises(UnirenderError, match="belongs to another start or configuration"):
            RefineState.load(path, truth, dataclasses.replace(FAST, light_levels=levels))
    path.write_bytes(b"nothing")
    with pytest.raises(UnirenderError, match="no readable state"):
        RefineState.load(path, truth, FAST)


def test_without_refinement_the_start_is_returned(views: Views, truth: Solution) -> None:
    assert refine(views, truth, dataclasses.replace(FAST, enabled=False)) is truth


def test_the_fit_to_held_out_views_is_reported(views: Views, truth: Solution) -> None:
    config, seen = dataclasses.replace(FAST, held_out_every=2, iterations=4), []

    def note(step: Step) -> bool:
        seen.append(step.values.get("held_out_psnr"))
        return True

    refine(views, truth, config, note)
    assert [value is not None for value in seen] == [False, True, False, True]
    assert min(value for value in seen if value is not None) > 10


PRIORS: dict[str, Name] = {
    "white_light": "environment",
    "albedo_smoothness": "albedo",
    "light_anchor": "environment",
    "albedo_anchor": "albedo",
    "material_anchor": "metallic",
}


@pytest.mark.parametrize("field", PRIORS)
def test_every_prior_reaches_its_map(views: Views, truth: Solution, field: str) -> None:
    """The derivative of the priors against central differences, in the space of steps; without weight there is none."""
    fit = Fit.__new__(Fit)
    fit.config = dataclasses.replace(FAST, **{field: 2.0})
    state = RefineState.begin(truth, fit.config)
    rng, name = np.random.default_rng(0), PRIORS[field]
    state.parameters = {
        key: np.clip(value + rng.uniform(-0.1, 0.1, value.shape), -1.6, 0.95).astype(np.float32)
        for key, value in state.parameters.items()
    }
    (weighted,) = [slope for own, _, slope in fit.priors(state).values() if own == name]
    move, step = rng.normal(size=weighted.shape), 1e-3

    def total(scale: float) -> float:
        moved = dataclasses.replace(state, parameters={**state.parameters, name: state.parameters[name] + scale * move})
        return 2.0 * sum(value for own, value, _ in fit.priors(moved).values() if own == name)

    along = float((weighted * move).sum())
    assert along == pytest.approx((total(step) - total(-step)) / (2 * step), rel=0.02)
    assert along != 0
    fit.config = FAST
    assert not fit.priors(state)


def test_pixels_are_weighed_by_what_the_start_explains(
    views: Views, truth: Solution, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By the start also where a run goes on from another state, and not at all where that is off."""
    shown: list[float] = []
    monkeypatch.setattr(Fit, "weigh", lambda self, maps: shown.append(float(maps["albedo"].mean())))
    state = RefineState.begin(truth, FAST)
    first = float(state.maps(FAST)["albedo"].mean())
    state.parameters["albedo"] = 0.5 * state.parameters["albedo"]
    refine(views, truth, dataclasses.replace(FAST, iterations=0), state=state)
    assert shown == [pytest.approx(first)]
    refine(views, truth, dataclasses.replace(FAST, iterations=0, robust=False))
    assert len(shown) == 1


def test_every_step_draws_samples_of_its_own(views: Views, truth: Solution) -> None:
    fit, state = Fit(views, truth, FAST), RefineState.begin(truth, FAST)
    first = fit.pictures(state)[0]["loss"]
    assert fit.pictures(state)[0]["loss"] == pytest.approx(first, rel=1e-5)
    state.iteration = 1
    assert fit.pictures(state)[0]["loss"] != pytest.approx(first, rel=1e-5)


def test_a_light_is_interpolated_as_the_renderer_does(truth: Solution) -> None:
    finer = interpolated_light(truth.environment, 11)  # rows of the poles stay: 5 intervals become 10
    assert finer.shape == (11, 22, 3)
    views = problems.blank_views(1)
    maps, other = maps_of(truth), Solution(truth.obj, finer)
    one = TexturedScene(truth, views).image(maps, 256, 0)[..., :3].mean()
    assert TexturedScene(other, views).image(maps_of(other), 256, 0)[..., :3].mean() == pytest.approx(one, rel=0.03)
    np.testing.assert_allclose(finer[::2].mean(1), truth.environment.mean(1), rtol=0.02)


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("loss", "l1", r"--refine\.loss l1: expected one of log, srgb, linear, slope"),
        ("parametrisation", "log", r"--refine\.parametrisation log: expected one of perceptual, linear"),
        ("spp", 0, r"--refine\.spp 0: expected 1 or more"),
    ],
)
def test_a_misspelled_ingredient_is_refused_before_any_work(
    truth: Solution, name: str, value: Any, message: str
) -> None:
    """Another loss ended a run after its start, another space was taken for the linear one."""
    config = RefineConfig()
    object.__setattr__(config, name, value)  # past the types, which are looked at in tests alone
    for call in (OptimizeConfig(refine=config).check, lambda: refine(Views(problems.blank_views(1)), truth, config)):
        with pytest.raises(UsageError, match=message):
            call()


def test_a_misspelled_choice_of_materials_is_refused(truth: Solution) -> None:
    config = TransportConfig()
    object.__setattr__(config, "materials", "map")
    with pytest.raises(UsageError, match=r"--transport\.materials map: expected one of one, maps"):
        solve_appearance(Views(problems.blank_views(1)), truth.obj, config)


def test_the_plain_loop_has_no_ingredient() -> None:
    plain = RefineConfig.plain()
    assert plain.spp == plain.spp_gradient == 16
    assert (plain.one_sided, plain.uniform, plain.decay) == (False, False, 1)
    assert plain.parametrisation == "linear"
    assert plain.albedo_levels == plain.material_levels == plain.light_levels == 1


def test_the_plain_loop_descends_as_mitsubas_adam(truth: Solution) -> None:
    """The same steps for the same gradients; not with our refinement's second moment."""
    mi = backend.mitsuba()
    import drjit as dr

    shape, rate = truth.obj.albedo.shape, 0.02
    gradients = np.random.default_rng(0).normal(size=(4, *shape)).astype(np.float32)
    adam = mi.ad.Adam(lr=rate, params={"albedo": mi.Float(np.zeros(truth.obj.albedo.size, np.float32))})
    for gradient in gradients:
        dr.set_grad(adam["albedo"], mi.Float(gradient.ravel()))
        adam.step()
    expected = np.array(adam["albedo"]).reshape(shape)
    for beta_2, same in ((RefineConfig.plain().beta_2, True), (RefineConfig().beta_2, False)):
        config = dataclasses.replace(RefineConfig.plain(), beta_2=beta_2)
        moments = RefineState.begin(truth, config).moments["albedo"]
        moved = np.sum([moments.step(gradient, rate) for gradient in gradients], axis=0)
        assert np.allclose(moved, expected, rtol=1e-4, atol=1e-6) == same
    for beta_2 in (-0.1, 1.0):
        with pytest.raises(UsageError, match="beta-2"):
            RefineConfig(beta_2=beta_2).check()
