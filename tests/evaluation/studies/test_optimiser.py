"""`bench ingredients`: rows that differ in what they say, nothing measured twice, differences that are paired."""

import dataclasses
import io
import json
import re
from collections.abc import Sequence
from importlib import import_module
from pathlib import Path
from typing import get_type_hints

import pytest
from multiview_pieces import ball_scene
from rich.console import Console
from study_pieces import FEW, SMALL, VERSIONS, full, one_thread, small_study, twin, unrefined

from unirender.errors import UnirenderError
from unirender_evaluation.metrics import DEFAULT_VARIANT
from unirender_evaluation.multiview.methods import Optimized, PlainLoop
from unirender_evaluation.multiview.scoring import score_solution
from unirender_evaluation.multiview.tables import PROTOCOL
from unirender_evaluation.records import Record
from unirender_evaluation.statistics import UNPRINTED
from unirender_evaluation.studies.folder import open_folder
from unirender_evaluation.studies.optimiser.commands import BenchIngredients
from unirender_evaluation.studies.optimiser.ingredients import (
    FULL,
    GREY,
    GROUPS,
    PRIORS,
    REFINEMENT,
    START,
    Ingredient,
    changes,
    ingredients,
)
from unirender_evaluation.studies.optimiser.measure import (
    RECORDS,
    TABLE,
    Starts,
    measure,
    measure_all,
    rendered_protocol,
)
from unirender_evaluation.studies.optimiser.tables import (
    Line,
    columns,
    show,
    summarise,
    tables,
    to_json,
    to_markdown,
)
from unirender_evaluation.tables.formats import signed
from unirender_evaluation.versions import OPTIMIZER, Versions

OWN = "studies/optimiser/measure"
QUIET = Console(quiet=True)
SECONDS = "time.seconds"


def test_every_row_is_another_configuration() -> None:
    rows = ingredients()
    assert rows[0].name == FULL
    assert len({row.name for row in rows}) == len(rows)
    assert not {row.name for row in rows} & set(GROUPS)
    for row in rows[1:]:
        assert changes(row.config, rows[0].config), row.name
        row.config.check()
    assert not [(a.name, b.name) for a in rows for b in rows if a is not b and a.config == b.config]


def test_rows_change_what_their_group_says() -> None:
    rows = ingredients(3)
    for row in rows[1:]:
        changed = set(changes(row.config, rows[0].config))
        assert row.config.seed == 3
        if row.group in (REFINEMENT, PRIORS):
            assert {name.split(".")[0] for name in changed} == {"refine"}, row.name
        if row.group == START:
            assert len(changed) == 1, row.name
        if row.group == GREY:
            assert "transport.enabled" in changed, row.name


def test_small_rates_are_a_quarter_of_every_rate() -> None:
    rows = {row.name: dataclasses.asdict(row.config.refine) for row in ingredients()}
    rates = [name for name in rows[FULL] if name.endswith("_rate")]
    assert rates
    assert all(rows["small-rates"][name] == rows[FULL][name] / 4 for name in rates)


def test_the_plain_row_is_the_plain_loop_of_the_multi_view_table() -> None:
    plain = next(row for row in ingredients() if row.name == "plain")
    assert plain.config.refine == PlainLoop().settings


def test_a_file_in_the_place_of_the_folder_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("kept")
    with pytest.raises(UnirenderError, match="choose another --out"), open_folder(tmp_path / "file"):
        pass
    assert (tmp_path / "file").read_text() == "kept"


def test_a_second_run_in_the_folder_is_refused(tmp_path: Path) -> None:
    refused = pytest.raises(UnirenderError, match="another run is writing here")
    with open_folder(tmp_path / "study") as held, refused:
        BenchIngredients(out=held, objects=1).run()
    assert list((tmp_path / "study").iterdir()) == []  # the lock is gone, and nothing was left
    with open_folder(held):
        pass


STUDIES = ("derived_light", "sampling", "training", "unknown_mesh", "warm_start")


@pytest.mark.parametrize("study", STUDIES)
def test_every_study_holds_its_folder(study: str, tmp_path: Path) -> None:
    run = import_module(f"unirender_evaluation.studies.{study}.run").run
    what = object.__new__(next(iter(get_type_hints(run).values())))  # no more of it is looked at
    object.__setattr__(what, "out", tmp_path / "study")
    others = {"derived_light": (QUIET,), "training": ([], [], QUIET)}.get(study, ([], QUIET))
    with open_folder(what.out), pytest.raises(UnirenderError, match="another run is writing here"):
        run(what, *others)


@pytest.fixture(scope="module")
def measured(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[Record]]:
    """Folder and records of the full method, its twin and a row without refinement."""
    folder = tmp_path_factory.mktemp("ingredients")
    study = small_study(folder, OWN)
    with one_thread():
        return folder, measure_all(study, [full(), twin(), unrefined()], folder, QUIET)


def differences(records: Sequence[Record], row: Ingredient) -> dict[str, float]:
    line = summarise([full(), row], records)[1]
    return {
        column.key(DEFAULT_VARIANT): cell.difference.mean
        for column, cell in zip(columns(), line.cells, strict=True)
        if cell.difference is not None
    }


@pytest.mark.long
def test_a_row_like_the_full_method_differs_from_it_by_nothing(measured: tuple[Path, list[Record]]) -> None:
    found = differences(measured[1], twin())
    assert len(found) == len(columns())
    assert {key for key, value in found.items() if value != 0} <= {SECONDS}
    other = differences(measured[1], unrefined())  # the twin that must differ
    assert all(other[key] != 0 for key in other)
    assert other[SECONDS] < 0


@pytest.mark.long
def test_what_is_measured_is_the_method_itself() -> None:
    """The shared start, then refinement: the same as all stages in one run."""
    scene = ball_scene(16, FEW)
    with one_thread():
        values = measure(scene, Starts(scene), SMALL)
        expected = score_solution(scene, Optimized(config=SMALL).solve(scene.views, scene.mesh))
    assert values.pop(SECONDS) > 0
    assert values == expected


def test_rows_share_the_start_that_they_have_in_common() -> None:
    scene = ball_scene(16, FEW)
    starts, other = Starts(scene), dataclasses.replace(SMALL.transport, iterations=2)
    first = starts.of(SMALL)
    assert starts.of(unrefined().config) is first
    assert starts.of(dataclasses.replace(SMALL, transport=other)) is not first


@pytest.mark.long
def test_nothing_is_measured_twice(measured: tuple[Path, list[Record]]) -> None:
    """Seconds are a wall clock's: equal ones were read, not measured."""
    folder, before = measured
    path, study = folder / RECORDS, small_study(folder, OWN)
    path.write_text(path.read_text() + '{"table": "ingr')  # a killed run's half line
    rows = [full(), twin(), unrefined()]
    assert measure_all(study, rows, folder, QUIET) == before
    assert [record.method for record in measure_all(study, rows[:1], folder, QUIET)] == [FULL]
    assert measure_all(study, rows, folder, QUIET) == before  # those that one run did not ask for are kept


@pytest.mark.long
def test_other_code_and_other_settings_are_measured_anew(measured: tuple[Path, list[Record]]) -> None:
    folder, before = measured
    newer = small_study(folder, OWN, versions=Versions("test", {**VERSIONS.parts, OPTIMIZER: "2"}))
    study, scene = small_study(folder, OWN), small_study(folder, OWN).scenes[0]
    known = {record.key for record in before}
    question, config = f"{TABLE}/{FULL}", dataclasses.asdict(SMALL)
    assert study.key(scene, question, config) in known
    other = dataclasses.replace(SMALL, refine=dataclasses.replace(SMALL.refine, spp=8))
    for key in (
        newer.key(scene, question, config),
        study.key(scene, question, dataclasses.asdict(other)),
        small_study(folder, "studies/optimiser/race").key(scene, question, config),
    ):
        assert key not in known


def made(method: str, values: Sequence[float]) -> list[Record]:
    """A record for each object: every column has the same value."""
    keys = [column.key(DEFAULT_VARIANT) for column in columns()]
    return [
        Record(TABLE, PROTOCOL, method, f"scene-{k}", f"object-{k}", dict.fromkeys(keys, value))
        for k, value in enumerate(values)
    ]


def lines_of(ours: Sequence[float], others: Sequence[float]) -> tuple[list[Line], list[Record]]:
    records = [*made(FULL, ours), *made("twin", others)]
    return summarise([full(), twin()], records), records


def test_the_table_says_what_was_measured() -> None:
    """Differences of -1, -2, -3: standard error 0.577, t of two degrees of freedom 4.303."""
    lines, _ = lines_of((20.0, 24.0, 28.0), (19.0, 22.0, 25.0))
    (table,) = tables(lines, settings=False)
    assert [row[1] for section in table.sections for row in section] == ["24.00", "22.00 (-2.00 ± 2.48)"]
    lines, _ = lines_of((20.0, 24.0, 28.0), (18.9, 23.0, 27.1))
    (table,) = tables(lines, settings=False)
    assert table.sections[1][0][1] == "23.00 (**-1.00 ± 0.25**)"
    assert UNPRINTED not in to_markdown(lines, ())
    lines, _ = lines_of((20.0,), (19.0,))  # no interval
    (table,) = tables(lines, settings=False)
    assert table.sections[1][0][1] == "19.00 (-1.00)"
    lines, _ = lines_of((20.0, 24.0), (18.9, 23.1))  # none that is printed
    (table,) = tables(lines, settings=False)
    assert table.sections[1][0][1] == "21.00 (-1.00)"
    assert UNPRINTED in to_markdown(lines, ())


@pytest.mark.parametrize("width", [80, 130])
def test_a_terminal_shows_every_figure_whole(width: int) -> None:
    lines, _ = lines_of((20.0, 24.0, 28.0), (19.0, 22.0, 25.0))
    printed = io.StringIO()
    show(Console(file=printed, width=width), lines, ())
    assert "…" not in printed.getvalue()
    for number in ("24.00", "22.00", "24.0000", "22.0000", "24.000", "22.000", "24.0", "22.0"):
        expected = sum(number == f"{float(number):.{column.metric.decimals}f}" for column in columns())
        assert len(re.findall(rf"(?<![\d.]){re.escape(number)}(?!\d)", printed.getvalue())) == expected


@pytest.mark.long
def test_the_markdown_has_measured_figures_only(measured: tuple[Path, list[Record]]) -> None:
    """Every figure of the table's cells is a mean over the records, or a difference of two."""
    folder, records = measured
    lines = summarise([full(), twin(), unrefined()], records)
    text = to_markdown(lines, rendered_protocol(small_study(folder, OWN)))
    rows = [line.split(" | ") for line in text.splitlines() if line.startswith("| ") and ":--" not in line]
    cells = [row[2:] for row in rows if row[0] != "| What is different"]
    assert len(cells) == 4  # full, twin; full, unrefined: a table for each group
    values = {record.method: record.values for record in records}
    for row, method in zip(cells, (FULL, "twin", FULL, "unrefined"), strict=True):
        for cell, column in zip(row, columns(), strict=True):
            key, digits = column.key(DEFAULT_VARIANT), column.metric.decimals
            expected = [f"{values[method][key]:.{digits}f}"]
            if method != FULL:
                expected.append(signed(values[method][key] - values[FULL][key], digits))
            assert re.findall(r"[+-]?\d[\d.]*", cell) == expected
    assert f"{FEW.seen} pictures of 32 x 32 px" in text
    assert "`refine.enabled = False`" in text
    assert text.startswith("## ")


def test_the_json_is_strict_and_keeps_each_object() -> None:
    lines, records = lines_of((20.0, 24.0), (19.0, 25.0))
    content = json.loads(to_json(lines, records, (("objects", "2"),)), parse_constant=pytest.fail)
    row = content["rows"][1]
    assert row["metrics"]["albedo.psnr@masked-srgb-raw"]["objects"] == {"object-0": 19.0, "object-1": 25.0}
    assert row["metrics"]["albedo.psnr@masked-srgb-raw"]["difference"]["n"] == 2
    lines, records = lines_of((20.0,), (19.0,))
    content = json.loads(to_json(lines, records, ()), parse_constant=pytest.fail)
    assert content["rows"][1]["metrics"]["relit.psnr@masked-srgb-raw"]["difference"]["low"] is None


def test_a_zero_has_no_sign() -> None:
    assert [signed(x, 2) for x in (-0.001, 0.001, 0.0, -1.0, 1.0)] == ["0.00", "0.00", "0.00", "-1.00", "+1.00"]
