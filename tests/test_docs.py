"""The documentation against the program: the command lines that it shows are taken, the options that it names exist,
and so do the files and headings that it links to. What blocks hold besides commands is run by `test_docs_code.py`.
"""

import ast
import contextlib
import importlib.util
import io
import json
import pkgutil
import re
import shlex
import tomllib
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from types import ModuleType, SimpleNamespace

import pytest
from doc_blocks import anchors, blocks, pages
from docutils import nodes
from docutils.utils.math import MathError
from docutils.utils.math.latex2mathml import tex2mathml

from unirender import cli
from unirender.command_line.parse import parse
from unirender.errors import UnirenderError

ROOT = Path(__file__).resolve().parents[1]
PAGES = [
    ROOT / "README.md",
    *sorted((ROOT / "docs").glob("*.md")),
    *sorted((ROOT / "docs" / "notebooks").glob("*.ipynb")),
]
LINK = re.compile(r"\]\((?!https?:|#)([^)#\s]+)")
HEADING = re.compile(r"\]\((?!https?:)([^)#\s]*)#([^)\s]+)\)")
CODE = re.compile(r"^(`{3,}).*?^\1|`[^`\n]*`", re.MULTILINE | re.DOTALL)
FORMULA = re.compile(r"\$\$(.+?)\$\$|\$([^$]+)\$", re.DOTALL)
EXTRA = re.compile(r"unirender\[([\w,]+)\]")


def page_text(page: Path) -> str:
    """The text of a page; of a notebook what stands between its code."""
    text = page.read_text(encoding="utf-8")
    if page.suffix != ".ipynb":
        return text
    cells = (cell for cell in json.loads(text)["cells"] if cell["cell_type"] == "markdown")
    return "\n\n".join("".join(cell["source"]) for cell in cells)


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
    assert not problems(page_text(page))


def typed(text: str) -> Iterator[list[str]]:
    """The words of every command that a console block shows, without comments and the dots that stand for more."""
    for line in re.sub(r"\\\n\s*", " ", text).splitlines():
        if line.startswith("$ "):
            yield [word for word in shlex.split(line.removeprefix("$ "), comments=True) if word not in ("...", "…")]


def refusal(words: list[str]) -> str:
    """Why a command that the documentation shows would not start; empty where it would, or is not ours to know."""
    if "unirender.cli" in words:  # started by another program, with -m
        words = ["unirender", *words[words.index("unirender.cli") + 1 :]]
    if words[:1] == ["unirender"]:
        said = io.StringIO()
        with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
            try:
                parse(cli.Command, words[1:], "unirender", "")
            except (SystemExit, UnirenderError) as error:
                return f"{' '.join(words)}: {error} {said.getvalue()}"
    elif words[:1] == ["make"]:
        known = re.findall(r"^([\w-]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE)
        return "".join(f"no target: {word}" for word in words[1:] if "=" not in word and word not in known)
    elif words[:2] == ["python", "-m"] and importlib.util.find_spec(words[2]) is None:
        return f"no module: {words[2]}"
    return ""


@pytest.mark.parametrize("page", pages(), ids=lambda page: page.name)
def test_command_lines_are_taken(page: Path) -> None:
    """Read as the program reads them: values, choices and what has to be there, too. Nothing is run."""
    shown = [(block, words) for block in blocks(page) if block.language == "console" for words in typed(block.text)]
    assert not [f"{block.place}: {why}" for block, words in shown if (why := refusal(words))]


def test_console_blocks_show_commands() -> None:
    """With the prompt by which they are known, or they would not be looked at."""
    shown = [block for page in pages() for block in blocks(page) if block.language == "console"]
    assert not [block.place for block in shown if not list(typed(block.text))]


def test_a_command_that_would_not_start_is_found() -> None:
    lines = (
        "$ unirender dataset --out a --vary moods # --no-such",
        "$ unirender dataset --out a \\\n  --objects 3 ...",
        "$ unirender edit",
        "$ torchrun -m unirender.cli train --steps many",
        "$ make bunch",
        "$ make bench A=1",
        "$ python -m no_such_module",
        "$ ls",
        "unirender no-command",
    )
    refused = [bool(refusal(words)) for words in typed("\n".join(lines))]
    assert refused == [True, False, True, True, True, False, True, False]


def test_extras_exist() -> None:
    known = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["optional-dependencies"]
    shown = {name for page in PAGES for found in EXTRA.findall(page.read_text("utf-8")) for name in found.split(",")}
    assert shown
    assert shown <= set(known)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_linked_headings_exist(page: Path) -> None:
    """Sphinx refuses a wrong one of the site; README is no page of it, and is read elsewhere."""
    links = HEADING.findall(page.read_text(encoding="utf-8"))
    targets = [
        (page.parent / name if name else page, anchor) for name, anchor in links if name.endswith(".md") or not name
    ]
    assert not [f"{path.name}#{anchor}" for path, anchor in targets if anchor not in anchors(path)]


def test_anchors_are_those_of_github_and_myst(tmp_path: Path) -> None:
    (tmp_path / "a.md").write_text(
        "# Other sizes: `--tile`\n```console\n# no heading\n```\n## s and d, [again](b.md)\n(mark)=\n#### too deep\n"
    )
    assert anchors(tmp_path / "a.md") == {"other-sizes---tile", "s-and-d-again", "mark"}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_linked_files_exist(page: Path) -> None:
    links = LINK.findall(page_text(page))
    assert not [link for link in links if not (page.parent / link).exists()]


def misread(text: str) -> list[str]:
    """Formulas that docutils, which makes the site's MathML, refuses or silently takes for others."""
    found = []
    for block, inline in FORMULA.findall(CODE.sub("", text)):
        formula = (block or inline).strip()
        try:
            shown = tex2mathml(formula)
        except MathError as error:
            found.append(f"{formula}: {error}")
            continue
        if re.search(r"frac\s*\d", formula):  # 12 is one number to it, and the denominator is what comes next
            found.append(f"{formula}: braces are missing")
        if "\\" in shown:
            found.append(f"{formula}: backslash is shown")
    return found


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_formulas_are_shown_as_they_were_meant(page: Path) -> None:
    assert not misread(page_text(page))


def test_a_formula_that_is_misread_is_found() -> None:
    right = r"$\frac{1}{2}$, as code `$\frac12$`" + "\n```\n$ \\frac12 $\n```\n"
    wrong = r"$a = \frac12 (b)$, $$\text{down\_up}$$ and $\nosuch$"
    assert misread(right) == []
    problems = [problem.split(": ", 1)[1].split()[0] for problem in misread(right + wrong)]
    assert problems == ["braces", "backslash", "Unknown"]


@cache
def site_settings() -> ModuleType:
    """The module docs/conf.py."""
    spec = importlib.util.spec_from_file_location("site_settings", ROOT / "docs" / "conf.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_a_bar_over_a_formula_is_left_to_the_style_sheet() -> None:
    page, writer = nodes.section(), SimpleNamespace(body=[])
    page += nodes.math("", r"\overline{w^2} + \overline{w}")
    site_settings()._formulas(None, page)
    with pytest.raises(nodes.SkipNode):
        site_settings()._mathml(writer, page[0])
    (markup,) = writer.body
    assert markup.count('<mrow class="overline">') == markup.count("</mrow>") == 2
    assert "mover" not in markup
    assert "math .overline {" in (ROOT / "docs" / "_static" / "narrow.css").read_text(encoding="utf-8")


def test_an_interval_and_a_count_are_not_broken_but_in_code() -> None:
    page = nodes.section()
    page += [nodes.paragraph("", "Ours (n = 48) 1.5 ± 0.2"), nodes.literal_block("", "(n = 48) 1.5 ± 0.2")]
    site_settings()._intervals(None, page)
    assert [each.astext().replace("\N{NO-BREAK SPACE}", "_") for each in page.children] == [
        "Ours (n_=_48) 1.5 ±_0.2",
        "(n = 48) 1.5 ± 0.2",
    ]


def executed(page: Path) -> Iterator[tuple[str, str]]:
    """The code of every cell that the build runs, and what it says of its picture to those who do not see it."""
    if page.suffix == ".ipynb":
        for cell in json.loads(page.read_text(encoding="utf-8"))["cells"]:
            if cell["cell_type"] == "code":
                yield "".join(cell["source"]), cell["metadata"].get("mystnb", {}).get("image", {}).get("alt", "")
        return
    for block in blocks(page):
        if block.language.startswith("{code-cell}"):
            _, options, source = (
                block.text.split("---\n", 2) if block.text.startswith("---\n") else ("", "", block.text)
            )
            yield source, "".join(re.findall(r"^ +alt: (.+)", options, re.MULTILINE))


def draws(source: str) -> bool:
    """Whether the code calls a function `show` or `imshow`; defining one that does is not yet a picture."""
    magic = source.startswith("%%")  # a cell that IPython writes to a file, say, and does not run
    code = "" if magic else re.sub(r"^[%:].*", "", source, flags=re.MULTILINE)
    top = [node for node in ast.parse(code).body if not isinstance(node, ast.FunctionDef)]
    calls = [ast.unparse(node.func) for each in top for node in ast.walk(each) if isinstance(node, ast.Call)]
    return any(call.rsplit(".", 1)[-1] in ("show", "imshow") for call in calls)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_computed_pictures_have_words(page: Path) -> None:
    """Without any a screen reader reads out the name of a file, which is a hash."""
    assert not [source[:60] for source, alt in executed(page) if draws(source) and len(alt.split()) < 4]


def test_cells_that_draw_are_known() -> None:
    assert draws(":tags: [hide-input]\nimport numpy\nshow(a=1)")
    assert draws("for axis in axes:\n    axis.imshow(picture)")
    assert not draws("def show():\n    plt.show()")
    assert not draws("%%writefile a.py\nshow(1)")
    counts = {page.stem: sum(draws(source) for source, _ in executed(page)) for page in PAGES}
    assert counts["decompose_edit_relight"] == 7


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_names_in_python_roles_exist(page: Path) -> None:
    for name in re.findall(r"\{py:\w+\}`([\w.]+)`", page_text(page)):
        assert pkgutil.resolve_name(name) is not None


def test_the_check_finds_a_wrong_command_and_a_wrong_option() -> None:
    text = "```console\n$ unirender decompose a.png --output b --no-such 1   # comment --seed\n$ unirender bake\n```"
    assert problems(text) == [
        "no option: decompose a.png --output b --no-such 1: --no-such",
        "no command: unirender bake",
    ]
    assert problems("$ unirender decompose a.png --output b --seed 3") == []
