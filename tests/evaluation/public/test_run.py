"""`unirender bench public`: records and tables of a run, a second run, plug-in and folder alike, refusals."""

import csv
import inspect
import io
import json
import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from public_folders import make_iiw, make_maw, make_orb
from rich.console import Console

from unirender import cli
from unirender.errors import UnirenderError
from unirender.exr import image_channels, intrinsics_channels, write_exr
from unirender.intrinsics import Intrinsics
from unirender.shipped import checkpoint_folder, checkpoint_sha256
from unirender.visualization import write_png
from unirender_evaluation.methods.plugins import Plugin
from unirender_evaluation.methods.trivial import InputAsAlbedo
from unirender_evaluation.predictions.check import PredictionError
from unirender_evaluation.public import answers
from unirender_evaluation.public import rows as public_rows
from unirender_evaluation.public import run as public_run
from unirender_evaluation.public.answers import takes_part
from unirender_evaluation.public.command import BenchPublic
from unirender_evaluation.public.iiw import Iiw
from unirender_evaluation.public.maw import Maw
from unirender_evaluation.public.orb import StanfordOrb
from unirender_evaluation.public.rows import trivial_rows
from unirender_evaluation.public.run import PublicResult, PublicRun, run
from unirender_evaluation.public.sets import PublicSet
from unirender_evaluation.public.tables import averaged
from unirender_evaluation.records import Record, read_records
from unirender_evaluation.rows import Row, plugin_rows, prediction_rows
from unirender_evaluation.versions import Versions, package_folder
from unirender_reference.folder_lock import LOCK, locked, made_folder


class Ramp:
    """A stranger's method: an albedo that rises to the right, a slanted normal, and the light's mean as the answer."""

    name = "ramp"
    config: dict[str, float] = {}  # noqa: RUF012 - as a stranger writes it

    def decompose(self, image_srgb, mask, camera):
        height, width = mask.shape[:2]
        albedo = np.broadcast_to(np.linspace(0.1, 0.9, width)[None, :, None], (height, width, 3))
        normal = np.broadcast_to(np.array([0.6, 0, 0.8]), (height, width, 3))
        return Intrinsics(albedo=albedo, normal=normal, mask=mask, camera=camera)

    def relight(self, image_srgb, mask, camera, environment=None, specular=None, diffuse=None):
        assert environment is not None
        return (environment.mean(axis=(0, 1)) * mask).astype(np.float32)


def done(public: PublicSet, rows: list[Row], out: Path, limit: int | None = None) -> PublicResult:
    """A run without LPIPS, which other tests hold."""
    what = PublicRun(public, tuple(rows), out, limit, (), Versions("test", {"model": "1", "lpips": "1"}))
    return run(what, Console(file=io.StringIO(), width=200))


def of(result: PublicResult, method: str) -> dict[tuple[str, str], dict[str, float]]:
    return {(r.table, r.sample): dict(r.values) for r in result.records if r.method == method}


def test_a_run_writes_records_and_tables_and_a_second_one_measures_nothing(tmp_path: Path) -> None:
    iiw, out = Iiw(make_iiw(tmp_path / "iiw")), tmp_path / "out"
    first = done(iiw, trivial_rows(iiw), out)
    assert first.computed == len(first.records) == 4
    values = of(first, "input-as-albedo")["iiw", "100"]
    assert values == {"albedo.whdr": 0, "albedo.whdr_equal": 0, "albedo.whdr_unequal": 0}
    assert of(first, "mean-albedo")["iiw", "101"]["albedo.whdr"] == pytest.approx(2 / 3)
    before = {path.name: path.read_bytes() for path in out.iterdir()}
    assert {"records.jsonl", "records.csv", "tables.md", "tables.tex", "tables.json", "run.json"} <= set(before)
    with (out / "records.csv").open() as file:
        lines = list(csv.DictReader(file))
    assert {line["sample"] for line in lines} == {"100", "101"}
    assert len(lines) == 12
    text = before["tables.md"].decode()
    for words in ("delta 0.1", "trained on single objects", "checked on made data", "n: 2 samples"):
        assert words in text
    assert "\\toprule" in before["tables.tex"].decode()
    assert done(iiw, trivial_rows(iiw), out).computed == 0
    assert {path.name: path.read_bytes() for path in out.iterdir()} == before


class Encoded(Ramp):
    """Display values where linear ones are asked for, and normals with y down."""

    name = "encoded"

    def decompose(self, image_srgb, mask, camera):
        y = np.linspace(0.9, -0.9, len(image_srgb))[:, None]
        normal = np.broadcast_to(np.stack([0 * y, -y, np.sqrt(1 - y**2)], axis=-1), image_srgb.shape)
        return Intrinsics(albedo=image_srgb, normal=normal, mask=mask, camera=camera)


def test_usual_mistakes_of_a_stranger_are_noted(tmp_path: Path) -> None:
    """By the code of other runs: nearly all pictures of four objects, here categories; not of a trivial row."""
    folder = make_maw(tmp_path / "maw")
    meta, photos = folder / "labels" / "meta.csv", folder / "images_png"
    line = meta.read_text()
    for name in ("scene_1", "scene_2", "scene_3"):
        shutil.copytree(photos / "scene_0", photos / name)
        meta.write_text(meta.read_text() + line.replace("scene_0", name))
    maw = Maw(folder)
    result = done(maw, [*trivial_rows(maw), *plugin_rows([Plugin(Encoded(), "test")])], tmp_path / "out")
    notes = [note for note in result.tables[0].notes if "nearer to the truth" in note]
    assert [note.split(":")[0] for note in notes] == ["encoded"]
    assert "taken for display values (encoded? expected linear): albedo (4 of 4, +20.0 dB)" in notes[0]
    assert not any(".if_" in key for values in of(result, "input-as-albedo").values() for key in values)


def test_each_map_of_a_public_set_tells_its_mistakes(tmp_path: Path) -> None:
    orb = StanfordOrb(make_orb(tmp_path / "orb"), 32)
    found = of(done(orb, plugin_rows([Plugin(Encoded(), "test")]), tmp_path / "out"), "encoded")
    maps = found["stanford-orb", "cup_scene001_0000"]
    gains = {key: value for key, value in maps.items() if key.startswith("normal.if_")}
    assert gains["normal.if_y_down"] == max(gains.values()) > 1
    assert "albedo.if_bgr" in maps
    assert any("relit.if_bgr" in values for values in found.values())


def test_only_what_changed_is_measured_again(tmp_path: Path) -> None:
    folder, out = make_iiw(tmp_path / "iiw"), tmp_path / "out"
    iiw = Iiw(folder)
    done(iiw, trivial_rows(iiw)[:1], out)
    assert done(iiw, trivial_rows(iiw), out).computed == 2  # one more row
    path = folder / "data" / "100.json"
    path.write_text(path.read_text().replace('"darker": "1"', '"darker": "2"'))
    iiw = Iiw(folder)
    changed = done(iiw, trivial_rows(iiw), out)
    assert changed.computed == 2
    assert of(changed, "input-as-albedo")["iiw", "100"]["albedo.whdr"] == pytest.approx(2 / 3)
    assert done(Iiw(folder, 15), trivial_rows(iiw), out).computed == 4  # another resolution
    later = PublicRun(iiw, tuple(trivial_rows(iiw)), out, None, (), Versions("changed", {}))
    assert run(later, Console(file=io.StringIO())).computed == 4  # other code


@pytest.mark.parametrize("public", [StanfordOrb, Iiw, Maw])
def test_every_module_that_measures_is_in_the_keys(public: type) -> None:
    """All that a reader imports of its package."""
    folder = package_folder("unirender_evaluation") / "public"
    named = {path.stem for name in public.modules for path in folder.parent.glob(f"{name}.py")}
    text = Path(inspect.getfile(public)).read_text()
    imported = set(re.findall(r"unirender_evaluation\.public(?:\.| import )(\w+)", text))
    assert imported
    assert {path.stem for path in folder.glob("*.py")} >= named >= imported


class Dark(Ramp):
    """A Ramp whose pictures are black."""

    name = "dark"

    def relight(self, image_srgb, mask, camera, environment=None, specular=None, diffuse=None):
        return np.zeros_like(image_srgb)


class Silent:
    """Has no answer."""

    name = "silent"
    config: dict[str, float] = {}  # noqa: RUF012 - as a stranger writes it

    def decompose(self, image_srgb, mask, camera):
        return None

    def relight(self, image_srgb, mask, camera, environment=None, specular=None, diffuse=None):
        return None


def test_none_is_no_answer(tmp_path: Path) -> None:
    """It is asked all that it is there for, and stands in no table."""
    orb = StanfordOrb(make_orb(tmp_path / "orb"), 32, 60.0)
    result = done(orb, plugin_rows([Plugin(kind(), "test") for kind in (Silent, Ramp, Dark)]), tmp_path / "out")
    assert {record.method for record in result.records} == {"ramp", "dark"}
    assert all(0 < (record.seconds or 0) < 60 for record in result.records)
    assert "dark: 8 of 8 PSNRs are the benchmark's floor." in result.tables[1].notes
    assert result.computed == len(result.records), "of the records that the run has"
    asked = [record.method for record in read_records(tmp_path / "out" / "records.jsonl")]
    assert asked.count("silent") == asked.count("ramp") > 0


def test_what_a_plug_in_leaves_open_is_listed(tmp_path: Path) -> None:
    """None for one photograph, no `relight`; what no single picture answers is nobody's gap."""

    class Half:
        name, config = "half", Ramp.config

        def decompose(self, image_srgb, mask, camera):
            return None if np.array_equal(image_srgb, left_out) else Ramp().decompose(image_srgb, mask, camera)

    orb, out = StanfordOrb(make_orb(tmp_path / "orb"), 32), tmp_path / "out"
    samples = [sample for sample in orb.samples() if sample.one_picture]
    left_out = orb.inputs(samples[0])["image_srgb"]
    result = done(orb, plugin_rows([Plugin(Half(), "test")]), out)
    open_ = [f"{sample.table}/{sample.key}" for sample in (samples[0], *samples[3:])]
    assert result.missing == {"half": open_}
    assert (out / "missing.txt").read_text() == "".join(f"half: {name}\n" for name in open_)
    assert f"half: no answer to 1: {samples[0].key}." in (out / "tables.md").read_text()


def test_a_table_that_nothing_can_be_asked_for_is_explained(tmp_path: Path) -> None:
    """The relighting of Stanford-ORB, where no photograph is from nearly the other's camera."""
    folder = make_orb(tmp_path / "orb")
    path = folder / "blender_LDR/cup_scene001/transforms_test.json"
    path.write_text(path.read_text().replace("0.6", "0.8"))  # another field of view
    said = {}
    for degrees in (2.0, 60.0):
        orb, console = StanfordOrb(folder, 32, degrees), Console(file=io.StringIO(), width=200)
        rows = tuple(plugin_rows([Plugin(Ramp(), "test")]))
        what = PublicRun(
            orb, rows, tmp_path / f"out-{degrees}", None, (), Versions("test", {"model": "1", "lpips": "1"})
        )
        result = run(what, console)
        assert isinstance(console.file, io.StringIO)
        said[degrees] = (len(result.tables), console.file.getvalue())
    line = (
        "relighting: 0 of 2 photographs were taken from within 2 degrees of a photograph of the capture that is relit; "
        "see --tolerance-deg\n"
    )
    assert (said[2.0][0], line in said[2.0][1]) == (1, True)
    assert (said[60.0][0], "relighting: 0 of" in said[60.0][1]) == (2, False)
    (folder / "blender_LDR/cup_scene001/transforms_novel.json").unlink()
    assert StanfordOrb(folder, 32).why_absent("stanford-orb-relighting") is None  # nothing is asked of anybody


def test_maps_of_a_folder_that_are_not_asked_for_are_no_answer(tmp_path: Path) -> None:
    """As those of a plug-in: IIW asks for albedo alone."""
    iiw = Iiw(make_iiw(tmp_path / "iiw"))
    sample = iiw.samples()[0]
    folder = tmp_path / "mine" / sample.key
    folder.mkdir(parents=True)
    write_png(folder / "roughness.png", np.zeros((*iiw.frame(sample)[0], 1), np.float32))
    result = done(iiw, prediction_rows({"mine": tmp_path / "mine"}), tmp_path / "out")
    assert result.missing == {"mine": [f"{sample.table}/{sample.key}" for sample in iiw.samples()]}


def test_a_limit_is_a_watermark(tmp_path: Path) -> None:
    iiw = Iiw(make_iiw(tmp_path / "iiw"))
    result = done(iiw, trivial_rows(iiw), tmp_path / "out", limit=1)
    assert {record.sample for record in result.records} == {"100"}
    assert "--limit 1: a partial run" in (tmp_path / "out" / "tables.md").read_text()
    done(iiw, trivial_rows(iiw), tmp_path / "out", limit=len(iiw.samples()))
    assert "--limit" not in (tmp_path / "out" / "tables.md").read_text(), "it takes all"


def test_a_killed_run_leaves_no_table_and_goes_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    iiw, out = Iiw(make_iiw(tmp_path / "iiw")), tmp_path / "out"
    rows, ask = trivial_rows(iiw), answers.asked

    def killed(row: Row, sample, inputs):
        if sample.key == "101":
            raise KeyboardInterrupt
        return ask(row, sample, inputs)

    monkeypatch.setattr(public_run, "asked", killed)
    with pytest.raises(KeyboardInterrupt):
        done(iiw, rows, out)
    assert [path.name for path in out.iterdir()] == ["records.jsonl"]
    assert len(read_records(out / "records.jsonl")) == 2
    monkeypatch.undo()
    continued = done(iiw, rows, out)
    assert continued.computed == 2
    whole = done(iiw, rows, tmp_path / "whole")

    def told(records: tuple[Record, ...]) -> list[tuple]:
        return [(r.method, r.sample, r.key, dict(r.values)) for r in records]

    assert told(continued.records) == told(whole.records)
    assert (out / "tables.md").read_text() == (tmp_path / "whole" / "tables.md").read_text()


def test_a_second_run_in_the_same_folder_waits_for_the_first(tmp_path: Path) -> None:
    iiw, out = Iiw(make_iiw(tmp_path / "iiw")), tmp_path / "out"
    with made_folder(out), locked(out):
        with pytest.raises(UnirenderError, match="another run is writing here"):
            done(iiw, trivial_rows(iiw), out)
        assert [path.name for path in out.iterdir()] == [LOCK]
    assert done(iiw, trivial_rows(iiw), out).computed == 4


def test_orb_averages_each_capture_first(tmp_path: Path) -> None:
    """The first capture has one photograph with maps, the second two."""
    orb = StanfordOrb(make_orb(tmp_path / "orb"), 32)
    first = done(orb, plugin_rows([Plugin(Ramp(), "test")]), tmp_path / "out")
    records = [
        replace(r, values={"normal.angle": value}) for r, value in zip(first.records[:3], (1.0, 2.0, 6.0), strict=True)
    ]
    assert [r.sample for r in records] == ["cup_scene001_0000", "cup_scene002_0000", "cup_scene002_0001"]
    units = averaged(orb, records)
    assert [(r.sample, dict(r.values)) for r in units] == [
        ("cup_scene001", {"normal.angle": 1.0}),
        ("cup_scene002", {"normal.angle": 4.0}),
    ]
    iiw = Iiw(make_iiw(tmp_path / "iiw"))
    assert averaged(iiw, records) == records
    text = (tmp_path / "out" / "tables.md").read_text()
    assert "3 samples of 1 objects or scenes; means over 2 captures, each the mean of its samples" in text


def write_predictions(public: PublicSet, method: Ramp, folder: Path, leave_out: str = "") -> Path:
    """What a method answers, as a folder of predictions has it."""
    for sample in public.samples():
        if not sample.one_picture or sample.key == leave_out:
            continue
        place = folder / sample.folder
        place.mkdir(parents=True, exist_ok=True)
        inputs = public.inputs(sample)
        if sample.asks == "relight":
            write_exr(place / f"{sample.answer}.exr", image_channels(method.relight(**inputs)), half=False)
        else:
            maps = method.decompose(**inputs)
            depth = {"depth.Z": np.full((maps.height, maps.width), 2.5, np.float32)} if "orb" in public.name else {}
            write_exr(place / "intrinsics.exr", intrinsics_channels(maps) | depth, half=False)
    return folder


@pytest.mark.parametrize("name", ["stanford-orb", "iiw", "maw"])
def test_plug_in_and_folder_have_the_same_numbers(name: str, tmp_path: Path) -> None:
    makers = {
        "stanford-orb": lambda path: StanfordOrb(make_orb(path), 32),
        "iiw": lambda path: Iiw(make_iiw(path)),
        "maw": lambda path: Maw(make_maw(path)),
    }
    public = makers[name](tmp_path / "set")
    folder = write_predictions(public, Ramp(), tmp_path / "predictions")
    rows = [*plugin_rows([Plugin(Ramp(), "source")]), *prediction_rows({"folder": folder})]
    result = done(public, rows, tmp_path / "out")
    plugin, read = of(result, "ramp"), of(result, "folder")
    assert plugin.keys() == read.keys()
    for sample, values in plugin.items():
        both = {key: value for key, value in read[sample].items() if not key.startswith("depth.")}
        assert both == pytest.approx(values), sample
    assert plugin


def test_a_folder_s_depth_is_scored(tmp_path: Path) -> None:
    orb = StanfordOrb(make_orb(tmp_path / "set"), 32)
    folder = write_predictions(orb, Ramp(), tmp_path / "predictions")
    result = done(orb, prediction_rows({"mine": folder}), tmp_path / "out")
    depths = [v["depth.si_mse"] for (table, _), v in of(result, "mine").items() if table == "stanford-orb"]
    assert len(depths) == 3
    assert min(depths) > 0  # a plane is no sphere
    assert "Depth SI-MSE" in (tmp_path / "out" / "tables.md").read_text()
    relit = of(result, "mine")["stanford-orb-relighting", "cup_scene001/relight_cup_scene002_0000"]
    assert relit["relit.psnr_l@aligned_rgb"] > relit["relit.psnr_l@raw"]


def test_what_a_folder_leaves_open_is_listed(tmp_path: Path) -> None:
    orb = StanfordOrb(make_orb(tmp_path / "set"), 32)
    folder = write_predictions(orb, Ramp(), tmp_path / "predictions", leave_out="cup_scene002_0001")
    result = done(orb, prediction_rows({"mine": folder}), tmp_path / "out")
    beside = "stanford-orb-relighting/cup_scene001/relight_cup_scene002_0001"
    assert result.missing == {"mine": ["stanford-orb/cup_scene002_0001", beside]}
    assert (tmp_path / "out" / "missing.txt").read_text() == f"mine: stanford-orb/cup_scene002_0001\nmine: {beside}\n"
    assert "mine: no answer to 1: cup_scene002_0001." in (tmp_path / "out" / "tables.md").read_text()
    done(orb, trivial_rows(orb)[:1], tmp_path / "out")
    assert not (tmp_path / "out" / "missing.txt").exists(), "that of an earlier run says nothing of this one"


def test_all_problems_of_a_folder_are_named_before_anything_runs(tmp_path: Path) -> None:
    iiw, folder = Iiw(make_iiw(tmp_path / "set")), tmp_path / "predictions"
    for name, size in (("100", (20, 30)), ("101", (10, 15)), ("no-such", (20, 30))):
        (folder / name).mkdir(parents=True)
        write_png(folder / name / "albedo.png", np.full((*size, 3), 0.5, np.float32))
    with pytest.raises(PredictionError) as caught:
        done(iiw, prediction_rows({"mine": folder}), tmp_path / "out")
    said = "\n".join(caught.value.problems)
    assert "101/albedo.png: albedo is 15 x 10 pixels, expected 30 x 20" in said
    assert "no-such: the suite 'iiw' has no such picture" in said
    assert not (tmp_path / "out").exists()


def test_a_method_is_asked_what_one_picture_can_answer(tmp_path: Path) -> None:
    orb = StanfordOrb(make_orb(tmp_path), 32)
    (ramp,) = plugin_rows([Plugin(Ramp(), "source")])
    (albedo,) = plugin_rows([Plugin(InputAsAlbedo(), "source")])
    assert [takes_part(ramp, sample) for sample in orb.samples()] == [True, True, True, True, False]
    assert [takes_part(albedo, sample) for sample in orb.samples()] == [True, True, True, False, False]


def test_our_model_is_asked_once_anchored_where_a_set_relights(tmp_path: Path) -> None:
    """And only there: its maps are those of the row beside it."""
    orb = StanfordOrb(make_orb(tmp_path / "orb"), 32)
    plain, anchored = public_rows.our_rows(orb, Path("small"), "cpu")
    assert [row.config["anchored"] for row in (plain, anchored)] == [False, True]
    assert plain.config["weights"] == anchored.config["weights"] == checkpoint_sha256(checkpoint_folder(Path("small")))
    relit = [sample.asks == "relight" and sample.one_picture for sample in orb.samples()]
    assert [takes_part(anchored, sample) for sample in orb.samples()] == relit
    assert [takes_part(plain, sample) for sample in orb.samples()] == [True, True, True, True, False]
    iiw = Iiw(make_iiw(tmp_path / "iiw"))
    (alone,) = public_rows.our_rows(iiw, None, "cpu")
    assert not alone.config["anchored"]
    names = ["unedited-input", "input-as-albedo", "mean-albedo", "mean-normal", "sphere-normal"]
    assert [[row.info.key for row in trivial_rows(public)] for public in (orb, iiw)] == [names, names[1:3]]
    mine = {"mine": write_predictions(iiw, Ramp(), tmp_path / "mine")}
    rows = public_rows.public_rows(iiw, ("plugins",), predictions=mine)
    assert [row.info.key for row in rows if row.info.kind == "external"][-1:] == ["mine"]
    assert {*names[1:3]} < {row.info.key for row in rows}, "whoever is there is held against them"


def test_every_option_reaches_the_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each with a value that is not its default."""
    orb, rows = make_orb(tmp_path / "orb"), list[tuple]()
    runs, predictions = list[PublicRun](), tmp_path / "mine"
    predictions.mkdir()
    monkeypatch.setattr(public_rows, "public_rows", lambda *given: rows.append(given) or [])
    monkeypatch.setattr(public_run, "run", lambda what, _: runs.append(what))
    words = ["--out", tmp_path / "out", "--limit", 1, "--resolution", 16, "--tolerance-deg", 5, "--checkpoint", "small"]
    words += ["--methods", "ours", "--method", "a:B", "--predictions", f"mine={predictions}", "--device", "auto"]
    assert command("stanford-orb", str(orb), *map(str, words)) == 0
    ((public, *given),), (what,) = rows, runs
    assert given == [("ours",), ("a:B",), {"mine": predictions}, Path("small"), "auto"]
    assert what.public is public
    assert (public.folder, public.resolution, public.tolerance_deg) == (orb, 16, 5)
    assert (what.out, what.limit) == (tmp_path / "out", 1)
    assert command("iiw", "set") == 0
    assert runs[-1].out == Path("results/public-iiw")
    readers = BenchPublic("iiw", orb, resolution=16).reader(), BenchPublic("maw", orb, resolution=16).reader()
    for reader, kind in zip(readers, (Iiw, Maw), strict=True):
        assert isinstance(reader, kind)
        assert (reader.folder, reader.resolution) == (orb, 16)
    assert Iiw(orb).resolution == BenchPublic("iiw", orb).resolution
    usual = BenchPublic("stanford-orb", orb).reader()
    assert isinstance(usual, StanfordOrb)
    assert usual.tolerance_deg == StanfordOrb(orb).tolerance_deg == 2


def command(*words: str) -> int:
    with pytest.raises(SystemExit) as end:
        cli.main(["bench", "public", *words])
    return int(end.value.code or 0)


def test_the_command_scores_a_file_s_method(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder, out = make_maw(tmp_path / "maw"), tmp_path / "out"
    method = tmp_path / "naive.py"
    method.write_text(
        "import numpy as np\nfrom unirender import Intrinsics\n\n\nclass Grey:\n    name, config = 'grey', {}\n\n"
        "    def decompose(self, image_srgb, mask, camera):\n"
        "        return Intrinsics(albedo=np.full_like(image_srgb, 0.5), mask=mask, camera=camera)\n"
    )
    assert command("maw", str(folder), "--out", str(out), "--methods", "plugins", "--method", f"{method}:Grey") == 0
    shown = json.loads((out / "tables.json").read_text())
    assert {row["label"] for table in shown for row in table["rows"]} == {"grey", "input as albedo", "mean albedo"}
    assert "MAW" in capsys.readouterr().out


def test_the_command_refuses(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = make_iiw(tmp_path / "iiw")
    (folder / "data" / "100.png").unlink()
    (folder / "data" / "101.png").unlink()
    assert command("iiw", str(folder), "--out", str(tmp_path / "out"), "--methods", "trivial") == 1
    assert len([line for line in capsys.readouterr().err.splitlines() if "no such file" in line]) == 2
    assert command("iiw", str(folder), "--tolerance-deg", "3") == 2
    assert command("iiw", str(folder), "--resolution", "0") == 2
    assert command("iiw", str(folder), "--methods", "paper") == 2
    assert command("iiw", str(folder), "--methods", "plugins", "--predictions", "a") == 2
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_our_model_answers_every_question(tmp_path: Path) -> None:
    folder, out = make_orb(tmp_path / "orb"), tmp_path / "out"
    assert command("stanford-orb", str(folder), "--out", str(out), "--resolution", "32", "--methods", "ours") == 0
    records = read_records(out / "records.jsonl")
    maps = [r for r in records if r.table == "stanford-orb"]
    relit = [r for r in records if r.table == "stanford-orb-relighting"]
    assert {r.method for r in maps} == {"ours-mean"}
    assert {r.method for r in relit} == {"ours-mean", "ours-mean-anchored"}
    assert all(
        {"normal.cosine_distance", "albedo.psnr_l@raw", "albedo.lpips_alex@aligned_rgb"} <= set(r.values) for r in maps
    )
    assert "LPIPS backbones: alex; vgg: no weights here, no column" in " ".join((out / "tables.md").read_text().split())
    assert all(r.values["normal.cosine_distance"] < 0.5 for r in maps)  # a ball is seen as one; random normals have 1
