"""Where the object stands: by mesh, by masks; its texture coordinates; predictions laid on it."""

import dataclasses
import math

import numpy as np
import pytest
from optimizer_runs import rendered_views, truth
from reference_scenes import sphere

from unirender.camera import Camera
from unirender.errors import UnirenderError
from unirender.intrinsics import Intrinsics
from unirender.lighting import rotate_environment
from unirender_reference.multiview import orbit, pose_towards
from unirender_reference.optimize.placement import check_alignment, placed, project, sphere_of_masks
from unirender_reference.optimize.solution import Solution
from unirender_reference.optimize.uv import charted, has_own_texels
from unirender_reference.optimize.views import View, Views
from unirender_reference.optimize.warm import solution_from_predictions
from unirender_reference.shapes import MeshObject, Sphere, make_object


@pytest.fixture(scope="module")
def solution() -> Solution:
    return truth()


@pytest.fixture(scope="module")
def views(solution: Solution) -> Views:
    return rendered_views(solution, seen=6, held_out=1, side=32)


def away(views: Views, place: Sphere) -> Views:
    """The same pictures in a world of other units."""
    return placed(views, Sphere(-place.center / place.radius, 1 / place.radius))


def test_world_moves_there_and_back(views: Views):
    place = Sphere(np.array([3.0, -2.0, 10.0]), 0.25)
    moved = away(views, place)
    np.testing.assert_allclose(moved.seen[0].pose[:3, 3], views.seen[0].pose[:3, 3] * 0.25 + place.center, atol=1e-5)
    back = placed(moved, place)
    for one, other in zip((*views.seen, *views.held_out), (*back.seen, *back.held_out), strict=True):
        np.testing.assert_allclose(one.pose, other.pose, atol=1e-4)


def test_masks_bound_the_object(views: Views, solution: Solution):
    """In a far world of other units, the sphere of the masks holds the object and is not much larger."""
    place = Sphere(np.array([30.0, -20.0, 5.0]), 4.0)
    found = sphere_of_masks(away(views, place))
    vertices = solution.obj.vertices * place.radius + place.center
    reach = np.linalg.norm(vertices - found.center, axis=1).max() / found.radius
    assert 0.8 < reach < 1.05


def test_cameras_on_one_side_do_not_tell_the_size(views: Views):
    alone = Views((views.seen[0],))
    with pytest.raises(UnirenderError, match="look at the object from one side"):
        sphere_of_masks(alone)


def test_projection_is_that_of_the_rays():
    camera = Camera(40.0, (0.45, 0.6))
    view = View(np.zeros((20, 30, 3)), np.zeros((20, 30, 1)), camera, pose_towards(40, 20, camera))
    rays = camera.rays(20, 30) @ view.pose[:3, :3].T
    points = (view.pose[:3, 3] + 2.5 * rays).reshape(-1, 3)
    row, column = np.indices((20, 30)).reshape(2, -1) + 0.5
    found = project(view, points)
    np.testing.assert_allclose(found[:, 0], column, atol=1e-3)
    np.testing.assert_allclose(found[:, 1], row, atol=1e-3)
    assert (found[:, 2] > 0).all()


def test_a_mesh_that_lies_elsewhere_is_refused(views: Views, solution: Solution):
    check_alignment(views, solution.obj)
    for place in (Sphere(np.array([1.5, 0, 0]), 1.0), Sphere(np.zeros(3), 0.4), Sphere(np.zeros(3), 2.0)):
        with pytest.raises(UnirenderError, match="of its vertices lie inside the masks"):
            check_alignment(placed(views, place), solution.obj)


def test_a_close_up_that_cuts_the_object_off_is_no_reason(views: Views, solution: Solution):
    def close_up(view: View) -> View:
        half = math.degrees(2 * math.atan(math.tan(math.radians(view.camera.fov_deg / 2)) / 2))
        return View(view.image[8:24, 8:24], view.mask[8:24, 8:24], Camera(half), view.pose, view.name)

    check_alignment(Views(tuple(map(close_up, views.seen))), solution.obj)


@pytest.mark.parametrize("seed", [0, 3, 5])
def test_charts_of_textured_objects_serve(seed: int):
    obj = make_object(seed, "train", maps=True)
    assert has_own_texels(obj)
    assert charted(obj, 64) is obj


def shared(obj: MeshObject) -> MeshObject:
    """Both halves of the object look at the same half of the texture."""
    assert obj.uv is not None
    folded = np.stack([np.abs(obj.uv[:, 0] - 0.5) * 2, obj.uv[:, 1]], axis=1)
    return dataclasses.replace(obj, uv=folded.astype(np.float32))


def test_coordinates_that_do_not_serve_are_replaced(solution: Solution):
    obj = solution.obj
    assert obj.uv is not None
    tiled = dataclasses.replace(obj, uv=(obj.uv * 3).astype(np.float32))
    pointlike = dataclasses.replace(obj, uv=np.zeros_like(obj.uv))
    assert not has_own_texels(tiled)
    assert not has_own_texels(pointlike)
    for bad in (sphere(subdivisions=3), shared(obj)):
        assert not has_own_texels(bad)
        good = charted(bad, 64)
        assert has_own_texels(good)
        assert good.uv is not None
        np.testing.assert_array_equal(good.vertices[good.faces], bad.vertices[bad.faces])
        np.testing.assert_allclose(good.normals[good.faces], bad.normals[bad.faces], atol=1e-3)
        assert good.roughness is None


def test_predictions_come_back_from_the_mesh(solution: Solution):
    """Maps that are functions of the place on the surface are found again; the lights agree in the world."""
    obj, camera = sphere(subdivisions=4), Camera()
    light = solution.environment
    views, predictions = [], []
    for pose in [*orbit(6, camera), pose_towards(10, 80, camera), pose_towards(200, -80, camera)]:
        size = 48
        blank = np.zeros((size, size, 3), np.float32)
        center, rays = pose[:3, 3].astype(np.float64), camera.rays(size, size) @ pose[:3, :3].T
        b = (rays * center).sum(-1)
        root = b**2 - (center @ center - 1)
        mask = (root > 0)[..., None].astype(np.float32)
        point = center + rays * (-b - np.sqrt(np.maximum(root, 0)))[..., None]
        color = np.clip((0.5 + 0.4 * point) * mask, 0, 1).astype(np.float32)
        views.append(View(blank, mask, camera, pose))
        turned = rotate_environment(light, pose[:3, :3].T)
        predictions.append(Intrinsics(color, roughness=color[..., :1], metallic=color[..., 1:2], environment=turned))
    given = Views(tuple(views))
    found = solution_from_predictions(given, obj, predictions, 64, 16)
    uv = found.obj.uv
    assert uv is not None
    texel = np.clip((uv * 64).astype(int), 0, 63)
    albedo = found.obj.albedo[texel[:, 1], texel[:, 0]]
    error = np.abs(albedo - (0.5 + 0.4 * found.obj.vertices))
    assert np.quantile(error, 0.9) < 0.04
    assert found.obj.roughness is not None
    np.testing.assert_allclose(found.obj.roughness, found.obj.albedo[..., 0], atol=1e-6)
    blurred = np.abs(found.environment.mean((0, 1)) / light.mean((0, 1)) - 1)
    assert blurred.max() < 0.1
    twin = [p.replace(environment=light) for p in predictions]  # lights that were not turned along
    wrong = solution_from_predictions(given, obj, twin, 64, 16)
    similar = [float(np.corrcoef(s.environment.ravel(), light.ravel())[0, 1]) for s in (found, wrong)]
    assert similar[0] > 0.8 > similar[1] + 0.1
    with pytest.raises(UnirenderError, match="got 1 predictions for 8 views"):
        solution_from_predictions(given, obj, predictions[:1], 64, 16)
