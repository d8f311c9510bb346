"""Shape from shading, charts, measures."""

import dataclasses

import numpy as np
import pytest
from posed_spheres import blank_views, dented_sphere, mask_views
from reference_scenes import environment, sphere

from unirender.color import image_srgb
from unirender.errors import UnirenderError
from unirender_reference.optimize.shape.cameras import Cameras
from unirender_reference.optimize.shape.charts import unwrap, welded
from unirender_reference.optimize.shape.config import ShapeConfig
from unirender_reference.optimize.shape.measure import chamfer, normal_buffers, score_shape
from unirender_reference.optimize.shape.normal_matrix import normal_matrix
from unirender_reference.optimize.shape.refine_shape import refine_shape
from unirender_reference.optimize.shape.shading import shade_points
from unirender_reference.optimize.shape.topology import vertex_normals
from unirender_reference.optimize.solution import Solution
from unirender_reference.optimize.views import View, Views
from unirender_reference.render import Renderer
from unirender_reference.shapes import MeshObject

SIZE = 32
ROUGHNESS, METALLIC, ALBEDO = 0.5, 0.3, 0.6


def _solution(obj: MeshObject, light: np.ndarray) -> Solution:
    """The object with one known material everywhere."""
    flat = np.full((2, 2), 1.0, np.float32)
    uv = np.full((len(obj.vertices), 2), 0.5, np.float32)
    albedo = np.full((2, 2, 3), ALBEDO, np.float32)
    known = dataclasses.replace(obj, uv=uv, albedo=albedo, roughness=ROUGHNESS * flat, metallic=METALLIC * flat)
    return Solution(known, light)


def _pictures(obj: MeshObject, light: np.ndarray, count: int, spp: int) -> Views:
    renderer = Renderer(dataclasses.replace(obj, uv=None, albedo=np.full(3, ALBEDO, np.float32)), resolution=SIZE)

    def picture(index: int, blank: View) -> View:
        rgba = renderer.image(light, ROUGHNESS, METALLIC, spp, seed=index, pose=blank.pose).mean
        mask = np.clip(rgba[..., 3:], 0, 1)
        straight = np.where(mask > 0, rgba[..., :3] / np.maximum(mask, 1e-6), 0)
        return dataclasses.replace(blank, image=np.round(image_srgb(straight) * 255) / 255, mask=mask)

    return Views(tuple(picture(k, view) for k, view in enumerate(blank_views(count, SIZE))))


def _soft_light() -> np.ndarray:
    """Bright on one side, different colours from different sides; at most display white on the object."""
    y, x = np.meshgrid(np.linspace(0, np.pi, 16), np.arange(32) / 32 * 2 * np.pi, indexing="ij")
    lobes = [1 + np.cos(y), 1 + np.sin(y) * np.cos(x - 3.0), 1 + np.sin(y) * np.cos(x - 5.0)]
    return (0.45 * np.stack(lobes, axis=-1)).astype(np.float32)


def test_the_derivative_of_the_vertex_normals_is_their_finite_difference() -> None:
    obj, rng = dented_sphere(subdivisions=2), np.random.default_rng(0)
    vertices = obj.vertices.astype(np.float64)
    step = 1e-6 * rng.normal(size=vertices.shape)
    difference = vertex_normals(vertices + step, obj.faces) - vertex_normals(vertices - step, obj.faces)
    matrix = normal_matrix(vertices, obj.faces)
    expected = 2 * (matrix @ step.ravel()).reshape(-1, 3)
    np.testing.assert_allclose(difference, expected, rtol=0, atol=1e-5 * np.abs(expected).max())
    frozen = (matrix.T @ step.ravel()).reshape(-1, 3) * 2  # twin
    assert np.abs(difference - frozen).max() > 1e-5 * np.abs(expected).max()


def test_the_shading_of_the_points_is_direct_light() -> None:
    obj, light, views = sphere(), _soft_light(), blank_views(2, SIZE)
    renderer = Renderer(dataclasses.replace(obj, albedo=np.full(3, ALBEDO, np.float32)), resolution=SIZE)
    image = renderer.image(light, ROUGHNESS, METALLIC, 256, depth=2, pose=views[1].pose).mean
    inner = np.flatnonzero(image[..., 3].ravel() > 0.999) + SIZE**2
    shaded = shade_points(_solution(obj, light), Cameras(views), inner, 128, seed=0)
    truth = image[..., :3].reshape(-1, 3)[shaded.pixel - SIZE**2]
    assert np.abs(shaded.radiance.mean(0) / truth.mean(0) - 1).max() < 0.02
    assert np.abs(shaded.radiance - truth).mean() < 0.06 * truth.mean()
    other = shade_points(_solution(obj, light[:, ::-1].copy()), Cameras(views), inner, 128, seed=0)  # twin
    assert np.abs(other.radiance - truth).mean() > 0.06 * truth.mean()


def test_the_derivative_of_the_shading_is_its_finite_difference() -> None:
    obj, light, cameras = sphere(), _soft_light(), Cameras(blank_views(1, SIZE))
    inner = (np.arange(8, 24)[:, None] * SIZE + np.arange(8, 24)).ravel()
    tilt = np.cross(obj.normals, [0.3, 0.9, 0.1])

    def shaded(step: float, samples: int):
        normals = obj.normals + step * tilt
        normals = (normals / np.linalg.norm(normals, axis=1, keepdims=True)).astype(np.float32)
        return shade_points(_solution(dataclasses.replace(obj, normals=normals), light), cameras, inner, samples, 1)

    middle = shaded(0, 512)
    slope = (shaded(0.05, 512).radiance - shaded(-0.05, 512).radiance) / 0.1
    direction = np.einsum("nk,nkc->nc", middle.share, tilt[obj.faces[middle.face]])
    found = np.einsum("nij,nj->ni", middle.derivative, direction)
    error = np.linalg.norm(found - slope) / np.linalg.norm(slope)
    assert error < 0.2, f"relative error {error:.3f} (threshold 0.2: noise of the difference)"
    assert (found * slope).sum() / (slope**2).sum() == pytest.approx(1, abs=0.05)
    across = np.einsum("nij,nj->ni", middle.derivative, np.cross(direction, obj.normals[obj.faces[middle.face, 0]]))
    assert np.linalg.norm(across - slope) / np.linalg.norm(slope) > 0.2  # twin: another tilt


@pytest.mark.long
def test_shading_carves_a_dent_that_no_mask_shows() -> None:
    true, light = dented_sphere(), _soft_light()
    views = _pictures(true, light, 8, 256)
    cameras = Cameras(blank_views(4, SIZE, start_deg=10))
    start = _solution(sphere(subdivisions=4), light)
    config = ShapeConfig(image_steps=8, image_weight=4.0, stiffness=0.2, spp=16)
    before = score_shape(start.obj, true, cameras)
    steps = []
    found = refine_shape(views, start, config, lambda step: steps.append(step) or True)
    after = score_shape(found.obj, true, cameras)
    assert 1 - after.normal_cosine < 0.6 * (1 - before.normal_cosine), f"{before} -> {after}"
    assert after.chamfer < 0.8 * before.chamfer
    assert after.mask_iou > 0.96
    assert steps[-1].values["image_rmse"] < 0.85 * steps[0].values["image_rmse"]
    assert [step.iteration for step in steps] == list(range(1, 9))
    np.testing.assert_array_equal(found.obj.faces, start.obj.faces)
    wrong = Solution(start.obj, np.roll(light[::-1], 16, axis=1))  # twin: light from the other side
    misled = score_shape(refine_shape(views, wrong, config).obj, true, cameras)
    assert 1 - misled.normal_cosine > 0.6 * (1 - before.normal_cosine)


def test_refinement_repeats_and_stops_when_it_is_told() -> None:
    true, light = dented_sphere(subdivisions=3), _soft_light()
    views = _pictures(true, light, 2, 16)
    start, config = _solution(sphere(subdivisions=3), light), ShapeConfig(image_steps=2, spp=4)
    first, second = (refine_shape(views, start, config, lambda step: False) for _ in range(2))
    np.testing.assert_array_equal(first.obj.vertices, second.obj.vertices)
    assert (first.obj.vertices != start.obj.vertices).any()
    other = refine_shape(views, start, dataclasses.replace(config, seed=1), lambda step: False)  # twin: another seed
    assert (first.obj.vertices != other.obj.vertices).any()


def test_a_lower_bound_moves_no_vertex() -> None:
    """Also one that is far below display white: the mean of a clipped value and dark ones (`View.clipped`)."""
    start, config = _solution(sphere(subdivisions=2), _soft_light()), ShapeConfig(image_steps=1, spp=4)
    blank = mask_views(dented_sphere(subdivisions=2), 2, SIZE).seen

    def moved(level: float, clipped: bool) -> np.ndarray:
        image, bound = np.full((SIZE, SIZE, 3), level, np.float32), np.full((SIZE, SIZE, 3), clipped)
        seen = tuple(dataclasses.replace(view, image=image, clipped=bound) for view in blank)
        return refine_shape(Views(seen), start, config).obj.vertices

    np.testing.assert_array_equal(moved(0.3, clipped=True), moved(0.7, clipped=True))
    assert (moved(0.3, clipped=False) != moved(0.7, clipped=False)).any()


def test_charts_keep_the_faces_and_do_not_overlap() -> None:
    obj = dented_sphere(subdivisions=3)
    charts = unwrap(obj.vertices, obj.faces)
    np.testing.assert_array_equal(charts.source[charts.faces], obj.faces)
    assert charts.uv.min() >= 0
    assert charts.uv.max() <= 1
    size = 256
    owners = np.zeros((size, size), int)
    for corners in charts.uv[charts.faces] * size:  # texel centres well inside a face
        low, high = np.floor(corners.min(0)).astype(int), np.ceil(corners.max(0)).astype(int)
        x, y = np.meshgrid(np.arange(low[0], high[0]) + 0.5, np.arange(low[1], high[1]) + 0.5)
        system = np.column_stack([corners[1] - corners[0], corners[2] - corners[0]])
        if abs(np.linalg.det(system)) < 1e-9:
            continue
        share = np.linalg.solve(system, np.stack([x.ravel() - corners[0, 0], y.ravel() - corners[0, 1]]))
        inside = (share.min(0) > 0.02) & (share.sum(0) < 0.98)
        np.add.at(owners, (np.floor(y.ravel()[inside]).astype(int), np.floor(x.ravel()[inside]).astype(int)), 1)
    assert owners.max() == 1
    assert (owners > 0).mean() > 0.2


def test_welding_undoes_the_cuts() -> None:
    obj = dented_sphere(subdivisions=3)
    charts = unwrap(obj.vertices, obj.faces)
    assert len(charts.uv) > len(obj.vertices)  # there are seams
    cut = obj.vertices[charts.source]
    points, faces, index = welded(cut, charts.faces)
    assert len(points) == len(obj.vertices)
    np.testing.assert_array_equal(points[index], cut)
    np.testing.assert_array_equal(points[faces], obj.vertices[obj.faces])


def test_charts_of_a_broken_mesh_are_refused() -> None:
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, np.nan, 0]], np.float32)
    with pytest.raises(UnirenderError, match="infinite or NaN vertices"):
        unwrap(vertices, np.array([[0, 1, 2]]))


def test_a_mesh_is_equal_to_itself() -> None:
    obj, cameras = sphere(subdivisions=4), Cameras(blank_views(3, SIZE))
    score = score_shape(obj, obj, cameras)
    assert score.mask_iou == 1
    assert score.normal_cosine == pytest.approx(1, abs=1e-6)
    assert score.chamfer < 0.02  # the spacing of the samples


def test_a_shifted_sphere_is_at_the_distance_that_the_integral_gives() -> None:
    ball, cameras = sphere(subdivisions=4), Cameras(blank_views(3, SIZE))
    shifted = dataclasses.replace(
        ball, family="reconstruction", vertices=ball.vertices + np.array([0, 0.2, 0], np.float32)
    )
    # A point at angle t from the shift is sqrt(1 + 0.04 + 0.4 cos t) from the other centre.
    cosine = np.linspace(-1, 1, 20001)
    expected = np.abs(np.sqrt(1.04 + 0.4 * cosine) - 1).mean()
    assert chamfer(ball, shifted) == pytest.approx(expected, abs=0.006)
    assert score_shape(shifted, ball, cameras).mask_iou < 0.9


def test_normals_are_those_of_the_sphere_where_it_is() -> None:
    cameras = Cameras(blank_views(2, SIZE))
    coverage, normal = normal_buffers(sphere(), cameras)
    assert coverage.max() == 1
    middle = normal[:, SIZE // 2 - 1 : SIZE // 2 + 1, SIZE // 2 - 1 : SIZE // 2 + 1].mean((1, 2))
    towards = cameras.center / np.linalg.norm(cameras.center, axis=1, keepdims=True)
    np.testing.assert_allclose(middle, towards, atol=0.01)
    assert (normal[coverage == 0] == 0).all()


def test_a_mesh_that_covers_more_loses_intersection_over_union() -> None:
    ball, cameras = sphere(subdivisions=4), Cameras(blank_views(2, 64))
    smaller = dataclasses.replace(ball, family="reconstruction", vertices=ball.vertices * np.float32(0.9))
    score = score_shape(smaller, ball, cameras)
    assert score.mask_iou == pytest.approx(0.81, abs=0.02)  # of two discs; nearer silhouettes shrink a little more
    assert mask_views(ball, 2, 16).seen[0].mask.max() == 1


def test_environment_is_used() -> None:
    """The light of a solution reaches the shading: twice as much light, twice the radiance."""
    obj, cameras, light = sphere(subdivisions=3), Cameras(blank_views(1, SIZE)), environment()
    inner = np.array([SIZE * (SIZE // 2) + SIZE // 2])
    one, two = (shade_points(_solution(obj, light * np.float32(k)), cameras, inner, 16, 0).radiance for k in (1, 2))
    np.testing.assert_allclose(two, 2 * one, rtol=1e-4)
