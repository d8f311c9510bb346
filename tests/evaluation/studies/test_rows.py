"""Rows by name and by group, for the studies of the optimiser and of the training; what notes of studies say alike."""

from collections.abc import Sequence
from dataclasses import dataclass

import pytest

from unirender.errors import UsageError
from unirender_evaluation.multiview.settings import MultiviewSettings
from unirender_evaluation.statistics import METHOD
from unirender_evaluation.studies.optimiser.ingredients import GROUPS, ingredients
from unirender_evaluation.studies.rows import StudyRow, chosen
from unirender_evaluation.studies.sampling import tables as sampling_tables
from unirender_evaluation.studies.training import tables as training_tables
from unirender_evaluation.studies.training.choices import QUESTIONS, training_choices
from unirender_evaluation.studies.unknown_mesh.tables import shape_notes
from unirender_evaluation.studies.warm_start import tables as warm_start_tables


@dataclass(frozen=True)
class Line:
    name: str
    group: str


ROWS = (Line("full", ""), Line("log", "losses"), Line("grey", "start"), Line("srgb", "losses"))


def names(*wanted: str) -> list[str]:
    return [row.name for row in chosen(ROWS, wanted, "--rows")]


def test_without_names_all_rows_are_chosen() -> None:
    assert chosen(ROWS, (), "--rows") == ROWS


def test_rows_keep_their_order_and_the_one_without_a_group_is_always_there() -> None:
    assert names("srgb", "grey") == ["full", "grey", "srgb"]
    assert names("losses") == ["full", "log", "srgb"]
    assert names("losses", "log", "grey") == ["full", "log", "grey", "srgb"]
    assert names("full") == ["full"]


@pytest.mark.parametrize("wanted", [("colour",), ("log", "colour"), ("brown", "colour"), ("",)])
def test_a_name_of_neither_is_refused_with_those_that_can_be_used(wanted: tuple[str, ...]) -> None:
    unknown = " ".join(name for name in wanted if name != "log")
    expected = f"--rows {unknown}: expected some of full, log, grey, srgb, or the groups losses, start"
    with pytest.raises(UsageError) as refused:
        chosen(ROWS, wanted, "--rows")
    assert str(refused.value) == expected
    with pytest.raises(UsageError, match=r"start; did you mean losses\?$"):
        chosen(ROWS, ("Losses",), "--rows")


@pytest.mark.parametrize(
    ("rows", "groups"), [(ingredients(), GROUPS), (training_choices(), QUESTIONS)], ids=["ingredients", "training"]
)
def test_the_rows_of_a_study_have_names_of_their_own_and_the_groups_that_have_a_title(
    rows: Sequence[StudyRow], groups: dict[str, str]
) -> None:
    assert len({*groups, *(row.name for row in rows)}) == len(groups) + len(rows)
    assert {row.group for row in rows} == {"", *groups}


def test_notes_say_how_intervals_are_made() -> None:
    notes = (
        sampling_tables.QUALITY_NOTE,
        training_tables.NOTE,
        warm_start_tables.NOTES[0],
        shape_notes(MultiviewSettings())[-1],
    )
    assert [note for note in notes if METHOD not in note] == []
