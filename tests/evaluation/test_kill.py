"""`unirender bench run` killed by SIGKILL in the middle, and run again: the same tables, byte for byte.

Mitsuba has one thread here: with more, the order in which samples are summed changes the last bits of a render from one
process to the next, killed or not.
"""

import re
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest

from unirender_evaluation.records import read_records, read_run
from unirender_evaluation.suites.suite import load_suite
from unirender_evaluation.table_list import ALL_TABLES
from unirender_evaluation.tables.build import build_tables
from unirender_evaluation.tables.formats import to_markdown
from unirender_evaluation.tasks import scene_ids
from unirender_evaluation.truth.check import chosen_scenes

FILES = ("tables.md", "tables.tex", "tables.json", "verdict.txt")
KILLED_AT = 25  # records on disk
PATIENCE_S = 900.0  # until they are there: a busy machine may take minutes for what takes seconds
PROGRAM = (
    "import sys; from unirender_reference.backend import set_threads; set_threads(1); "
    "from unirender.cli import main; sys.exit(main())"
)
DATE = re.compile(r"\d{4}-\d\d-\d\d(T[\d:+]+)?")


def command(out: Path) -> list[str]:
    """One scene of the shipped suite, the rows without a network, a truth check of that very scene."""
    tiny = load_suite("tiny")
    scenes = scene_ids(tiny, 1)
    seed = next(seed for seed in range(1000) if chosen_scenes(tiny, 1, seed)[0] in scenes)
    size = ("--suite", "tiny", "--limit", "1", "--check-scenes", "1", "--check-seed", str(seed), "--jobs", "0")
    return [sys.executable, "-c", PROGRAM, "bench", "run", *size, "--methods", "trivial", "--out", str(out)]


def finish(out: Path) -> tuple[int, int]:
    """Runs to the end; how many records are new, of how many."""
    result = subprocess.run(command(out), capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stdout + result.stderr
    (found,) = re.findall(r"(\d+) new records of (\d+)", result.stdout)
    return int(found[0]), int(found[1])


def lines(path: Path) -> int:
    return path.read_bytes().count(b"\n") if path.exists() else 0


def kill_in_the_middle(out: Path) -> int:
    """Starts a run and kills it; how many records it leaves."""
    process = subprocess.Popen(command(out), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    deadline = time.monotonic() + PATIENCE_S
    while lines(out / "records.jsonl") < KILLED_AT and process.poll() is None and time.monotonic() < deadline:
        time.sleep(0.005)
    process.send_signal(signal.SIGKILL)
    assert process.wait() == -signal.SIGKILL, "it was still at work"
    assert not (out / "run.json").exists()
    return lines(out / "records.jsonl")


def text(out: Path, name: str) -> str:
    """A file of a run; the dates of the run and of its truth check are no results."""
    return DATE.sub("(date)", (out / name).read_text(encoding="utf-8"))


@pytest.mark.long
def test_a_killed_run_ends_in_the_same_tables(tmp_path: Path) -> None:
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    left = kill_in_the_middle(killed)
    new, count = finish(killed)
    left -= sum(record.method == "reference-other-seed" for record in read_records(killed / "records.jsonl"))
    assert 0 < left < count
    assert 0 < new <= count - left + 1, "only what was missing, and the line that the kill may have torn"
    assert finish(whole) == (count, count)
    for name in FILES:
        assert text(killed, name) == text(whole, name), name

    info, records = read_run(killed / "run.json"), [r for r in read_records(killed / "records.jsonl") if r.values]
    remade = [to_markdown(table) for table in build_tables(records, info, ALL_TABLES)]
    assert all(table in (killed / "tables.md").read_text() for table in remade)
    index = next(i for i, record in enumerate(records) if "albedo.psnr@masked-srgb-raw" in record.values)
    values = {**records[index].values, "albedo.psnr@masked-srgb-raw": 0.0}
    records[index] = replace(records[index], values=values)
    changed = [to_markdown(table) for table in build_tables(records, info, ALL_TABLES)]
    assert changed != remade, "the twin: one other value in one record is seen"
