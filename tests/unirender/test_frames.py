"""Folders of pictures: what is done, kept, refused and listed; and how much frames change."""

import dataclasses
import json
import os
import weakref
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from unirender.command_line.input_picture import read_input
from unirender.errors import UnirenderError, UsageError
from unirender.files import write_result
from unirender.folders import (
    AT_ONCE,
    FolderResult,
    batches,
    decompose_folder,
    figures_of,
    list_pictures,
    mask_finder,
    write_summary,
)
from unirender.frames import FilmFrame, temporal_difference
from unirender.intrinsics import Intrinsics
from unirender.new_folders import new_folder
from unirender.pictures import Picture
from unirender.pipelines.results import Decomposition
from unirender.visualization import map_picture

SETTINGS = {"command": "decompose", "seed": 0}


def save(path: Path, value: int = 100, size: tuple[int, int] = (12, 10)) -> Path:
    Image.new("RGB", size, (value, value // 2, 9)).save(path)
    return path


def read(path: Path, mask: Path | None) -> Picture:
    picture, remarks = read_input(path, mask)
    return dataclasses.replace(picture, remarks=remarks)


def decompose(batch: list[Picture]) -> list[Decomposition]:
    """A method in one line: the picture is its own albedo."""
    found = []
    for picture in batch:
        assert picture.mask is not None
        ones = np.ones_like(picture.mask)
        maps: dict[str, Any] = {"albedo": picture.image_srgb, "roughness": 0.5 * ones, "metallic": 0 * ones}
        maps |= {name: 0 * picture.image_srgb for name in ("normal", "specular", "diffuse")}
        light = np.ones((2, 4, 3), np.float32)
        found.append(Decomposition(Intrinsics(**maps, mask=picture.mask, environment=light), 0.5, 0.0))
    return found


def run(pictures: list[Path], output: Path, **changes: Any) -> FolderResult:
    settings = {"read": read, "decompose": decompose, "settings": SETTINGS} | changes
    return decompose_folder(pictures, output, **settings)


def test_pictures_in_natural_order(tmp_path: Path) -> None:
    for name in ("f10.png", "f9.png", "F1.PNG", "b.jpg", ".hidden.png", "notes.txt", "summary.json"):
        (tmp_path / name).write_text("")
    (tmp_path / "folder.png").mkdir()
    assert [path.name for path in list_pictures(tmp_path)] == ["b.jpg", "F1.PNG", "f9.png", "f10.png"]
    with pytest.raises(UnirenderError, match="no pictures"):
        list_pictures(tmp_path / "folder.png")
    Image.new("RGB", (12, 10)).save(tmp_path / "folder.png" / "a.gif")
    (tmp_path / "folder.png" / "b.png").symlink_to(tmp_path / "nowhere.png")
    os.mkfifo(tmp_path / "folder.png" / "c.png")  # to which nobody writes: not waited for
    pictures = list_pictures(tmp_path / "folder.png")
    assert [path.name for path in pictures] == ["a.gif", "b.png", "c.png"]
    found = run(pictures, tmp_path / "out")
    assert "b.png: no such file" in found.failed["b.png"]
    assert "c.png: is a pipe or a device" in found.failed["c.png"]
    with pytest.raises(UnirenderError, match=r"is a result, whose pictures are maps, .*`unirender render`"):
        list_pictures(tmp_path / "out" / "a.gif")


def test_a_cameras_files_are_listed_as_failed(tmp_path: Path) -> None:
    Image.new("RGB", (12, 10)).save(tmp_path / "thumbnail.tiff")
    for name in ("a.DNG", "b.cr2", "c.heic", "thumbnail.NEF"):
        (tmp_path / name).write_bytes((tmp_path / "thumbnail.tiff").read_bytes() if name != "c.heic" else b"ftypheic")
    found = list_pictures(tmp_path)  # but those of which there is a picture: cameras write both
    assert mask_finder(tmp_path)(Path("elsewhere/thumbnail.png")) == tmp_path / "thumbnail.tiff"
    failed = run(found, tmp_path / "out").failed
    assert set(failed) == {"a.DNG", "b.cr2", "c.heic"}
    assert all("a camera's raw file, expected PNG" in failed[name] for name in ("a.DNG", "b.cr2"))


def test_one_bad_picture_is_listed_and_the_others_are_done(tmp_path: Path) -> None:
    good = [save(tmp_path / name) for name in ("a.png", "a.jpg", "c.png")]
    (tmp_path / "b.png").write_text("no picture")
    found = run([*good, tmp_path / "b.png"], tmp_path / "out")
    assert set(found.figures) == {"a.png", "a.jpg", "c.png"}  # one stem, two results
    frame = {"mask": "no mask and no alpha channel: the whole frame is taken as the object (--mask)"}
    assert found.figures["a.png"] == {"roughness_mean": 0.5, "metallic_mean": 0.0, "clipped": 0.0, "remarks": frame}
    assert json.loads((tmp_path / "out" / "a.png" / "meta.json").read_text())["remarks"] == frame
    assert run(good, tmp_path / "out").figures == found.figures  # also of what is kept
    assert set(found.failed) == {"b.png"}
    assert "not a readable picture" in found.failed["b.png"]
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["a.jpg", "a.png", "c.png"]
    write_summary(tmp_path / "out", found, SETTINGS)
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert summary == {**SETTINGS, "pictures": found.figures, "failed": found.failed}
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["a.jpg", "a.png", "c.png", "summary.json"]


def test_what_is_done_is_kept_and_what_differs_is_no_silent_reuse(tmp_path: Path) -> None:
    pictures = [save(tmp_path / name) for name in ("a.png", "b.png")]

    def stop_at_b(batch: list[Picture]) -> list[Decomposition]:
        if any(picture.name == "b.png" for picture in batch):
            raise KeyboardInterrupt
        return decompose(batch)

    run(pictures[:1], tmp_path / "out", decompose=stop_at_b)
    with pytest.raises(KeyboardInterrupt):
        run(pictures, tmp_path / "out", decompose=stop_at_b)
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["a.png"]
    assert run(pictures, tmp_path / "out").kept == 1
    seen: list[int] = []
    again = run([*pictures, save(tmp_path / "d.png")], tmp_path / "out", watch=seen.append)
    assert (again.kept, len(again.figures), seen) == (2, 3, [3])
    save(pictures[0], 30)
    changed = run(pictures, tmp_path / "out")
    assert "another picture or mask (a file changed since)" in changed.failed["a.png"]
    other = run(pictures, tmp_path / "out", settings=SETTINGS | {"seed": 1})
    assert "another seed" in other.failed["b.png"]
    fresh = run(pictures, tmp_path / "out", settings=SETTINGS | {"seed": 1}, overwrite=True)
    assert (fresh.kept, len(fresh.figures), fresh.failed) == (0, 2, {})
    assert figures_of(tmp_path / "out" / "c.png", SETTINGS) is None
    (tmp_path / "out" / "a.png" / "meta.json").write_text("[]")
    assert figures_of(tmp_path / "out" / "a.png", SETTINGS) is None


def test_two_runs_at_once_keep_what_the_other_has_done(tmp_path: Path) -> None:
    """The second finishes while the first looks at its pictures."""
    pictures, out = [save(tmp_path / f"{name}.png") for name in "ab"], tmp_path / "out"

    def slowly(batch: list[Picture]) -> list[Decomposition]:
        assert run(pictures, out).kept == 0
        return decompose(batch)

    first = run(pictures, out, decompose=slowly)
    assert (first.kept, sorted(first.figures), first.failed) == (2, ["a.png", "b.png"], {})


def test_of_another_mask_the_result_is_another(tmp_path: Path) -> None:
    picture, mask = save(tmp_path / "a.png"), tmp_path / "mask.png"
    for columns, kept, failed in ((4, 0, False), (4, 1, False), (8, 0, True)):
        values = np.zeros((10, 12), np.uint8)
        values[:, :columns] = 255
        Image.fromarray(values).save(mask)
        found = run([picture], tmp_path / "out", masks=mask)
        assert (found.kept, bool(found.failed)) == (kept, failed), columns


def test_another_place_or_machine_is_no_other_setting(tmp_path: Path) -> None:
    """Nor is a setting that an older result does not name, at the value which it then had."""
    picture = save(tmp_path / "a.png")
    run([picture], tmp_path / "out", settings=SETTINGS | {"device": "cpu"})
    moved = tmp_path / "elsewhere" / "a.png"
    moved.parent.mkdir()
    picture.rename(moved)
    found = run([moved], tmp_path / "out", settings=SETTINGS | {"device": "cuda", "looks": 1, "flat": False})
    assert (found.kept, found.failed) == (1, {})
    more = run([moved], tmp_path / "out", settings=SETTINGS | {"device": "cuda", "looks": 4, "flat": False})
    assert "another looks" in more.failed["a.png"]


@pytest.mark.parametrize("name", ["intrinsics.exr", "environment.exr", "normal.png"])
def test_a_damaged_result_is_made_again(name: str, tmp_path: Path) -> None:
    pictures = [save(tmp_path / name) for name in ("a.png", "b.png")]
    run(pictures, tmp_path / "out")
    for damage in (lambda file: file.unlink(), lambda file: file.write_bytes(b"")):
        file = tmp_path / "out" / "a.png" / name
        damage(file)
        again = run(pictures, tmp_path / "out")
        assert (again.kept, again.failed, set(again.figures)) == (1, {}, {"a.png", "b.png"})
        assert file.stat().st_size > 0
    assert run(pictures, tmp_path / "out").kept == 2


def test_one_result_and_a_folder_of_them_do_not_replace_each_other(tmp_path: Path) -> None:
    picture = save(tmp_path / "a.png")
    with new_folder(tmp_path / "one") as folder:
        write_result(folder, None, {})
    with pytest.raises(UnirenderError, match=r"has a meta\.json, so that it is one result"):
        run([picture], tmp_path / "one", overwrite=True)
    found = run([picture], tmp_path / "out")
    write_summary(tmp_path / "out", found, SETTINGS)
    (tmp_path / "out" / "meta.json").write_text("{}")  # of a run of an earlier version
    with (
        pytest.raises(UnirenderError, match=r"has a summary\.json, so that it holds the results of a folder"),
        new_folder(tmp_path / "out", overwrite=True),
    ):
        pass
    assert (tmp_path / "out" / "a.png" / "meta.json").exists()


def test_a_folder_that_is_in_the_way_is_kept(tmp_path: Path) -> None:
    pictures = [save(tmp_path / name) for name in ("a.png", "b.png")]
    (tmp_path / "out" / "a.png").mkdir(parents=True)
    (tmp_path / "out" / "a.png" / "precious").write_text("1")
    found = run(pictures, tmp_path / "out")
    assert list(found.figures) == ["b.png"]
    assert "not empty" in found.failed["a.png"]
    assert (tmp_path / "out" / "a.png" / "precious").exists()
    with pytest.raises(UsageError, match="is the folder of the pictures"):
        run(pictures, tmp_path)


def test_masks_of_a_folder(tmp_path: Path) -> None:
    pictures = [save(tmp_path / name) for name in ("a.png", "b.png")]
    (tmp_path / "masks").mkdir()
    values = np.zeros((10, 12), dtype=np.uint8)
    values[:, :5] = 255
    mask = tmp_path / "masks" / "a.bmp"
    Image.fromarray(values).save(mask)
    assert mask_finder(tmp_path / "masks")(pictures[0]) == mask
    assert mask_finder(mask)(pictures[0]) == mask
    found = run(pictures, tmp_path / "out", masks=tmp_path / "masks")
    assert list(found.figures) == ["a.png"]
    assert "has 0 masks for b.png" in found.failed["b.png"]
    assert np.asarray(Image.open(tmp_path / "out" / "a.png" / "mask.png")).mean() == pytest.approx(255 * 5 / 12)
    Image.fromarray(255 - values).save(tmp_path / "masks" / "a.png")
    with pytest.raises(UnirenderError, match=r"has 2 masks for a\.png"):
        mask_finder(tmp_path / "masks")(pictures[0])


def test_a_folder_of_masks_is_listed_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Else 10,000 pictures with 10,000 masks take minutes to look up."""
    (tmp_path / "masks").mkdir()
    pictures = [save(tmp_path / name) for name in ("a.png", "b.png")]
    listed, real = [], Path.iterdir

    def counted(folder: Path) -> Iterator[Path]:
        listed.append(folder)
        return real(folder)

    monkeypatch.setattr(Path, "iterdir", counted)
    assert len(run(pictures, tmp_path / "out", masks=tmp_path / "masks").failed) == 2
    assert listed.count(tmp_path / "masks") == 1


def test_batches_are_bounded() -> None:
    small = Picture(np.zeros((8, 8, 3), np.float32), None, "small")
    large = dataclasses.replace(small, image_srgb=np.broadcast_to(np.float32(0), (2000, 1500, 3)))
    items: list[Any] = [(Path("a"), picture, {}) for picture in [small] * (AT_ONCE + 1) + [large, large, small]]
    assert [len(batch) for batch in batches(items)] == [AT_ONCE, 2, 2]
    assert [item for batch in batches(items) for item in batch] == items
    assert max(len(batch) for batch in batches(items, 1)) == 1


def test_results_are_forgotten_before_the_next_picture_is_taken(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of large pictures each is alone: neither the last one's maps nor the next picture lie in memory beside it."""
    monkeypatch.setattr("unirender.folders.PIXELS_AT_ONCE", 1)
    taken: list[str] = []
    made: list[weakref.ref[Intrinsics]] = []

    def taking(path: Path, mask: Path | None) -> Picture:
        taken.append(path.name)
        return read(path, mask)

    def watched(batch: list[Picture]) -> list[Decomposition]:
        assert [picture.name for picture in batch] == taken[-1:]
        assert [one() for one in made] == [None] * len(made)
        found = decompose(batch)
        made.extend(weakref.ref(result.intrinsics) for result in found)
        return found

    pictures = [save(tmp_path / f"{name}.png") for name in "abc"]
    assert not run(pictures, tmp_path / "out", read=taking, decompose=watched).failed
    assert len(made) == 3


def make_frame(folder: Path, picture: Path, albedo: float, wide: int = 6, roughness: float = 0.5) -> tuple[Path, Path]:
    """A frame whose left `wide` columns are the object, of the picture's colour and this albedo."""
    folder.mkdir()
    mask = np.zeros((10, 12, 1), dtype=np.float32)
    mask[:, :wide] = 1
    environment = np.full((4, 8, 3), albedo, dtype=np.float32)
    maps: dict[str, Any] = {"albedo": albedo * mask.repeat(3, axis=-1), "roughness": roughness * mask, "mask": mask}
    write_result(folder, Intrinsics(**maps, environment=environment), {})
    return picture, folder


def test_temporal_difference_is_that_of_the_pictures_people_see(tmp_path: Path) -> None:
    dark, light = save(tmp_path / "dark.png", 100), save(tmp_path / "light.png", 120)
    first = make_frame(tmp_path / "1", dark, 0.25)
    second = make_frame(tmp_path / "2", light, 0.5, wide=9, roughness=0.7)
    found = temporal_difference([first, second])
    shown = [map_picture("albedo", np.full((1, 1, 3), value, np.float32)) for value in (0.25, 0.5)]
    expected = float(shown[1].mean() - shown[0].mean())  # where only one of them shows the object does not count
    assert found["pairs"] == 1
    assert found["albedo"] == pytest.approx(expected, abs=1e-3)
    assert found["environment"] == pytest.approx(expected, abs=1e-3)
    assert found["roughness"] == pytest.approx(0.2, abs=1e-3)
    assert found["input"] == pytest.approx((20 + 10 + 0) / 3 / 255, abs=1e-5)
    still = temporal_difference([first, first, first])
    assert still.pop("pairs") == 2
    assert set(still.values()) == {0.0}


def test_frames_without_a_neighbour_are_left_out(tmp_path: Path) -> None:
    picture = save(tmp_path / "a.png")
    first = make_frame(tmp_path / "1", picture, 0.25)
    second = make_frame(tmp_path / "2", picture, 0.5)
    assert temporal_difference([first, None, second]) == {"pairs": 0}
    assert temporal_difference([first]) == {"pairs": 0}
    both = temporal_difference([first, second, None, second, second])
    alone = temporal_difference([first, second])
    assert both["pairs"] == 2
    assert both["albedo"] == pytest.approx(alone["albedo"] / 2)
    mask = np.zeros((10, 12, 1), dtype=np.float32)
    mask[:, 8:] = 1
    elsewhere = FilmFrame(FilmFrame.read(*first).shown, mask)
    assert not elsewhere.comparable(FilmFrame.read(*first))
