"""Scores of multi-view results: the truth scores what noise allows, the scale of albedo and light is what it is, and
each wrong thing is seen by the metric that is there for it."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from multiview_pieces import MATERIAL, ball_scene, true_solution

from unirender_evaluation.multiview.methods import ConstantObject
from unirender_evaluation.multiview.scenes import MultiviewScene
from unirender_evaluation.multiview.scoring import camera_means, ceiling_values, score_solution, solution_looks
from unirender_evaluation.multiview.tables import MULTIVIEW_TABLE
from unirender_reference.optimize.solution import Solution

RAW, ALIGNED = "psnr@masked-srgb-raw", "psnr@masked-srgb-aligned"


@pytest.fixture(scope="module")
def scene() -> MultiviewScene:
    return ball_scene()


@pytest.fixture(scope="module")
def truth_scores(scene: MultiviewScene) -> dict[str, float]:
    return score_solution(scene, true_solution(scene))


def changed(scene: MultiviewScene, **change: Callable[[np.ndarray], np.ndarray]) -> dict[str, float]:
    """Scores of the true solution with some of it changed."""
    true = true_solution(scene)
    light = change.pop("environment", lambda x: x)(true.environment)
    looks = {name: f(getattr(true.obj, name)).astype(np.float32) for name, f in change.items()}
    return score_solution(scene, Solution(replace(true.obj, **looks), light))


def test_the_truth_scores_what_noise_allows(scene: MultiviewScene, truth_scores: dict[str, float]) -> None:
    """Maps are exact; a picture of the same noise is 3 dB below the ceiling."""
    assert truth_scores[f"albedo.{RAW}"] == np.inf
    assert max(truth_scores[f"{name}.mse@masked"] for name in ("roughness", "metallic")) < 1e-12
    assert truth_scores["environment.log_rmse_scaled"] < 1e-4
    assert truth_scores["environment.peak_deg"] < 1e-3
    ceiling = ceiling_values(scene)
    for what in ("novel", "relit"):
        assert truth_scores[f"{what}.{RAW}"] == pytest.approx(ceiling[f"{what}.{RAW}"] - 3, abs=1.0)


def test_a_common_factor_of_albedo_and_light_is_free(scene: MultiviewScene, truth_scores: dict[str, float]) -> None:
    """A darker albedo under a brighter light: raw albedo and relit scores pay, aligned ones nearly do not (the
    dielectric reflection does not scale), nor does the novel view."""
    scores = changed(scene, albedo=lambda a: 0.6 * a, environment=lambda e: e / 0.6)
    assert scores[f"albedo.{RAW}"] < 20
    assert scores[f"albedo.{ALIGNED}"] > 60
    assert scores[f"relit.{RAW}"] < truth_scores[f"relit.{RAW}"] - 8
    assert scores[f"relit.{ALIGNED}"] > scores[f"relit.{RAW}"] + 5
    assert scores[f"novel.{RAW}"] > scores[f"relit.{RAW}"] + 5
    assert scores["environment.log_rmse_scaled"] < 1e-3


def test_relit_pictures_are_aligned_each_and_albedo_as_a_whole(scene: MultiviewScene) -> None:
    """As the table's description says: exposures that differ between cameras are free in relit pictures, with values
    above 1 among them, not in the albedo."""
    looks = solution_looks(scene, true_solution(scene))
    exposures = [np.array([4.0 ** (i + 1)] * 3 + [1], np.float32) for i in range(len(looks.relit.pictures))]
    rgba = [k * picture.mean for k, picture in zip(exposures, looks.relit.pictures, strict=True)]
    pictures = tuple(replace(own, mean=mean) for own, mean in zip(looks.relit.pictures, rgba, strict=True))
    albedo = looks.buffers.require("albedo")["albedo"]
    dimmed = albedo * np.linspace(0.5, 1, len(albedo), dtype=np.float32)[:, None, None]
    other = replace(looks, relit=replace(looks.relit, pictures=pictures), buffers=looks.buffers.replace(albedo=dimmed))
    plain, scores = (score_solution(scene, true_solution(scene), looks=shown) for shown in (looks, other))
    assert max(float(picture[..., :3].max()) for picture in rgba) > 1.5
    assert scores[f"relit.{RAW}"] < 15
    assert scores[f"relit.{ALIGNED}"] == pytest.approx(plain[f"relit.{ALIGNED}"], abs=0.01)
    assert scores[f"albedo.{ALIGNED}"] < 30
    assert "for albedo of the object, for relit of each picture (fitted before the clip)" in MULTIVIEW_TABLE.description


def test_a_wrong_material_is_seen(scene: MultiviewScene, truth_scores: dict[str, float]) -> None:
    scores = changed(scene, roughness=lambda r: r - 0.3, metallic=lambda m: m + 0.5)
    assert scores["roughness.mse@masked"] == pytest.approx(0.09, rel=1e-3)
    assert scores["metallic.mse@masked"] == pytest.approx(0.25, rel=1e-3)
    assert scores[f"albedo.{RAW}"] == np.inf
    for what in ("novel", "relit"):
        assert scores[f"{what}.{RAW}"] < truth_scores[f"{what}.{RAW}"] - 3


def test_a_wrong_light_is_seen_by_the_light_and_the_novel_view(
    scene: MultiviewScene, truth_scores: dict[str, float]
) -> None:
    """Relighting gives the light, and does not see it."""
    scores = changed(scene, environment=lambda e: np.roll(e, 16, axis=1))
    assert scores["environment.log_rmse_scaled"] > 0.1
    assert scores["environment.peak_deg"] > 20
    assert scores[f"novel.{RAW}"] < truth_scores[f"novel.{RAW}"] - 3
    assert scores[f"relit.{RAW}"] == truth_scores[f"relit.{RAW}"]


def test_the_constant_object_is_a_bar_and_not_the_truth(scene: MultiviewScene, truth_scores: dict[str, float]) -> None:
    method = ConstantObject()
    solution = method.solve(scene.views, scene.mesh)
    scores = score_solution(scene, solution)
    assert scores["roughness.mse@masked"] == pytest.approx((MATERIAL[1] - 0.5) ** 2, rel=1e-3)
    assert scores["metallic.mse@masked"] == pytest.approx((MATERIAL[0] - 0.5) ** 2, rel=1e-3)
    assert scores["environment.peak_deg"] == 90
    assert 10 < scores[f"novel.{RAW}"] < truth_scores[f"novel.{RAW}"] - 10
    pictures = scene.pictures_of(solution.obj, solution.environment, "novel")
    assert pictures.rgb(0).sum() == pytest.approx(scene.novel.rgb(0).sum(), rel=0.4), "the pictures' energy"


def test_every_camera_keeps_its_value_and_the_row_is_their_mean(truth_scores: dict[str, float]) -> None:
    cameras = [truth_scores[f"novel_{i}.{RAW}"] for i in range(2)]
    assert cameras[0] != cameras[1]
    assert truth_scores[f"novel.{RAW}"] == pytest.approx(np.mean(cameras))
    assert camera_means("x", {"x_0.a": 1.0, "x_1.a": 4.0, "y_0.a": 9.0}, 2) == {"x.a": 2.5}
    assert not any(key.startswith(("albedo.ssim", "albedo.lpips")) for key in truth_scores), "they would see seams"
