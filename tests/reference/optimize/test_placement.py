"""Where the object stands: by mesh, by masks; its texture coordinates; predictions laid on it."""

import dataclasses
import functools
import math
from collections.abc import Callable

import numpy as np
import pytest
from optimizer_runs import rendered_views, truth
from reference_scenes import sphere

from unirender.camera import Camera
from unirender.errors import UnirenderError
from unirender.intrinsics import Intrinsics
from unirender.light.environment import rotate_environment
from unirender_reference.multiview import orbit, pose_towards
from unirender_reference.optimize.files.transforms import Y_UP, Up
from unirender_reference.optimize.multiview.warm import solution_from_predictions
from unirender_reference.optimize.shape.cameras import Cameras
from unirender_reference.optimize.shape.hull import visual_hull
from unirender_reference.optimize.shape.placement import check_alignment, check_in_picture, placed, sphere_of_masks
from unirender_reference.optimize.shape.uv import charted, has_own_texels
from unirender_reference.optimize.solution import Solution
from unirender_reference.optimize.views import View, Views
from unirender_reference.shapes import MeshObject, Sphere, make_object


@functools.cache
def pictures(side: int = 32, seed: int = 3) -> Views:
    """Six pictures of an object, and one held out."""
    return rendered_views(truth(seed), seen=6, held_out=1, side=side)


@pytest.fixture(scope="module")
def solution() -> Solution:
    return truth()


@pytest.fixture(scope="module")
def views() -> Views:
    return pictures()


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


def turned(obj: MeshObject, axis: int, quarters: int) -> MeshObject:
    """The mesh, turned about a coordinate axis."""
    turn = np.eye(3)
    first, second = (axis + 1) % 3, (axis + 2) % 3
    cosine, sine = [(0, 1), (-1, 0), (0, -1)][quarters - 1]
    turn[[first, first, second, second], [first, second, first, second]] = cosine, -sine, sine, cosine
    return dataclasses.replace(
        obj,
        vertices=(obj.vertices @ turn.T).astype(np.float32),
        normals=(obj.normals @ turn.T).astype(np.float32),
    )


def with_masks(views: Views, change: Callable[[np.ndarray], np.ndarray]) -> Views:
    seen = tuple(dataclasses.replace(view, mask=change(view.mask)) for view in views.seen)
    return dataclasses.replace(views, seen=seen)


def from_opencv(views: Views) -> Views:
    """The poses as OpenCV writes them: +y down, +z forward."""
    flip = np.diag([1, -1, -1, 1]).astype(np.float32)
    return dataclasses.replace(
        views, seen=tuple(dataclasses.replace(view, pose=view.pose @ flip) for view in views.seen)
    )


def test_a_mesh_that_lies_elsewhere_is_refused(views: Views, solution: Solution):
    check_alignment(views, solution.obj)
    for place in (Sphere(np.array([1.5, 0, 0]), 1.0), Sphere(np.zeros(3), 0.4), Sphere(np.zeros(3), 2.0)):
        with pytest.raises(UnirenderError, match="IoU"):
            check_alignment(placed(views, place), solution.obj)


def test_a_single_pose_that_is_wrong_is_named(caplog: pytest.LogCaptureFixture):
    """The others hide it in the IoU of all; a mask that shows nothing, or is wrong by half a pixel, is not named."""
    views, mesh = pictures(64, 3), truth(3).obj
    faint = dataclasses.replace(views.seen[0], mask=np.zeros_like(views.seen[0].mask))
    rounded = dataclasses.replace(views.seen[1], mask=np.round(views.seen[1].mask))
    check_alignment(Views((faint, rounded, *views.seen, *views.seen)), mesh)
    assert not caplog.messages
    turned_off = dataclasses.replace(views.seen[3], pose=views.seen[5].pose)
    check_alignment(Views((turned_off, *views.seen, *views.seen[1:])), mesh)
    assert [message.split(":")[0] for message in caplog.messages] == [
        f"the mesh covers other pixels than the mask in 1 of 12 pictures ({turned_off.name})"
    ]


@pytest.mark.parametrize("side", [24, pytest.param(64, marks=pytest.mark.long)])
def test_a_mesh_in_other_axes_is_refused(side: int):
    """Turned by quarters about each axis, at any size (an object that is nearly round about an axis is not)."""
    views, solution = pictures(side, 5), truth(5)
    check_alignment(views, solution.obj)
    for axis in (0, 1, 2):
        for quarters in (1, 2, 3):
            with pytest.raises(
                UnirenderError, match=r"IoU .* 0\.\d\d, expected at least 0\.\d\d; (turned so that|with --up z)"
            ):
                check_alignment(views, turned(solution.obj, axis, quarters))


def test_the_axis_that_is_up_is_advised_where_it_is_the_cause(views: Views, solution: Solution):
    """Poses with +z up and a mesh with +y up, off the world's origin; and --up z for poses that need none."""
    place, other = Sphere(np.array([3.0, -2.0, 1.0]), 0.5), truth(5)
    given = pictures(24, 5)
    cases: list[tuple[np.ndarray, Up, str]] = [
        (Y_UP.T, "y", r"; with --up z .* would be (0\.9|1\.0)"),
        (Y_UP, "z", r"; without --up z .* would be (0\.9|1\.0)"),
    ]
    for turn, up, advice in cases:
        world = away(given, place)
        wrong = tuple(dataclasses.replace(view, pose=(turn @ view.pose).astype(np.float32)) for view in world.seen)
        with pytest.raises(UnirenderError, match=advice):
            check_alignment(placed(Views(wrong), place), other.obj, place, up)
        check_alignment(placed(world, place), other.obj, place, up)


@pytest.mark.parametrize(
    ("size", "center", "message"),
    [
        (0.01, (0, 0, 0), r"the object is about 0\.0\d+ times as large as the mesh: .* units"),
        (100, (0, 0, 0), r"the object is about [89]\d times as large as the mesh"),
        (1, (10, 0, 0), r"it lies about \((10|9\.9)\d*, \S+, \S+\), the mesh about \(0, 0, 0\) in the poses' units"),
        (2, (0, 6, 0), r"about (1\.[89]|2)\d* times as large as the mesh and it lies about \(\S+, [56]"),
    ],
)
def test_another_size_or_place_is_named(
    views: Views, solution: Solution, size: float, center: tuple[float, ...], message: str
):
    """Of the object in the pictures, where the mesh is that of the unit sphere; and --up z is not advised."""
    with pytest.raises(UnirenderError, match=message) as caught:
        check_alignment(away(views, Sphere(np.array(center, np.float64), size)), solution.obj)
    assert "--up z" not in str(caught.value)


@pytest.mark.parametrize("side", [8, 32])
def test_a_wrong_size_of_the_pictures_is_refused_at_any_size(solution: Solution, side: int):
    """w and h twice as large as the pictures are: half the focal length, and a centre at a quarter."""
    views = pictures(side)
    half = math.tan(math.radians(Camera().fov_deg / 2))
    for camera, message in (
        (Camera(math.degrees(2 * math.atan(half * 2)), (0.25, 0.25)), "principal point lies at 0.25 of the width"),
        (
            Camera(math.degrees(2 * math.atan(half * 2))),
            "times as large as the mesh: .* field of view" if side > 8 else "is it another mesh, or a field of view",
        ),
    ):
        wrong = tuple(dataclasses.replace(view, camera=camera) for view in views.seen)
        with pytest.raises(UnirenderError, match=message):
            check_alignment(Views(wrong), solution.obj)
    check_alignment(views, solution.obj)


def test_nothing_far_away_passes_in_small_pictures(solution: Solution):
    """The demand is that of the masks, whatever the mesh covers."""
    for side in (8, 24):
        views = pictures(side)
        for place in (Sphere(np.array([10.0, 0, 0]), 1.0), Sphere(np.zeros(3), 100.0), Sphere(np.zeros(3), 0.01)):
            with pytest.raises(UnirenderError, match=r"expected at least 0\.[5-7]"):
                check_alignment(placed(views, place), solution.obj)


@pytest.mark.parametrize("change", ["rounded", "grown", "shrunk", "shifted"])
def test_a_mesh_passes_with_masks_that_are_slightly_wrong(solution: Solution, change: str):
    """By half a pixel, in pictures of 24 pixels; by two pixels it does not."""
    views = pictures(24)
    wrong = {
        "rounded": lambda mask: np.round(mask),
        "grown": lambda mask: np.ceil(mask),
        "shrunk": lambda mask: np.floor(mask + 1e-3),
        "shifted": lambda mask: (mask + np.roll(mask, 1, axis=1)) / 2,
    }
    check_alignment(with_masks(views, wrong[change]), solution.obj)
    with pytest.raises(UnirenderError, match="IoU"):
        check_alignment(with_masks(views, lambda mask: np.roll(mask, 2, axis=1)), solution.obj)


def test_poses_in_the_axes_of_opencv_are_named(views: Views, solution: Solution):
    with pytest.raises(UnirenderError, match=r"OpenCV's axes .*negate columns 2 and 3 .*: it would be"):
        check_alignment(from_opencv(views), solution.obj)
    with pytest.raises(UnirenderError, match=r"6 of 6 cameras look away from it: .*negate columns 2 and 3"):
        check_alignment(with_masks(from_opencv(views), lambda mask: np.roll(mask, 20, axis=1)), solution.obj)
    with pytest.raises(UnirenderError, match=r"behind 6 of 6 cameras .*negate columns 2 and 3"):
        sphere_of_masks(from_opencv(views))
    with pytest.raises(UnirenderError, match="no point of the unit sphere lies inside all 6 masks"):
        visual_hull(np.stack([view.mask[..., 0] for view in views.seen]), Cameras(from_opencv(views).seen), 16)


@pytest.mark.parametrize("up", ["y", "z"])
def test_poses_of_another_convention_are_named(views: Views, solution: Solution, up: Up):
    """Of a mesh that stands away from the origin, in a world whose unit is not its radius."""
    place = Sphere(np.array([0.3, -0.2, 0.5]), 2.5)
    world = np.eye(4) if up == "y" else Y_UP
    flip = np.diag([1, -1, -1, 1])

    def given(convention: Callable[[np.ndarray], np.ndarray]) -> Views:
        """The views as they are read from poses of a convention."""

        def pose(view: View) -> np.ndarray:
            own = view.pose.astype(np.float64)
            own[:3, 3] = place.center + place.radius * own[:3, 3]
            return (world @ convention(world.T @ own)).astype(np.float32)

        seen = tuple(dataclasses.replace(view, pose=pose(view)) for view in views.seen)
        return placed(dataclasses.replace(views, seen=seen), place)

    check_alignment(given(lambda pose: pose), solution.obj, place, up)
    for convention, said in (
        (lambda pose: pose @ flip, r"OpenCV's axes \(\+z forward\)\? then negate .*: it would be"),
        (np.linalg.inv, r"world to camera\? then invert each transform_matrix: it would be"),
        (lambda pose: flip @ np.linalg.inv(pose), r"as COLMAP's images.txt has them\? then invert"),
    ):
        with pytest.raises(UnirenderError, match=said):
            check_alignment(given(convention), solution.obj, place, up)


def test_a_view_without_the_object_does_not_move_its_place(views: Views):
    """Neither an empty mask nor a faint one; the other views say the same as without it."""
    rest = dataclasses.replace(views, seen=views.seen[1:])
    for share in (0.0, 0.4):
        blank = dataclasses.replace(views.seen[0], mask=views.seen[0].mask * share)
        found = sphere_of_masks(dataclasses.replace(views, seen=(blank, *rest.seen)))
        np.testing.assert_allclose(found.center, sphere_of_masks(rest).center, atol=1e-9)
        assert found.radius == pytest.approx(sphere_of_masks(rest).radius)


def test_masks_without_an_outline_are_refused(views: Views, solution: Solution):
    opaque = with_masks(views, np.ones_like)
    for look in (sphere_of_masks, lambda given: check_alignment(given, solution.obj)):
        with pytest.raises(UnirenderError, match=r"covers the whole frame in 6 pictures .*view 0.*, .*mask_path"):
            look(opaque)


def test_a_close_up_that_cuts_the_object_off_needs_its_mesh(views: Views, solution: Solution):
    def cut(view: View) -> View:
        camera = dataclasses.replace(view.camera, principal=(16 / 20, 0.5))
        return View(view.image[:, :20], view.mask[:, :20], camera, view.pose, view.name)

    near = Views(tuple(map(cut, views.seen)))
    check_alignment(near, solution.obj)
    with pytest.raises(UnirenderError, match=r"cuts the object off in 6 of 6 pictures .*view 0.* pass the mesh"):
        sphere_of_masks(near)


def test_a_mesh_before_one_picture(solution: Solution):
    """The first view is the contract's."""
    mask = rendered_views(solution, 1, 0, 64).seen[0].mask
    check_in_picture(mask, Camera(), solution.obj)
    for mesh, fov in ((turned(solution.obj, 0, 1), 36.0), (sphere(), 36.0)):
        with pytest.raises(UnirenderError, match=r"IoU .* does it face the camera"):
            check_in_picture(mask, Camera(fov), mesh)


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
