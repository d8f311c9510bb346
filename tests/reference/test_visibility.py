"""Traced visibility against the closed form of two squares that meet, and what a data set of it holds."""

import io
import json
from pathlib import Path

import numpy as np
import pytest
import webdataset
from inline_executor import Inline

from unirender.errors import UnirenderError
from unirender.light.environment import environment_directions
from unirender_reference.commands import Dataset
from unirender_reference.dataset import generate
from unirender_reference.dataset_config import DatasetConfig
from unirender_reference.render import Renderer
from unirender_reference.shapes import MeshObject
from unirender_reference.visibility import COVERED, DIRECTIONS, trace_visible

FOLD, EDGE, HALF_HEIGHT = np.array([0, -0.866]), np.array([0.75, 0.433]), 0.5  # (x, z) of the fold and the right end
SIZE = 24


def gutter() -> MeshObject:
    """Two rectangles that meet in a line far from the viewer, mirrored about x = 0."""
    corners, faces, normals = [], [], []
    for side in (-1, 1):
        first = len(corners)
        for x, z in (FOLD, EDGE):
            corners += [(side * x, -HALF_HEIGHT, z), (side * x, HALF_HEIGHT, z)]
        faces += [(first, first + 2, first + 3), (first, first + 3, first + 1)][:: 1 if side > 0 else -1]
        dx, dz = EDGE - FOLD
        normals += [np.array([-side * dz, 0, dx]) / np.hypot(dx, dz)] * 4
    as_float = [np.asarray(values, np.float32) for values in (corners, normals)]
    return MeshObject(
        name="gutter",
        family="mesh",
        vertices=as_float[0],
        faces=np.asarray(faces, np.int32),
        normals=as_float[1],
        uv=None,
        albedo=np.full(3, 0.5, np.float32),
    )


def meets_the_other(point: np.ndarray, towards: np.ndarray) -> np.ndarray:
    """Whether rays from a point of one rectangle meet the other one."""
    side = -np.sign(point[0])
    along = np.array([side * EDGE[0], EDGE[1]]) - FOLD
    x, z = towards[:, 0], towards[:, 2]
    # point + t towards = FOLD + u along, in the plane of x and z
    determinant = along[0] * z - along[1] * x
    dx, dz = FOLD[0] - point[0], FOLD[1] - point[2]
    with np.errstate(divide="ignore", invalid="ignore"):
        t = (along[0] * dz - along[1] * dx) / determinant
        u = (x * dz - z * dx) / determinant
    return (t > 0) & (u > 0) & (u < 1) & (np.abs(point[1] + t * towards[:, 1]) < HALF_HEIGHT)


def test_what_a_gutter_hides_is_what_its_other_side_covers() -> None:
    renderer = Renderer(gutter(), resolution=SIZE)
    maps = renderer.geometry(25).require("normal", "mask")
    surface = maps["mask"][..., 0] >= COVERED
    visible = trace_visible(renderer, surface, seed=1)
    assert visible.shape == (surface.sum(), DIRECTIONS[0] * DIRECTIONS[1])
    directions = environment_directions(*DIRECTIONS).reshape(-1, 3)
    rays, eye = renderer.camera.rays(SIZE, SIZE), np.array([0, 0, renderer.camera.distance()])
    agree, hidden = [], []
    for number, (row, column) in enumerate(np.argwhere(surface)):
        ray, n = rays[row, column], maps["normal"][row, column]
        if maps["mask"][row, column] < 1 or abs(ray[0]) < 0.03:
            continue  # an end, or the fold
        on_plane = np.array([0, 0, FOLD[1]])
        point = eye + ray * ((on_plane - eye) @ n / (ray @ n))
        above = directions @ n > 0.1
        expected = meets_the_other(point, directions)
        agree.append((visible[number] == ~expected)[above].mean())
        hidden.append(expected[above].mean())
    assert np.mean(hidden) > 0.1  # the twin: something is hidden
    assert np.mean(agree) > 0.97, np.mean(agree)
    again = trace_visible(renderer, surface, seed=1)
    assert np.array_equal(visible, again)


def box() -> MeshObject:
    """Seen from the front: its front face alone, whose edges cut pixels in parts."""
    corners, faces, normals = [], [], []
    half = np.array([0.62, 0.54, np.sqrt(1 - 0.62**2 - 0.54**2)])
    for axis in range(3):
        for side in (-1, 1):
            u, v = np.roll(np.eye(3), -axis, axis=0)[1:]  # with n = axis a right-handed frame
            n, first = side * np.eye(3)[axis], len(corners)
            corners += [(n + a * u + side * b * v) * half for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
            normals += [n] * 4
            faces += [(first, first + 1, first + 2), (first, first + 2, first + 3)]
    return MeshObject(
        name="box",
        family="mesh",
        vertices=np.asarray(corners, np.float32),
        faces=np.asarray(faces, np.int32),
        normals=np.asarray(normals, np.float32),
        uv=None,
        albedo=np.full(3, 0.5, np.float32),
    )


def test_what_misses_the_object_along_its_silhouette_does_not_count() -> None:
    renderer = Renderer(box(), resolution=SIZE)
    mask = renderer.geometry(25).require("mask")["mask"][..., 0]
    surface = mask >= COVERED
    visible = trace_visible(renderer, surface, seed=1)
    z = environment_directions(*DIRECTIONS).reshape(-1, 3)[:, 2]
    edge = mask[surface] < 0.9
    assert edge.mean() > 0.1  # of the front face, two thirds of each pixel
    for pixels in (edge, ~edge):
        assert visible[pixels][:, z > 0.01].all()
        assert not visible[pixels][:, z < -0.01].any()
    corner = np.zeros_like(surface)
    corner[0, 0] = True  # of the picture, where nothing is
    assert trace_visible(renderer, corner, seed=1).all()


def test_a_data_set_of_it_is_read_back(tmp_path: Path) -> None:
    command = Dataset(out=tmp_path / "data", vary="visibility", objects=2, resolution=16, workers=1, turn_objects=True)
    generate(command.check(), executor=Inline())
    assert command.run() == 0  # finds all there
    urls = [str(path) for path in sorted((tmp_path / "data").glob("*.tar"))]
    groups = list(webdataset.WebDataset(urls, shardshuffle=False))  # pyright: ignore[reportAttributeAccessIssue] - exported lazily
    assert len(groups) == 2
    for group in groups:
        assert set(group) - {"__key__", "__url__", "__local_path__"} == {"shared.exr", "visible.npy", "json"}
        bits = np.load(io.BytesIO(group["visible.npy"]))
        record = json.loads(group["json"])
        assert bits.shape[1] * 8 == record["directions"][0] * record["directions"][1]
        assert len(bits) == pytest.approx(record["coverage"] * 16**2, rel=0.2)
        assert record["vary"] == "visibility"
    first = (tmp_path / "data" / "shard-000000.tar").read_bytes()
    again = DatasetConfig(2, 1, 16, "visibility", tmp_path / "again", workers=1, turn_objects=True)
    generate(again, executor=Inline())
    assert (tmp_path / "again" / "shard-000000.tar").read_bytes() == first


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"pairs": 3}, "leave --pairs out"),
        ({"denoise": True}, "--denoise: got it with --vary visibility"),
        ({"noise_floor": 40.0}, "--noise-floor: got it with --vary visibility"),
    ],
)
def test_what_it_has_no_use_for_is_refused(change: dict[str, object], named: str, tmp_path: Path) -> None:
    with pytest.raises(UnirenderError, match=named):
        DatasetConfig(**{"objects": 1, "pairs": 1, "resolution": 16, "vary": "visibility", "out": tmp_path} | change)  # pyright: ignore[reportArgumentType] - from tests
