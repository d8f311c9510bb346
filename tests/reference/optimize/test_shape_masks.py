"""Shape from masks: projection, hull, outlines and their derivative, the fit."""

import dataclasses
import logging
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from posed_spheres import blank_views, mask_views, with_masks
from reference_scenes import environment, sphere

from unirender.camera import Camera
from unirender.errors import UnirenderError, UsageError
from unirender_reference.multiview import pose_towards
from unirender_reference.optimize.multiview.config import OptimizeConfig
from unirender_reference.optimize.multiview.run import optimize
from unirender_reference.optimize.shape import tracer
from unirender_reference.optimize.shape.bounds import check_masks, check_reach
from unirender_reference.optimize.shape.cameras import Cameras
from unirender_reference.optimize.shape.charts import welded
from unirender_reference.optimize.shape.config import ShapeConfig
from unirender_reference.optimize.shape.fit import MeshFit
from unirender_reference.optimize.shape.hull import extract, mask_distance, visual_hull
from unirender_reference.optimize.shape.measure import score_shape
from unirender_reference.optimize.shape.placement import placed, sphere_of_masks
from unirender_reference.optimize.shape.principal import shifted_principal
from unirender_reference.optimize.shape.reconstruct import reconstruct
from unirender_reference.optimize.shape.silhouette import outline
from unirender_reference.optimize.shape.topology import mesh_edges, neighbours, vertex_normals
from unirender_reference.optimize.shape.tracer import MeshTracer
from unirender_reference.optimize.views import Views
from unirender_reference.render import Renderer
from unirender_reference.shapes import MeshObject, Sphere, make_object, signed_volume

SIZE = 32


def _masks(views: Views) -> np.ndarray:
    return np.stack([view.mask[..., 0] for view in views.seen]).astype(np.float64)


def _rotated(obj: MeshObject, seed: int = 5) -> MeshObject:
    """No vertex on the poles of the orbit, no edge towards a camera."""
    turn, _ = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    turn *= np.sign(np.linalg.det(turn))
    vertices = (obj.vertices @ turn.T).astype(np.float32)
    return dataclasses.replace(obj, vertices=vertices, normals=vertices.copy())


def test_rays_go_through_the_points_that_project_to_their_pixels() -> None:
    cameras, rng = Cameras(blank_views(5, SIZE)), np.random.default_rng(0)
    points, view = rng.uniform(-0.5, 0.5, (40, 3)), rng.integers(0, 5, 40)
    rays = cameras.rays(cameras.project(points, view), view)
    offset = points - cameras.center[view]
    np.testing.assert_allclose(rays, offset / np.linalg.norm(offset, axis=1, keepdims=True), rtol=0, atol=1e-6)


def test_the_derivative_of_the_projection_is_its_finite_difference() -> None:
    cameras, rng = Cameras(blank_views(5, SIZE)), np.random.default_rng(1)
    points, view = rng.uniform(-0.5, 0.5, (40, 3)), rng.integers(0, 5, 40)
    step = 1e-5 * rng.normal(size=(40, 3))
    difference = cameras.project(points + step, view) - cameras.project(points - step, view)
    expected = 2 * np.einsum("nij,nj->ni", cameras.jacobian(points, view), step)
    np.testing.assert_allclose(difference, expected, rtol=0, atol=1e-4 * np.abs(expected).max())


def test_coverage_is_the_alpha_that_the_path_tracer_renders() -> None:
    obj, views = sphere(), blank_views(3, SIZE)
    alpha = Renderer(obj, resolution=SIZE).image(environment(), 0.5, 0.5, 64, pose=views[1].pose).mean[..., 3]
    coverage = MeshTracer(obj.vertices, obj.faces).coverage(Cameras(views), 8)
    assert np.abs(coverage[1] - alpha).max() < 0.15  # 64 random samples: 4 standard deviations are 0.25
    assert np.abs(coverage[1] - alpha).mean() < 0.005
    turned = coverage[1][:, ::-1].T  # twin: another frame
    assert np.abs(np.roll(turned, 1, axis=1) - alpha).mean() > 0.005


def test_coverage_takes_few_rays_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Memory does not grow with the views; rows taken apart are the same rows."""
    obj, cameras = sphere(), Cameras(blank_views(3, SIZE))
    traced = MeshTracer(obj.vertices, obj.faces)
    whole, most = traced.coverage(cameras, 2), 5 * SIZE * 4
    meets, rays = MeshTracer.meets, []

    def counted(self: MeshTracer, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
        rays.append(len(origins))
        return meets(self, origins, directions)

    monkeypatch.setattr(MeshTracer, "meets", counted)
    monkeypatch.setattr(tracer, "MOST_RAYS", most)
    np.testing.assert_array_equal(traced.coverage(cameras, 2), whole)
    assert max(rays) <= most
    assert sum(rays) == 3 * SIZE**2 * 4


def test_rays_that_meet_nothing_have_no_coordinates() -> None:
    """Mitsuba leaves there what memory held. One NaN among a pixel's rays took its normal away."""
    obj, cameras = sphere(), Cameras(blank_views(2, SIZE))
    y, x = np.mgrid[:SIZE, :SIZE].reshape(2, -1) + 0.5
    view = np.repeat([0, 1], SIZE**2)
    rays = cameras.rays(np.tile(np.stack([x, y], axis=1), (2, 1)), view)
    face, distance, at = MeshTracer(obj.vertices, obj.faces).first_hits(cameras.center[view], rays)
    assert 0.2 < (face < 0).mean() < 0.8
    assert (distance[face < 0] == np.inf).all()
    assert (at[face < 0] == 0).all()
    assert (at[face >= 0] > 0).any(axis=1).mean() > 0.99


@pytest.mark.parametrize("offset", [0.2, 0.35, 0.8])
def test_soft_masks_place_an_outline_within_a_tenth_of_a_pixel(offset: float) -> None:
    edge = 10 + offset  # the object covers x < edge
    mask = np.clip(edge - np.arange(20, dtype=np.float64), 0, 1)[None].repeat(12, 0)
    found = mask_distance(mask)[6]
    expected = edge - (np.arange(20) + 0.5)
    near = np.abs(expected) < 4
    assert np.abs(found - expected)[near].max() < 0.2
    assert abs((found - expected)[near].mean()) < 0.1
    hard = mask_distance((mask > 0.5).astype(np.float64))[6]  # twin: a binary mask does not know
    assert abs((hard - expected)[near].mean()) > 0.15


def test_the_hull_of_a_sphere_is_a_sphere() -> None:
    views = mask_views(sphere(), 12, SIZE)
    vertices, faces = extract(visual_hull(_masks(views), Cameras(views.seen), 32))
    radius = np.linalg.norm(vertices, axis=1)
    pixel = 4.0 / Cameras(views.seen).focal[0]
    assert np.abs(radius - 1).mean() < 0.35 * pixel
    assert signed_volume(vertices, faces) == pytest.approx(4 / 3 * np.pi, rel=0.06)
    assert len(vertices) - len(mesh_edges(faces)[0]) + len(faces) == 2  # closed, genus 0


def test_masks_that_contradict_each_other_are_refused() -> None:
    views = mask_views(sphere(), 4, SIZE)
    masks = _masks(views)
    masks[2] = 0
    with pytest.raises(UnirenderError, match="no point of the unit sphere lies inside all 4 masks"):
        visual_hull(masks, Cameras(views.seen), 16)


def _lit(views: Views) -> Views:
    seen = tuple(dataclasses.replace(view, image=np.full_like(view.image, 0.5)) for view in views.seen)
    return dataclasses.replace(views, seen=seen)


def _placed_masks(count: int, obj: MeshObject | None = None) -> Views:
    views = _lit(mask_views(obj or sphere(), count, SIZE))
    return placed(views, sphere_of_masks(views))


def test_masks_that_do_not_bound_the_object_are_refused_before_anything_is_written(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Two from opposite sides leave it endless, three bound what is no ball, roughly; six bound a ball."""
    with pytest.raises(
        UnirenderError, match=r"the 2 masks do not bound the object: .* reaches 2(\.\d)? times .*--mesh"
    ):
        optimize(_placed_masks(2), None, OptimizeConfig(), tmp_path / "out")
    assert not (tmp_path / "out").exists()
    with caplog.at_level(logging.WARNING, "unirender"):
        check_masks(_placed_masks(6), 64)
        assert not caplog.text
        check_masks(_placed_masks(3, make_object(0, "train")), 64)
    assert "3 pictures and no mesh: the shape will be rough" in caplog.text
    with pytest.raises(UnirenderError, match=r"reaches 1\.4 times as far"):
        check_reach(1.4, 5)


@pytest.mark.parametrize("moved", [0.06, -0.06, 0.0, 0.004])
def test_a_principal_point_that_the_masks_contradict_is_named(moved: float, caplog: pytest.LogCaptureFixture) -> None:
    views = _lit(mask_views(make_object(0, "train"), 8, SIZE))
    camera = Camera(principal=(0.5 + moved, 0.5))
    views = Views(tuple(dataclasses.replace(view, camera=camera) for view in views.seen))
    with caplog.at_level(logging.WARNING, "unirender"):
        check_masks(placed(views, sphere_of_masks(views)), 64)
    said = f"the masks agree better with cx moved by about {-SIZE * moved:+.0f} pixels: is the principal point right?"
    assert caplog.messages == ([said] if abs(moved) > 0.01 else [])


def test_a_turntable_from_above_says_nothing_of_the_principal_point() -> None:
    """What lies inside its masks grows with `cy`, wherever that is."""
    blank, camera = blank_views(12, 64), Camera()
    ring = [dataclasses.replace(view, pose=pose_towards(30.0 * k, 40.0, camera)) for k, view in enumerate(blank)]
    views = _lit(with_masks(make_object(0, "train"), ring))
    assert shifted_principal(placed(views, sphere_of_masks(views)).seen) is None


def test_a_sheet_says_nothing_of_the_principal_point() -> None:
    obj = make_object(24, "train")
    vertices = obj.vertices * np.array([1, 0.05, 1], np.float32)
    sheet = dataclasses.replace(obj, vertices=vertices / np.linalg.norm(vertices, axis=1).max())
    views = _lit(mask_views(sheet, 8, 64))
    assert shifted_principal(placed(views, sphere_of_masks(views)).seen) is None


def test_a_world_that_is_not_that_of_the_unit_sphere_is_named(tmp_path: Path) -> None:
    for place in (Sphere(np.array([-20.0, 0, 4]), 0.5), Sphere(np.zeros(3), 0.2)):
        views = placed(_placed_masks(6), place)
        with pytest.raises(
            UnirenderError, match=r"expected the unit sphere: .*placed\(views, sphere_of_masks\(views\)\)"
        ):
            optimize(views, None, OptimizeConfig(), tmp_path / "out")
        assert not (tmp_path / "out").exists()
        check_masks(placed(views, sphere_of_masks(views)), 64)


def test_a_camera_inside_the_unit_sphere_is_refused() -> None:
    view = blank_views(1, SIZE)[0]
    pose = view.pose.copy()
    pose[:3, 3] *= 0.1
    with pytest.raises(UnirenderError, match="inside the object's unit sphere"):
        visual_hull(np.ones((1, SIZE, SIZE)), Cameras([dataclasses.replace(view, pose=pose)]), 16)


def test_topology_of_a_tetrahedron() -> None:
    faces = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]])
    edges, sides = mesh_edges(faces)
    assert len(edges) == 6
    assert all(len({*faces[a]} & {*faces[b]}) == 2 for a, b in sides)
    np.testing.assert_allclose(neighbours(4, faces).toarray(), (1 - np.eye(4)) / 3)


def _coverage_slope(vertices: np.ndarray, faces: np.ndarray, moves: np.ndarray, cameras: Cameras) -> np.ndarray:
    """Finite difference of the coverage, from many rays."""
    step = 0.01
    tracer = MeshTracer(vertices + step * moves, faces)
    above = tracer.coverage(cameras, 32)
    tracer.move(vertices - step * moves)
    return (above - tracer.coverage(cameras, 32)) / (2 * step)


@pytest.mark.parametrize("move", ["shift", "bulge"])
def test_the_outlines_derivative_is_the_finite_difference_of_the_coverage(move: str) -> None:
    obj, cameras = _rotated(sphere(subdivisions=3)), Cameras(blank_views(2, SIZE))
    vertices = obj.vertices.astype(np.float64) * 0.9
    moves = {
        "shift": np.broadcast_to([0.6, 0.5, 0.3], vertices.shape),
        "bulge": vertices * np.sin(5 * vertices[:, :1]),
    }[move]
    slope = _coverage_slope(vertices, obj.faces, moves, cameras).ravel()
    edges = outline(vertices, obj.faces, cameras, MeshTracer(vertices, obj.faces), samples=24)
    matrix = edges.matrix(slope.size, len(vertices))
    found = matrix @ moves.ravel()
    error = np.linalg.norm(found - slope) / np.linalg.norm(slope)
    assert error < 0.1, f"relative error {error:.3f} (threshold 0.1)"
    hidden = matrix @ (moves * (np.arange(len(moves)) % 2)[:, None]).ravel()  # twin: half of the vertices move
    assert np.linalg.norm(hidden - slope) / np.linalg.norm(slope) > 0.15


def test_the_fit_finds_the_masks_again() -> None:
    obj = sphere(subdivisions=3)
    views = mask_views(obj, 8, SIZE)
    cameras, masks = Cameras(views.seen), _masks(views)
    dented = obj.vertices * (1 + 0.08 * np.sin(6 * obj.vertices[:, :1]))
    fit = MeshFit(dented.astype(np.float64), obj.faces, masks, cameras)
    errors = [fit.step(0.1) for _ in range(6)]
    assert errors[-1] < 0.25 * errors[0]
    off = np.abs(np.linalg.norm(fit.vertices, axis=1) - 1).mean()
    start = np.abs(np.linalg.norm(dented, axis=1) - 1).mean()
    assert off < 0.35 * start, f"mean distance from the sphere {off:.4f}, {start:.4f} before"
    stiff = MeshFit(dented.astype(np.float64), obj.faces, masks, cameras)  # twin: a plate that does not bend to masks
    assert min(stiff.step(0.1, stiffness=1e6) for _ in range(6)) > 0.5 * errors[0]


def _torus() -> MeshObject:
    import trimesh

    mesh = trimesh.creation.torus(major_radius=0.7, minor_radius=0.3, major_sections=64, minor_sections=32)
    vertices, normals = (np.asarray(part, np.float32) for part in (mesh.vertices, mesh.vertex_normals))
    turn = np.array([[1, 0, 0], [0, 0.8, -0.6], [0, 0.6, 0.8]], np.float32)
    faces = np.asarray(mesh.faces, np.int32)
    return MeshObject("torus", "torus", vertices @ turn, faces, normals @ turn, None, np.full(3, 0.5, np.float32))


@pytest.mark.long
@pytest.mark.slow
def test_reconstruction_of_a_torus_from_masks() -> None:
    torus = _torus()
    views = mask_views(torus, 12, SIZE)
    steps = []
    config = ShapeConfig(cells=32, mask_steps=4)
    found = reconstruct(views, config, lambda step: steps.append(step) or True)
    held_out = Cameras(blank_views(4, SIZE, start_deg=15))
    score = score_shape(found, torus, held_out)
    assert score.mask_iou > 0.97
    assert score.normal_cosine > 0.97
    assert score.chamfer < 0.03
    points, faces, _ = welded(found.vertices, found.faces)
    assert len(points) - len(mesh_edges(faces)[0]) + len(faces) == 0  # genus 1
    assert [step.iteration for step in steps] == [1, 2, 3, 4]
    assert steps[-1].values["mask_rmse"] < steps[0].values["mask_rmse"]
    hull = reconstruct(views, dataclasses.replace(config, mask_steps=0))  # twin: the hull alone
    assert score_shape(hull, torus, held_out).mask_iou < score.mask_iou
    stopped: list[int] = []
    reconstruct(views, config, lambda step: bool(stopped.append(step.iteration)))
    assert stopped == [1]


def test_masks_that_contradict_each_other_a_little_are_told_of(caplog: pytest.LogCaptureFixture) -> None:
    """A pose that belongs to another picture carves away what the others show."""
    views, config = mask_views(_torus(), 8, SIZE), ShapeConfig(cells=24, mask_steps=2)
    reconstruct(views, config)
    assert not caplog.messages  # twin
    wrong = dataclasses.replace(views.seen[2], pose=views.seen[0].pose)
    reconstruct(Views((*views.seen[:2], wrong, *views.seen[3:])), config)
    assert len(caplog.messages) == 1
    assert "the masks contradict each other: what lies inside all of them is not what" in caplog.messages[0]


def test_vertex_normals_of_a_sphere_point_outwards() -> None:
    ball = sphere(subdivisions=4)
    assert (np.einsum("ni,ni->n", vertex_normals(ball.vertices, ball.faces), ball.vertices) > 0.9999).all()


@pytest.mark.parametrize(("name", "value"), [("cells", 4), ("image_weight", 0.0), ("stiffness", -1.0), ("depth", 1)])
def test_options_that_make_no_sense_are_refused(name: str, value: Any) -> None:
    with pytest.raises(UsageError, match=f"--shape.{name.replace('_', '-')} {value:g}: expected"):
        ShapeConfig(**{name: value})
