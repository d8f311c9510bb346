"""`unirender bench sampling`: calibration of distributions that are known; measured once, stored, continued."""

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console
from tiny_models import make_pipeline

from unirender.command_line.options import ModelOptions
from unirender.errors import UnirenderError
from unirender.models.precision import resolve_device
from unirender.shipped import checkpoint_folder, checkpoint_sha256
from unirender_evaluation.metrics import DEFAULT_VARIANT
from unirender_evaluation.records import Record
from unirender_evaluation.rows import evenly
from unirender_evaluation.statistics import UNPRINTED
from unirender_evaluation.studies.cells import difference
from unirender_evaluation.studies.sampling import run as run_module
from unirender_evaluation.studies.sampling.calibration import Calibration, calibrate, pool
from unirender_evaluation.studies.sampling.command import BenchSampling
from unirender_evaluation.studies.sampling.measure import DECOMPOSE, MEAN, RENDER, Case, SamplingStudy, Setting, measure
from unirender_evaluation.studies.sampling.plots import PANELS, draw_reliability
from unirender_evaluation.studies.sampling.run import run
from unirender_evaluation.studies.sampling.tables import COLUMNS, calibration_table, headline, quality_table, tables
from unirender_evaluation.suites.suite import Suite
from unirender_evaluation.versions import MODEL, Versions

VERSIONS = Versions("test", {MODEL: "1"})
PIXELS, COUNT = 20_000, 5
PSNR = COLUMNS[0].key(DEFAULT_VARIANT)


class CountingPipeline:
    """A tiny pipeline that counts what it is asked."""

    def __init__(self) -> None:
        self.pipeline, self.asked = make_pipeline(), 0

    def decompose(self, *args: Any, **kwargs: Any) -> Any:
        self.asked += 1
        return self.pipeline.decompose(*args, **kwargs)

    def render(self, *args: Any, **kwargs: Any) -> Any:
        self.asked += 1
        return self.pipeline.render(*args, **kwargs)


@pytest.fixture(scope="module")
def what(suite: Suite, tmp_path_factory: pytest.TempPathFactory) -> SamplingStudy:
    """Two balls of 32 pixels and an untrained model; nothing is measured yet."""
    out = tmp_path_factory.mktemp("sampling")
    return SamplingStudy(suite, out, CountingPipeline(), "none", "cpu", (1, 2), (1, 3), "ddim", 0, VERSIONS)


@pytest.fixture(scope="module")
def records(what: SamplingStudy, tmp_path_factory: pytest.TempPathFactory) -> list[Record]:
    """One scene of each object."""
    console = Console(file=(tmp_path_factory.mktemp("console") / "out.txt").open("w+"), width=250)
    return run(what, what.suite.scenes[::2], console)


def drawn(spread_factor: float = 1.0, scale: float = 0.3) -> Calibration:
    """Samples and truth from normal distributions; the samples' width is that of the truth times a factor.

    The widths differ from pixel to pixel by a factor of up to 30, so that spread and error have ranks.
    """
    rng = np.random.default_rng(0)
    center, width = rng.uniform(size=(PIXELS, 1)), scale * np.exp(rng.uniform(-3.4, 0, (PIXELS, 1)))
    truth = center + width * rng.standard_normal((PIXELS, 1))
    samples = center + spread_factor * width * rng.standard_normal((COUNT, PIXELS, 1))
    return calibrate(samples, truth, np.ones(PIXELS))


def test_samples_of_the_truths_own_distribution_are_calibrated() -> None:
    found = drawn()
    assert pool([found]).ratio == pytest.approx(1, abs=0.03)
    assert found.coverage == pytest.approx(0.9, abs=0.01)
    assert found.expected == pytest.approx(found.variance * (1 + 1 / COUNT))
    assert found.rank is not None
    assert found.rank > 0.4


def test_half_the_spread_is_twice_too_sure() -> None:
    """The twin. The mean of samples of width sigma/2 errs by sigma^2 (1 + 1/4N), and sigma^2 (1 + 1/N) / 4 is said."""
    found = drawn(spread_factor=0.5)
    ratio = math.sqrt((1 + 0.25 / COUNT) / (0.25 * (1 + 1 / COUNT)))
    assert pool([found]).ratio == pytest.approx(ratio, rel=0.03)
    assert ratio == pytest.approx(2, rel=0.1), "2 but for the mean's own noise"
    assert found.coverage < 0.75


def test_the_ratio_is_that_of_many_samples_at_any_number() -> None:
    """With sqrt(1 + 1/N) left out, two samples of the truth's own distribution would seem too sure by a fifth."""
    rng = np.random.default_rng(1)
    truth, samples = rng.standard_normal((PIXELS, 1)), rng.standard_normal((2, PIXELS, 1))
    found = calibrate(samples, truth, np.ones(PIXELS))
    assert pool([found]).ratio == pytest.approx(1, abs=0.03)
    assert math.sqrt(found.squared_error / found.variance) == pytest.approx(math.sqrt(1.5), abs=0.03)
    assert found.coverage == pytest.approx(0.9, abs=0.01)


def test_reliability_bins_hold_the_whole_error_and_follow_the_spread() -> None:
    found = drawn()
    assert sum(bin_.weight for bin_ in found.bins) == pytest.approx(1)
    assert sum(bin_.squared_error for bin_ in found.bins) == pytest.approx(found.squared_error)
    assert sum(bin_.variance for bin_ in found.bins) == pytest.approx(found.expected)
    errors = [math.sqrt(bin_.squared_error / bin_.weight) for bin_ in found.bins if bin_.weight > 0.01]
    assert errors == sorted(errors)
    assert errors[-1] > 8 * errors[0]


def test_weights_choose_the_pixels() -> None:
    """Pixels of weight 0 may hold anything."""
    rng = np.random.default_rng(2)
    truth, samples = rng.standard_normal((400, 3)), rng.standard_normal((COUNT, 400, 3))
    weights = np.repeat([1.0, 0.0], 200)
    samples[:, 200:] += 1e3
    part = calibrate(samples[:, :200], truth[:200], np.ones(200))
    assert calibrate(samples, truth, weights).values("albedo") == pytest.approx(part.values("albedo"))
    with pytest.raises(UnirenderError, match="expected at least 2 samples"):
        calibrate(samples[:1], truth, weights)
    with pytest.raises(UnirenderError, match="a weight of 0"):
        calibrate(samples, truth, np.zeros(400))


def test_a_constant_map_has_no_rank_and_no_spread_is_infinitely_sure() -> None:
    truth, samples = np.full((50, 1), 0.5), np.full((3, 50, 1), 0.25)
    found = calibrate(samples, truth, np.ones(50))
    assert found.rank is None
    assert found.coverage == 0
    assert pool([found]).ratio == math.inf
    assert Calibration.of_values("albedo", found.values("albedo")) == found
    assert Calibration.of_values("normal", found.values("albedo")) is None


def test_everything_is_measured(what: SamplingStudy, records: list[Record]) -> None:
    assert [s.key for s in what.settings] == ["mean", "sample-1x1", "sample-2x1", "sample-1x3", "sample-2x3"]
    assert len(records) == 2 * 2 * len(what.settings)
    for record in records:
        key = PSNR if record.protocol == DECOMPOSE else COLUMNS[-1].key(DEFAULT_VARIANT)
        assert np.isfinite(record.values[key])
        has_spread = record.protocol == DECOMPOSE and record.method.endswith("x3")
        assert any(".spread." in key for key in record.values) == has_spread
    with_spread = next(record for record in records if record.method == "sample-2x3" and record.protocol == DECOMPOSE)
    for name in ("albedo", "normal", "roughness", "metallic", "specular", "diffuse", "environment"):
        found = Calibration.of_values(name, with_spread.values)
        assert found is not None, name
        assert found.variance > 0
    assert "roughness.spread.rank" not in with_spread.values, "one value per object"


def test_fewer_samples_are_the_first_of_many(what: SamplingStudy, records: list[Record]) -> None:
    """To the rounding of another batch size: the record of one sample is what a call for one sample gives."""
    scene = what.suite.scenes[0]
    alone = Case(replace(what, samples=(1,)), scene).values(DECOMPOSE, Setting("sample", 2, 1))
    record = next(r for r in records if (r.sample, r.method, r.protocol) == (scene.key, "sample-2x1", DECOMPOSE))
    assert alone[PSNR] == pytest.approx(record.values[PSNR], abs=1e-3)
    other = next(r for r in records if (r.sample, r.method, r.protocol) == (scene.key, "sample-2x3", DECOMPOSE))
    assert abs(other.values[PSNR] - record.values[PSNR]) > 1e-3


def test_render_is_given_s_and_d_and_the_sampler_is_asked_for(what: SamplingStudy) -> None:
    """Two steps of one sampler are not two steps of the other; scenes take the suite's edits in turn."""
    asked = []

    class Renders:
        def render(self, intrinsics: Any, **how: Any) -> np.ndarray:
            asked.append((intrinsics, how))
            return np.zeros((intrinsics.height, intrinsics.width, 3), np.float32)

    for sampler in ("ddim", "unipc"):
        for scene in what.suite.scenes[:2]:
            Case(replace(what, pipeline=Renders(), sampler=sampler), scene).values(RENDER, Setting("sample", 2, 3))
    assert [how["sampler"] for _, how in asked] == ["ddim", "ddim", "unipc", "unipc"]
    for maps, how in asked:
        assert {"albedo", "specular", "diffuse"} <= set(maps.present)
        assert "environment" not in maps.present
        assert (how["num_inference_steps"], how["num_samples"]) == (2, 3)
    first, second = (maps.require("roughness", "metallic") for maps, _ in asked[:2])
    assert any(first[name].max() != second[name].max() for name in first)


def test_a_second_run_measures_nothing(what: SamplingStudy, records: list[Record]) -> None:
    asked = what.pipeline.asked
    again = list(measure(what, what.suite.scenes[::2]))
    assert not any(new for _, new in again)
    assert [record for record, _ in again] == records
    assert what.pipeline.asked == asked


def test_keys_follow_what_a_record_depends_on(what: SamplingStudy) -> None:
    """Other numbers of steps beside it leave a record valid."""
    scene, setting = what.suite.scenes[0], Setting("sample", 2, 3)
    key = what.key(scene, DECOMPOSE, setting)
    assert replace(what, steps=(1, 2, 50), samples=(3,)).key(scene, DECOMPOSE, setting) == key
    others = [
        replace(what, weights="other").key(scene, DECOMPOSE, setting),
        replace(what, seed=1).key(scene, DECOMPOSE, setting),
        replace(what, sampler="unipc").key(scene, DECOMPOSE, setting),
        replace(what, versions=Versions("test", {MODEL: "2"})).key(scene, DECOMPOSE, setting),
        what.key(scene, RENDER, setting),
        what.key(scene, DECOMPOSE, Setting("sample", 1, 3)),
        what.key(what.suite.scenes[1], DECOMPOSE, setting),
    ]
    assert len({key, *others}) == len(others) + 1
    mean = what.key(scene, DECOMPOSE, MEAN)
    assert replace(what, sampler="unipc", seed=1).key(scene, DECOMPOSE, MEAN) == mean, "it draws from neither"


def test_tables_show_what_was_measured(what: SamplingStudy, records: list[Record]) -> None:
    table = quality_table(records, what.settings)
    assert table.title.endswith("n = 2")
    assert [len(section) for section in table.sections] == [1, 2, 2]
    row = next(row for section in table.sections for row in section if row[:3] == ("sample", "2", "3"))
    mean = np.mean([r.values[PSNR] for r in records if r.method == "sample-2x3" and r.protocol == DECOMPOSE])
    assert row[3].startswith(f"{mean:.2f}")
    calibrated = calibration_table(records, Setting("sample", 2, 3))
    assert [row[0] for row in calibrated.sections[0]][:2] == ["albedo", "normal"]
    own = [r for r in records if r.method == "sample-2x3" and r.protocol == DECOMPOSE]
    error = np.mean([record.values["albedo.spread.squared_error"] for record in own])
    assert calibrated.sections[0][0][1] == f"{math.sqrt(error):.3f}"
    assert UNPRINTED in calibrated.notes
    text = (what.out / "sampling.md").read_text()
    assert table.markdown() in text
    assert "Protocol: pictures: 2 of 2 objects" in text
    content = json.loads((what.out / "sampling.json").read_text())
    assert content["quality"]["sample-2x3"][PSNR]["mean"] == pytest.approx(mean)
    assert content["calibration"].keys() == {"sample-1x3", "sample-2x3"}
    for name in ("sampling.png", "calibration.png"):
        assert (what.out / name).read_bytes().startswith(b"\x89PNG")


def test_the_plot_over_steps_pairs_by_picture() -> None:
    """Pictures differ by 10 dB, the setting from mode `mean` by 0.5 dB on each: the bar is 0, not 12."""
    setting, (column, _) = Setting("sample", 4, 5), PANELS
    scores = {MEAN: (15.0, 20.0, 25.0), setting: (14.5, 19.5, 24.5)}
    made = [
        Record("sampling", DECOMPOSE, own.key, f"s{k}", f"o{k}", {column.key(DEFAULT_VARIANT): value})
        for own, values in scores.items()
        for k, value in enumerate(values)
    ]
    found = difference(made, setting.key, MEAN.key, column)
    assert found is not None
    assert (found.mean, found.n) == (-0.5, 3)
    assert found.half_width == pytest.approx(0, abs=1e-12)
    assert difference(made[:3], setting.key, MEAN.key, column) is None
    infinite = replace(made[-1], values={column.key(DEFAULT_VARIANT): math.inf})
    assert difference([*made[:-1], infinite], setting.key, MEAN.key, column) is None


def test_every_option_reaches_the_study(what: SamplingStudy, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each with a value that is not its default."""
    seen, loaded = list[tuple](), list[ModelOptions]()
    monkeypatch.setattr(run_module, "run", lambda *given: seen.append(given))
    monkeypatch.setattr(ModelOptions, "load", lambda options: loaded.append(options) or what.pipeline)
    made = BenchSampling(
        str(what.suite.spec.path), tmp_path, Path("small"), 2, (4, 2), (3, 1), "unipc", seed=7, device="auto"
    )
    assert made.run() == 0
    ((study, scenes, _),) = seen
    assert (study.suite.sha256, study.out, study.sampler, study.seed) == (what.suite.sha256, tmp_path, "unipc", 7)
    assert (study.steps, study.samples) == ((2, 4), (1, 3))
    assert study.weights == checkpoint_sha256(checkpoint_folder(Path("small")))
    assert study.device == str(resolve_device("auto"))
    assert scenes == evenly(what.suite.scenes, 2)
    assert study.pipeline.decompose
    assert [(options.checkpoint, options.device) for options in loaded] == [(Path("small"), "auto")]


def test_one_sample_has_no_calibration(what: SamplingStudy, records: list[Record]) -> None:
    settings = (MEAN, Setting("sample", 1, 1), Setting("sample", 2, 1))
    assert len(tables(records, settings, ())) == 1
    assert (headline(settings), headline(what.settings)) == (None, Setting("sample", 2, 3))
    assert len(tables(records, what.settings, ())) == 3
    assert draw_reliability(records, what.settings[-1]).startswith(b"\x89PNG")
