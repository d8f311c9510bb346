"""The log of a run: what a kill left half written costs no other line."""

from pathlib import Path

import pytest

from unirender.training.logs.run_log import OVERFLOW, RunLog, read_lines
from unirender.training.optim.processes import ALONE, Processes

LINES = '{"step": 1, "image": 2.0}\n', '{"step": 2, "image": 1.5}\n', '{"step": 3, "image": 1.0}\n'


@pytest.mark.parametrize(
    "broken", ["{not json\n", "[1, 2]\n", '{"image": 1.0}\n', "\n", '{"step": "2"}\n', "\0\0\n", b"\xff\xfe\n"]
)
def test_a_broken_line_is_dropped_and_no_other(tmp_path: Path, broken: str | bytes) -> None:
    log = RunLog(tmp_path, ALONE)
    unreadable = broken.encode() if isinstance(broken, str) else broken
    log.path.write_bytes(LINES[0].encode() + unreadable + LINES[1].encode() + LINES[2].encode() + b'{"step": 2, "im')
    assert [line["step"] for line in read_lines(log.path)] == [1, 2, 3]
    RunLog(tmp_path, Processes(rank=1, size=2)).forget_after(2)
    assert len(log.path.read_bytes()) > len("".join(LINES))  # the first process alone writes
    log.forget_after(2)
    assert log.path.read_text() == "".join(LINES[:2])


def test_what_holds_from_the_state_on_is_told_anew(tmp_path: Path) -> None:
    """Other data or parts than the state's come again, with their line."""
    log, before = RunLog(tmp_path, ALONE), LINES[0] + '{"step": 1, "data": "1 -> 2"}\n' + LINES[1]
    log.path.write_text(before + '{"step": 2, "data": "2 -> 3"}\n{"step": 2, "parts": "1 -> 2"}\n')
    log.forget_after(2)
    assert log.path.read_text() == before


def test_a_value_is_its_mean_over_steps_and_processes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """And light above the curves is told of only where there is some."""
    log = RunLog(tmp_path, Processes(rank=0, size=2))
    monkeypatch.setattr(Processes, "gather", lambda self, own: [own, own | {"image": 7.0}])
    log.add({"image": 1.0, f"{OVERFLOW}diffuse": 0.0, f"{OVERFLOW}specular": 0.5})
    log.add({"image": 2.0, f"{OVERFLOW}diffuse": 0.0, f"{OVERFLOW}specular": 0.0})
    assert log.means() == {"image": (1.5 + 7) / 2, f"{OVERFLOW}specular": 0.25}
    assert log.means() == {}


def test_a_run_without_a_log_has_no_lines(tmp_path: Path) -> None:
    RunLog(tmp_path, ALONE).forget_after(-1)
    assert read_lines(tmp_path / "log.jsonl") == []
    assert not list(tmp_path.iterdir())
