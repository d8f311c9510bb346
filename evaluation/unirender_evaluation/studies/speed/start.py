"""Cold start: how long `unirender decompose` takes on one small picture in a process of its own.

Three kinds of processes take turns, so that a change of the machine's load meets them alike; the first turn does not
count, so that files are in the page cache:

    torch       python -c "import torch"
    command     python -m unirender.cli decompose PICTURE ...
    split       the same command inside `TIMER`, which says where its time went

    import      inside import statements, wherever they stand
    load        inside `ModelOptions.load`, imports left out
    run         everything else of the command
    interpreter the process's wall clock less these three: the start of Python, and its end
"""

import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from unirender.errors import UnirenderError
from unirender_evaluation.studies.speed.timing import Part, aim_text, medians
from unirender_evaluation.suites.suite import Scene, Suite
from unirender_evaluation.tables.text import TextTable
from unirender_evaluation.tasks import picture

AIM = 2.5  # times a bare import of torch
BARE = "import torch"
SPLIT = ("import", "load", "run")
TIMER = '''
import builtins, importlib, json, sys, threading, time

begun, main_thread = time.perf_counter(), threading.get_ident()
spent, inside = {"import": 0.0, "load": 0.0}, []


def watched(name, function):
    """The function; its time counts for `name` where no other watched call of that name is around it."""
    def call(*args, **kwargs):
        if name in inside or threading.get_ident() != main_thread:
            return function(*args, **kwargs)
        inside.append(name)
        start, others = time.perf_counter(), spent["import"]
        try:
            return function(*args, **kwargs)
        finally:
            inside.pop()
            own = time.perf_counter() - start
            spent[name] += own if name == "import" else own - (spent["import"] - others)
    return call


builtins.__import__ = watched("import", builtins.__import__)
importlib.import_module = watched("import", importlib.import_module)
from unirender import cli
from unirender.command_line.options import ModelOptions

ModelOptions.load = watched("load", ModelOptions.load)
report, sys.argv = sys.argv[1], [sys.argv[0], *sys.argv[2:]]
try:
    cli.main()
except SystemExit as end:
    if end.code:
        raise
total = time.perf_counter() - begun
with open(report, "w") as file:
    json.dump({**spent, "run": total - sum(spent.values())}, file)
'''


def cold_starts(
    suite: Suite, scene: Scene, checkpoint: Path | None, options: Sequence[str], turns: int
) -> list[dict[str, float]]:
    """Seconds of each kind of process, a dict a turn: `torch`, `command`, the entries of `SPLIT`, `interpreter`."""
    from unirender.shipped import checkpoint_folder
    from unirender.visualization import write_png

    found = []
    with tempfile.TemporaryDirectory(prefix="unirender-start-") as name:
        folder = Path(name)
        seen = picture(suite, scene, suite.spec.base)
        write_png(folder / "picture.png", np.concatenate([seen["image_srgb"], seen["mask"]], axis=-1))
        (folder / "timer.py").write_text(TIMER)
        fov = f"{suite.spec.camera.fov_deg:g}"
        command = ["decompose", str(folder / "picture.png"), "--fov", fov, *options]
        command += ["--checkpoint", str(checkpoint_folder(checkpoint).resolve())]
        for turn in range(turns + 1):
            bare = run_process(["-c", BARE], folder)
            outs = [str(folder / f"{kind}-{turn}") for kind in ("command", "split")]
            whole = run_process(["-m", "unirender.cli", *command, "--output", outs[0]], folder)
            report = folder / "report.json"
            wall = run_process(["timer.py", str(report), *command, "--output", outs[1]], folder)
            split = json.loads(report.read_text())
            row = {"torch": bare, "command": whole, **split, "interpreter": wall - sum(split.values())}
            if turn:
                found.append(row)
    return found


def run_process(arguments: Sequence[str], folder: Path) -> float:
    """Wall clock in seconds of Python with these arguments."""
    start = time.perf_counter()
    done = subprocess.run([sys.executable, *arguments], cwd=folder, capture_output=True, text=True, check=False)
    seconds = time.perf_counter() - start
    if done.returncode:
        last = (done.stderr.strip().splitlines() or ["no message"])[-1]
        raise UnirenderError(f"cold start: {' '.join(arguments[:3])} ... ended with {done.returncode}: {last}")
    return seconds


def start_part(suite: Suite, scene: Scene, checkpoint: Path | None, options: Sequence[str], turns: int) -> Part:
    """The part `start`."""
    rows = cold_starts(suite, scene, checkpoint, options, turns)
    middle = medians(rows)
    ratio = middle["command"] / middle["torch"]
    data: dict[str, Any] = {"median_s": middle, "ratio": ratio, "turns_s": rows}
    return Part("start", (start_table(middle, suite.spec.resolution, turns),), data)


def start_table(middle: dict[str, float], size: int, turns: int) -> TextTable:
    """Seconds and times a bare import of torch, a phase a row."""
    labels = {
        "torch": f'python -c "{BARE}"',
        "command": "unirender decompose",
        "import": "of it: import",
        "load": "of it: load the checkpoint",
        "run": "of it: read, run, write",
        "interpreter": "of it: start and end of Python",
    }
    rows = tuple((label, f"{middle[key]:.2f}", f"{middle[key] / middle['torch']:.2f}") for key, label in labels.items())
    ratio = middle["command"] / middle["torch"]
    notes = (
        f"One picture of {size} px in a fresh process; medians of {turns} turns in which the kinds of process "
        "alternate, after one that does not count (files are cached). The split is that of a run of its own under a "
        "timer: import is all time inside import statements, load that of `ModelOptions.load` without imports.",
        aim_text("unirender decompose / import torch", ratio, "<=", AIM),
    )
    return TextTable("Cold start", ("process", "seconds", "of import torch"), (rows,), notes)
