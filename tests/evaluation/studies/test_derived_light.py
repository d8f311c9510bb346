"""`unirender bench derived-light`: measured once, stored, continued; closed forms; the aim; refused options."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from environments import smooth_environment
from rich.console import Console

from unirender.errors import UnirenderError, UsageError
from unirender.light.surface_light import specular_light
from unirender_evaluation.records import Record
from unirender_evaluation.studies.derived_light.command import BenchDerivedLight
from unirender_evaluation.studies.derived_light.measure import (
    COVERED,
    DIFFUSE,
    FLOOR_DB,
    FULL,
    MASKED,
    PREFILTERED,
    SMALL,
    SUBPIXELS,
    SURE,
    TRUTH,
    DerivedLight,
    measure,
    pixel_means,
    prefiltered_light,
)
from unirender_evaluation.studies.derived_light.run import run
from unirender_evaluation.studies.derived_light.tables import aim
from unirender_evaluation.versions import REFERENCE, Versions

VERSIONS = Versions("test", {REFERENCE: "1"})


@pytest.fixture(scope="module")
def what(tmp_path_factory: pytest.TempPathFactory) -> DerivedLight:
    """A small sphere in the sun."""
    return DerivedLight(tmp_path_factory.mktemp("derived"), ("pmndrs-esplanade",), (), (0.3,), 24, VERSIONS)


@pytest.fixture(scope="module")
def records(what: DerivedLight) -> list[Record]:
    return run(what, Console(file=(what.out / "console.txt").open("w+"), width=160))


def values(records: list[Record], question: str, method: str) -> dict[str, float]:
    (found,) = (record.values for record in records if (record.protocol, record.method) == (question, method))
    return dict(found)


@pytest.mark.long
def test_a_sphere_is_lit_as_mitsuba_lights_it(records: list[Record]) -> None:
    for question in ("s-0.3", DIFFUSE):
        floor = values(records, question, TRUTH)
        assert floor[MASKED] > floor[SURE] >= FLOOR_DB
        full, fine = values(records, question, FULL), values(records, question, SUBPIXELS)
        assert full[MASKED] > 35
        assert full[COVERED] > 35
        assert fine[MASKED] > 38
    # twins: what the light's resolution and the true view directions are worth
    assert values(records, "s-0.3", SMALL)[MASKED] < values(records, "s-0.3", FULL)[MASKED] - 5
    assert values(records, "s-0.3", PREFILTERED)[MASKED] < values(records, "s-0.3", FULL)[MASKED] - 5
    assert len(records) == 5 + 4


@pytest.mark.long
def test_a_second_run_measures_nothing_and_a_longer_one_what_is_missing(
    what: DerivedLight, records: list[Record]
) -> None:
    assert [new for _, new in measure(what)] == [False] * len(records)
    longer = list(measure(replace(what, roughness=(0.3, 0.8))))
    assert [record.protocol for record, new in longer if new] == ["s-0.8"] * 5
    changed = replace(what, versions=Versions("another", {REFERENCE: "1"}))
    assert changed.code != what.code
    text = (what.out / "derived_light.md").read_text()
    assert "| sphere, s 0.3 |" in text
    assert "(asked: 45)" in text


def test_prefiltering_is_exact_in_a_furnace_and_nowhere_else() -> None:
    normal = np.zeros((8, 8, 3), np.float32)
    normal[2:6, 2:6] = np.array([0.6, 0.0, 0.8], np.float32)
    white = np.ones((64, 128, 3), np.float32)
    np.testing.assert_allclose(prefiltered_light(normal, 0.6, white), specular_light(normal, 0.6, white), atol=2e-3)
    light = smooth_environment()
    assert (
        np.abs(prefiltered_light(normal, 0.6, light) - specular_light(normal, 0.6, light)).max() > 0.02
    )  # ten times as much


def test_means_of_blocks_are_weighted_by_coverage() -> None:
    mask = np.zeros((4, 4, 1), np.float32)
    mask[0, 0], mask[0, 1] = 1.0, 0.5
    light = np.arange(48, dtype=np.float32).reshape(4, 4, 3)
    means = pixel_means(light, mask, 2)
    np.testing.assert_allclose(means[0, 0], (light[0, 0] + 0.5 * light[0, 1]) / 1.5)
    assert not means[1:].any()
    assert not means[0, 1].any()


def test_the_aim_is_met_or_missed() -> None:
    def made(name: str, value: float) -> Record:
        return Record("derived-light", "s-0.1", FULL, f"{name}/light", name, {MASKED: value})

    said = aim([made("sphere", 36.0), made("box", 20.0)])
    assert "the sphere: met, least 36.0" in said
    assert "all objects: missed by s 0.1 (28.0)" in said


@pytest.mark.parametrize(
    "options",
    [
        {"resolution": 4},
        {"lights": ()},
        {"lights": ("pmndrs-city", "pmndrs-city")},
        {"roughness": (1.5,)},
        {"objects": (-1,)},
    ],
)
def test_bad_options_are_refused(options: dict, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="expected"):
        BenchDerivedLight(out=tmp_path, **options).check()


def test_a_size_is_refused_before_anything_is_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(UnirenderError, match=r"--resolution 10000000: would take .* render fewer"):
        BenchDerivedLight(out=tmp_path, resolution=10_000_000).run()
    assert capsys.readouterr().err == ""


def test_an_unknown_light_is_named(tmp_path: Path) -> None:
    with pytest.raises(UnirenderError, match="'moon': not bundled"):
        DerivedLight(tmp_path, ("moon",), (), (0.3,), 24, VERSIONS)
