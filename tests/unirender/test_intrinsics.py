"""The data contract refuses what would silently be wrong, and its files keep what it holds."""

from pathlib import Path

import numpy as np
import OpenEXR
import pytest

from unirender.camera import Camera
from unirender.errors import UnirenderError
from unirender.exr import (
    exr_bytes,
    intrinsics_channels,
    intrinsics_from_channels,
    read_exr,
    read_exr_bytes,
    write_exr,
)
from unirender.intrinsics import MAPS, Intrinsics, unit_normals


def random_intrinsics(height: int = 6, width: int = 5) -> Intrinsics:
    rng = np.random.default_rng(1)
    maps = {name: rng.random((height, width, channels), dtype=np.float32) for name, channels in MAPS.items()}
    maps["normal"] = maps["normal"] - 0.5
    maps["normal"] /= np.linalg.norm(maps["normal"], axis=-1, keepdims=True)
    maps["specular"] *= 40
    maps["environment"] = rng.random((4, 8, 3), dtype=np.float32) * 1e5
    return Intrinsics(**maps, camera=Camera(fov_deg=45))


def test_size_presence_and_replace() -> None:
    full = random_intrinsics()
    assert (full.height, full.width) == (6, 5)
    assert full.present == tuple(MAPS)
    partial = full.replace(specular=None)
    assert "specular" not in partial.present
    assert partial.camera == full.camera
    with pytest.raises(UnirenderError, match="specular missing"):
        partial.require("specular")


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("albedo", np.ones((4, 4)), "expected .*3"),
        ("roughness", np.ones((4, 4)), "keep their last axis"),
        ("albedo", np.full((4, 4, 3), 1.5), r"expected \[0, 1\]"),
        ("albedo", np.full((4, 4, 3), np.nan), "NaN"),
        ("normal", np.full((4, 4, 3), 1.0), "unit vectors"),
        ("specular", np.full((4, 4, 3), -1.0), "radiance >= 0"),
        ("environment", np.full((4, 4, 3), np.inf), "infinite"),
        ("mask", np.zeros((0, 4, 1)), "empty"),
    ],
)
def test_bad_maps_are_refused(name: str, value: np.ndarray, message: str) -> None:
    with pytest.raises(UnirenderError, match=message):
        Intrinsics().replace(**{name: value})


def test_sizes_must_agree_except_for_the_environment() -> None:
    with pytest.raises(UnirenderError, match="like the other maps"):
        Intrinsics(albedo=np.zeros((4, 4, 3)), mask=np.zeros((5, 4, 1)))
    Intrinsics(albedo=np.zeros((4, 4, 3)), environment=np.zeros((16, 32, 3)))


def test_exr_round_trip_keeps_every_map(tmp_path: Path) -> None:
    full = random_intrinsics()
    path = tmp_path / "a.exr"
    write_exr(path, intrinsics_channels(full), half=False, attributes={"spp": "64"})
    channels, attributes = read_exr(path)
    back = intrinsics_from_channels(channels, full.environment, full.camera)
    assert attributes["spp"] == "64"
    for name in MAPS:
        np.testing.assert_array_equal(getattr(back, name), getattr(full, name))
    assert list(tmp_path.iterdir()) == [path]


def test_exr_channel_names_are_the_contracts() -> None:
    names = set(intrinsics_channels(random_intrinsics()))
    assert {"albedo.R", "normal.X", "roughness.Y", "metallic.Y", "specular.B", "diffuse.G", "mask.Y"} <= names


def test_exr_bytes_are_a_pure_function_and_single_part() -> None:
    channels = intrinsics_channels(random_intrinsics())
    data = exr_bytes(channels)
    assert data == exr_bytes(channels)
    channels, _ = read_exr_bytes(data)
    assert len(channels) == 15


def test_half_precision_refuses_what_it_cannot_hold() -> None:
    with pytest.raises(UnirenderError, match="half precision"):
        exr_bytes({"R": np.full((2, 2), 1e5)})
    exr_bytes({"R": np.full((2, 2), 1e5)}, half=False)
    with pytest.raises(UnirenderError, match="NaN"):
        exr_bytes({"R": np.full((2, 2), np.nan)})


def test_broken_and_multipart_files_give_one_line(tmp_path: Path) -> None:
    (tmp_path / "text.exr").write_text("not an image")
    with pytest.raises(
        UnirenderError, match=r"text\.exr: not a readable OpenEXR file: it is of another kind; write it again"
    ):
        read_exr(tmp_path / "text.exr")
    with pytest.raises(UnirenderError, match=r"a\.exr: not a readable OpenEXR file: it is empty; write it again"):
        read_exr_bytes(b"", "a.exr")
    with pytest.raises(UnirenderError, match="cannot be read"):
        read_exr(tmp_path / "missing.exr")
    data = exr_bytes({"R": np.zeros((64, 64))})
    with pytest.raises(UnirenderError, match="not a readable OpenEXR file: it is damaged or mip-mapped; write"):
        read_exr_bytes(data[: len(data) // 2])
    parts = [OpenEXR.Part({}, {"Z": np.zeros((4, 4), "f")}, "a"), OpenEXR.Part({}, {"Z": np.zeros((4, 4), "f")}, "b")]
    OpenEXR.File(parts).write(str(tmp_path / "two.exr"))
    with pytest.raises(UnirenderError, match="2 parts"):
        read_exr(tmp_path / "two.exr")


@pytest.mark.parametrize("shown", [((0, 2), (3, 5)), ((2, 0), (5, 3)), ((2, 2), (5, 7)), ((2, 2), (7, 5))])
def test_pixels_that_cover_another_part_than_the_picture_are_refused(shown: tuple, tmp_path: Path) -> None:
    """A crop read as the whole would lie in the wrong place; both windows moved alike are the whole."""

    def write(shown: tuple) -> Path:
        corners = {"dataWindow": ((2, 2), (5, 5)), "displayWindow": shown}
        header = {name: tuple(np.array(corner, np.int32) for corner in two) for name, two in corners.items()}
        pixels = {"roughness.Y": np.full((4, 4), 0.5, np.float32)}
        OpenEXR.File({"type": OpenEXR.scanlineimage, **header}, pixels).write(str(tmp_path / "moved.exr"))
        return tmp_path / "moved.exr"

    with pytest.raises(UnirenderError, match=r"moved.exr: the pixels cover \(\(2, 2\), \(5, 5\)\) .* the picture \(\("):
        read_exr(write(shown))
    assert read_exr(write(((2, 2), (5, 5))))[0]["roughness.Y"].shape == (4, 4)


def test_a_map_with_some_of_its_channels_is_refused() -> None:
    channels = intrinsics_channels(random_intrinsics())
    for missing in ("albedo.R", "albedo.B", "normal.X"):
        with pytest.raises(UnirenderError, match=f"EXR channels {missing} missing"):
            intrinsics_from_channels({name: value for name, value in channels.items() if name != missing})


def test_unit_normals_keep_their_bits_and_others_get_length_1() -> None:
    normal = np.random.default_rng(0).normal(size=(2, 5, 6, 3)).astype(np.float32)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    normal[:, 0] = 0
    for kept in (normal, normal.astype(np.float16).astype(np.float32)):
        assert unit_normals(kept) is kept
    maps = Intrinsics(normal=normal)
    assert maps.with_unit_normals() is maps
    short = normal.copy()
    short[:, 1] *= 0.5
    short[:, 2] *= 1e-4
    made = unit_normals(short)
    np.testing.assert_array_equal(made[:, 3:], normal[:, 3:])
    np.testing.assert_allclose(made[:, 1], normal[:, 1], atol=1e-6)
    assert not made[:, [0, 2]].any()
    assert Intrinsics(normal=short).normal is short  # the contract keeps what it is given
