"""The truth check's deliberate errors: found on every object and every base roughness, and named where they are not."""

from types import SimpleNamespace

import numpy as np
import pytest

from unirender.intrinsics import Intrinsics
from unirender_evaluation.truth.check import Check, TruthCheck, look_twice, twin_roughness
from unirender_evaluation.truth.geometry import compare_geometry, twin_geometry


def flat(albedo: float, normal: tuple[float, float, float] = (0, 0, 1), coverage: float = 1.0) -> Intrinsics:
    """A plane of one colour."""
    shape = (8, 8)
    return Intrinsics(
        mask=np.full((*shape, 1), coverage, np.float32),
        albedo=np.full((*shape, 3), albedo, np.float32),
        normal=np.broadcast_to(np.array(normal, np.float32), (*shape, 3)).copy(),
    )


@pytest.mark.parametrize("albedo", [0.0, 1e-5, 1e-3, 0.5, 0.985, 1.0])
@pytest.mark.parametrize("normal", [(0, 0, 1), (1, 0, 0), (0, 1, 0), (0.6, 0, 0.8)])
@pytest.mark.parametrize("coverage", [0.5, 1.0])
@pytest.mark.parametrize("spp", [64, 256])
def test_no_object_hides_a_wrong_albedo_or_normal(
    albedo: float, normal: tuple[float, float, float], coverage: float, spp: int
) -> None:
    """White, black, flat fronts, thin things: at every number of samples that a suite may have."""
    truth = flat(albedo, normal, coverage)
    twins = twin_geometry(truth)
    assert [name.split()[0] for name in twins] == ["albedo", "normal"]
    for name, wrong in twins.items():
        test = compare_geometry(truth, wrong, spp)
        assert not test.passed, name
        assert all(found.startswith(name.split()[0]) for found in test.exceeded), "the error is of that map alone"
    assert compare_geometry(truth, truth, spp).passed


def test_a_white_part_does_not_hide_that_the_rest_is_off() -> None:
    truth = flat(0.2)
    albedo = truth.require("albedo")["albedo"].copy()
    albedo[:2] = 1
    truth = truth.replace(albedo=albedo)
    wrong = twin_geometry(truth)["albedo 2% off"]
    np.testing.assert_allclose(wrong.require("albedo")["albedo"], 0.98 * albedo, rtol=0, atol=1e-6)


def test_the_wrong_roughness_is_another_one_within_its_range() -> None:
    """12 % rougher as long as that exists; away from the bounds by more than a mirror's noise."""
    values = np.linspace(0, 1, 201)
    wrong = np.array([twin_roughness(value) for value in values])
    assert wrong.min() >= 0
    assert wrong.max() <= 1
    assert (np.abs(wrong - values) >= 0.024).all()
    between = (values >= 0.25) & (values <= 0.89)
    np.testing.assert_allclose(wrong[between], 1.12 * values[between], rtol=0, atol=1e-12)
    assert twin_roughness(0.0) == 0.25
    assert twin_roughness(1.0) == pytest.approx(1 / 1.12)


def test_a_check_names_the_errors_that_it_missed() -> None:
    truth = flat(0.5)
    same, other = compare_geometry(truth, truth), compare_geometry(truth, flat(0.6))
    check = TruthCheck((), other, 1, geometry_twins={"albedo 2% off": other, "normal off": other})
    assert check.twins_detected
    check = TruthCheck((), same, 1, geometry_twins={"albedo 2% off": other, "normal off": same}, twin_name="roughness")
    assert not check.passed
    assert list(check.missed) == ["roughness", "normal off"]
    assert "raise the suite's spp" in check.missed["roughness"]
    assert "samples" not in check.missed["normal off"]


@pytest.mark.parametrize(
    ("passing", "asked"), [({7: True}, [7]), ({7: False, 8: True}, [7, 8]), ({7: False, 8: False}, [7, 8])]
)
def test_a_failure_is_looked_at_once_more(passing: dict[int, bool], asked: list[int]) -> None:
    """By chance it does not fail again; a wrong truth does."""
    seen: list[int] = []

    def check(seed: int) -> Check:
        seen.append(seed)
        done = object.__new__(Check)
        object.__setattr__(done, "test", SimpleNamespace(passed=passing[seed]))
        return done

    assert look_twice(check, 7).test.passed is passing[asked[-1]]
    assert seen == asked
