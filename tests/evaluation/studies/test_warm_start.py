"""`unirender bench warm-start`: measured once, stored, continued; paired differences; refused options."""

import json
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType

import numpy as np
import pytest
from rich.console import Console

from unirender.camera import Camera
from unirender.intrinsics import Intrinsics
from unirender_evaluation.metrics import DEFAULT_VARIANT
from unirender_evaluation.records import Record
from unirender_evaluation.studies.cells import difference
from unirender_evaluation.studies.warm_start.measure import COLD, PICTURE, PREDICTION, WARM, Case, WarmStart, measure
from unirender_evaluation.studies.warm_start.run import our_method, run
from unirender_evaluation.studies.warm_start.tables import COLUMNS, block, tables
from unirender_evaluation.suites.suite import Suite
from unirender_evaluation.versions import MODEL, MULTIVIEW, OPTIMIZER, REFERENCE, Versions
from unirender_reference.optimize.single.config import SingleConfig

QUICK = SingleConfig(steps=(2,), noise=(0.05,), fine_steps=1, coarse_pixels=60, pixels=60, light_rows=8)
VERSIONS = Versions("test", {MODEL: "1", MULTIVIEW: "1", OPTIMIZER: "1", REFERENCE: "1"})
GEOMETRY = "predicted-normals"


class Oracle:
    """A prediction that knows albedo, material and light of one scene, as a method that is asked."""

    name = "oracle"
    config = MappingProxyType({"oracle": 1})

    def __init__(self, suite: Suite) -> None:
        self.suite, self.asked = suite, 0

    def decompose(self, image_srgb: np.ndarray, mask: np.ndarray, camera: Camera) -> Intrinsics:
        self.asked += 1
        scene = next(s for s in self.suite.scenes if np.array_equal(self.suite.mask(s), mask))
        what = WarmStart(self.suite, Path(), self, QUICK, (GEOMETRY,), VERSIONS)
        material = Case(what, scene).material
        return self.suite.intrinsics(scene, material).replace(specular=None, diffuse=None)


@pytest.fixture(scope="module")
def what(suite: Suite, tmp_path_factory: pytest.TempPathFactory) -> WarmStart:
    """Two balls of 32 pixels; nothing is measured yet."""
    return WarmStart(suite, tmp_path_factory.mktemp("warm"), Oracle(suite), QUICK, (GEOMETRY,), VERSIONS)


@pytest.fixture(scope="module")
def records(what: WarmStart, tmp_path_factory: pytest.TempPathFactory) -> list[Record]:
    """One scene of each object."""
    console = Console(file=(tmp_path_factory.mktemp("console") / "out.txt").open("w+"), width=200)
    return run(what, what.suite.scenes[::2], console)


def named(records: list[Record], method: str) -> list[Record]:
    return [record for record in records if record.method == method]


@pytest.mark.long
def test_a_perfect_prediction_is_a_better_start_than_none(records: list[Record]) -> None:
    """It scores the ceiling itself; what starts from it is nearer to the truth than what starts from grey."""
    assert len(records) == 6
    for record in named(records, PREDICTION):
        assert record.protocol == PICTURE
        assert record.values["albedo.psnr@masked-srgb-raw"] > 80
        assert record.values["roughness.mse@masked"] < 1e-6
        assert record.values["environment.peak_deg"] < 1e-2
    for cold, warm in zip(named(records, COLD), named(records, WARM), strict=True):
        assert cold.sample == warm.sample
        assert warm.values["albedo.psnr@masked-srgb-raw"] > cold.values["albedo.psnr@masked-srgb-raw"] + 3
        assert warm.values["environment.log_rmse_scaled"] < cold.values["environment.log_rmse_scaled"]
        assert cold.values["normal.cosine"] == pytest.approx(1.0, abs=1e-3), "given the predicted normals"
        assert 0 < cold.values["time.steps"] <= 3
        for key in ("relit.psnr@masked-srgb-raw", "fit.psnr@masked-srgb-raw"):
            assert np.isfinite([cold.values[key], warm.values[key]]).all()


@pytest.mark.long
def test_a_second_run_measures_nothing(what: WarmStart, records: list[Record]) -> None:
    asked = what.base.asked
    again = list(measure(what, what.suite.scenes[::2]))
    assert not any(new for _, new in again)
    assert [record for record, _ in again] == records
    assert what.base.asked == asked


def test_keys_follow_what_a_record_depends_on(what: WarmStart) -> None:
    """Another model leaves the cold runs on a known mesh valid, another configuration the prediction."""
    scene = what.suite.scenes[0]
    model = Oracle(what.suite)
    model.config = MappingProxyType({"oracle": 2})  # pyright: ignore[reportAttributeAccessIssue] - another configuration of this one
    other_model, other_config = replace(what, base=model), replace(what, config=SingleConfig())

    def same(other: WarmStart, protocol: str, method: str) -> bool:
        return other.key(scene, protocol, method) == what.key(scene, protocol, method)

    assert same(other_model, "known-mesh", COLD)
    assert not same(other_model, "known-mesh", WARM)
    assert not same(other_model, GEOMETRY, COLD), "its normals are the prediction's"
    assert same(other_config, PICTURE, PREDICTION)
    assert not same(other_config, "known-mesh", COLD)
    keys = {what.key(own, "known-mesh", WARM) for own in what.suite.scenes}
    assert len(keys) == len(what.suite.scenes), "two lights of one object are two pictures"


@pytest.mark.long
def test_identical_methods_differ_by_exactly_nothing(records: list[Record]) -> None:
    """The twin: a decibel more on one of three scenes is a third of one, with an interval."""
    cold = named(records, COLD)
    cold.append(replace(cold[0], sample="third", object="third"))
    same = [replace(record, method=WARM) for record in cold]
    for column in COLUMNS:
        found = difference([*cold, *same], WARM, COLD, column)
        assert found is not None
        assert (found.mean, found.low, found.high, found.n) == (0, 0, 0, 3)
    key = COLUMNS[0].key(DEFAULT_VARIANT)
    better = [replace(same[0], values={**same[0].values, key: same[0].values[key] + 1}), *same[1:]]
    found = difference([*cold, *better], WARM, COLD, COLUMNS[0])
    assert found is not None
    assert found.mean == pytest.approx(1 / 3)
    assert found.low < 1 / 3 < found.high


@pytest.mark.long
def test_tables_show_both_starts_and_their_difference(what: WarmStart, records: list[Record]) -> None:
    table = tables(records, (GEOMETRY,))[0]
    assert table.title.endswith("n = 2")
    assert table.columns == ("figure", "cold", "warm", "prediction alone", "warm - cold", "warm - prediction alone")
    rows = table.sections[0]
    assert len(rows) == len(COLUMNS)
    cold, warm = (named(block(records, GEOMETRY), method) for method in (COLD, WARM))
    column = next(index for index, column in enumerate(COLUMNS) if column.quantity == "environment")
    key = COLUMNS[column].key(DEFAULT_VARIANT)
    gain = np.mean([b.values[key] - a.values[key] for a, b in zip(cold, warm, strict=True)])
    assert rows[column][4] == f"{gain:+.3f}", "of two objects there is no interval"
    assert rows[0][2] == "∞", "the perfect albedo is kept"
    assert rows[0][4] == "-", "and has no finite difference"
    text = (what.out / "warm_start.md").read_text()
    assert table.markdown() in text
    content = json.loads((what.out / "warm_start.json").read_text())
    assert content["geometries"][GEOMETRY]["difference"]["warm - cold"][key]["mean"] == pytest.approx(gain)
    assert len(content["records"]) == len(records)


def test_our_method_is_the_row_of_the_benchmark() -> None:
    """Named, not loaded."""
    method = our_method(None)
    assert method.name == "Ours (mean)"
    assert method.config["mode"] == "mean"
