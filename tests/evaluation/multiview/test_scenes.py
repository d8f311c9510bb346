"""What the multi-view table shows a method, and what it keeps."""

import numpy as np
import pytest
from multiview_pieces import MATERIAL, SMALL, ball_scene, painted_ball

from unirender_evaluation.methods.method import quantise
from unirender_evaluation.multiview.scenes import (
    MultiviewScene,
    multiview_scenes,
    scene_material,
    suite_scene,
    turned,
)
from unirender_evaluation.suites.objects import GREY, known_mesh, scene_object
from unirender_evaluation.suites.suite import load_suite
from unirender_reference.render import Renderer


@pytest.fixture(scope="module")
def scene() -> MultiviewScene:
    return ball_scene()


def test_pictures_are_what_a_camera_stores(scene: MultiviewScene) -> None:
    views = scene.views
    assert (len(views.seen), views.held_out, views.hdr) == (SMALL.seen, (), False)
    for view in views.seen:
        levels = view.image * 255
        assert np.abs(levels - np.round(levels)).max() < 1e-3, "8 bits"
        assert not view.image[view.mask[..., 0] == 0].any()
    linear = np.concatenate([views.linear(view) for view in views.seen])
    assert 0.02 < linear.mean() < 0.6, "neither black nor white"


def test_the_mesh_says_nothing_of_the_looks(scene: MultiviewScene) -> None:
    assert (scene.mesh.albedo == GREY).all()
    assert scene.mesh.albedo.shape == (3,)
    assert (scene.mesh.roughness, scene.mesh.metallic, scene.mesh.normal_map) == (None, None, None)
    assert np.array_equal(scene.mesh.vertices, scene.obj.vertices)
    assert scene.mesh.uv is scene.obj.uv


def test_held_out_cameras_stand_between_the_seen_ones(scene: MultiviewScene) -> None:
    for pose in scene.held_out_poses:
        apart = [np.degrees(np.arccos(np.clip(pose[:3, 2] @ seen[:3, 2], -1, 1))) for seen in scene.seen_poses]
        assert min(apart) > 20


def test_buffers_are_those_of_the_cameras(scene: MultiviewScene) -> None:
    """Coverage traced from the turned object is the alpha of the rendered picture, albedo what the camera would see;
    the next camera's are not."""
    size = scene.resolution
    maps = scene.buffers.require("albedo", "roughness", "metallic", "mask")
    masks = maps["mask"].reshape(-1, size, size)
    for index, view in enumerate(scene.views.seen):
        assert np.abs(masks[index] - view.mask[..., 0]).mean() < 0.01
    painted = maps["albedo"].reshape(-1, size, size, 3)
    assert len(painted) == SMALL.seen + SMALL.held_out
    white = np.full((16, 32, 3), 1.0, np.float32)  # in white light a rough dielectric shows its albedo
    for index, pose in enumerate(scene.seen_poses):
        shown = scene._renderer.image(white, 1.0, 0.0, 64, pose=pose).mean
        straight = shown[..., :3] / np.maximum(shown[..., 3:], 1e-6)
        inside = masks[index] > 0.99
        right, wrong = (
            np.corrcoef(straight[inside].ravel(), painted[i][inside].ravel())[0, 1]
            for i in (index, (index + 1) % SMALL.seen)
        )
        assert right > 0.95 > wrong
    assert maps["metallic"].max() == pytest.approx(MATERIAL[0])
    assert maps["roughness"].max() == pytest.approx(MATERIAL[1])


def test_a_turned_object_has_normals_in_camera_axes() -> None:
    """From any side, the middle of a ball faces the viewer."""
    scene = ball_scene(resolution=9)
    for pose in scene.seen_poses:
        maps = Renderer(turned(painted_ball(), pose), scene.camera, 9).geometry(16).require("normal")
        assert maps["normal"][4, 4, 2] > 0.99


def test_truth_is_lit_by_the_two_lights(scene: MultiviewScene) -> None:
    novel, relit = scene.novel, scene.relit
    assert len(novel.pictures) == len(relit.pictures) == SMALL.held_out
    assert np.abs(novel.rgb(0) - relit.rgb(0)).mean() > 0.1 * novel.rgb(0).mean()
    assert np.abs(novel.mask(0) - relit.mask(0)).mean() < 0.01
    assert (novel.variance(0) >= 0).all()
    assert novel.variance(0).max() > 0


def test_suite_scenes() -> None:
    """The first scene of every object; materials in turn over all levels of metallic; the front view is the suite's
    own picture."""
    suite = load_suite("tiny")
    every = multiview_scenes(list(suite.scenes), None)
    assert [scene.object for scene in every] == list(dict.fromkeys(scene.object for scene in suite.scenes))
    some = multiview_scenes(list(suite.scenes), 4)
    assert [every.index(scene) for scene in some] == [0, 8, 15, 23]
    metallic = [scene_material(suite, scene)[0] for scene in every]
    assert min(metallic) <= 0.1
    assert max(metallic) >= 0.9
    assert np.mean(metallic) == pytest.approx(0.45, abs=0.1)
    chosen = some[2]
    made = suite_scene(suite, chosen, SMALL)
    stored = quantise(suite.image(chosen, made.material), suite.mask(chosen))
    inside = suite.mask(chosen)[..., 0] > 0.99
    assert np.abs(made.views.seen[0].image - stored)[inside].mean() < 0.03
    assert np.array_equal(known_mesh(suite, chosen).vertices, scene_object(suite, chosen).vertices)
