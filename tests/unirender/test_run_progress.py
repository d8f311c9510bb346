"""How far a run is, where nobody watches: a line now and then, with a count and the time that is left."""

import io
from collections.abc import Iterator

import pytest
from rich.console import Console

from unirender.system.run_progress import EVERY, LineProgress, progress_bar


@pytest.fixture
def printed(monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[LineProgress, io.StringIO, list[float]]]:
    """A progress of lines, what it prints, and its clock."""
    clock, out = [1000.0], io.StringIO()
    progress = LineProgress(Console(file=out, width=20))
    monkeypatch.setattr(progress, "get_time", lambda: clock[0])
    with progress:
        yield progress, out, clock


def test_a_line_at_the_beginning_and_then_at_most_every_so_often(
    printed: tuple[LineProgress, io.StringIO, list[float]],
) -> None:
    progress, out, clock = printed
    bar = progress.add_task("Mitsuba: [truth] check", total=40)
    assert out.getvalue().splitlines() == ["Mitsuba: [truth] check: 0 of 40"], "before the first is done"
    for _ in range(30):  # 2 s each
        clock[0] += 2
        progress.advance(bar)
    after = [10, 20, 30]
    assert out.getvalue().splitlines()[1:] == [
        f"Mitsuba: [truth] check: {done} of 40, {2 * (40 - done)} s left at this pace" for done in after
    ]
    assert EVERY == 2 * 10
    clock[0] += 100 * EVERY
    progress.update(bar, advance=9, description="a row")
    assert out.getvalue().splitlines()[-1] == "a row: 39 of 40, 53 s left at this pace"
    clock[0] += EVERY
    progress.advance(bar)
    assert len(out.getvalue().splitlines()) == 5, "the end says itself that it is there"


def test_what_has_no_count_yet_or_nothing_to_do_prints_nothing(
    printed: tuple[LineProgress, io.StringIO, list[float]],
) -> None:
    progress, out, _ = printed
    bar = progress.add_task("methods", total=None)
    progress.add_task("multi-view", total=0, visible=False)
    assert not out.getvalue()
    progress.update(bar, total=3)
    progress.remove_task(bar)
    assert out.getvalue() == "methods: 0 of 3\n"


@pytest.mark.parametrize(("seconds", "text"), [(90, "90 s"), (600, "10 min"), (2e4, "5.6 h")])
def test_a_time_is_said_in_its_unit(
    printed: tuple[LineProgress, io.StringIO, list[float]], seconds: float, text: str
) -> None:
    progress, out, clock = printed
    bar = progress.add_task("methods", total=2)
    clock[0] += seconds
    progress.advance(bar)
    assert f"1 of 2, {text} left" in out.getvalue()


def test_the_first_of_many_says_nothing_of_the_rest(printed: tuple[LineProgress, io.StringIO, list[float]]) -> None:
    """Worker processes start, kernels are compiled: it took minutes of the 174 records' 64."""
    progress, out, clock = printed
    bar = progress.add_task("methods", total=174)
    clock[0] += 22
    progress.advance(bar)
    assert out.getvalue().splitlines()[-1] == "methods: 1 of 174"


def test_what_an_earlier_run_had_done_does_not_count_for_the_pace(
    printed: tuple[LineProgress, io.StringIO, list[float]],
) -> None:
    """A data set of 1,000 groups that was stopped at the 900th: "4 s left", it said."""
    progress, out, clock = printed
    bar = progress.add_task("groups", total=None)
    progress.update(bar, completed=900, total=1000)
    clock[0] += 40
    progress.update(bar, completed=910)
    assert out.getvalue().splitlines() == ["groups: 900 of 1000", "groups: 910 of 1000, 6 min left at this pace"]


def test_a_terminal_gets_a_bar_and_a_log_lines_on_the_other_stream(capsys: pytest.CaptureFixture[str]) -> None:
    """What is written to a file is the tables alone."""
    assert not isinstance(progress_bar(Console(force_terminal=True)), LineProgress)
    with progress_bar(Console()) as progress:
        progress.add_task("methods", total=2)
    with progress_bar(Console(quiet=True)) as progress:
        progress.add_task("methods", total=2)
    assert capsys.readouterr() == ("", "methods: 0 of 2\n")
