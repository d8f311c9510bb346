"""Runs: records, resume, the noise ceiling, a folder of predictions against the same method as a plug-in, the
verdict."""

import json
import os
import re
import weakref
from collections.abc import Iterable, Iterator, Sequence
from copy import deepcopy
from dataclasses import replace
from functools import partial
from math import inf
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
from rich.progress import Progress

from unirender.camera import Camera
from unirender.color import srgb_encode, unpremultiply
from unirender.errors import UnirenderError
from unirender.exr import image_channels, intrinsics_channels, write_environment, write_exr
from unirender.intrinsics import Intrinsics
from unirender_evaluation import engine
from unirender_evaluation.ceiling import ceiling_breaches
from unirender_evaluation.engine import Prediction, method_jobs, score
from unirender_evaluation.export import export_inputs
from unirender_evaluation.methods.composite import Composite
from unirender_evaluation.methods.trivial import InputAsAlbedo, MeanAlbedo, MeanNormal, SphereNormal, UneditedInput
from unirender_evaluation.metrics import OWN_MASK
from unirender_evaluation.records import Record, read_records
from unirender_evaluation.report.pictures import Pictures
from unirender_evaluation.rows import Row, make_row, prediction_rows, trivial_rows
from unirender_evaluation.runs.benchmark import _work
from unirender_evaluation.runs.config import BenchConfig
from unirender_evaluation.runs.dry_run import planned
from unirender_evaluation.runs.workers import Run, run_in_workers
from unirender_evaluation.store import KEPT, KEY_PREFIX, Job, Store, content_key
from unirender_evaluation.subsets import Subsets
from unirender_evaluation.suites.suite import Scene, Suite, load_suite
from unirender_evaluation.tables.protocol import doubts, mask_source
from unirender_evaluation.task import PROTOCOLS, Task
from unirender_evaluation.tasks import tasks
from unirender_evaluation.versions import LPIPS, MODEL, REFERENCE, Versions

NO_MITSUBA = Subsets(mitsuba=0)
TEST_VERSIONS = Versions("test", {LPIPS: "none", MODEL: "1", REFERENCE: "1"})


class Guess:
    """A deterministic stranger's method with all four capabilities, good at none."""

    name = "guess"
    config: dict[str, Any] = {"guess": 1}  # noqa: RUF012 - a constant of the test

    def decompose(self, image_srgb: np.ndarray, mask: np.ndarray, camera: Camera) -> Intrinsics:
        grey = np.broadcast_to(image_srgb.mean(axis=-1, keepdims=True), image_srgb.shape).astype(np.float32)
        half = ((mask > 0) * 0.25).astype(np.float32)
        normal = ((mask > 0) * np.array([0, 0, 1])).astype(np.float32)
        return Intrinsics(
            albedo=grey,
            normal=normal,
            metallic=half,
            roughness=half,
            specular=grey,
            diffuse=grey,
            environment=np.full((4, 8, 3), 0.1 + image_srgb.mean(), np.float32),
            mask=mask,
            camera=camera,
        )

    def edit(self, image_srgb: np.ndarray, mask: np.ndarray, camera: Camera, **_: float) -> np.ndarray:
        return (0.5 * image_srgb * mask).astype(np.float32)

    def relight(self, image_srgb: np.ndarray, mask: np.ndarray, camera: Camera, **_: Any) -> np.ndarray:
        return (0.7 * image_srgb * mask).astype(np.float32)

    def render(self, intrinsics: Intrinsics) -> np.ndarray:
        maps = intrinsics.require("albedo", "mask")
        return (0.4 * maps["albedo"] * maps["mask"]).astype(np.float32)


class Halved(Guess):
    """The same, which thinks that the object ends in the middle."""

    name = "halved"
    config: dict[str, Any] = {"guess": 1, "mask": "left half"}  # noqa: RUF012 - a constant of the test

    def decompose(self, image_srgb: np.ndarray, mask: np.ndarray, camera: Camera) -> Intrinsics:
        half = mask * (np.arange(mask.shape[1]) < mask.shape[1] // 2)[:, None].astype(np.float32)
        return super().decompose(image_srgb, mask, camera).replace(mask=half)


class Careless:
    """The same as another method, and spoils everything that it is handed, and what it has returned before."""

    def __init__(self, method: Guess) -> None:
        self.method, self.name, self.config = method, method.name, method.config
        self._before: list[np.ndarray] = []

    def decompose(self, **given: Any) -> Intrinsics:
        return self._spoilt(self.method.decompose, given)

    def edit(self, **given: Any) -> np.ndarray:
        return self._spoilt(self.method.edit, given)

    def relight(self, **given: Any) -> np.ndarray:
        return self._spoilt(self.method.relight, given)

    def render(self, **given: Any) -> np.ndarray:
        return self._spoilt(self.method.render, given)

    def _spoilt(self, answer: Any, given: dict[str, Any]) -> Any:
        made = answer(**{name: deepcopy(value) for name, value in given.items()})
        self._before += [array for value in given.values() for array in _arrays(value)]
        for array in self._before:
            array[...] = 0.125
        self._before = list(_arrays(made))
        return made


def _arrays(value: Any) -> Iterator[np.ndarray]:
    yield from value.maps.values() if isinstance(value, Intrinsics) else [value] * isinstance(value, np.ndarray)


def under_one_light(suite: Suite) -> list[Scene]:
    """Both objects, half of the scenes."""
    return [scene for scene in suite.scenes if scene.key.endswith("_l0")]


def evaluate(suite: Suite, rows: list[Row], path: Path, scenes: Sequence[Scene] = ()) -> list[Record]:
    """The engine on these scenes (none: all) without Mitsuba and LPIPS."""
    store = Store.open(path)
    pictures = path.parent / "pictures" / path.stem
    scenes = scenes or suite.scenes
    whole = Run(suite, rows, list(scenes), TEST_VERSIONS, (), pictures, NO_MITSUBA)
    for scene in scenes:
        for job in whole.jobs(scene):
            if not job.label.startswith("physics") and not job.is_done(store.has):
                store.add(job.make())
    return store.close()


class Watched(Run):
    """A run whose jobs are two stubs a scene; `most` is how many of earlier scenes were alive when a scene began."""

    def jobs(self, scene: Scene) -> Iterator[Job]:
        self.most = max(getattr(self, "most", 0), sum(ref() is not None for ref in self.made))
        for number in range(2):
            key = f"{scene.key} {number}"
            job = Job(key, "stub", partial(Record, "t", "p", "m", key, "o", {}, key))
            self.made.append(weakref.ref(job))
            yield job
            del job

    made: ClassVar[list[weakref.ref[Job]]] = []


def test_jobs_of_one_scene_at_a_time_are_in_memory(
    suite: Suite, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """They hold its pictures, and a suite may have thousands of scenes of any size."""
    scenes = list(suite.scenes)
    run = Watched(suite, [], scenes, TEST_VERSIONS, (), tmp_path / "pictures", NO_MITSUBA)
    config = BenchConfig(out=tmp_path / "run", jobs=0)
    store = Store.open(tmp_path / "records.jsonl")
    _work(run, config, store, Progress(disable=True))
    assert len(store.used) == 2 * len(scenes)
    monkeypatch.setattr("unirender_evaluation.runs.dry_run.prepare", lambda _: run)
    assert sum(row.missing for row in planned(replace(config, methods=())).rows) == 2 * len(scenes)
    assert len(run.made) == 3 * 2 * len(scenes)
    assert run.most <= 1
    kept = [job for scene in scenes for job in run.jobs(scene)]  # the twin
    assert run.most == len(kept) - 2


def test_what_is_done_is_looked_up_without_its_pictures(
    suite: Suite, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A run that is continued asks for every key first; decoding a large suite's pictures for that took minutes."""
    rows = [*trivial_rows(), make_row(Guess(), "external")]
    run = Run(suite, rows, list(suite.scenes), TEST_VERSIONS, (), tmp_path / "pictures", Subsets())
    read: list[str] = []
    channels = Suite._channels
    monkeypatch.setattr(Suite, "_channels", lambda self, name: read.append(name) or channels(self, name))
    jobs = [job for scene in suite.scenes for job in run.jobs(scene)]
    assert all(job.key for job in jobs)
    assert not read
    jobs[0].make()
    assert read


def test_a_cluster_gets_what_is_missing_most_first(
    suite: Suite, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scenes = list(suite.scenes)
    run = Watched(suite, [], scenes, TEST_VERSIONS, (), tmp_path / "pictures", NO_MITSUBA)
    store = Store.open(tmp_path / "records.jsonl")
    done = [*run.jobs(scenes[0]), *list(run.jobs(scenes[1]))[:1]]
    for job in done:
        store.lay_by(job.make())
    given: list[dict[str, frozenset[str]]] = []
    monkeypatch.setattr(
        "unirender_evaluation.runs.benchmark.run_on_cluster",
        lambda _run, _build, _suite, wanted, _: given.append(wanted) or (records for records in ()),
    )
    _work(run, BenchConfig(out=tmp_path / "run", cluster="tcp://nowhere:1"), store, Progress(disable=True))
    assert [(key, len(keys)) for key, keys in given[0].items()] == [
        *((scene.key, 2) for scene in scenes[2:]),
        (scenes[1].key, 1),
    ]


def test_keys_change_with_what_results_depend_on(suite: Suite) -> None:
    scene = suite.scenes[0]
    base = content_key(suite, scene, "inverse/x", {"a": 1}, "code")
    others = {
        content_key(suite, suite.scenes[-1], "inverse/x", {"a": 1}, "code"),
        content_key(suite, scene, "inverse/y", {"a": 1}, "code"),
        content_key(suite, scene, "inverse/x", {"a": 2}, "code"),
        content_key(suite, scene, "inverse/x", {"a": 1}, "other"),
    }
    assert len({base, *others}) == 5
    assert base == content_key(suite, scene, "inverse/x", {"a": 1}, "code")


@pytest.mark.long
def test_workers_give_the_same_numbers(suite: Suite, tmp_path: Path) -> None:
    here = evaluate(suite, trivial_rows(), tmp_path / "here.jsonl")
    whole = Run(suite, trivial_rows(), list(suite.scenes), TEST_VERSIONS, (), tmp_path / "pictures", NO_MITSUBA)
    made = [r for records in run_in_workers(whole, trivial_rows, [suite.scenes[0]], frozenset(), 1) for r in records]
    expected = {r.key: r.values for r in here}
    found = {r.key: r.values for r in made if r.table != "physics"}
    assert len(found) > 20
    assert found.items() <= expected.items()


def test_ceiling_holds_and_a_leaking_method_is_caught(suite: Suite, tmp_path: Path) -> None:
    """Honest rows stay below the noise ceiling; a method that returns the noisy truth itself breaches it."""
    scenes = suite.scenes[:1]
    # This suite's truth is noise-free composites with a claimed noise: its composite row is as good as a leak.
    records = [
        r for r in evaluate(suite, trivial_rows(), tmp_path / "records.jsonl", scenes) if r.method != "composite"
    ]
    assert ceiling_breaches(records) == []
    leaking, better = [], []
    for task in tasks(suite, "rendering", "given", list(scenes)):
        image = task.truth_image
        values = score(task, Prediction(image=image), ())
        assert values[f"{task.quantity}.psnr@masked-srgb-raw"] == inf
        leaking.append(Record(task.table, task.protocol, "leak", task.sample, task.scene.object, values))
    for record in records:
        if record.method == "noise-ceiling" and record.table == "rendering":
            values = {key: value + 3 for key, value in record.values.items()}
            better.append(Record(record.table, record.protocol, "better", record.sample, record.object, values))
    measured = [*records, *leaking, *better]
    breaches = ceiling_breaches(of_four_objects(measured))
    assert {b.method for b in breaches} == {"leak", "better"}
    assert all(b.low_db == (inf if b.method == "leak" else pytest.approx(3)) for b in breaches)


def test_ceiling_of_ssim_is_scored_where_the_suite_has_a_twin(suite: Suite, tmp_path: Path) -> None:
    """PSNR everywhere, SSIM on the one scene of this suite that has renders of more samples; LPIPS without weights: no
    value. A row above it in SSIM is no breach."""
    found = evaluate(suite, [], tmp_path / "records.jsonl", under_one_light(suite))
    records = [record for record in found if record.method == "noise-ceiling"]
    assert all(any(".psnr@" in key for key in r.values) for r in records)
    scored = {r.sample for r in records if any(".ssim@" in key for key in r.values)}
    assert {sample.partition("_l")[0] for sample in scored} == {"ball-0"}
    assert scored < {r.sample for r in records}
    assert not any("lpips" in key for r in records for key in r.values)
    lights = next(r for r in records if r.sample == "ball-0_l0_to_l1" and r.protocol == "from-image-sd").values
    for quantity in ("specular", "diffuse"):
        assert 0.98 < lights[f"{quantity}.ssim@masked-srgb-raw"] < 1
    above = [
        Record(r.table, r.protocol, "above", r.sample, r.object, {k: 1.0 for k in r.values if ".ssim@" in k})
        for r in records
    ]
    assert ceiling_breaches([*records, *above]) == []


@pytest.mark.long
def test_a_partial_run_keeps_the_records_of_the_whole_one(suite: Suite, tmp_path: Path) -> None:
    path = tmp_path / "records.jsonl"
    whole = evaluate(suite, trivial_rows(), path)
    store = Store.open(path)
    assert store.has(whole[0].key)
    assert [record.key for record in store.close()] == [whole[0].key]
    assert [record.key for record in read_records(path)] == [whole[0].key]  # the file is what this run measured
    again = Store.open(path)
    assert all([again.has(record.key) for record in whole])  # and nothing is lost to the next
    again.close()
    assert {record.key for record in read_records(path)} == {record.key for record in whole}


def test_records_of_other_code_are_kept(suite: Suite, tmp_path: Path) -> None:
    """One may return to it: they wait where those wait that a smaller run does not ask for."""
    path = tmp_path / "records.jsonl"
    mine, other = (content_key(suite, suite.scenes[0], "what", {}, code) for code in ("code", "other code"))
    assert other[:KEY_PREFIX] != mine[:KEY_PREFIX]
    for key, others in ((mine, 0), (other, 1), (mine, 1)):
        store = Store.open(path)
        if not store.has(key):
            store.add(Record("inverse", "single-image", "m", "s", "o", {}, key))
        assert store.of_other_code() == others
        assert [record.key for record in store.close()] == [key]
    assert Store.open(path).known.keys() == {mine, other}


def test_of_other_code_the_last_few_records_of_a_measurement_wait(suite: Suite, tmp_path: Path) -> None:
    """However many states of the code a folder has seen; those of other settings are the run's own code's, and stay."""

    def waiting_after(codes: list[str], settings: list[int]) -> list[str]:
        keys = [content_key(suite, suite.scenes[0], "what", {"s": s}, c) for c, s in zip(codes, settings, strict=True)]
        folder = tmp_path / codes[-1]
        folder.mkdir()
        for key in keys:
            store = Store.open(folder / "records.jsonl")
            for sample in ("a", "b"):
                store.add(Record("inverse", "single-image", "m", sample, "o", {}, f"{key}-{sample}"))
            store.close()
        assert (folder / "records.jsonl").read_text().count("\n") == 2
        found = [Record.from_json(line).key for line in (folder / "unused.jsonl").read_text().splitlines()]
        every = [f"{key}-{sample}" for key in keys[:-1] for sample in ("a", "b")]
        assert found == every[len(every) - len(found) :], "the last, in order"
        return found

    count = KEPT + 4
    assert len(waiting_after([f"code {i}" for i in range(count)], [0] * count)) == 2 * KEPT
    assert len(waiting_after(["code"] * count, list(range(count)))) == 2 * (count - 1)


def test_no_file_of_unused_records_where_every_record_is_used(tmp_path: Path) -> None:
    """Neither in a new folder nor after a run has asked again for all that waited."""
    record = Record("inverse", "single-image", "m", "s", "o", {}, "key")
    path = tmp_path / "records.jsonl"
    for laid_by in (True, False):
        store = Store.open(path)
        store.lay_by(record) if laid_by else store.has(record.key)
        store.close()
        assert (tmp_path / "unused.jsonl").exists() == laid_by
    assert path.read_text().count("\n") == 1


class Killer:
    """Ends its process."""

    name = "killer"
    config: ClassVar[dict[str, Any]] = {}

    def edit(self, **_: Any) -> np.ndarray:
        os._exit(9)


def killer_rows() -> list[Row]:
    return [make_row(Killer(), "external")]


@pytest.mark.long
def test_what_was_under_way_in_a_worker_that_died_is_named(suite: Suite, tmp_path: Path) -> None:
    scene = suite.scenes[1]
    run = Run(suite, killer_rows(), [scene], TEST_VERSIONS, (), tmp_path / "pictures", NO_MITSUBA)
    with pytest.raises(UnirenderError, match=rf"a worker process died: .* \(under way: killer on {scene.key}\)"):
        list(run_in_workers(run, killer_rows, [scene], frozenset(), 1))


class Turned(Guess):
    """The same in OpenCV's axes, with no mask."""

    name = "turned"

    def decompose(self, image_srgb: np.ndarray, mask: np.ndarray, camera: Camera) -> Intrinsics:
        found = super().decompose(image_srgb, mask, camera)
        return found.replace(normal=-found.require("normal")["normal"], mask=np.zeros_like(mask))


def repeated(jobs: Iterable[Job]) -> list[Record]:
    """The records of four objects that are one."""
    return of_four_objects([job.make() for job in jobs])


def of_four_objects(records: list[Record]) -> list[Record]:
    """One object's, which tell nothing, four times."""
    return [
        replace(record, sample=f"{record.sample}_{i}", object=f"{record.object}_{i}")
        for i in range(4)
        for record in records
    ]


def test_what_is_probably_a_mistake_is_noted(suite: Suite, tmp_path: Path) -> None:
    """From the records, so that a run which is continued says it, too."""
    rows = [make_row(method, "external") for method in (Turned(), Guess())]
    pictures = Pictures(tmp_path, suite, [])
    records = repeated(method_jobs(suite, rows, [], suite.scenes[0], TEST_VERSIONS, (), pictures))
    n = 4 * len(suite.scenes[0].materials)
    assert doubts("guess", [record for record in records if record.sample.endswith("_0")]) == []
    mask, normals = doubts("turned", records)
    assert re.search(r"misses the object on \d+ of \d+ pictures", mask)
    assert f'with normal_axes = ["+x", "-y", "-z"] (OpenCV?): normal ({n} of {n}, +' in normals


class Encoded(Guess):
    """Answers that are right, but display values, and with y down."""

    name = "encoded"

    def __init__(self, suite: Suite) -> None:
        self.suite = suite

    def decompose(self, image_srgb: np.ndarray, mask: np.ndarray, camera: Camera) -> Intrinsics:
        true = self.suite.intrinsics(self.suite.scenes[0], self.suite.spec.base).require("albedo", "normal")
        down = true["normal"] * np.array([1, -1, 1], np.float32)
        return Intrinsics(albedo=srgb_encode(true["albedo"]), normal=down, camera=camera)

    def edit(self, image_srgb: np.ndarray, mask: np.ndarray, camera: Camera, **change: float) -> np.ndarray:
        metallic, roughness = self.suite.spec.base
        material = change.get("metallic", metallic), change.get("roughness", roughness)
        true = self.suite.image(self.suite.scenes[0], material)
        return srgb_encode(np.clip(unpremultiply(true, mask), 0, 1)) * mask


def test_other_conventions_that_only_the_score_tells_are_noted(suite: Suite, tmp_path: Path) -> None:
    """And those of a sound answer, however bad, are not."""
    sound = [InputAsAlbedo(), MeanAlbedo(), MeanNormal(), SphereNormal(), UneditedInput()]
    rows = [make_row(method, "external") for method in (Encoded(suite), *sound)]
    pictures = Pictures(tmp_path, suite, [])
    records = repeated(method_jobs(suite, rows, [], suite.scenes[0], TEST_VERSIONS, (), pictures))
    (said,) = doubts("encoded", records)
    n = 4 * len(suite.scenes[0].materials)
    assert f"taken for display values (encoded? expected linear): albedo ({n} of {n}, +20.0 dB)" in said
    assert f', and with normal_axes = ["+x", "-y", "+z"] (y down?): normal ({n} of {n}, +20.0 dB)' in said
    assert [note for row in rows[1:] for note in doubts(row.info.key, records[: len(records) // 4])] == []


def test_maps_are_scored_with_the_mask_that_they_bring_and_pictures_with_the_true_one(
    suite: Suite, tmp_path: Path
) -> None:
    rows = [make_row(method, "external") for method in (Guess(), Halved())]
    records = evaluate(suite, rows, tmp_path / "r.jsonl", suite.scenes[:1])
    values = {(r.table, r.protocol, r.sample, r.method): dict(r.values) for r in records}
    assert [mask_source(key, records) for key in ("guess", "halved")] == ["pasted", "own"]
    with_maps = set()
    for (table, protocol, sample, method), own in values.items():
        if method == "halved":
            pasted = values[table, protocol, sample, "guess"]
            different = {key for key in pasted if own[key] != pasted[key]}
            assert all("@whole" in key and not key.startswith(("relit", "edit")) for key in different)
            if OWN_MASK in own:
                with_maps.add((table, protocol))
                assert 0.2 < own[OWN_MASK] < 0.8
            assert bool(different) == (own.keys() - pasted.keys() == {OWN_MASK})
    assert with_maps == {("inverse", "single-image"), ("relighting", "from-image-sd")}


def test_a_method_that_writes_into_what_it_is_handed_changes_nothing(suite: Suite) -> None:
    """Neither the truth, nor what is asked next of it or of others, nor what it said before."""
    asked = [task for question in PROTOCOLS for task in tasks(suite, *question, list(suite.scenes))]
    careful, careless = (make_row(method, "external") for method in (Guess(), Careless(Guess())))
    answers = [[engine.answer(row, task) for row in (careless, careful)] for task in asked]
    for task, (spoilt, right) in zip(asked, answers, strict=True):
        assert np.array_equal(task.mask, suite.mask(task.scene))
        for one, other in ((spoilt.image, right.image), (spoilt.maps, right.maps)):
            arrays = list(_arrays(one)), list(_arrays(other))
            assert len(arrays[0]) == len(arrays[1])
            assert all(map(np.array_equal, *arrays))


def test_folder_and_plugin_score_alike(suite: Suite, tmp_path: Path) -> None:
    """A stranger's method, called and read back from EXR files: the same numbers to half-float rounding."""
    method, folder, scenes = Guess(), tmp_path / "guess", list(suite.scenes[:1])
    for table, protocol in PROTOCOLS:
        for task in tasks(suite, table, protocol, scenes):
            target = folder / task.folder
            target.mkdir(parents=True, exist_ok=True)
            for capability in task.asks:
                result = getattr(method, capability)(**task.inputs[capability])
                if task.asks_light:
                    write_environment(target / "environment.exr", result.environment)
                elif isinstance(result, Intrinsics):
                    write_exr(target / "intrinsics.exr", intrinsics_channels(result), half=False)
                else:
                    write_exr(target / f"{task.answer}.exr", image_channels(result), half=False)
    called = evaluate(suite, [make_row(method, "external")], tmp_path / "called.jsonl", scenes)
    read = evaluate(suite, prediction_rows({"guess": folder}), tmp_path / "read.jsonl", scenes)
    pick = lambda records: {(r.table, r.protocol, r.sample): dict(r.values) for r in records if r.method == "guess"}  # noqa: E731 - one use
    assert pick(called) == pick(read)
    assert all(r.seconds is None for r in read if r.method == "guess"), "reading files is no measurement of a method"
    assert len(pick(read)) == sum(1 for t, p in PROTOCOLS for _ in tasks(suite, t, p, scenes))


def test_export_writes_inputs_and_no_truth(suite: Suite, tmp_path: Path) -> None:
    kinds = export_inputs(suite, tmp_path / "out")
    assert kinds.total() == sum(1 for t, p in PROTOCOLS for _ in tasks(suite, t, p, list(suite.scenes)))
    assert kinds.keys() == {"intrinsics", "environment", "edit", "relight", "render"}
    assert kinds["intrinsics"] == sum(1 for _ in tasks(suite, "inverse", "single-image", list(suite.scenes)))
    names = {path.name for path in (tmp_path / "out").rglob("*") if path.is_file()}
    assert names == {"image.png", "mask.exr", "meta.json", "given.exr", "environment.exr"}
    for meta in (tmp_path / "out").glob("*/meta.json"):
        for answer, question in json.loads(meta.read_text())["answers"].items():
            assert {"table", "protocol"} <= set(question)
            given = meta.parent / answer / "given.exr"
            assert given.exists() == (question["protocol"] in ("given", "given-light", "from-image-sd"))


def test_neither_names_nor_times_of_the_export_tell_what_a_picture_shows(suite: Suite, tmp_path: Path) -> None:
    export_inputs(suite, tmp_path)
    folders = sorted(tmp_path.iterdir())
    assert all(re.fullmatch("[0-9a-f]{12}", folder.name) for folder in folders)
    times = [(folder / "meta.json").stat().st_mtime_ns for folder in folders]
    assert times == sorted(times)
    texts = [str(json.loads((folder / "meta.json").read_text())["answers"]) for folder in folders]
    assert not any(scene.object in text for scene in suite.scenes for text in texts)


def test_a_picture_to_decompose_has_no_other_question_in_its_folder() -> None:
    """Else true maps, or an edit of the base material, would lie beside the picture whose maps are asked for."""
    suite = load_suite("tiny")
    asked: dict[str, set[tuple[str, str]]] = {}
    shown: set[str] = set()
    for question in PROTOCOLS:
        for task in tasks(suite, *question, list(suite.scenes)):
            asked.setdefault(task.folder, set()).add(question)
            if question == ("rendering", "given"):
                shown.add(task.sample)
    inverse = list(tasks(suite, "inverse", "single-image", list(suite.scenes)))
    assert any(task.sample in shown for task in inverse), "one of them is a picture of maps that are given"
    assert all(asked[task.folder] == {("inverse", "single-image")} for task in inverse)


def test_the_order_of_the_questions_does_not_tell_the_material() -> None:
    """That of the suite ascends in metallic: with five pictures a scene its place alone has a mean squared error of
    0.006."""
    suite, order = load_suite("tiny"), list[str]()

    class Seen:
        def has(self, task: Task, method: str, key: str) -> bool:
            if task.table == "inverse":
                order.append(task.sample.removeprefix(task.scene.key))
            return True

        def keep(self, task: Task, method: str, key: str, prediction: Prediction) -> None: ...

    rows, versions = [make_row(Guess(), "external")], Versions("core", {LPIPS: "none", MODEL: "none"})
    for scene in suite.scenes:
        list(method_jobs(suite, rows, list(suite.scenes), scene, versions, (), Seen()))
    places = np.argsort(np.array(order).reshape(-1, 5), axis=1)
    assert len(places) == len(suite.scenes)
    assert np.abs(places.mean(axis=0) - 2).max() < 1, "no place is that of the lower or of the higher values"


def test_limited_rows_run_on_their_subset(suite: Suite, tmp_path: Path) -> None:
    row = make_row(Composite(), "baseline", scenes=2)
    records = [
        r for r in evaluate(suite, [row], tmp_path / "r.jsonl") if r.method == "composite" and r.protocol == "given"
    ]
    assert len(records) == 2 * len(suite.spec.edits)
