"""The documentation against the program: commands and options that it shows exist, and so do the files it links to."""

import contextlib
import io
import pkgutil
import re
import shlex
from functools import cache
from pathlib import Path

import pytest

from unirender import cli

ROOT = Path(__file__).resolve().parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
LINK = re.compile(r"\]\((?!https?:|#)([^)#\s]+)")


def shown_commands(text: str) -> list[list[str]]:
    """The arguments of every `$ unirender ...` line in a console block, and of every `unirender ...` in code quotes."""
    lines = re.findall(r"^\$ unirender ([^#\n]*)", text, re.MULTILINE) + re.findall(r"`unirender ([^`]*)`", text)
    return [words for line in lines if (words := shlex.split(line.replace("…", "")))]


@cache
def help_text(*command: str) -> str:
    """What `unirender <command> --help` prints; empty where there is no such command."""
    out = io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(io.StringIO()), pytest.raises(SystemExit) as end:
        cli.main([*command, "--help"])
    text = out.getvalue()
    return text if end.value.code == 0 and f"unirender {' '.join(command)} " in text else ""


def problems(text: str) -> list[str]:
    """What of the commands in a text does not exist."""
    found = []
    for words in shown_commands(text):
        command = words[:2] if words[0] in ("bench", "reference") else words[:1]
        if command[0].startswith("-") or command == ["..."]:
            continue
        shown = help_text(*command)
        if not shown:
            found.append(f"no command: unirender {' '.join(command)}")
        options = [word.split("=")[0] for word in words if word.startswith("--")]
        found += [f"no option: {' '.join(words)}: {option}" for option in options if shown and option not in shown]
    return found


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_commands_and_options_exist(page: Path) -> None:
    assert not problems(page.read_text(encoding="utf-8"))


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_linked_files_exist(page: Path) -> None:
    links = LINK.findall(page.read_text(encoding="utf-8"))
    assert not [link for link in links if not (page.parent / link).exists()]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_names_in_python_roles_exist(page: Path) -> None:
    for name in re.findall(r"\{py:\w+\}`([\w.]+)`", page.read_text(encoding="utf-8")):
        assert pkgutil.resolve_name(name) is not None


def test_the_check_finds_a_wrong_command_and_a_wrong_option() -> None:
    text = "```console\n$ unirender decompose a.png --output b --no-such 1   # comment --seed\n$ unirender bake\n```"
    assert problems(text) == [
        "no option: decompose a.png --output b --no-such 1: --no-such",
        "no command: unirender bake",
    ]
    assert problems("$ unirender decompose a.png --output b --seed 3") == []
