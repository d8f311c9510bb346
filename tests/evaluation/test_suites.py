"""Suites: stratification, the truth file's hash, what a task hands out, and the shipped truth against Mitsuba."""

from pathlib import Path

import numpy as np
import pytest
from tiny_suites import make_suite, write_suite

from unirender.color import srgb_decode
from unirender.errors import UnirenderError
from unirender_evaluation.suites import (
    constant_mse,
    level_counts,
    load_suite,
    read_spec,
    stratified_materials,
    suite_path,
)
from unirender_evaluation.tasks import PROTOCOLS, scene_ids, tasks
from unirender_evaluation.truth import noise_ceiling_db, quality_summary, render_to_ceiling


def test_tiny_materials_are_stratified_and_independent() -> None:
    spec = read_spec("tiny")
    materials = spec.materials()
    flat = np.array([m for scene in materials for m in scene])
    assert flat.shape == (240, 2)
    for mse in constant_mse(materials):
        assert mse == pytest.approx(0.1, abs=0.002)
    for counts in level_counts(materials):
        assert len(counts) == 11
        assert set(counts.values()) <= {21, 22}
    assert abs(np.corrcoef(flat.T)[0, 1]) < 0.02
    assert materials == spec.materials(), "the assignment is a pure function of the suite file"
    assert all(len(set(scene)) == 5 for scene in materials)


def test_stratification_is_not_trivially_even() -> None:
    """Twin: independent uniform draws miss the tolerance that the stratification meets."""
    rng = np.random.default_rng(0)
    draws = rng.integers(0, 11, (200, 240, 2)) / 10
    outside = np.abs(np.mean((draws - 0.5) ** 2, axis=1) - 0.1) > 0.002
    assert outside.any(axis=1).mean() > 0.5


@pytest.mark.parametrize(("scenes", "per_scene", "levels"), [(4, 2, 11), (48, 5, 11), (10, 3, 5)])
def test_every_size_has_different_materials_in_a_scene(scenes: int, per_scene: int, levels: int) -> None:
    materials = stratified_materials(scenes, per_scene, levels, seed=1)
    assert [len(set(row)) for row in materials] == [per_scene] * scenes


def test_changed_truth_is_refused(tmp_path: Path) -> None:
    path = write_suite(tmp_path)
    load_suite(path)
    tar = tmp_path / "ball.tar"
    data = bytearray(tar.read_bytes())
    data[len(data) // 2] ^= 1
    tar.write_bytes(bytes(data))
    with pytest.raises(UnirenderError, match="was changed"):
        load_suite(path)
    tar.unlink()
    with pytest.raises(UnirenderError, match="has no truth file"):
        load_suite(path)


def test_broken_suite_files_are_named(tmp_path: Path) -> None:
    with pytest.raises(UnirenderError, match="expected one of tiny"):
        suite_path("no-such-suite")
    with pytest.raises(UnirenderError, match="no suite file"):
        read_spec(tmp_path / "none.toml")
    (tmp_path / "broken.toml").write_text("name = ")
    with pytest.raises(UnirenderError, match="is not TOML"):
        read_spec(tmp_path / "broken.toml")
    (tmp_path / "short.toml").write_text('name = "x"\nwrong = 1\n')
    with pytest.raises(UnirenderError, match=r"missing keys .*unknown keys \['wrong'\]"):
        read_spec(tmp_path / "short.toml")


def test_methods_see_eight_bits_and_nothing_else(tmp_path: Path) -> None:
    """No leakage: every input is the quantised picture, mask, camera and what the protocol gives away."""
    suite = make_suite(tmp_path)
    allowed = {
        "from-image": {"edit": {"image_srgb", "mask", "camera", "metallic", "roughness"}},
        "single-image": {"decompose": {"image_srgb", "mask", "camera"}},
        "from-image-sd": {
            "decompose": {"image_srgb", "mask", "camera"},
            "relight": {"image_srgb", "mask", "camera", "specular", "diffuse"},
        },
        "from-image-hdri": {
            "decompose": {"image_srgb", "mask", "camera"},
            "relight": {"image_srgb", "mask", "camera", "environment"},
        },
        "given": {"render": {"intrinsics"}},
        "given-light": {"render": {"intrinsics"}},
    }
    seen = 0
    for table, protocol in PROTOCOLS:
        for task in tasks(suite, table, protocol, list(suite.scenes)):
            for capability, inputs in task.inputs.items():
                assert set(inputs) <= allowed[protocol][capability]
                if "image_srgb" in inputs:
                    picture = inputs["image_srgb"]
                    np.testing.assert_allclose(picture * 255, np.round(picture * 255), rtol=0, atol=1e-4)
                    assert np.all(picture[task.mask[..., 0] == 0] == 0)
                    seen += 1
            if protocol == "given":
                assert task.inputs["render"]["intrinsics"].environment is None
            if protocol == "given-light":
                assert set(task.inputs["render"]["intrinsics"].present).isdisjoint({"specular", "diffuse"})
            if table == "relighting":  # the light of the answer, not of the question
                own = suite.intrinsics(task.scene, suite.spec.base)
                given = task.inputs["relight"]
                assert given.get("environment") is None or np.abs(given["environment"] - own.environment).max() > 0.1
    assert seen > 0


def test_an_unquantised_picture_would_be_caught(tmp_path: Path) -> None:
    """Twin of the leakage test: the linear truth itself has more than 8 bits."""
    suite = make_suite(tmp_path)
    truth = suite.image(suite.scenes[0], suite.spec.base)
    task = next(tasks(suite, "rendering", "from-image", list(suite.scenes)))
    seen = task.inputs["edit"]["image_srgb"]
    assert np.abs(seen * 255 - np.round(seen * 255)).max() < 1e-4
    assert np.abs(truth * 255 - np.round(truth * 255)).max() > 0.3
    assert np.abs(srgb_decode(seen) * task.mask - truth).max() < 0.01


def test_limited_runs_take_scenes_evenly(tmp_path: Path) -> None:
    suite = make_suite(tmp_path)
    assert len(scene_ids(suite, None)) == 4
    assert [s.key for s in scene_ids(suite, 2)] == [suite.scenes[0].key, suite.scenes[-1].key]
    with pytest.raises(UnirenderError, match="at least 1"):
        scene_ids(suite, 0)


def test_stored_noise_survives_half_floats(tmp_path: Path) -> None:
    """Radiances over four decades keep their standard deviation to a few per cent."""
    suite = make_suite(tmp_path)
    scene = suite.scenes[0]
    mean, variance = suite.image(scene, suite.spec.base), suite.image_variance(scene, suite.spec.base)
    bright = mean > 1e-3
    np.testing.assert_allclose(np.sqrt(variance[bright]) / mean[bright], 1e-3, rtol=0.06)


def test_noise_ceiling_is_the_score_of_a_noise_free_prediction() -> None:
    """Monte Carlo against the delta method; the twin is the score of another noisy render, 3 dB worse."""
    from unirender.color import image_srgb

    rng = np.random.default_rng(0)
    mask = np.ones((64, 64, 1), np.float32)
    clean = rng.uniform(0.05, 0.9, (64, 64, 3)).astype(np.float32)
    sigma = 0.01 * clean
    noisy, again = (clean + sigma * rng.standard_normal(clean.shape, np.float32) for _ in range(2))

    def measured(a: np.ndarray, b: np.ndarray) -> float:
        return float(-10 * np.log10(np.mean((image_srgb(a) - image_srgb(b)) ** 2)))

    predicted = noise_ceiling_db(noisy, sigma**2, mask, True)
    assert measured(clean, noisy) == pytest.approx(predicted, abs=0.15)
    assert measured(again, noisy) == pytest.approx(predicted - 3.01, abs=0.15)


def test_sampling_goes_on_until_the_ceiling_is_reached(tmp_path: Path) -> None:
    """Combined estimates average means and variances; sampling stops at target or limit."""
    from unirender_reference.passes import Estimate

    spec = read_spec(write_suite(tmp_path))
    mask, calls = np.ones((8, 8, 1), np.float32), []

    def render(spp: int, seed: int) -> Estimate:
        calls.append((spp, seed))
        noise = np.random.default_rng(seed).standard_normal((8, 8, 3)) * 0.2 / np.sqrt(spp)
        variance = np.full((8, 8, 3), 0.04 / spp, np.float32)
        return Estimate((0.5 + noise).astype(np.float32), variance)

    mean, variance, spp, ceiling = render_to_ceiling(render, mask, spec, 7, True)
    assert 1 < len(calls) <= 3, "the first render says how many samples are missing"
    assert len({seed for _, seed in calls}) == len(calls), "every render has its own seed"
    assert spp == sum(count for count, _ in calls)
    assert all(count % spec.batches == 0 for count, _ in calls)
    np.testing.assert_allclose(variance, 0.04 / spp, rtol=1e-4)
    assert spec.target_db <= ceiling < spec.target_db + 0.5
    assert np.abs(mean - 0.5).max() < 0.2 / np.sqrt(spp) * 6


def test_shipped_truth_reaches_its_noise_ceiling() -> None:
    suite = load_suite("tiny")
    assert len({scene.object for scene in suite.scenes}) >= 24
    assert len(suite.scenes) == 2 * len({scene.object for scene in suite.scenes})
    assert sum(len(scene.materials) for scene in suite.scenes) == 240
    summary = quality_summary(suite)
    assert summary["image"]["mean_db"] >= 45
    assert summary["image"]["share_below_target"] < 0.05  # the noisiest end at max_spp
    assert summary["image"]["min_db"] > 40
    assert summary["specular"]["min_db"] >= suite.spec.light_target_db
    assert summary["diffuse"]["min_db"] >= suite.spec.light_target_db
    assert suite.spec.truth_path.stat().st_size < 12e6


@pytest.mark.slow
def test_shipped_truth_agrees_with_mitsuba_here() -> None:
    """One image and one roughness 12 % off, rendered here: the first passes the z-test, the second must not."""
    from unirender_evaluation.truth_check import _check_image, chosen_scenes, compare_geometry, twin_geometry
    from unirender_reference.render import Renderer
    from unirender_reference.shapes import make_object

    suite = load_suite("tiny")
    scene = min(
        chosen_scenes(suite, 8, seed=5), key=lambda s: suite.provenance["quality"][f"{s.key}.m050_r050.exr"]["spp"]
    )
    obj = make_object(suite.provenance["objects"][scene.object]["seed"], "test")
    renderer = Renderer(obj, camera=suite.spec.camera, resolution=suite.spec.resolution)
    good = _check_image(suite, renderer, scene, suite.spec.base, suite.spec.base, seed=5, alpha=1e-3)
    wrong = _check_image(suite, renderer, scene, suite.spec.base, (0.5, 0.56), seed=5, alpha=1e-3)
    assert good.test.passed, str(good.test)
    assert not wrong.test.passed, str(wrong.test)
    stored, again = suite.intrinsics(scene, suite.spec.base), renderer.geometry(suite.spec.geometry_spp, seed=77)
    assert compare_geometry(stored, again).passed, str(compare_geometry(stored, again))
    for name, twin in twin_geometry(again).items():
        assert not compare_geometry(stored, twin).passed, name
