"""`unirender optimize`: folders in other units with and without a mesh, pictures, and what it refuses."""

import dataclasses
import errno
import json
import logging
import os
import shutil
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
import tyro
from optimizer_runs import rendered_views, truth
from PIL import Image

from unirender.camera import Camera
from unirender.color import image_srgb, srgb_decode, unpremultiply
from unirender.errors import UnirenderError, UsageError
from unirender.exr import channels_rgb, image_channels, read_exr, write_exr
from unirender.files import read_result, write_result
from unirender.intrinsics import MAPS, Intrinsics
from unirender.system.machine import memory_bytes
from unirender.visualization import write_png
from unirender_reference.meshes import load_mesh_placed
from unirender_reference.optimize.commands import Optimize
from unirender_reference.optimize.files.export import write_solution
from unirender_reference.optimize.files.folder import write_views
from unirender_reference.optimize.machine import require_cores, require_memory
from unirender_reference.optimize.shape.placement import placed
from unirender_reference.optimize.single.config import COLD_NORMALS
from unirender_reference.optimize.single.picture import PictureInput, read_normals, read_picture_input, unit_normals
from unirender_reference.optimize.single.pixels import make_picture
from unirender_reference.optimize.single.render import rerendered
from unirender_reference.optimize.solution import Solution
from unirender_reference.optimize.views import View, Views
from unirender_reference.shapes import Sphere

PLACE = Sphere(np.array([4.0, 1.0, -2.0]), 0.5)  # where the object stands in the user's units
QUICK = [
    *("--refine.iterations", "2", "--refine.spp", "2", "--refine.spp-gradient", "2", "--refine.depth", "2"),
    *("--no-progress", "--texture-size", "16", "--light-rows", "8", "--transport.no-enabled"),
]

FEW = [
    *("--fov", "36", "--no-progress", "--single.light-rows", "8"),
    *("--single.steps", "1", "--single.noise", "0.1", "--single.fine-steps", "1"),
]


@pytest.fixture(scope="module")
def solution() -> Solution:
    return truth()


def write_one(solution: Solution, path: Path, side: int) -> View:
    """One picture of the object, as PNG with its mask."""
    view = rendered_views(solution, 1, 0, side).seen[0]
    write_png(path, np.concatenate([view.image, view.mask], axis=-1))
    return view


@pytest.fixture(scope="module")
def data(solution: Solution, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of pictures and `mesh.glb`, in units of their own."""
    folder = tmp_path_factory.mktemp("data")
    views = placed(rendered_views(solution, seen=6, held_out=1, side=24), inverse(PLACE))
    write_views(views, folder / "views")
    write_solution(solution, folder, PLACE)
    return folder


def inverse(place: Sphere) -> Sphere:
    return Sphere(-place.center / place.radius, 1 / place.radius)


def command(*arguments: str | Path) -> Optimize:
    return tyro.cli(Optimize, args=[*map(str, arguments)])


@pytest.mark.long
def test_a_folder_with_its_mesh(data: Path, solution: Solution, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    out = tmp_path / "out"
    assert command(data / "views", "--mesh", data / "mesh.glb", "--out", out, *QUICK).run() == 0
    said = capsys.readouterr().out
    assert "6 views" in said
    assert "held_out" in said
    files = {path.name for path in out.iterdir()}
    assert files == {
        *("mesh.glb", "environment.exr", "latlong.exr", "solution.json", "history.jsonl", "mitsuba", "state"),
        *("views.png", "turntable.png", "loss.png"),
    }
    record = json.loads((out / "solution.json").read_text())
    assert record["views"] == {"seen": 6, "held_out": 1, "hdr": False}
    assert f"IoU of the masks: {record['mask_iou']:.3f}" in said
    assert record["config"]["refine"]["iterations"] == 2
    assert [row["stage"] for row in record["stages"]] == ["refine"]
    obj, place = load_mesh_placed(out / "mesh.glb")
    np.testing.assert_allclose(
        obj.vertices[obj.faces] * place.radius + place.center,
        solution.obj.vertices[solution.obj.faces] * PLACE.radius + PLACE.center,
        atol=1e-5,
    )
    assert Image.open(out / "turntable.png").width > 600
    assert command(data / "views", "--mesh", data / "mesh.glb", "--out", out, *QUICK).run() == 0  # again: all there
    assert capsys.readouterr().out == said


@pytest.mark.long
def test_a_folder_without_a_mesh(data: Path, solution: Solution, tmp_path: Path):
    """The reconstruction stands where the object stood, in the units of the poses."""
    out = tmp_path / "out"
    quick = [*QUICK, "--shape.cells", "24", "--shape.mask-steps", "2", "--shape.image-steps", "1", "--no-pictures"]
    assert command(data / "views", "--out", out, "--shape-rounds", "1", *quick).run() == 0
    record = json.loads((out / "solution.json").read_text())
    assert [row["stage"] for row in record["stages"]] == ["shape", "refine", "reshape-1", "refine-1"]
    obj, place = load_mesh_placed(out / "mesh.glb")
    found = obj.vertices * place.radius + place.center
    true = solution.obj.vertices * PLACE.radius + PLACE.center
    for k in (0, 1):
        bounds = [np.quantile(points, (0.02, 0.98), axis=0)[k] for points in (found, true)]
        np.testing.assert_allclose(*bounds, atol=0.25 * PLACE.radius)


@pytest.mark.slow
def test_a_warm_start_takes_the_place_of_the_transport(data: Path, tmp_path: Path):
    calls = []

    def predict(image, mask, camera) -> Intrinsics:
        calls.append(camera)
        one = np.ones_like(mask)
        light = np.full((16, 32, 3), 0.4, np.float32)
        return Intrinsics(0.3 * np.repeat(one, 3, -1), roughness=0.6 * one, metallic=0.1 * one, environment=light)

    chosen = command(
        data / "views", "--mesh", data / "mesh.glb", "--out", tmp_path / "o", "--init", "unirender", *QUICK
    )
    off = dataclasses.replace(chosen.config, refine=dataclasses.replace(chosen.config.refine, enabled=False))
    assert dataclasses.replace(chosen, config=off, pictures=False).run(predict) == 0
    assert len(calls) == 6
    environment = channels_rgb(read_exr(tmp_path / "o/environment.exr")[0])
    np.testing.assert_allclose(environment, np.full((8, 16, 3), 0.4), rtol=1e-5)
    obj, _ = load_mesh_placed(tmp_path / "o/mesh.glb")
    assert obj.roughness is not None
    np.testing.assert_allclose(obj.roughness, 0.6, atol=0.003)
    with pytest.raises(UnirenderError, match="no model at hand"):
        dataclasses.replace(chosen, out=tmp_path / "p").run()


def test_every_option_reaches_what_it_is_for(
    data: Path, solution: Solution, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """Each with another value than its default, up to the call that takes it."""
    one, mesh, out = tmp_path / "one.png", data / "mesh.glb", tmp_path / "out"

    def taken_by(function: str, *arguments: str | Path) -> tuple[tuple[Any, ...], dict[str, Any]]:
        calls = []

        def stop(*given: Any, **named: Any) -> None:
            calls.append((given, named))
            raise UnirenderError("far enough")

        with monkeypatch.context() as patch:
            patch.setattr(f"unirender_reference.optimize.{function}", stop)
            with pytest.raises(UnirenderError, match="far enough"):
                command(*arguments, "--out", out).run()
        return calls[0]

    folder = ["--up", "z", "--hold-out", "3", "--most-views", "4", "--size", "12"]
    given, named = taken_by("files.folder.read_views", data / "views", *folder)
    assert (given, named) == ((data / "views",), {"up": "z", "hold_out": 3, "most_views": 4, "longest_side": 12})
    options = ["--mesh", mesh, "--threads", "1", "--no-pictures", *QUICK]
    given, named = taken_by("multiview.run.optimize", data / "views", *options)
    assert (given[2].refine.iterations, given[3], named["pictures"], named["threads"]) == (2, out, False, 1)

    write_one(solution, one, 12)
    known = ["--mask", "m.png", "--fov", "40", "--normal", "n.png", "--size", "10"]
    given, _ = taken_by("single.picture.read_picture_input", one, *known)
    assert given == (one, Path("m.png"), 40, Path("n.png"), 10)
    options = ["--mesh", mesh, "--fov", "40", "--single.light-rows", "12"]
    given, named = taken_by("single.run.optimize_image", one, *options)
    assert (given[2].fov_deg, given[3].light_rows, named["hdr"], named["init"]) == (40, 12, False, None)
    assert len(named["geometry"].faces) == len(solution.obj.faces)
    assert not out.exists()


def test_a_mesh_in_other_units_is_refused(data: Path, solution: Solution, tmp_path: Path):
    write_solution(solution, tmp_path, Sphere(np.zeros(3), 1.0))
    with pytest.raises(UnirenderError, match=r"IoU .* do its units and axes, and the masks, belong to the poses"):
        command(data / "views", "--mesh", tmp_path / "mesh.glb", "--out", tmp_path / "out", *QUICK).run()
    assert not (tmp_path / "out").exists()


def test_a_mesh_that_the_picture_does_not_show_is_refused(solution: Solution, tmp_path: Path):
    view = write_one(solution, tmp_path / "one.png", 24)
    write_png(tmp_path / "open.png", view.image)
    trimesh.creation.box((1, 1, 1)).export(tmp_path / "cube.obj")
    write_solution(solution, tmp_path)
    for picture, mesh in (("one.png", "cube.obj"), ("open.png", "mesh.glb")):
        with pytest.raises(UnirenderError, match=r"IoU .* do --fov and --mask .* belong to the picture"):
            command(tmp_path / picture, "--mesh", tmp_path / mesh, "--out", tmp_path / "out").run()
        assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("mesh", [True, False])
def test_poses_in_other_axes_leave_nothing_behind(data: Path, tmp_path: Path, mesh: bool):
    """As OpenCV and COLMAP write them."""
    shutil.copytree(data / "views", tmp_path / "views")
    path = tmp_path / "views/transforms.json"
    content = json.loads(path.read_text())
    for frame in content["frames"]:
        frame["transform_matrix"] = (np.array(frame["transform_matrix"]) @ np.diag([1, -1, -1, 1])).tolist()
    path.write_text(json.dumps(content))
    given = ["--mesh", data / "mesh.glb"] if mesh else []
    with pytest.raises(UnirenderError, match="negate columns 2 and 3"):
        command(tmp_path / "views", *given, "--out", tmp_path / "out", *QUICK).run()
    assert not (tmp_path / "out").exists()


def test_linear_pictures_are_not_for_the_model(solution: Solution, data: Path, tmp_path: Path):
    views = rendered_views(solution, 2, 0, 12, hdr=True)
    write_views(Views(views.seen, (), True), tmp_path / "hdr")
    write_solution(solution, tmp_path)
    chosen = command(tmp_path / "hdr", "--mesh", tmp_path / "mesh.glb", "--out", tmp_path / "o", "--init", "unirender")
    with pytest.raises(UsageError, match="the model sees display pictures"):
        chosen.run(lambda image, mask, camera: Intrinsics())
    assert not (tmp_path / "o").exists()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--mask", "m.png"], "--mask: of one picture"),
        (["--overwrite", "--fov", "40"], "--fov, --overwrite: of one picture"),
        (["--size", "4"], "--size 4: expected 8 or more"),
        (["--most-views", "0"], "--most-views 0: expected 1 or more"),
        (["--hold-out", "1"], "^--hold-out 1: expected 2 or more"),
        (["--threads", "-1"], "^--threads -1: expected 0 or more"),
        (["--texture-size", "2"], "--texture-size 2: expected 4 or more"),
        (["--light-rows", "9"], "--light-rows 9: expected an even number"),
        (["--single.seed", "3", "--single.light-rows", "8"], "--single.light-rows, --single.seed: of one picture"),
        *((["--fov", degrees], f"--fov {degrees}: expected degrees between 0 and 180") for degrees in ("0", "200")),
        *(
            ([f"--{name}", value], f"--{name} {value}: expected {expected}")
            for name, value, expected in (
                ("refine.iterations", "-3", "0 or more"),
                ("refine.spp", "0", "1 or more"),
                ("refine.depth", "0", "2 or more"),
                ("refine.albedo-levels", "0", "1 or more"),
                ("refine.held-out-every", "-1", "0 or more"),
                ("refine.decay", "-1", "more than 0"),
                ("refine.light-rate", "nan", "0 or more"),
                ("save-seconds", "-1", "0 or more"),
                ("transport.pixels", "0", "16 or more"),
                ("transport.smooth-light", "-1", "0 or more"),
            )
        ),
        (["--transport.correction-spp", "0"], "--transport.correction-spp 0: spp: got 0 in 1 batches"),
        (["--transport.correction-spp", "257"], "--transport.correction-spp 257: .* use 256"),
    ],
)
def test_wrong_command_lines_of_a_folder(data: Path, tmp_path: Path, arguments: list[str], message: str):
    with pytest.raises(UsageError, match=message):
        command(data / "views", "--out", tmp_path / "out", *arguments).run()
    assert not (tmp_path / "out").exists()


def test_a_mesh_leaves_nothing_to_reconstruct(data: Path, tmp_path: Path):
    """An option without effect would yet make it another run."""
    given = [data / "views", "--out", tmp_path / "out", "--shape.cells", "32", "--shape-rounds", "1"]
    with pytest.raises(UsageError, match=r"^--shape\.cells, --shape-rounds: of the reconstruction, but --mesh"):
        command(*given, "--mesh", data / "mesh.glb").run()
    command(*given).check()  # the twin


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--threads", str((os.cpu_count() or 1) + 1)], rf"expected at most {os.cpu_count()}, the cores"),
        (["--texture-size", "1000000"], r"--texture-size 1000000: would take about [\d,]+ GiB of memory"),
        (["--light-rows", "9998"], r"--light-rows 9998: would take about [\d,]+ GiB"),
        (["--light-rows", "1000000", "--transport.no-enabled"], r"--light-rows 1000000: would take about"),
    ],
)
def test_more_than_the_machine_has(data: Path, tmp_path: Path, arguments: list[str], message: str):
    with pytest.raises(UnirenderError, match=message) as refused:
        command(data / "views", "--mesh", data / "mesh.glb", "--out", tmp_path / "out", *arguments).run()
    assert not isinstance(refused.value, UsageError)  # a larger machine could do it
    assert not (tmp_path / "out").exists()


def test_all_that_the_machine_has_may_be_asked_for(monkeypatch: pytest.MonkeyPatch):
    require_cores(os.cpu_count() or 1)
    present = memory_bytes()
    assert present > 2**30
    require_memory({"--texture-size 8": 0.99 * present})
    with pytest.raises(UnirenderError, match="--light-rows 8"):
        require_memory({"--texture-size 8": 0.99 * present, "--light-rows 8": 1.01 * present})
    monkeypatch.setattr(os, "sysconf_names", {}, raising=False)
    require_memory({"--texture-size 8": 1e30})  # a system that does not tell


def test_wrong_command_lines_of_a_picture(tmp_path: Path):
    write_png(tmp_path / "one.png", np.ones((12, 12, 4)))
    for arguments, message in (
        (["--up", "z"], "--up: of a folder"),
        (["--hold-out", "3"], "--hold-out: of a folder"),
        (["--seed", "7", "--refine.iterations", "9"], "--refine.iterations, --seed: of a folder"),
        (["--shape.cells", "9", "--no-pictures"], "--pictures, --shape.cells: of a folder"),
    ):
        with pytest.raises(UsageError, match=message):
            command(tmp_path / "one.png", "--out", tmp_path / "out", *arguments).run()
    (tmp_path / "transforms.json").write_text("{}")
    with pytest.raises(UsageError, match="is a file of poses, expected its folder"):
        command(tmp_path / "transforms.json", "--out", tmp_path / "out").run()
    with pytest.raises(UnirenderError, match="no such file or folder"):
        command(tmp_path / "two", "--up", "z", "--out", tmp_path / "out").run()


def test_of_a_reduced_picture_the_mean_of_a_clipped_value_is_a_lower_bound(tmp_path: Path):
    image = np.full((8, 8, 3), 0.5)
    image[2, 2, 0] = 1
    write_png(tmp_path / "one.png", image)
    given = read_picture_input(tmp_path / "one.png", longest_side=4)
    assert given.image[1, 1, 0] < 0.8
    facing = np.broadcast_to(np.array([0, 0, 1], np.float32), (4, 4, 3))
    linear = srgb_decode(given.image)
    seen = make_picture(linear, given.mask, given.camera, {"normal": facing}, None, 16, (4, 8), False, 0, given.clipped)
    expected = np.zeros((4, 4, 3), bool)
    expected[1, 1, 0] = True
    np.testing.assert_array_equal(seen.saturated.reshape(4, 4, 3), expected)
    plain = make_picture(linear, given.mask, given.camera, {"normal": facing}, None, 16, (4, 8), False, 0)
    assert not plain.saturated.any()


def test_a_picture_with_what_is_known_of_it(tmp_path: Path, caplog: pytest.LogCaptureFixture):
    rng = np.random.default_rng(0)
    write_png(tmp_path / "one.png", rng.random((12, 16, 3)))
    normals = rng.normal(size=(12, 16, 3)) + np.array([0, 0, 2])
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    write_png(tmp_path / "normal.png", normals / 2 + 0.5)
    with caplog.at_level(logging.WARNING, "unirender"):
        given = read_picture_input(tmp_path / "one.png", normal=tmp_path / "normal.png")
    assert "whole frame" in caplog.text
    assert "36 degrees assumed" in caplog.text
    assert given.mask.min() == 1
    assert given.normal is not None
    np.testing.assert_allclose(given.normal, normals, atol=0.01)
    np.testing.assert_allclose(np.linalg.norm(given.normal, axis=-1), 1, atol=1e-5)
    half = np.zeros((12, 16, 1), np.float32)
    half[:, :8] = 1
    stored = read_normals(tmp_path / "normal.png")
    assert not unit_normals(stored, half, tmp_path / "normal.png")[:, 8:].any()
    with pytest.raises(UnirenderError, match=r"normal\.png: the normals are 16 x 12 pixels, expected 20 x 10"):
        unit_normals(stored, np.ones((10, 20, 1), np.float32), tmp_path / "normal.png")
    write_png(tmp_path / "flat.png", np.full((12, 16, 3), 0.5))
    with pytest.raises(UnirenderError, match=r"flat\.png: .* have no normal"):
        read_picture_input(tmp_path / "one.png", normal=tmp_path / "flat.png")


def test_the_camera_is_that_of_the_header_or_of_the_normals(tmp_path: Path, caplog: pytest.LogCaptureFixture):
    """As `decompose` takes it; what it was taken from is told."""
    rgba = np.full((12, 16, 4), 0.5, np.float32)
    rgba[..., 3] = 1
    camera, other = Camera(60.0, (0.4, 0.55)), Camera(50.0)
    write_exr(tmp_path / "one.exr", image_channels(rgba), attributes={"camera": camera.describe()})
    write_exr(tmp_path / "two.exr", image_channels(rgba))
    normal = np.zeros((12, 16, 3), np.float32)
    normal[..., 2] = 1
    write_result(tmp_path / "maps", Intrinsics(normal=normal, mask=rgba[..., 3:], camera=other), {})
    with caplog.at_level(logging.WARNING, "unirender"):
        assert read_picture_input(tmp_path / "one.exr", normal=tmp_path / "maps").camera == camera
        assert "60 degrees, as the picture's header says" in caplog.text
        assert read_picture_input(tmp_path / "two.exr", normal=tmp_path / "maps").camera == other
        assert f"50 degrees, the one that {tmp_path / 'maps'} is read with" in caplog.text
    given = read_picture_input(tmp_path / "one.exr", fov_deg=40.0, longest_side=8).camera
    assert (given.fov_deg, given.principal) == (40.0, pytest.approx((0.4, 0.55)))
    with pytest.raises(UnirenderError, match="gone: no such file"):
        read_picture_input(tmp_path / "one.exr", normal=tmp_path / "gone")


def test_of_a_result_folder_the_normals_picture_counts_and_no_other_maps(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
):
    normal, mask = np.zeros((12, 16, 3), np.float32), np.ones((12, 16, 1), np.float32)
    normal[..., 2] = 1
    maps = Intrinsics(normal=normal, mask=mask, camera=Camera())
    write_result(tmp_path / "alone", maps, {})
    read_normals(tmp_path / "alone")
    assert not caplog.messages
    write_result(tmp_path, maps.replace(albedo=normal, metallic=mask), {})
    write_png(tmp_path / "albedo.png", normal[::2, ::2])  # of another size
    np.testing.assert_array_equal(read_normals(tmp_path), normal)
    assert caplog.messages == [f"{tmp_path}: only its normals are used, not its albedo, metallic"]
    write_png(tmp_path / "normal.png", normal[..., ::-1] / 2 + 0.5)
    np.testing.assert_allclose(read_normals(tmp_path), normal[..., ::-1], rtol=0, atol=0.01)


def test_normals_of_the_pictures_own_size_are_reduced_with_it(tmp_path: Path):
    """They are the mean directions; those of the reduced size are taken as they are."""
    rng = np.random.default_rng(1)
    write_png(tmp_path / "one.png", rng.random((24, 32, 3)))
    slope = np.linspace(-1.2, 1.2, 32)
    ball = np.stack([np.sin(slope), 0 * slope, np.cos(slope)], axis=-1) * np.ones((24, 1, 1))
    write_png(tmp_path / "normal.png", ball / 2 + 0.5)
    given = read_picture_input(tmp_path / "one.png", normal=tmp_path / "normal.png", longest_side=16)
    assert given.normal is not None
    assert given.normal.shape == (12, 16, 3)
    np.testing.assert_allclose(np.linalg.norm(given.normal, axis=-1), 1, atol=1e-5)
    means = ball.reshape(12, 2, 16, 2, 3).mean((1, 3))
    expected = means / np.linalg.norm(means, axis=-1, keepdims=True)
    np.testing.assert_allclose(given.normal, expected, atol=0.01)  # 8 bits
    write_png(tmp_path / "small.png", expected / 2 + 0.5)
    small = read_picture_input(tmp_path / "one.png", normal=tmp_path / "small.png", longest_side=16)
    assert small.normal is not None
    np.testing.assert_allclose(small.normal, expected, atol=0.01)
    write_png(tmp_path / "other.png", ball[:20] / 2 + 0.5)
    with pytest.raises(UnirenderError, match="32 x 20 pixels, expected 32 x 24 like the picture"):
        read_picture_input(tmp_path / "one.png", normal=tmp_path / "other.png", longest_side=16)


def test_normals_in_other_axes_are_noticed(tmp_path: Path, caplog: pytest.LogCaptureFixture):
    """Of a ball: towards the camera is told from away by most pixels, right and up by the outline."""
    y, x = (1 - 2 * (np.indices((24, 24)) + 0.5) / 24) / 0.8
    inside = x**2 + y**2 < 1
    ball = np.stack([-x, y, np.sqrt(np.maximum(1 - x**2 - y**2, 0))], axis=-1)
    write_png(tmp_path / "one.png", np.concatenate([np.full((24, 24, 3), 0.5), inside[..., None]], axis=-1))

    def said(*signs: int) -> str:
        write_png(tmp_path / "normal.png", ball * signs / 2 + 0.5)
        caplog.clear()
        with caplog.at_level(logging.WARNING, "unirender"):
            read_picture_input(tmp_path / "one.png", fov_deg=36.0, normal=tmp_path / "normal.png")
        return caplog.text

    assert not said(1, 1, 1)
    assert "point inwards along y; expected +x right, +y up: negate y?" in said(1, -1, 1)
    assert "point inwards along x;" in said(-1, 1, 1)
    with pytest.raises(UnirenderError, match=r"\d+% of the object's normals look away .* negate z \(OpenCV's axes: y"):
        said(1, -1, -1)


@pytest.mark.parametrize(
    ("value", "message"),
    [(0.0, "black wherever its mask covers it"), (1.0, "100% of the object's values are saturated")],
)
def test_a_picture_that_shows_nothing_is_refused(tmp_path: Path, value: float, message: str):
    """Whatever it shows outside the mask; a ninth that shows something is enough."""
    picture = np.full((12, 12, 4), value)
    picture[..., 3] = 0
    picture[3:9, 3:9, 3] = 1
    picture[0, 0, :3] = 0.4
    write_png(tmp_path / "one.png", picture)
    with pytest.raises(UnirenderError, match=rf"one\.png: .*{message}"):
        command(tmp_path / "one.png", "--out", tmp_path / "out").run()
    assert not (tmp_path / "out").exists()
    picture[3:5, 3:5, :3] = 0.5
    write_png(tmp_path / "one.png", picture)
    assert read_picture_input(tmp_path / "one.png").image.shape == (12, 12, 3)


def test_a_black_linear_picture_is_refused(tmp_path: Path):
    for name, value in (("black", 0.0), ("dim", 1e-5)):
        rgba = np.full((8, 8, 4), value, np.float32)
        rgba[..., 3] = 1
        write_exr(tmp_path / f"{name}.exr", image_channels(rgba), half=False)
    with pytest.raises(UnirenderError, match=r"black\.exr: the picture is black"):
        read_picture_input(tmp_path / "black.exr")
    assert read_picture_input(tmp_path / "dim.exr").hdr


def test_what_is_dropped_of_a_file_is_told(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    frames = [Image.new("RGB", (9, 8), colour) for colour in ("grey", "red")]
    frames[0].save(tmp_path / "a.png", save_all=True, append_images=frames[1:])
    picture = read_picture_input(tmp_path / "a.png", fov_deg=36.0)
    np.testing.assert_allclose(picture.image, 128 / 255)
    assert f"{tmp_path / 'a.png'}: the file holds 2 pictures, of which the first is taken" in caplog.messages


@pytest.mark.parametrize("kind", ["folder", "picture"])
def test_a_full_disk_is_one_sentence(
    kind: str, data: Path, solution: Solution, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    def full(*arguments: object, **options: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    out = tmp_path / "out"
    if kind == "folder":
        monkeypatch.setattr("unirender_reference.optimize.files.state.RunFolder.record", full)
        chosen = command(data / "views", "--mesh", data / "mesh.glb", "--out", out, *QUICK)
        to_do = "run the same command again to go on"
    else:
        write_one(solution, tmp_path / "one.png", 20)
        monkeypatch.setattr("unirender.files.write_result", full)
        chosen = command(tmp_path / "one.png", "--out", out, *FEW)
        to_do = "choose another place"
    with pytest.raises(UnirenderError, match=rf"out: cannot be written \(No space left on device\); .*{to_do}$"):
        chosen.run()
    assert out.exists() == (kind == "folder")


@pytest.mark.slow
def test_one_picture(solution: Solution, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    view = write_one(solution, tmp_path / "one.png", 20)
    chosen = command(tmp_path / "one.png", "--out", tmp_path / "out", *FEW)
    assert chosen.run() == 0
    found = read_result(tmp_path / "out")
    assert found.present == tuple(MAPS)
    assert (found.height, found.width) == (20, 20)
    assert found.environment is not None
    assert found.environment.shape == (8, 16, 3)
    meta = json.loads((tmp_path / "out/meta.json").read_text())
    assert (meta["command"], meta["init"], meta["config"]["light_rows"]) == ("optimize", "none", 8)
    assert (tmp_path / "out/history.jsonl").read_text().count("\n") >= 2
    said = capsys.readouterr().out
    assert f"rendered again: {meta['psnr_db']:.2f} dB" in said
    assert said.endswith(
        "assumed, since one picture does not tell it: metallic (0.5), the mean of albedo (0.25); colours of albedo and "
        "light may be exchanged\n"
    )
    assert meta["config"]["trust"] == dataclasses.asdict(COLD_NORMALS)
    again = channels_rgb(read_exr(tmp_path / "out/image.exr")[0])
    shown, given = image_srgb(unpremultiply(again, view.mask)), view.image
    error = np.average(((shown - given) ** 2).mean(-1), weights=view.mask[..., 0])
    assert -10 * np.log10(error) == pytest.approx(meta["psnr_db"], abs=0.5)  # the file has the samples' noise
    assert 18 < meta["psnr_db"] < 60
    assert Image.open(tmp_path / "out/views.png").height > 2 * 80
    with pytest.raises(UnirenderError, match="exists and is not empty; choose another folder"):
        chosen.run()


def test_the_seconds_of_one_picture_count_the_prediction(
    solution: Solution, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
):
    write_one(solution, tmp_path / "one.png", 12)
    clock, later = time.perf_counter, []
    monkeypatch.setattr(time, "perf_counter", lambda: clock() + sum(later))

    def predict(image, mask, camera) -> Intrinsics:
        later.append(1000)
        one = np.ones_like(mask)
        maps = Intrinsics(0.3 * np.repeat(one, 3, -1), roughness=0.6 * one, metallic=0.1 * one)
        normal = np.concatenate([0 * one, 0 * one, one], -1)
        return maps.replace(normal=normal, environment=np.full((16, 32, 3), 0.4, np.float32))

    none = ["--init", "unirender", "--single.steps", "0", "--single.fine-steps", "0"]
    chosen = command(tmp_path / "one.png", "--out", tmp_path / "out", *FEW, *none)
    began = time.perf_counter()
    assert chosen.run(predict) == 0
    seconds = float(capsys.readouterr().out.split(": ")[1].split(" s")[0])
    assert 1000 <= seconds <= round(time.perf_counter() - began, 1)


def test_a_picture_rendered_again_has_the_exposure_of_its_fit(solution: Solution):
    """In any unit a linear picture is scored alike, and the picture of its maps has its unit."""
    view = rendered_views(solution, 1, 0, 12, hdr=True).seen[0]
    one = np.ones_like(view.mask)
    maps = Intrinsics(0.4 * np.repeat(one, 3, -1), roughness=0.5 * one, metallic=0 * one, mask=view.mask)
    maps = maps.replace(normal=np.concatenate([0 * one, 0 * one, one], -1))
    found = []
    for unit in (1.0, 100.0):
        lit = maps.replace(environment=np.full((8, 16, 3), 0.3 * unit, np.float32))
        given = PictureInput(view.image * np.float32(unit), view.mask, view.camera, None, hdr=True)
        found.append(rerendered(given, lit, None, "one.exr"))
    assert found[0].psnr_db == pytest.approx(found[1].psnr_db, abs=1e-3)
    np.testing.assert_allclose(found[1].image_linear, 100 * found[0].image_linear, rtol=1e-4, atol=1e-6)
    assert np.array_equal(np.array(found[0].strip), np.array(found[1].strip))
