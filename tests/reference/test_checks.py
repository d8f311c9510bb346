"""`unirender reference check`: verdicts, perturbations that come and go, the command's exit status and files."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from unirender.camera import Camera
from unirender.errors import UnirenderError, UsageError
from unirender_reference import effects, envmap, materials, scene, sensors
from unirender_reference.backend import mitsuba
from unirender_reference.checks import bsdf_checks
from unirender_reference.checks.ball import ball, ball_view
from unirender_reference.checks.command import Check
from unirender_reference.checks.outcome import against_truth, bounded
from unirender_reference.checks.perturbations import PERTURBATIONS, perturbed
from unirender_reference.checks.registry import CHECKS, run_check
from unirender_reference.editable_scene import EditableScene
from unirender_reference.passes import Estimate


def noisy(truth: np.ndarray, seed: int, batches: int = 16) -> Estimate:
    draws = truth + np.random.default_rng(seed).normal(0, 0.1, (batches, *truth.shape))
    variance = draws.var(axis=0, ddof=1) / batches
    return Estimate(draws.mean(axis=0).astype(np.float32), variance.astype(np.float32))


def test_z_test_verdict_is_that_of_the_numbers() -> None:
    truth, mask = np.full((20, 20, 3), 1.0), np.ones((20, 20), bool)
    good = against_truth("x", [noisy(truth, 0), noisy(truth, 1)], [truth, truth], mask)
    bad = against_truth("x", [noisy(truth, 0), noisy(truth, 1)], [truth, truth + 0.05], mask)
    assert good.passed
    assert good.value >= good.threshold
    assert not bad.passed
    hidden = against_truth("x", [noisy(truth, 0), noisy(truth + 9, 1)], [truth, truth], np.stack([mask, ~mask]))
    assert hidden.passed


def test_bounds_hold_and_nan_fails() -> None:
    assert bounded("x", "error", 1.0, 1.0).passed
    assert not bounded("x", "error", 1.01, 1.0).passed
    assert not bounded("x", "error", float("nan"), 1.0).passed


def test_share_is_the_statistic_where_it_alone_fails() -> None:
    """A small error everywhere, and one wrong pixel."""
    truth, mask = np.full((40, 40, 3), 1.0), np.ones((40, 40), bool)
    shifted = against_truth("x", [noisy(truth + 0.03, 0)], [truth], mask)
    assert not shifted.passed
    assert shifted.statistic == "share of p >= 0.05"
    assert shifted.value < shifted.threshold == 0.92
    wrong = noisy(truth, 0)
    wrong.mean[3, 3] += 1
    spot = against_truth("x", [wrong], [truth], mask)
    assert not spot.passed
    assert spot.statistic == "p (Sidak)"
    assert spot.value < spot.threshold


@pytest.mark.parametrize(("name", "call"), [("bsdf-values", 2), ("bsdf-gradients", 5)])
def test_one_nan_of_mitsubas_bsdf_fails(name: str, call: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """One value of one material, neither the first nor the last; without it the check passes."""
    read, calls = bsdf_checks._array, []

    def spoilt(value: Any) -> np.ndarray:
        calls.append(value)
        array = read(value).copy()
        if len(calls) == call:
            array[0] = np.nan
        return array

    monkeypatch.setattr(bsdf_checks, "DIRECTIONS", 200)
    monkeypatch.setattr(bsdf_checks, "_condition", lambda wi, wo, roughness: np.ones(len(wi)))
    monkeypatch.setattr(bsdf_checks, "RTOL", 1.0)
    monkeypatch.setattr(bsdf_checks, "GRADIENT_RTOL", 1.0)
    assert run_check(name).passed
    monkeypatch.setattr(bsdf_checks, "_array", spoilt)
    outcome = run_check(name)
    assert np.isnan(outcome.value)
    assert not outcome.passed
    assert len(calls) > call


def test_closed_sphere_is_the_cameras() -> None:
    """Area of the silhouette: the disc of radius 0.9 / 2 of the frame's height; normals face the viewer."""
    view = ball_view(Camera(), 16, 16)
    assert abs(view.coverage.mean() - np.pi * 0.45**2) < 1e-3
    assert (view.cosine > 0).all()
    np.testing.assert_allclose(np.linalg.norm(view.normal, axis=-1), 1, atol=1e-9)
    np.testing.assert_allclose(view.pixel_mean(np.ones((len(view.normal), 1))), view.coverage)


def test_reflected_constant_light_is_the_weights_sum() -> None:
    view = ball_view(Camera(), 4, 2)
    directions, weight = np.array([[0.6, 0.0, 0.8], [0.0, 0.6, 0.8]]), np.array([[0.2] * 3, [0.3] * 3])

    def weights(cosine: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return np.tile(directions, (len(cosine), 1, 1)), np.tile(weight, (len(cosine), 1, 1))

    np.testing.assert_allclose(view.reflected(weights, np.ones_like), 0.5)
    upward = view.reflected(weights, lambda wo: np.repeat(wo[..., 1:2], 3, axis=-1))
    tangent = view.view - view.cosine[:, None] * view.normal
    tangent /= np.linalg.norm(tangent, axis=-1, keepdims=True)
    frame = tangent, np.cross(view.normal, tangent), view.normal
    expected = sum(w[0] * sum(d[k] * frame[k][:, 1] for k in range(3)) for d, w in zip(directions, weight, strict=True))
    np.testing.assert_allclose(upward[:, 0], expected, atol=1e-12)


@pytest.mark.parametrize("name", PERTURBATIONS)
def test_perturbation_is_gone_after_its_block(name: str) -> None:
    owners = (EditableScene, "show"), (envmap, "envmap_data"), (materials, "base_color_bitmap")
    owners += (scene, "mesh_shape"), (mitsuba(), "render"), (sensors, "sensor_dict")
    owners += ((effects, "interreflection_integrator"),)
    before = [getattr(owner, attribute) for owner, attribute in owners]
    with perturbed(name):
        inside = [getattr(owner, attribute) for owner, attribute in owners]
    assert sum(a is not b for a, b in zip(before, inside, strict=True)) == 1
    assert all(a is getattr(*owner) for a, owner in zip(before, owners, strict=True))


def test_unknown_names_are_refused() -> None:
    with pytest.raises(UnirenderError, match="expected one of roughness"), perturbed("rain"):
        pass
    with pytest.raises(UnirenderError, match="expected one of bsdf-values"):
        run_check("rain")
    assert ball().name == "ball"


def test_command_prints_a_table_and_writes_the_rows(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "160")
    out = tmp_path / "checks.json"
    assert Check(only=("exposure",), json=out).run() == 0
    printed = capsys.readouterr().out
    assert "exposure" in printed
    assert "1 of 1 checks passed" in printed
    (row,) = json.loads(out.read_text())
    assert row["passed"] is True
    assert row["value"] <= row["threshold"] == 1e-6
    assert Check(only=("exposure",), perturb="gamma").run() == 1
    printed = capsys.readouterr().out
    assert "FAIL" in printed
    assert "0 of 1 checks passed" in printed


def test_command_reports_what_no_check_notices(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The exposure check notices gamma only: with it alone the others escape, and the status says so."""
    monkeypatch.setenv("COLUMNS", "160")
    monkeypatch.setattr("unirender_reference.checks.perturbations.PERTURBATIONS", {"gamma": PERTURBATIONS["gamma"]})
    assert Check(only=("exposure",), twins=True).run() == 0
    monkeypatch.setattr("unirender_reference.checks.perturbations.PERTURBATIONS", {"fov": PERTURBATIONS["fov"]})
    assert Check(only=("exposure",), twins=True).run() == 1
    assert "escapes every check: fov" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"only": ("rain",)}, "--only: got rain, expected some of"),
        ({"perturb": "rain"}, "--perturb: got rain"),
        ({"twins": True, "perturb": "fov"}, "--twins runs every perturbation"),
    ],
)
def test_command_refuses_what_makes_no_sense(options: dict, words: str) -> None:
    with pytest.raises(UsageError, match=words):
        Check(**options).run()
    assert "exposure" in CHECKS
