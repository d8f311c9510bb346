"""What s and d have beyond their own light, under another one."""

import math
from typing import Any

import numpy as np
import pytest
from seen_shapes import as_maps, gutter

from unirender.camera import Camera
from unirender.intrinsics import Intrinsics
from unirender.light.environment import environment_directions
from unirender.pipelines import carried_light
from unirender.pipelines.carried_light import MOST_RATIO, _smoothed, agreement, with_carried_light
from unirender.pipelines.derived_light import derived_light
from unirender.pipelines.editing import under_light
from unirender.pipelines.remembered import forget_pictures
from unirender.pipelines.revealed_light import agreeing_light

SIDE = 48
NAMES = ("specular", "diffuse")


def lamp(x: float, y: float, z: float, colour: tuple[float, float, float] = (1.0, 0.9, 0.7)) -> np.ndarray:
    """A wide lamp in a dim sky."""
    towards = np.array([x, y, z]) / np.linalg.norm([x, y, z])
    glow = np.exp(4 * (environment_directions(16, 32) @ towards - 1))
    return (0.1 + 3 * glow[..., None] * np.array(colour)).astype(np.float32)


OWN = lamp(1, 1, 1)
BESIDE = lamp(1, 0.6, 1.3)
OPPOSITE = lamp(-1, -1, 0.4)


def found(shadow: float = 0.6) -> Intrinsics:
    """A ball with a band in a shadow that its own light cannot explain."""
    y, x = (np.mgrid[:SIDE, :SIDE].astype(np.float32) + 0.5) / SIDE * 2.4 - 1.2
    z = np.sqrt(np.maximum(1 - x**2 - y**2, 0))
    mask = (x**2 + y**2 < 1)[..., None].astype(np.float32)
    bare = Intrinsics(
        normal=np.stack([x, -y, z], axis=-1) * mask, roughness=0.5 * mask, mask=mask, environment=OWN, camera=Camera()
    )
    shade = np.where((np.abs(y) < 0.3)[..., None], shadow, 1).astype(np.float32)
    return bare.replace(
        **{name: value * shade for name, value in derived_light(bare, OWN, NAMES, shadows=False).items()}
    )


def relit(before: Intrinsics, environment: np.ndarray) -> tuple[Intrinsics, Intrinsics]:
    """Without what is carried over, and with it."""
    after = under_light(before, environment, "keep", mirrors=False)
    return after, with_carried_light(before, after, NAMES)


def error(one: Intrinsics, other: Intrinsics) -> float:
    """Root mean square of log d and log s over the object."""
    inside = one.require("mask")["mask"][..., 0] > 0
    logs = (np.stack([np.log(maps.require(name)[name][inside] + 0.02) for name in NAMES]) for maps in (one, other))
    return float(np.sqrt(np.mean(np.square(next(logs) - next(logs)))))


def test_under_its_own_light_an_object_gets_its_own_light_back() -> None:
    before = found()
    without, carried = relit(before, agreeing_light(before))
    assert error(without, before) > 0.1
    assert error(carried, before) < 0.02


def test_where_s_and_d_are_what_their_own_light_gives_nothing_is_carried() -> None:
    """Through a camera that is not the default one, of a surface that hides its own light."""
    normal, mask, _ = gutter(16)
    maps = as_maps(normal, mask, 0.3).replace(camera=Camera(70, (0.1, 0.8)), environment=OWN)
    own, beside = (maps.replace(**derived_light(maps, light, NAMES)) for light in (OWN, BESIDE))
    carried = with_carried_light(own, beside, NAMES, OWN, shadows=True)
    for name in NAMES:
        np.testing.assert_allclose(getattr(carried, name), getattr(beside, name), rtol=1e-5)
    assert error(with_carried_light(own, beside, NAMES, OWN), beside) > 0.01  # the twin: as if it hid none


@pytest.mark.long
def test_a_shadow_is_carried_to_a_light_from_the_same_side_and_not_to_the_opposite_one() -> None:
    before = found()
    without, carried = relit(before, BESIDE)
    middle = np.s_[SIDE // 2 - 2 : SIDE // 2 + 2, SIDE // 3 : 2 * SIDE // 3]
    change = carried.require("diffuse")["diffuse"][middle] / without.require("diffuse")["diffuse"][middle]
    assert 0.5 < change.mean() < 0.9
    without, carried = relit(before, OPPOSITE)
    assert np.array_equal(carried.require("diffuse")["diffuse"], without.require("diffuse")["diffuse"])


def test_what_is_carried_is_bounded_and_0_outside_of_the_object() -> None:
    before = found(shadow=1e-4)
    without, carried = relit(before, OWN)
    for name in NAMES:
        old, new = without.require(name)[name], carried.require(name)[name]
        assert (new <= old * MOST_RATIO * 1.001).all()
        assert (new >= old / MOST_RATIO / 1.001).all()
        assert not new[before.require("mask")["mask"][..., 0] == 0].any()


@pytest.mark.parametrize("names", [("diffuse",), ("specular",), ()])
def test_light_that_is_given_stays_as_it_is(names: tuple[str, ...]) -> None:
    before = found()
    after, carried = (
        under_light(before, OWN, "keep"),
        with_carried_light(before, under_light(before, OWN, "keep"), names),
    )
    for name in NAMES:
        same = np.array_equal(after.require(name)[name], carried.require(name)[name])
        assert same == (name not in names), name


@pytest.mark.parametrize("missing", ["environment", "specular", "diffuse"])
def test_where_a_map_is_unknown_nothing_is_carried(missing: str) -> None:
    before = found()
    after = under_light(before, OWN, "keep")
    assert with_carried_light(before.replace(**{missing: None}), after, NAMES) is after


def test_the_light_at_hand_is_taken_as_it_is() -> None:
    before = found()
    after = under_light(before, OWN, "keep", mirrors=False)
    searched, given = with_carried_light(before, after, NAMES), with_carried_light(before, after, NAMES, OWN)
    by_hand = with_carried_light(before.replace(environment=None), after, NAMES, OWN)
    assert error(given, before) < error(searched, before) + 0.02
    assert np.array_equal(given.require("diffuse")["diffuse"], by_hand.require("diffuse")["diffuse"])


def test_what_its_own_light_gives_is_derived_once_for_many_lights(monkeypatch: pytest.MonkeyPatch) -> None:
    before, lights = found(), []
    light = agreeing_light(before)
    after = [under_light(before, environment, "keep", mirrors=False) for environment in (OPPOSITE, lamp(1, 0, 1))]

    def counted(intrinsics: Intrinsics, environment: np.ndarray, *args: Any, **kwargs: Any) -> Any:
        lights.append(environment)
        return derived_light(intrinsics, environment, *args, **kwargs)

    monkeypatch.setattr(carried_light, "derived_light", counted)
    *_, fresh = (with_carried_light(before, lit, NAMES, light) for lit in after)
    assert len(lights) == 1
    normal = before.require("normal")["normal"]
    normal[..., :2] *= -1  # in the same array
    turned = with_carried_light(before, after[1], NAMES, light)
    assert len(lights) == 2
    assert error(turned, fresh) > 1e-3
    forget_pictures()
    again = with_carried_light(before, after[1], NAMES, light)
    assert len(lights) == 3
    assert error(again, turned) == 0


def test_lights_agree_whatever_their_power_and_tint_and_not_where_they_come_from_other_sides() -> None:
    ball = found().replace(specular=None, diffuse=None)
    mask = ball.require("mask")["mask"]
    own, tinted, opposite, even = (
        derived_light(ball, light.astype(np.float32), ["diffuse"], shadows=False)["diffuse"]
        for light in (OWN, 7 * OWN * np.array([1, 2, 0.5]), OPPOSITE, np.ones((16, 32, 3)))
    )
    assert agreement(own, own, mask) == pytest.approx(1, abs=1e-6)
    assert agreement(own, tinted, mask) > 0.99
    assert agreement(own, opposite, mask) == 0
    assert agreement(even, 3 * even, mask) > 0.99, "two even lights do the same"
    assert agreement(own, even, mask) < 0.15
    assert agreement(own, own, 0 * mask) == 0, "of nothing"


def test_agreement_has_its_closed_form() -> None:
    """Log light of +-a and of +-b about its mean; a spread of 0.05 is in all light. Half coverage counts half."""
    for a, b, sign in ((0.1, 0.02, 1), (0.3, 0.3, 1), (0.1, 0.04, -1)):
        logs = (np.array([[[a], [-a], [a]]]), sign * np.array([[[b], [-b], [b]]]))
        one, other = (np.repeat(np.exp(log) - 0.02, 3, axis=-1).astype(np.float32) for log in logs)
        mask = np.array([[[0.5], [1], [0.5]]], np.float32)
        alike = (sign * a * b + 0.05**2) / math.sqrt((a**2 + 0.05**2) * (b**2 + 0.05**2))
        assert agreement(one, other, mask) == pytest.approx(max(alike, 0), abs=1e-5)


def test_the_finer_detail_is_carried_only_between_lights_that_agree() -> None:
    before = found()
    checks = np.indices((SIDE, SIDE)).sum(axis=0) % 2
    detail = np.where(checks, 1.3, 1 / 1.3).astype(np.float32)[..., None]
    speckled = before.replace(**{name: before.require(name)[name] * detail for name in NAMES})
    for environment, least, most in ((agreeing_light(speckled), 0.9, 1.1), (lamp(1, 0.2, 1.6), 0.0, 0.2)):
        smooth, fine = relit(before, environment)[1], relit(speckled, environment)[1]
        log_ratio = np.log(fine.require("diffuse")["diffuse"] + 1e-6) - np.log(
            smooth.require("diffuse")["diffuse"] + 1e-6
        )
        inside = np.s_[SIDE // 3 : 2 * SIDE // 3, SIDE // 3 : 2 * SIDE // 3]
        share = np.mean(log_ratio[inside] * np.log(detail[inside])) / np.log(1.3) ** 2
        assert least <= share <= most


def test_smoothing_has_its_standard_deviation_and_looks_at_nothing_but_the_object() -> None:
    middle, away = 60, np.arange(121) - 60
    spot = np.zeros((121, 121, 3), np.float32)
    spot[middle, middle] = 1
    for sigma in (2.0, 5.0, 12.0):
        smooth = _smoothed(spot, np.ones((121, 121, 1), np.float32), sigma)[..., 0]
        assert smooth.sum() == pytest.approx(1, rel=1e-4)
        for axis in (0, 1):
            assert np.sqrt((smooth.sum(axis=axis) * away**2).sum()) == pytest.approx(sigma, rel=0.1)
    inside = (np.hypot(away[:, None], away) < 40)[..., None].astype(np.float32)
    beside = np.where(inside > 0, 0.5, 9).repeat(3, axis=-1).astype(np.float32)
    np.testing.assert_allclose(_smoothed(beside, inside, 5.0), np.where(inside > 0, 0.5, 0).repeat(3, -1), rtol=1e-4)
