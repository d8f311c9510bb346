"""Result folders: what is written reads back, and what goes wrong leaves nothing behind."""

import contextlib
import errno
import json
import os
import shutil
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import OpenEXR
import pytest
from PIL import Image

from unirender.camera import Camera
from unirender.color import srgb_encode
from unirender.errors import UnirenderError, UsageError
from unirender.exr import image_channels, intrinsics_channels, on_pole_grid, read_exr, write_environment, write_exr
from unirender.files import read_result, write_result
from unirender.intrinsics import Intrinsics
from unirender.new_folders import new_folder
from unirender.pictures import read_picture
from unirender.shipped import checkpoint_sha256
from unirender.system.whole_files import replace_file, whole_file

RNG = np.random.default_rng(0)


def test_result_round_trip(tmp_path: Path) -> None:
    mask = np.ones((4, 6, 1), dtype=np.float32)
    intrinsics = Intrinsics(
        albedo=RNG.random((4, 6, 3), dtype=np.float32),
        mask=mask,
        environment=RNG.random((4, 8, 3), dtype=np.float32) * 1e5,
        camera=Camera(fov_deg=50.0, principal=(0.4, 0.6)),
    )
    with new_folder(tmp_path / "deep" / "down" / "out") as folder:
        write_result(folder, intrinsics, {"seed": 3}, image_linear=intrinsics.albedo)
    back = read_result(tmp_path / "deep" / "down" / "out")
    assert back.camera == intrinsics.camera
    assert back.present == intrinsics.present
    maps, expected = back.require("environment", "albedo"), intrinsics.require("environment", "albedo")
    np.testing.assert_array_equal(maps["environment"], expected["environment"])
    np.testing.assert_allclose(maps["albedo"], expected["albedo"], rtol=0, atol=1e-3)


def test_pictures_of_a_result_are_for_the_eye(tmp_path: Path) -> None:
    """Colours and light as a display shows them, materials as they are, (n + 1) / 2, and an image that is no darker
    where the object covers half of a pixel."""
    mask = np.array([[[1.0], [0.5], [0.0]]], np.float32)
    grey, up = np.full((1, 3, 3), 0.25, np.float32) * (mask > 0), np.array([0, 1, 0], np.float32) * (mask > 0)
    maps = Intrinsics(albedo=grey, roughness=grey[..., :1], normal=up.astype(np.float32), mask=mask, diffuse=8 * grey)
    write_result(tmp_path, maps, {}, image_linear=grey * mask)
    shown = srgb_encode(np.array(0.25)).item()
    for name, expected in {
        "albedo": [[shown] * 3] * 2 + [[0] * 3],
        "diffuse": [[1] * 3] * 2 + [[0] * 3],
        "roughness": [0.25, 0.25, 0],
        "mask": [1, 0.5, 0],
        "normal": [[0.5, 1, 0.5]] * 2 + [[0] * 3],
        "image": [[shown] * 3 + [1], [shown] * 3 + [0.5], [0] * 4],
    }.items():
        pixels = np.asarray(Image.open(tmp_path / f"{name}.png"))[0] / 255
        np.testing.assert_allclose(pixels, expected, rtol=0, atol=0.501 / 255, err_msg=name)


@pytest.mark.parametrize(("scale", "half"), [(1.0, True), (0.0, True), (1e6, False), (1e-7, False)])
def test_radiance_of_any_scale_is_stored(tmp_path: Path, scale: float, half: bool) -> None:
    """In half precision, 1e6 is infinite, and of 1e-7 one digit is left."""
    light = np.random.default_rng(4).uniform(0.2, 1, (8, 8, 3)).astype(np.float32) * np.float32(scale)
    write_result(tmp_path / "out", Intrinsics(specular=light, mask=np.ones((8, 8, 1), np.float32)), {}, light)
    stored = read_result(tmp_path / "out").require("specular")["specular"]
    np.testing.assert_allclose(stored, light, rtol=1e-3 if half else 0, atol=0)
    channels = OpenEXR.File(str(tmp_path / "out/intrinsics.exr"), separate_channels=True).channels()
    assert channels["specular.R"].pixels.dtype == (np.float16 if half else np.float32)
    image, _ = read_exr(tmp_path / "out/image.exr")
    np.testing.assert_allclose(image["R"], light[..., 0], rtol=1e-3 if half else 0, atol=0)


@pytest.mark.parametrize(
    ("channels", "said"),
    [
        ({}, r"expected one common \[height, width\]"),
        ({"R": np.zeros((2, 2)), "G": np.zeros((2, 3))}, "expected one common"),
        ({"R": np.zeros((2, 2, 1))}, "expected one common"),
        ({"R": np.zeros((0, 2))}, "expected one common"),
        ({"": np.zeros((2, 2))}, "EXR channels: got the names '', expected text"),
        ({"R": np.full((1, 1), 1j)}, "EXR channel R: got ndarray .* expected numbers"),
        ({"R": np.array([[0, np.nan]])}, "EXR channel R: got NaN or infinity"),
        ({"R": np.array([[0, np.inf]])}, "EXR channel R: got NaN or infinity"),
        ({"R": np.array([[0, 65600.0]])}, "got 6.56e"),
        ({"R": np.array([[0, -65600.0]])}, "half precision ends at 65504"),
    ],
)
def test_what_an_exr_cannot_hold_is_refused(channels: dict[str, np.ndarray], said: str, tmp_path: Path) -> None:
    with pytest.raises(UnirenderError, match=said):
        write_exr(tmp_path / "a.exr", channels)
    assert not any(tmp_path.iterdir())


def test_only_what_says_so_is_on_the_pole_grid() -> None:
    """The mark of an environment, or the exposure factor of a data set's."""
    for attributes, found in (
        ({"grid": "poles"}, True),
        ({"exposure_factor": "0.3"}, True),
        ({"grid": "areas"}, False),
        ({}, False),
    ):
        assert on_pole_grid(attributes) == found, attributes


def test_a_failure_inside_leaves_the_old_folder_and_nothing_else(tmp_path: Path) -> None:
    out = tmp_path / "out"
    with new_folder(out) as folder:
        (folder / "a").write_text("old")
        (folder / "meta.json").write_text("{}")

    def fail_half_way() -> None:
        with new_folder(out, overwrite=True) as folder:
            (folder / "a").write_text("new")
            raise RuntimeError

    with pytest.raises(RuntimeError):
        fail_half_way()
    with pytest.raises(OSError, match="full") as full, new_folder(out, overwrite=True):
        raise OSError(errno.ENOSPC, "full")  # as Pillow raises it, without a name
    assert full.value.filename == str(out)
    assert (out / "a").read_text() == "old"
    assert [path.name for path in tmp_path.iterdir()] == ["out"]
    with pytest.raises(UnirenderError, match="or overwrite it"), new_folder(out, overwrite=False):
        pass
    (out / "meta.json").unlink()
    with pytest.raises(UnirenderError, match=r"no meta\.json"), new_folder(out, overwrite=True):
        pass  # a folder that is no result is never replaced
    (tmp_path / "file").write_text("")
    with pytest.raises(UnirenderError, match=r"choose another folder$"), new_folder(out):  # of a command without it
        pass
    with pytest.raises(UnirenderError, match="is a file"), new_folder(tmp_path / "file"):
        pass


def test_what_a_kill_left_half_made_goes_after_a_day(tmp_path: Path) -> None:
    """Nothing else that is hidden there: another result's, one that is being made, and what is not named so."""
    for name, days in ((".a.0123456789ab", 2), (".a.fedcba987654", 0), (".b.0123456789ab", 2), (".a.old.x1", 2)):
        (tmp_path / name).mkdir()
        (tmp_path / name / "meta.json").touch()
        made_at = time.time() - days * 86400
        os.utime(tmp_path / name, (made_at, made_at))
    with new_folder(tmp_path / "a", tidy=False):
        pass
    assert (tmp_path / ".a.0123456789ab").is_dir(), "twin: it is the look that takes it away"
    (tmp_path / "a").rmdir()
    with new_folder(tmp_path / "a"):
        pass
    assert {path.name for path in tmp_path.iterdir()} == {"a", ".a.fedcba987654", ".b.0123456789ab", ".a.old.x1"}


def test_what_a_kill_left_of_a_replaced_result_goes_after_a_day(tmp_path: Path) -> None:
    """Only where there is another now: else it may be all that is left."""
    replaced = tmp_path / ".a.old.ab_12xyz"
    for there in (False, True):
        (replaced / "old").mkdir(parents=True, exist_ok=True)
        os.utime(replaced, (0, 0))
        with new_folder(tmp_path / "a", overwrite=True) as folder:
            (folder / "meta.json").touch()
        assert replaced.exists() != there


def test_a_signal_while_the_old_result_goes_leaves_nothing_of_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = shutil.rmtree

    def interrupted(path: Path, ignore_errors: bool = False) -> None:
        if not ignore_errors:
            raise KeyboardInterrupt
        whole(path, ignore_errors=True)

    for text in ("old", "new"):
        with contextlib.suppress(KeyboardInterrupt), new_folder(tmp_path / "a", overwrite=True) as folder:
            (folder / "meta.json").write_text(text)
            monkeypatch.setattr(shutil, "rmtree", interrupted)
    assert [path.name for path in tmp_path.iterdir()] == ["a"]
    assert (tmp_path / "a" / "meta.json").read_text() == "new"


def test_a_folder_that_may_not_be_listed_is_written_to(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refused(folder: Path) -> None:
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(folder))

    with monkeypatch.context() as patch:  # root may list any
        patch.setattr(Path, "iterdir", refused)
        with new_folder(tmp_path / "a") as folder:
            (folder / "meta.json").touch()
    assert (tmp_path / "a" / "meta.json").is_file()


@pytest.mark.parametrize("given", [".", "..", "inside/.."])
def test_the_working_directory_is_not_replaced(given: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "work").mkdir()
    (tmp_path / "meta.json").write_text("{}")
    monkeypatch.chdir(tmp_path / "work")
    with pytest.raises(UsageError, match="folder that you are in"), new_folder(given, overwrite=True):
        pass
    assert sorted(path.name for path in tmp_path.iterdir()) == ["meta.json", "work"]
    assert not list(Path.cwd().iterdir())
    with new_folder("new") as folder:  # the twin: a folder inside is fine
        (folder / "a").write_text("")
    assert [path.name for path in Path.cwd().iterdir()] == ["new"]


def test_a_folder_below_a_file_is_refused(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(UnirenderError, match="/file is no folder"), new_folder(tmp_path / "file/a"):
        pass


def test_an_empty_folder_and_a_link_to_one_are_filled(tmp_path: Path) -> None:
    (tmp_path / "real").mkdir()
    (tmp_path / "link").symlink_to("real")
    with new_folder(tmp_path / "link") as folder:
        (folder / "a").write_text("new")
    assert (tmp_path / "link").is_symlink()
    assert (tmp_path / "real" / "a").read_text() == "new"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["link", "real"]


@pytest.mark.parametrize("failing", ["old", "new"])
def test_a_folder_that_cannot_be_moved_stays_and_leaves_no_rest(
    failing: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "out"
    out.mkdir()
    (out / "meta.json").write_text("old")
    rename, refused = os.rename, []

    def busy(source: Path, target: Path) -> None:
        if (source if failing == "old" else target) == out and not refused:
            refused.append(source)
            raise OSError(16, "Device or resource busy")
        rename(source, target)

    monkeypatch.setattr(os, "rename", busy)
    with pytest.raises(UnirenderError, match="cannot be replaced"), new_folder(out, overwrite=True) as folder:
        (folder / "meta.json").write_text("new")
    assert refused
    assert (out / "meta.json").read_text() == "old"
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


def test_a_checkpoints_hash_is_of_weights_and_configuration(tmp_path: Path) -> None:
    (tmp_path / "net").mkdir()
    (tmp_path / "net" / "model.safetensors").write_bytes(b"weights")
    (tmp_path / "model_index.json").write_text("{}")
    before = checkpoint_sha256(tmp_path)
    for name in ("training.json", "validation.json"):
        (tmp_path / name).write_text("{}")
        assert checkpoint_sha256(tmp_path) == before, name
    seen = {before}
    for name in ("model_index.json", "net/model.safetensors", "net/config.json"):  # the twin
        (tmp_path / name).write_text("other")
        seen.add(checkpoint_sha256(tmp_path))
    assert len(seen) == 4


def test_headers_say_where_a_file_comes_from(tmp_path: Path) -> None:
    mask = np.ones((4, 4, 1), dtype=np.float32)
    intrinsics = Intrinsics(mask=mask, environment=np.ones((3, 4, 3), dtype=np.float32), camera=Camera(40))
    meta = {"input": Path("private/m\udcfcg.png"), "seed": 3, "mode": "mean", "above_x_max": {"specular": {"count": 1}}}
    with new_folder(tmp_path / "out") as folder:
        write_result(folder, intrinsics, meta, image_linear=np.ones((4, 4, 3), dtype=np.float32))
    for name in ("intrinsics.exr", "environment.exr", "image.exr"):
        _, attributes = read_exr(tmp_path / "out" / name)
        expected = {"input": "m\\udcfcg.png", "seed": "3", "mode": "mean", "camera": "fov_deg=40 principal=0.5,0.5"}
        assert expected.items() <= attributes.items(), name
    record = json.loads((tmp_path / "out" / "meta.json").read_text())
    assert record["input"] == "private/m\udcfcg.png", "a name that is no UTF-8 comes back"
    assert record["above_x_max"] == {"specular": {"count": 1}}


def test_the_camera_is_that_of_meta_json_else_of_the_header_else_the_default(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    mask, camera = np.ones((4, 6, 1), dtype=np.float32), Camera(100 / 3, (0.25, 2 / 3))
    with new_folder(tmp_path / "out") as folder:
        write_result(folder, Intrinsics(mask=mask, environment=mask[:3, :4].repeat(3, axis=-1), camera=camera), {})
    alone = read_result(tmp_path / "out" / "intrinsics.exr")
    assert alone.camera == camera
    assert alone.environment is None
    assert read_result(tmp_path / "out", fov_deg=50).camera == Camera(50, camera.principal)
    (tmp_path / "out" / "meta.json").write_text('{"fov_deg": 20}')
    assert read_result(tmp_path / "out").camera == Camera(20)
    (tmp_path / "out" / "meta.json").unlink()
    assert read_result(tmp_path / "out").camera == camera
    assert not caplog.records
    write_exr(tmp_path / "bare.exr", intrinsics_channels(Intrinsics(mask=mask)))
    assert read_result(tmp_path / "bare.exr", fov_deg=36).camera == Camera()
    assert not caplog.records
    assert read_result(tmp_path / "bare.exr").camera == Camera()
    write_exr(tmp_path / "odd.exr", intrinsics_channels(Intrinsics(mask=mask)), attributes={"camera": "wide"})
    assert read_result(tmp_path / "odd.exr", fov_deg=40).camera == Camera(40)  # as the error without it advises
    assert "36 degrees is assumed" in caplog.text


def test_damaged_results_are_named(tmp_path: Path) -> None:
    mask = np.ones((4, 4, 1), dtype=np.float32)
    with new_folder(tmp_path / "out") as folder:
        write_result(folder, Intrinsics(mask=mask), {})
    (tmp_path / "out" / "meta.json").write_text("{")
    with pytest.raises(UnirenderError, match="camera of the EXR file"):
        read_result(tmp_path / "out")
    (tmp_path / "out" / "intrinsics.exr").write_bytes(b"nothing")
    (tmp_path / "out" / "meta.json").unlink()
    with pytest.raises(UnirenderError, match="not a readable OpenEXR"):
        read_result(tmp_path / "out")
    for attributes, channels, words in (
        ({"camera": "wide"}, intrinsics_channels(Intrinsics(mask=mask)), "camera: got 'wide'"),
        ({}, {"depth.Y": mask[..., 0]}, "has the channels depth.Y"),
    ):
        write_exr(tmp_path / "a.exr", channels, attributes=attributes)
        with pytest.raises(UnirenderError, match=words):
            read_result(tmp_path / "a.exr")
    for path, words in ((tmp_path / "none", "no folder and no EXR"), (tmp_path, r"has no intrinsics\.exr")):
        with pytest.raises(UnirenderError, match=words):
            read_result(path)


def test_several_write_a_file_at_once(tmp_path: Path) -> None:
    """Each finds a whole content, whoever wrote it, and none takes another's file away."""
    path, contents = tmp_path / "file", [character * 100_000 for character in "abcd"]
    replace_file(path, contents[0])

    def write_and_read(content: str) -> bool:
        return all(replace_file(path, content).read_text() in contents for _ in range(20))

    with ThreadPoolExecutor(4) as pool:
        assert all(pool.map(write_and_read, contents))
    assert [file.name for file in tmp_path.iterdir()] == ["file"]


def test_a_file_is_replaced_at_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "deep" / "file"
    assert replace_file(path, "old ä").read_text(encoding="utf-8") == "old ä"
    seen, sync = [], os.fsync

    def look(handle: int) -> None:
        seen.append(path.read_text(encoding="utf-8"))
        sync(handle)

    monkeypatch.setattr(os, "fsync", look)
    replace_file(path, b"new")
    assert seen == ["old ä"]  # while the new content reached the disk the old one was there
    assert path.read_bytes() == b"new"

    def fail(handle: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", fail)
    with pytest.raises(OSError, match="No space"):
        replace_file(path, "newer")
    assert path.read_bytes() == b"new"
    assert [file.name for file in path.parent.iterdir()] == ["file"]


def test_what_is_no_plain_file_is_not_read(tmp_path: Path) -> None:
    """A pipe that nobody writes to was waited for."""
    pipe, loop = tmp_path / "pipe.exr", tmp_path / "loop.exr"
    os.mkfifo(pipe)
    loop.symlink_to(loop)
    for path in (pipe, Path(os.devnull)):
        with pytest.raises(UnirenderError, match=f"{path}: is a pipe or a device, expected an OpenEXR file"):
            read_exr(path)
        with pytest.raises(UnirenderError, match=f"{path}: is a pipe or a device, expected a picture"):
            read_picture(path)
    with pytest.raises(UnirenderError, match=r"loop.exr: cannot be read \(Too many levels of symbolic links\)"):
        read_exr(loop)
    with pytest.raises(UnirenderError, match=r"loop.exr: no such file, expected a picture"):
        read_picture(loop)


def test_what_is_no_plain_file_is_not_replaced_by_one(tmp_path: Path) -> None:
    """As root, `/dev/null` itself became a file."""
    pipe, link, file = tmp_path / "pipe", tmp_path / "link.exr", tmp_path / "elsewhere" / "file.exr"
    os.mkfifo(pipe)
    reader = os.open(pipe, os.O_RDONLY | os.O_NONBLOCK)
    replace_file(pipe, "said")
    assert os.read(reader, 100) == b"said"
    os.close(reader)
    assert pipe.is_fifo()
    link.symlink_to(file)
    for _ in range(2):  # before there is such a file, and after
        write_exr(link, {"Y": np.ones((2, 2), np.float32)})
        assert link.is_symlink()
        assert not file.is_symlink()
        assert read_exr(file)[0]["Y"].all()
    for folder in (tmp_path, Path(""), Path("/")):
        with pytest.raises(IsADirectoryError):
            replace_file(folder, "a")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["elsewhere", "link.exr", "pipe"]


def test_a_stream_that_breaks_leaves_what_was_there_and_nothing_aside(tmp_path: Path) -> None:
    """What it wrote would else fill the disk whose end it met."""
    path = tmp_path / "state"
    path.write_bytes(b"old")

    def fill() -> None:
        with whole_file(path) as file:
            file.write(b"half")
            raise OSError(28, "No space left on device")

    with pytest.raises(OSError, match=r"No space left on device: .*state'"):
        fill()
    assert path.read_bytes() == b"old"
    assert [each.name for each in tmp_path.iterdir()] == ["state"]
    with whole_file(path) as file:
        file.write(b"new")
        assert path.read_bytes() == b"old"
    assert path.read_bytes() == b"new"
    assert [each.name for each in tmp_path.iterdir()] == ["state"]


def test_an_error_of_a_library_keeps_its_words(tmp_path: Path) -> None:
    """NumPy says so of a full disk, without a number; with a file's name Python would print that alone."""
    with pytest.raises(OSError, match=r"^16 requested and 8 written$"), whole_file(tmp_path / "state"):
        raise OSError("16 requested and 8 written")


def test_an_environment_from_elsewhere_is_not_taken_for_one_of_ours(tmp_path: Path) -> None:
    """Its rows are areas, ours lie on the poles: taken as it is, light from above would be weighed wrongly."""
    mask = np.ones((8, 8, 1), dtype=np.float32)
    light = np.ones((8, 16, 3), dtype=np.float32)
    write_result(str(tmp_path), Intrinsics(mask=mask, roughness=mask, environment=light, camera=Camera()), {})
    assert read_result(tmp_path).environment is not None
    write_exr(tmp_path / "environment.exr", image_channels(np.ones((9, 18, 3), dtype=np.float32)))
    with pytest.raises(UnirenderError, match=r"environment\.exr: is no environment that .*--environment"):
        read_result(tmp_path)


@pytest.mark.parametrize(
    "text", ["[]", "3", "null", "[" * 100_000, f'{{"fov_deg": {10**400}}}', '{"fov_deg": 36, "principal": 1}']
)
def test_a_meta_file_that_is_no_account_is_refused(text: str, tmp_path: Path) -> None:
    mask = np.ones((8, 8, 1), dtype=np.float32)
    write_result(tmp_path, Intrinsics(mask=mask, roughness=mask, camera=Camera()), {})
    (tmp_path / "meta.json").write_text(text)
    with pytest.raises(UnirenderError, match=r"meta\.json: (not readable|expected)"):
        read_result(tmp_path)


def test_a_light_that_was_exchanged_is_noticed(tmp_path: Path) -> None:
    mask, light = np.ones((4, 5, 1), np.float32), np.random.default_rng(0).random((4, 8, 3), np.float32)
    surface = Intrinsics(mask=mask, roughness=mask)
    lit = surface.replace(diffuse=mask.repeat(3, axis=-1), environment=light)
    other = tmp_path / "other.exr"
    write_environment(other, 2 * light)
    for name, maps in {"lit": lit, "surface": surface.replace(environment=light)}.items():
        with new_folder(tmp_path / name) as folder:
            write_result(folder, maps, {})
        np.testing.assert_array_equal(read_result(tmp_path / name).environment, light)
        shutil.copy(other, tmp_path / name / "environment.exr")
    # nothing there comes from a light; its picture is that of the old one, and no edit
    np.testing.assert_array_equal(read_result(tmp_path / "surface").environment, 2 * light)
    assert read_result(tmp_path / "lit", light=False).diffuse is not None
    with pytest.raises(
        UnirenderError, match=r"environment.exr is another light than .* pass the other light as --envi"
    ):
        read_result(tmp_path / "lit")
    # maps of before the record, and of others
    write_exr(tmp_path / "lit" / "intrinsics.exr", intrinsics_channels(lit))
    np.testing.assert_array_equal(read_result(tmp_path / "lit").environment, 2 * light)
