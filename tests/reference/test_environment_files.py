"""Environments that unirender wrote, read back as lights: the same light, where any other lat-long map is resampled."""

import struct
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from jaxtyping import Float

from unirender.camera import Camera
from unirender.cli import read_light
from unirender.errors import UnirenderError
from unirender.exr import image_channels, on_pole_grid, read_exr, write_environment, write_exr
from unirender.files import write_result
from unirender.intrinsics import Intrinsics
from unirender.light.resampling import resample_environment
from unirender.light.surface_light import diffuse_light, specular_light
from unirender.new_folders import new_folder
from unirender_reference.lights import load_light
from unirender_reference.lights.files import BYTES_A_TEXEL, BYTES_OF_NONE
from unirender_reference.lights.light import area_resampled

Environment = Float[np.ndarray, "h w 3"]


def peaked_environment() -> Environment:
    """16 x 32, as the model predicts: a dim random sky and one bright texel."""
    environment = np.random.default_rng(0).uniform(0, 1, (16, 32, 3)).astype(np.float32)
    environment[3, 20] = 100
    return environment


def written_result(folder: Path, environment: Environment) -> Path:
    with new_folder(folder / "out") as temporary:
        write_result(temporary, Intrinsics(environment=environment, camera=Camera()), {"command": "decompose"})
    return folder / "out" / "environment.exr"


def written_environment(folder: Path, environment: Environment) -> Path:
    write_environment(folder / "light.exr", environment)
    return folder / "light.exr"


@pytest.mark.parametrize("write", [written_result, written_environment])
def test_a_written_environment_is_read_as_the_same_light(
    write: Callable[[Path, Environment], Path], tmp_path: Path
) -> None:
    environment = peaked_environment()
    np.testing.assert_array_equal(read_light(write(tmp_path, environment)), environment)


def test_any_other_map_is_taken_as_areas(tmp_path: Path) -> None:
    """The failing twin: without the mark the same pixels are another light, by far more than rounding."""
    environment = peaked_environment()
    write_exr(tmp_path / "map.exr", image_channels(environment), half=False, attributes={"author": "someone"})
    read = read_light(tmp_path / "map.exr")
    np.testing.assert_array_equal(read, area_resampled(environment, (64, 128)))
    normal = np.zeros((4, 4, 3), np.float32)
    normal[..., 2] = 1
    for buffer in (
        lambda light: diffuse_light(normal, light),
        lambda light: specular_light(normal, 0.2, light, Camera()),
    ):
        assert np.abs(buffer(read) / buffer(environment) - 1).max() > 0.01


def test_the_scale_and_another_shape_of_a_written_environment(tmp_path: Path) -> None:
    environment = peaked_environment()
    path = written_environment(tmp_path, environment)
    light = load_light(path)
    np.testing.assert_allclose(light.environment, environment * float(light.provenance["scale"]), rtol=1e-6)
    assert "contract" in light.provenance["rule"]
    small = load_light(path, shape=(8, 16), normalise=False).environment
    np.testing.assert_array_equal(small, resample_environment(environment, (8, 16)))


def test_a_written_environment_is_checked_like_any_map(tmp_path: Path) -> None:
    write_environment(tmp_path / "square.exr", np.ones((8, 8, 3), np.float32))
    with pytest.raises(UnirenderError, match="got 8x8, expected a lat-long map"):
        load_light(tmp_path / "square.exr")
    with pytest.raises(UnirenderError, match="expected finite values"):
        write_environment(tmp_path / "nan.exr", np.full((8, 16, 3), np.nan, np.float32))


def test_the_mark_stands_in_the_header_beside_the_others(tmp_path: Path) -> None:
    write_environment(tmp_path / "light.exr", peaked_environment(), {"command": "decompose"})
    channels, attributes = read_exr(tmp_path / "light.exr")
    assert set(channels) == set("RGB")
    assert {"command": "decompose", "grid": "poles"}.items() <= attributes.items()
    assert on_pole_grid(attributes)
    assert on_pole_grid({"exposure_factor": "1"})
    assert not on_pole_grid({"command": "decompose", "grid": "areas"})


def test_runs_of_old_radiance_files_are_named(tmp_path: Path) -> None:
    """Two grey pixels and the second six times more; twins: the same pixels one by one, and cut off, also where some of
    them are as dark as a run is written."""
    header, grey = b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 2 +X 4\n", bytes([128, 128, 128, 129])
    (tmp_path / "old.hdr").write_bytes(header + grey + grey + bytes([1, 1, 1, 6]))
    (tmp_path / "flat.hdr").write_bytes(header + 8 * grey)
    (tmp_path / "cut.hdr").write_bytes(header + 6 * grey)
    (tmp_path / "dark.hdr").write_bytes(header + bytes([1, 1, 1, 120]) + 5 * grey)
    (tmp_path / "long.hdr").write_bytes(header.replace(b"4", b"350") + grey + bytes([1, 1, 1, 187, 1, 1, 1, 2]))
    for name in ("old", "long"):
        with pytest.raises(UnirenderError, match=r"run-length coded as Radiance did before 1991.*save it as EXR"):
            load_light(tmp_path / f"{name}.hdr")
    for name in ("cut", "dark"):
        with pytest.raises(UnirenderError, match="read 0 out of"):
            load_light(tmp_path / f"{name}.hdr")
    assert np.allclose(load_light(tmp_path / "flat.hdr", normalise=False).environment, 1, atol=0.01)


def coded_rows(rows: int) -> bytes:
    """A Radiance file of 8 columns: its header, and rows that each have four runs."""
    return b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y %d +X 8\n" % rows + rows * (b"\2\2\0\x08" + 4 * b"\x88\x80")


def test_a_damaged_row_of_a_radiance_file_is_told(tmp_path: Path) -> None:
    """Where a row begins elsewhere than the one above ends, Mitsuba writes beyond its picture and the process dies."""
    path, whole = tmp_path / "a.hdr", coded_rows(4)
    path.write_bytes(whole)
    assert load_light(path, normalise=False).environment.shape == (64, 128, 3)
    for damaged in (whole[:-12] + b"\0" + whole[-11:], whole[:-13] + whole[-12:], whole[:-12] + b"\0" + whole[-12:]):
        path.write_bytes(damaged)
        with pytest.raises(UnirenderError, match=r"a\.hdr: row 4 of 4 does not begin where .*; copy it again"):
            load_light(path)


def test_a_radiance_file_without_a_size_is_told(tmp_path: Path) -> None:
    (tmp_path / "a.hdr").write_bytes(coded_rows(4).replace(b"-Y 4", b"-Y x"))
    with pytest.raises(UnirenderError, match=r"its header has no size, expected '-Y height \+X width'"):
        load_light(tmp_path / "a.hdr")
    (tmp_path / "a.pfm").write_bytes(b"PF\nx 4\n-1.0\n" + bytes(100))
    with pytest.raises(UnirenderError, match="not a readable HDR map"):
        load_light(tmp_path / "a.pfm")


RGBE, PFM = b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 8192 +X 16384\n", b"PF\n16384 8192\n-1.0\n"


PNG = b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR" + struct.pack(">IIBBBBB", 128, 64, 8, 2, 0, 0, 0)
PNG += struct.pack(">II", zlib.crc32(PNG[12:]), 9) + b"IDAT"


@pytest.mark.parametrize(
    ("name", "start", "texels"),
    [("a.hdr", RGBE, 2**27), ("a.pfm", PFM, 2**27), ("a.exr", None, 2**13), ("a.png", PNG, 2**13)],
)
def test_a_map_that_the_machine_is_too_small_for_is_refused_by_its_header(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, start: bytes | None, texels: int
) -> None:
    """Before its pixels are read, which are not there; a smaller map is read."""
    for file, rows in ((name, 64), ("small.exr", 32)):
        write_exr(tmp_path / file, image_channels(np.ones((rows, 2 * rows, 3))))
    if start is not None:
        (tmp_path / name).write_bytes(start)
    monkeypatch.setattr("unirender.system.machine.memory_bytes", lambda: BYTES_OF_NONE + BYTES_A_TEXEL * texels - 1)
    with pytest.raises(UnirenderError, match=r"million texels, which would take about [\d.]+ GiB .*; scale it down"):
        load_light(tmp_path / name)
    assert load_light(tmp_path / "small.exr", shape=(4, 8)).environment.shape == (4, 8, 3)
