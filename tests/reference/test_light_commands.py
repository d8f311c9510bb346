"""`unirender lights`: what it prints and writes."""

import json
import os
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from unirender.color import eight_bits
from unirender.errors import UnirenderError, UsageError
from unirender.exr import on_pole_grid, read_exr
from unirender.light.resampling import resample_environment
from unirender_reference import lights
from unirender_reference.lights.summary import light_row
from unirender_reference.measure.lights import THUMBNAIL, Lights
from unirender_reference.sheets import GAP, LINE, captioned_sheet, environment_preview, table_sheet


def printed(command: Lights, capsys: pytest.CaptureFixture[str], status: int = 0) -> dict:
    assert command.run() == status
    return json.loads(capsys.readouterr().out)


def test_the_catalogue_as_json(capsys: pytest.CaptureFixture[str]) -> None:
    found = printed(Lights(json=True), capsys)
    rows = {row["name"]: row for row in found["lights"]}
    assert rows.keys() == lights.catalogue().keys()
    assert sum(kind["share"] for kind in found["kinds"]) == pytest.approx(1)
    assert {kind["kind"] for kind in found["kinds"]} == {"bundled", "softboxes", "sunsky", "gradient", "constant"}
    for name, row in rows.items():
        assert (row["license"], row["split"]) == ("CC0-1.0", lights.catalogue()[name]["split"])
        assert row["package"].startswith(("npm @pmndrs/assets", "Debian blender-data"))
        assert row["mean_luminance"] == pytest.approx(1, rel=1e-4)
        assert row["peak_ratio"] > 5
    assert {row["twins"] for row in rows.values()} == {
        *("city", "forest", "night", "studio", "sunrise", "sunset", None)
    }
    assert rows["pmndrs-esplanade"]["twins"] is None
    assert found["alike"][0]["likeness"] == max(pair["likeness"] for pair in found["alike"])
    assert len(found["alike"]) == 8
    assert all(row["split"] == "test" for row in printed(Lights(split="test", json=True), capsys)["lights"])


def test_draws_are_those_of_make_light(capsys: pytest.CaptureFixture[str]) -> None:
    found = printed(Lights(split="train", draw=(0, 1, 4), json=True), capsys)
    assert [row["name"] for row in found["lights"]] == [lights.make_light(seed, "train").name for seed in (0, 1, 4)]
    light = lights.make_light(1, "train")
    assert found["lights"][1] == json.loads(json.dumps({"split": "train", **light_row(light)}))
    assert found["lights"][1]["peak_ratio"] == pytest.approx(
        (light.environment @ np.array([0.2126, 0.7152, 0.0722])).max(), rel=1e-3
    )


def test_tables_name_every_light_and_what_is_most_alike(capsys: pytest.CaptureFixture[str], monkeypatch) -> None:
    monkeypatch.setenv("COLUMNS", "200")
    assert Lights().run() == 0
    said = capsys.readouterr().out
    assert all(name in said for name in lights.catalogue())
    assert "26 lights of 64 x 128 texels, mean luminance 1" in said
    assert "peak / mean" in said
    assert all(word in said for word in ("twins forest", "CC0-1.0", "50%", "Alike across the splits: blender-sunset"))


def test_export_writes_maps_that_load_as_they_are(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "new" / "lights"
    found = printed(Lights(split="test", draw=(3, 5), export=folder, json=True), capsys)
    names = [row["name"] for row in found["lights"]]
    assert sorted(path.name for path in folder.iterdir()) == sorted(
        f"{name}{suffix}" for name in names for suffix in (".exr", ".png")
    )
    for seed, name in zip((3, 5), names, strict=True):
        light = lights.make_light(seed, "test")
        loaded = lights.load_light(folder / f"{name}.exr", normalise=False)
        np.testing.assert_array_equal(loaded.environment, light.environment)
        _, attributes = read_exr(folder / f"{name}.exr")
        assert on_pole_grid(attributes)
        assert attributes["kind"] == light.provenance["kind"]
        assert Image.open(folder / f"{name}.png").size == (128, 64)
    with pytest.raises(UnirenderError, match="expected a new folder"):
        Lights(export=folder).run()


def test_a_failed_export_leaves_nothing(tmp_path: Path) -> None:
    (tmp_path / "pool").mkdir()
    for name in ("a b.png", "a-b.png"):  # both would be a-b-png.exr
        Image.new("RGB", (40, 20), (90, 80, 70)).save(tmp_path / "pool" / name)
    with pytest.raises(UnirenderError, match="two lights have this name"):
        Lights(pool=tmp_path / "pool", export=tmp_path / "out").run()
    assert [path.name for path in tmp_path.iterdir()] == ["pool"]


def test_what_a_killed_export_left_goes_after_a_day(tmp_path: Path) -> None:
    (tmp_path / ".lights.0123456789ab").mkdir()
    os.utime(tmp_path / ".lights.0123456789ab", (0, 0))
    Lights(split="test", draw=(3, 5), export=tmp_path / "lights").run()
    assert [path.name for path in tmp_path.iterdir()] == ["lights"]


def test_a_folder_is_listed_with_reasons_and_what_looks_alike(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch
) -> None:
    pictures = np.random.default_rng(0).integers(20, 236, (4, 6, 9, 3), np.uint8).repeat(8, 1).repeat(8, 2)
    for number, picture in enumerate(pictures):
        Image.fromarray(picture).save(tmp_path / f"{number}.png")
    Image.fromarray(pictures[3, :, ::-1]).save(tmp_path / "1.png")  # 3.png mirrored: both are on the test side
    (tmp_path / "4.hdr").write_bytes(b"hello")
    found = printed(Lights(pool=tmp_path, holdout=2, json=True), capsys, status=1)
    assert [(row["name"], row["split"]) for row in found["lights"]] == [
        *(("0-png", "train"), ("2-png", "train"), ("1-png", "test"), ("3-png", "test"))
    ]
    assert len(found["failures"]) == 1
    assert "4.hdr: not a readable" in found["failures"][0]["reason"]
    assert found["alike"][0]["likeness"] < 0.5
    (tmp_path / "2.png").write_bytes((tmp_path / "1.png").read_bytes())
    alike = printed(Lights(pool=tmp_path, holdout=2, json=True), capsys, status=1)["alike"]
    assert {pair["test"] for pair in alike if pair["likeness"] > 0.99} == {"1-png", "3-png"}
    monkeypatch.setenv("COLUMNS", "200")
    assert Lights(pool=tmp_path, holdout=2).run() == 1
    said = capsys.readouterr().out
    assert "not a readable" in said
    assert said.count("Alike across the splits") == 2


def test_a_light_is_named_as_it_is_typed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """`--environment` takes files; a name like a-hall-png is none."""
    monkeypatch.setenv("COLUMNS", "200")
    (tmp_path / "a").mkdir()
    Image.fromarray(np.full((16, 32, 3), 90, np.uint8)).save(tmp_path / "a" / "[red]hall.png")
    (tmp_path / "broken.hdr").write_bytes(b"no map")
    assert Lights(pool=tmp_path, split="train").run() == 1
    said = capsys.readouterr().out
    assert "1 light of 64 x 128 texels" in said
    assert f"\nA light is used by its file: --environment '{tmp_path}/a/[red]hall.png'.\n" in said
    assert f"\nNo light (train): {tmp_path}/broken.hdr: " in said
    assert Lights(split="test").run() == 0
    assert "--environment 'FOLDER/blender-city.exr', once --export FOLDER has written it." in capsys.readouterr().out


def test_a_draw_names_the_files_it_passed_over(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    Image.new("RGB", (40, 20), (90, 80, 70)).save(tmp_path / "good.png")
    (tmp_path / "bad.png").write_bytes(b"hello")
    seeds = tuple(range(6))
    found = printed(Lights(split="train", pool=tmp_path, share=1, draw=seeds, json=True), capsys, status=1)
    assert {row["provenance"]["file"] for row in found["lights"]} == {"good.png"}
    assert 1 <= len(found["failures"]) <= 5
    assert all("bad.png" in failure["reason"] for failure in found["failures"])


@pytest.mark.parametrize("command", [Lights(draw=(-1,)), Lights(holdout=1), Lights(share=0.0), Lights(share=1.5)])
def test_a_wrong_command_line(command: Lights) -> None:
    with pytest.raises(UsageError, match="expected"):
        command.run()


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"holdout": 2}, "--holdout: of a folder of lights, expected --pool beside it"),
        ({"share": 1.0}, "--share: of a folder of lights that seeds draw from, expected --pool and --draw beside it"),
        ({"share": 1.0, "draw": (0,)}, "--share: .* expected --pool and --draw"),
        ({"share": 1.0, "pool": Path("lights")}, "--share: .* expected --pool and --draw"),
        ({"share": 1.0, "holdout": 2, "draw": (0,)}, "--holdout and --share: "),
    ],
)
def test_options_that_would_do_nothing_are_refused(options: dict, said: str) -> None:
    with pytest.raises(UsageError, match=said):
        Lights(**options).run()


def test_a_folder_without_lights(tmp_path: Path) -> None:
    with pytest.raises(UnirenderError, match="no maps or photographs for the train side"):
        Lights(pool=tmp_path).run()
    with pytest.raises(UnirenderError, match="no such folder"):
        Lights(pool=tmp_path / "absent").run()


def test_a_side_without_files_is_listed_but_not_drawn_from(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    Image.new("RGB", (40, 20), (90, 80, 70)).save(tmp_path / "only.png")
    assert [row["split"] for row in printed(Lights(pool=tmp_path, json=True), capsys)["lights"]] == ["train"]
    for command in (Lights(pool=tmp_path, draw=(0,)), Lights(pool=tmp_path, split="test")):
        with pytest.raises(UnirenderError, match="for the test side, expected at least 8"):
            command.run()


def test_a_sheet_shows_the_lights_asked_for(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert Lights(split="test", sheet=tmp_path / "sheet.png").run() == 0
    capsys.readouterr()
    lines = [line.tobytes() for line in np.asarray(Image.open(tmp_path / "sheet.png"))]
    for light in lights.bundled_lights():
        middle = eight_bits(environment_preview(resample_environment(light.environment, THUMBNAIL)))[40].tobytes()
        assert any(middle in line for line in lines) == (light.provenance["split"] == "test")


def test_what_is_left_out_is_said(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    from unirender_reference.measure import lights as command

    assert printed(Lights(sheet=tmp_path / "all.png", json=True), capsys)["notes"] == []
    monkeypatch.setattr(command, "MOST_COMPARED", 25)
    monkeypatch.setattr(command, "MOST_SHOWN", 5)
    found = printed(Lights(sheet=tmp_path / "five.png", json=True), capsys)
    assert found["notes"][0] == "not compared across the splits: 26 lights, more than 25"
    assert found["notes"][1].endswith("five.png: the first 5 of 26 lights")
    assert "alike" not in found
    heights = [Image.open(tmp_path / f"{name}.png").height for name in ("five", "all")]
    assert heights[0] < heights[1] / 4


def test_sheets_hold_their_tiles_and_labels() -> None:
    tiles = [np.full((10, 20, 3), value, np.float32) for value in (0.0, 0.25, 0.75)]
    sheet = np.asarray(captioned_sheet(tiles, ["a", "b", "c"], columns=2))
    for value in (0, 64, 191):
        assert (sheet == value).all(axis=-1).sum() >= 200
    table = np.asarray(table_sheet([tiles], ["row\nlabel\nof three"], ["x", "y", "a long label"]))
    assert table.shape[0] >= 4 * LINE  # tiles are smaller than the labels
    for value in (0, 64, 191):
        assert (table == value).all(axis=-1).sum() >= 200
    assert (table[:, 10:30] < 100).any()  # the row's label


def test_no_heading_sticks_out_of_a_sheet_also_where_its_last_line_is_empty() -> None:
    """`views.png` of one picture has its name above an empty line."""
    tile = np.full((10, 80, 3), 1, np.float32)
    one, two = (np.asarray(table_sheet([[tile]], ["row"], [label])) for label in ("picture", "picture\n"))
    assert len(two) == len(one) + LINE
    assert ((one < 100).any(axis=-1).sum()) == ((two < 100).any(axis=-1).sum()), "as much ink"


def test_captions_are_broken_between_words_not_cut() -> None:
    tile, line = np.ones((10, 80, 3), np.float32), LINE
    low, high = (captioned_sheet([tile, tile], [words, "a"], 2) for words in ("twins", "train, CC0, twins studio"))
    assert high.height == low.height + line  # two lines instead of one
    under = np.asarray(high)[-line:, : 80 + GAP]
    assert (under < 100).any()  # the last words stand there
    assert captioned_sheet([tile], ["w" * 99], 1).height == low.height  # one word has one line
