"""The figure of one's own pictures: how they are framed, what is asked of whom, what is refused."""

import tracemalloc
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from tiny_suites import make_suite

from unirender.camera import Camera
from unirender.errors import UnirenderError, UsageError
from unirender.intrinsics import Intrinsics
from unirender.pictures import Picture
from unirender_evaluation.figures.command import Figures
from unirender_evaluation.figures.overview import MAPS
from unirender_evaluation.figures.panels import Subject
from unirender_evaluation.figures.pictures import EDITS, MARGIN, framed, pictures_sheet, pictures_strip, read_cut_out
from unirender_evaluation.methods.trivial import InputAsAlbedo
from unirender_evaluation.rows import make_row
from unirender_evaluation.suites.suite import load_suite


def disc(height: int, width: int, centre: tuple[float, float], radius: float) -> Picture:
    """A red disc, grey outside of the mask: what is hidden must not bleed in."""
    y, x = np.mgrid[:height, :width] + 0.5
    mask = ((x - centre[0]) ** 2 + (y - centre[1]) ** 2 < radius**2).astype(np.float32)[..., None]
    image = np.where(mask > 0, [0.8, 0.2, 0.1], 0.5).astype(np.float32)
    return Picture(image, mask, "disc.png")


@pytest.mark.parametrize(
    "picture",
    [disc(200, 320, (60, 130), 50), disc(40, 30, (15, 20), 9), disc(64, 64, (32, 32), 32), disc(90, 90, (3, 45), 30)],
    ids=["large", "small", "full", "cut off at the left"],
)
def test_an_object_stands_in_the_middle_of_its_square(picture: Picture) -> None:
    found = framed(picture, 64)
    assert found.image_srgb.shape == (64, 64, 3)
    assert found.mask is not None
    covered = found.mask[..., 0] > 0.5
    rows, columns = (np.flatnonzero(covered.any(axis=axis)) for axis in (1, 0))
    for places in (rows, columns):
        assert abs((places[0] + places[-1]) / 2 - 31.5) <= 1
    assert max(np.ptp(rows), np.ptp(columns)) + 1 == pytest.approx(64 * (1 - 2 * MARGIN), abs=2)
    np.testing.assert_allclose(found.image_srgb[covered], np.tile([0.8, 0.2, 0.1], (covered.sum(), 1)), atol=2e-3)


class Told:
    """Writes down what it is asked."""

    name, config = "told", {"told": 1}

    def __init__(self) -> None:
        self.asked: list[dict[str, Any]] = []
        self.lit: list[np.ndarray] = []

    def decompose(self, image_srgb: np.ndarray, mask: np.ndarray, camera: Camera) -> Intrinsics:
        assert mask.shape == (*image_srgb.shape[:2], 1)
        return Intrinsics(albedo=np.full_like(image_srgb, 0.5), environment=np.ones((4, 8, 3), np.float32))

    def edit(self, image_srgb: np.ndarray, **given: Any) -> np.ndarray:
        self.asked.append({name: value for name, value in given.items() if name in ("metallic", "roughness")})
        return np.zeros_like(image_srgb)

    def relight(self, image_srgb: np.ndarray, mask: np.ndarray, camera: Camera, environment: np.ndarray) -> np.ndarray:
        self.lit.append(environment)
        return np.zeros_like(image_srgb)


def test_every_subject_is_asked_for_maps_edits_and_relightings() -> None:
    told = Told()
    pictures = [framed(disc(40, 40, (20, 20), radius), 32) for radius in (8, 15)]
    lights = {"left": np.ones((4, 8, 3), np.float32), "right": np.ones((8, 16, 3), np.float32)}
    subjects = [
        Subject("told", make_row(told, "trivial")),
        Subject("as albedo", make_row(InputAsAlbedo(), "trivial")),
    ]
    grid = pictures_sheet(subjects, pictures, lights, Camera())
    assert grid.columns[:2] == ("input", "albedo")
    assert grid.columns[-2:] == ("left", "right")
    assert [line.label for line in grid.lines] == ["disc.png, told", "disc.png, as albedo"] * 2
    assert told.asked == list(EDITS) * 2
    assert [light.shape for light in told.lit] == [light.shape for light in lights.values()] * 2
    of_told, of_other = (dict(zip(grid.columns, line.tiles, strict=True)) for line in grid.lines[:2])
    assert of_told["albedo"] is not None
    assert of_told["normal"] is of_told["rendered"] is None
    assert of_told["metallic 1"] is not None
    assert of_other["metallic 1"] is None
    assert set(MAPS) < set(grid.columns)


def test_a_strip_edits_one_parameter_of_every_picture_and_leaves_out_who_cannot() -> None:
    told = Told()
    pictures = [framed(disc(40, 40, (20, 20), radius), 32) for radius in (8, 15)]
    subjects = [Subject("as albedo", make_row(InputAsAlbedo(), "trivial")), Subject("told", make_row(told, "trivial"))]
    grid = pictures_strip(subjects, pictures, "roughness", (0.0, 0.25), Camera())
    assert grid.columns == ("input", "roughness 0", "roughness 0.25")
    assert [line.label for line in grid.lines] == ["disc.png"] * 2
    assert told.asked == [{"roughness": 0.0}, {"roughness": 0.25}] * 2
    assert all(tile is not None for line in grid.lines for tile in line.tiles)


def test_the_command_draws_pictures_of_ones_own(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    make_suite(tmp_path / "suite")
    suite = next((tmp_path / "suite").glob("*.toml"))
    cut = disc(50, 40, (20, 25), 12)
    assert cut.mask is not None
    rgba = np.round(np.concatenate([cut.image_srgb, cut.mask], axis=-1) * 255).astype(np.uint8)
    Image.fromarray(rgba).save(tmp_path / "cut.png")
    method = "unirender_evaluation.methods.trivial:InputAsAlbedo"
    paths = (tmp_path / "cut.png",)
    assert Figures(out=tmp_path / "out", suite=str(suite), method=(method,), pictures=paths, lights=1).run() == 0
    assert "pictures.png" in capsys.readouterr().out.replace("\n", "")
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["pictures.png"]
    method = "unirender_evaluation.methods.trivial:UneditedInput"
    strips = Figures(
        out=tmp_path / "strips", suite=str(suite), method=(method,), pictures=paths, kinds=("roughness", "metallic")
    )
    assert strips.run() == 0
    assert sorted(path.name for path in (tmp_path / "strips").iterdir()) == ["metallic.png", "roughness.png"]
    assert len(load_suite(str(suite)).scenes) >= 1


def test_what_cannot_be_drawn_is_named_before_a_model_is_loaded(tmp_path: Path) -> None:
    Image.new("RGB", (20, 20)).save(tmp_path / "opaque.png")
    with pytest.raises(UnirenderError, match=r"opaque\.png: has no alpha channel"):
        read_cut_out(tmp_path / "opaque.png")
    Image.new("RGBA", (20, 20)).save(tmp_path / "empty.png")
    with pytest.raises(UnirenderError, match=r"empty\.png"):
        read_cut_out(tmp_path / "empty.png")
    both = Figures(
        pictures=(tmp_path / "opaque.png", tmp_path / "absent.png"), checkpoint=(tmp_path / "none",), out=tmp_path / "o"
    )
    with pytest.raises(UnirenderError, match=r"opaque\.png: has no alpha.*; .*absent\.png: no such file"):
        both.run()
    assert not (tmp_path / "o").exists()
    strip: dict[str, Any] = {"kinds": ("roughness",)}
    beside: list[dict[str, Any]] = [{"scenes": ("a",)}, {"kinds": ("metallic", "overview")}, {"spp": 8}]
    for given in (*beside, {"values": (0.5,)}, strip | {"lights": 2}):
        with pytest.raises(UsageError, match="beside --pictures"):
            replace(Figures(pictures=(tmp_path / "opaque.png",)), **given).check()
    Figures(pictures=(tmp_path / "a.png",), values=(0.5,), **strip).check()
    with pytest.raises(UsageError, match="expected none of them twice"):
        Figures(pictures=(tmp_path / "a.png", tmp_path / "a.png")).check()


class Careless(InputAsAlbedo):
    """Writes into what it is handed."""

    name = "careless"

    def decompose(self, image_srgb: np.ndarray, mask: np.ndarray, camera: Camera) -> Intrinsics:
        image_srgb[...], mask[...] = 0, 0
        return Intrinsics(albedo=image_srgb, mask=mask, camera=camera)


def test_a_method_that_writes_into_the_picture_spoils_no_other_row() -> None:
    picture = framed(disc(64, 64, (32, 32), 20), 32)
    careless, other = (Subject(m.name, make_row(m, "external")) for m in (Careless(), InputAsAlbedo()))
    last = [pictures_sheet(who, [picture], {}, Camera()).lines[-1] for who in ([other], [careless, other])]
    for alone, beside in zip(last[0].tiles[1:], last[1].tiles[1:], strict=True):
        assert (alone is None) == (beside is None)
        assert alone is None or beside is None or np.array_equal(alone.picture, beside.picture)


def test_a_panorama_takes_the_memory_of_its_own_pixels() -> None:
    picture = Picture(np.ones((8, 2000, 3), np.float32), np.ones((8, 2000, 1), np.float32), "wide.png")
    tracemalloc.start()
    found = framed(picture, 64)
    taken = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert found.mask is not None
    assert found.mask.max() > 0
    assert taken < 10e6, "its square would take 100 megabytes"
