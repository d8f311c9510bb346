"""A stranger's path, end to end and from `docs/score_your_method.md` alone: the files that the page shows are run in a
folder outside the checkout, and the method scores alike as a plug-in, installed, and as a folder of predictions.
"""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from unirender.exr import read_exr, write_exr
from unirender_evaluation.records import read_records

PAGE = Path(__file__).resolve().parents[1] / "docs" / "score_your_method.md"
FILES = ("my_method.py", "predict.py", "pyproject.toml")
MOST_LINES = 20  # of the class that is the example
# One scene and one render of it: what is compared here does not depend on how many there are.
SMALL = ("--suite", "tiny", "--limit", "1", "--check-scenes", "1", "--jobs", "0")


def shown_files(text: str) -> dict[str, str]:
    """The files that a page shows in full: fenced blocks whose first line is a comment with the file's name."""
    return dict(re.findall(r"^```\w+\n# ([\w.]+\.\w+)\n(.*?)^```", text, re.MULTILINE | re.DOTALL))


@pytest.fixture(scope="module")
def files() -> dict[str, str]:
    return shown_files(PAGE.read_text(encoding="utf-8"))


def run(command: list[str], cwd: Path, path: Path | None = None) -> str:
    """Runs a program as a stranger does; what it prints. `path` is searched for installed packages, too."""
    unset = {"PYTHONPATH", "PYTHONHOME"}
    environment = {name: value for name, value in os.environ.items() if name not in unset}
    environment |= {} if path is None else {"PYTHONPATH": str(path)}
    result = subprocess.run(command, cwd=cwd, env=environment, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stdout + result.stderr
    return result.stdout


def unirender(*arguments: str, cwd: Path, path: Path | None = None) -> str:
    return run([str(Path(sys.executable).with_name("unirender")), *arguments], cwd, path)


def scores(out: Path, method: str) -> dict[tuple[str, ...], dict[str, float]]:
    """The values of one row of a run, by table, protocol and sample."""
    found = [record for record in read_records(out / "records.jsonl") if record.method == method and record.values]
    return {(record.table, record.protocol, record.sample): dict(record.values) for record in found}


def test_the_page_shows_the_files_and_a_short_class(files: dict[str, str]) -> None:
    assert tuple(files) == FILES
    _, keyword, body = files["my_method.py"].partition("class ")
    lines = (keyword + body).rstrip().splitlines()
    assert len(lines) <= MOST_LINES
    assert shown_files("```python\n# a.py\nx = 1\n```\n```python\nx = 2\n```\n") == {"a.py": "x = 1\n"}


@pytest.mark.long
def test_a_stranger_scores_alike_in_all_ways(files: dict[str, str], tmp_path: Path) -> None:
    """Named by its file, as a folder of predictions, installed: the same records, and other predictions other ones."""
    here, out = tmp_path / "stranger", tmp_path / "results"
    here.mkdir()
    for name, text in files.items():
        (here / name).write_text(text, encoding="utf-8")
    unirender("bench", "export", "--suite", "tiny", "--limit", "1", "--out", "inputs", cwd=here)
    run([sys.executable, "predict.py", "inputs", "predictions"], here)
    shutil.copytree(here / "predictions", here / "upside-down")
    for path in here.glob("upside-down/*/intrinsics.exr"):
        channels = read_exr(path)[0]
        write_exr(path, channels | {"normal.Y": -channels["normal.Y"]}, half=False)

    folders = ("--predictions", "folder=predictions", "--predictions", "twin=upside-down")
    unirender(
        *("bench", "run", *SMALL, "--methods", "plugins", "--method", "my_method.py:Retinex", *folders),
        *("--out", str(out)),
        cwd=here,
    )
    named, folder, twin = (scores(out, method) for method in ("retinex", "folder", "twin"))
    assert len(named) > 1
    assert named == folder, "as a plug-in and as a folder"
    assert twin.keys() == named.keys()
    assert all(twin[key]["normal.cosine"] != named[key]["normal.cosine"] for key in named)
    quantities = {name.partition(".")[0] for values in named.values() for name in values}
    assert quantities == {"albedo", "normal"}, "what the method leaves out has no number"

    pip = [sys.executable, "-m", "pip", "install", "--quiet", "--no-index", "--no-deps", "--no-build-isolation"]
    run([*pip, "--target", str(tmp_path / "site"), str(here)], tmp_path)
    assert not {path.name for path in tmp_path.iterdir()} & set(FILES)
    _forget(out / "records.jsonl", "retinex")
    assert not scores(out, "retinex")
    unirender(
        *("bench", "run", *SMALL, "--methods", "plugins", "--out", str(out)), cwd=tmp_path, path=tmp_path / "site"
    )
    assert scores(out, "retinex") == named, "installed, found by its entry point"


def _forget(path: Path, method: str) -> None:
    """Takes a row out of a run's records, so that it is computed again."""
    lines = [line for line in path.read_text().splitlines() if f'"method": "{method}"' not in line]
    path.write_text("".join(f"{line}\n" for line in lines))
