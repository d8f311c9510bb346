"""Scores of an object with a mesh of its own: the true one scores the ceiling, another outline is what it is."""

from dataclasses import replace

import numpy as np
import pytest
from multiview_pieces import ball_scene, true_solution

from unirender.color import srgb_encode
from unirender_evaluation.multiview.scenes import MultiviewScene
from unirender_evaluation.multiview.scoring import Looks, ceiling_values, solution_looks, true_looks
from unirender_evaluation.studies.unknown_mesh.pictures import camera_panels, found_strip
from unirender_evaluation.studies.unknown_mesh.scoring import score_found
from unirender_reference.optimize.solution import Solution
from unirender_reference.shapes.mesh_object import RECONSTRUCTION

MASKED, WHOLE = "psnr@masked-srgb-raw", "psnr@whole-srgb-raw"


def scaled(scene: MultiviewScene, factor: float) -> Solution:
    """The true object, smaller or larger; white, so that nothing but the outline is wrong."""
    true = true_solution(scene)
    looks = {"vertices": true.obj.vertices * np.float32(factor), "albedo": np.ones_like(true.obj.albedo)}
    return replace(true, obj=replace(true.obj, family=RECONSTRUCTION, **looks))


@pytest.fixture(scope="module")
def scene() -> MultiviewScene:
    """A white ball."""
    scene = ball_scene(16)
    white = replace(scene.obj, albedo=np.ones_like(scene.obj.albedo))
    return MultiviewScene(
        white, scene.material, scene.light, scene.other_light, scene.camera, scene.resolution, scene.settings
    )


@pytest.fixture(scope="module")
def smaller_looks(scene: MultiviewScene) -> Looks:
    return solution_looks(scene, scaled(scene, 0.9))


@pytest.fixture(scope="module")
def true_scores(scene: MultiviewScene) -> dict[str, float]:
    return score_found(scene, true_solution(scene))


@pytest.fixture(scope="module")
def smaller(scene: MultiviewScene, smaller_looks: Looks) -> dict[str, float]:
    return score_found(scene, scaled(scene, 0.9), smaller_looks)


def test_the_truth_scores_the_ceiling(scene: MultiviewScene, true_scores: dict[str, float]) -> None:
    for quantity in ("shape", "shape_steep"):
        assert true_scores[f"{quantity}.mask_iou"] == 1
        assert true_scores[f"{quantity}.normal_cosine"] > 0.999
    assert true_scores["shape.chamfer"] < 0.012, "two samplings of one surface"
    for variant in (MASKED, WHOLE):
        assert true_scores[f"albedo.{variant}"] == np.inf
    assert max(true_scores[f"{name}.mse@whole"] for name in ("roughness", "metallic")) < 1e-12
    ceiling = ceiling_values(scene)
    for what in ("novel", "relit"):
        assert true_scores[f"{what}.{MASKED}"] == pytest.approx(ceiling[f"{what}.{MASKED}"] - 3, abs=1.5)


def test_a_smaller_mesh_is_seen_by_the_shape(smaller: dict[str, float]) -> None:
    """A ball's silhouette has the area of its radius squared, nearly: perspective; its surface is 0.1 away."""
    for quantity in ("shape", "shape_steep"):
        assert smaller[f"{quantity}.mask_iou"] == pytest.approx(0.81, abs=0.02)
    assert smaller["shape.chamfer"] == pytest.approx(0.1, abs=0.005)


def test_what_is_not_covered_is_black(scene: MultiviewScene, smaller: dict[str, float], smaller_looks: Looks) -> None:
    """The only wrong pixels inside the true mask are those that the smaller ball leaves open."""
    true, found = (looks.require("mask", "albedo") for looks in (scene.buffers, smaller_looks.buffers))
    w = true["mask"]
    open_share = float(w[found["mask"] == 0].sum() / w.sum())
    assert 0.02 < open_share < 0.2
    white = float(srgb_encode(np.ones(1, np.float32))[0])
    assert smaller[f"albedo.{MASKED}"] == pytest.approx(-10 * np.log10(open_share * white**2), abs=0.01)
    metallic, roughness = scene.material
    assert smaller["metallic.mse@masked"] == pytest.approx(open_share * metallic**2, rel=1e-3)
    assert smaller["roughness.mse@masked"] == pytest.approx(open_share * roughness**2, rel=1e-3)


def test_pixels_that_are_covered_in_part_look_like_their_covered_part(
    scene: MultiviewScene, smaller: dict[str, float], smaller_looks: Looks
) -> None:
    """Divided by the true coverage instead of its own, every outline would be darker than it is."""
    camera = 0
    own, true = smaller_looks.novel.mask(camera), scene.novel.mask(camera)
    edge = ((own > 0.1) & (own < 0.6) & (true > 0.9))[..., 0]
    assert edge.sum() > 4
    shown, truth = smaller_looks.novel.rgb(camera)[edge], scene.novel.rgb(camera)[edge]
    straight = shown / own[edge]
    assert np.abs(straight - truth).mean() < 0.5 * np.abs(shown - truth).mean()
    assert all(np.isfinite(value) or value == np.inf for value in smaller.values())


def test_what_is_covered_beyond_the_truth_counts_in_the_whole_frame(scene: MultiviewScene) -> None:
    larger = score_found(scene, scaled(scene, 1.08))
    assert larger[f"albedo.{MASKED}"] == np.inf, "no pixel of the truth is wrong"
    assert larger["metallic.mse@masked"] < 1e-12
    assert larger["metallic.mse@whole"] > 1e-3
    assert larger["shape.mask_iou"] < 0.9


def test_the_strip_cuts_everything_out_by_its_own_mask(scene: MultiviewScene, smaller_looks: Looks) -> None:
    """Over white: where only the truth is, the found panels are white, and the truth's normals are not."""
    found = camera_panels(scene, smaller_looks, 0)
    true = camera_panels(scene, true_looks(scene), 0)
    assert list(found) == list(true) == ["image", "relit", "albedo", "normal", "roughness", "metallic"]
    first = len(scene.seen_poses) * scene.resolution
    masks = [
        looks.require("mask")["mask"][first : first + scene.resolution, :, 0]
        for looks in (scene.buffers, smaller_looks.buffers)
    ]
    ring = (masks[0] > 0.4) & (masks[1] == 0)
    assert ring.any()
    for name, panel in found.items():
        assert (panel[ring] > 0.95).all(), name
        if name != "albedo":  # this object's own is white
            assert (true[name][ring] < 0.99).any(), name
    picture = found_strip(scene, smaller_looks)
    assert picture.width > 6 * 100
    assert picture.height > 4 * 100
