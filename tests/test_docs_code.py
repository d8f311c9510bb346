"""Every block of the documentation is run: Python in the page's order in one namespace, files of data by their readers.

`helpers/doc_pages.py` says what a page assumes, `helpers/doc_files.py` who reads its files. Commands of console blocks
are checked by `test_docs.py`, and sphinx runs the `{code-cell}` blocks when it builds the pages.
"""

import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from doc_blocks import DOCS, Block, blocks, pages
from doc_files import LANGUAGES, READERS
from doc_pages import EXAMPLES, Example, Names

CONSOLE = ("console", "bash")
CELL = "{code-cell} python"  # sphinx runs it; other directives hold text, and blocks that are looked at
NOT_RUN: dict[str, list[str]] = {"install.md": ["it needs Docker"]}
"""All there is of blocks that are not run; a reason stands above its block as `<!-- not run: reason -->`."""
LONG = {"optimization.md", "tour.md"}
"""Pages whose Python takes ten seconds and more."""


def shown(page: Path, *languages: str) -> list[Block]:
    """A page's blocks of these languages that are run."""
    return [block for block in blocks(page) if block.language in languages and block.not_run is None]


def is_sphinx(language: str) -> bool:
    """A cell that it runs, or a directive that holds no code: `{code-block}` would be neither run nor read."""
    return language.startswith(CELL) or (language.startswith("{") and not language.startswith("{code"))


def run_python(page: Path, found: list[Block], example: Example) -> Names:
    """Runs the blocks in one namespace, shortened; what is in it then. Tracebacks name the page and its line."""
    unused = [words for words in example.less if not any(words in block.text for block in found)]
    assert not unused, f"{page.name}: {unused} are not on the page; mend `less` in tests/helpers/doc_pages.py"
    names: Names = {"__name__": "__main__", **example.names()}
    for block in found:
        text = block.text
        for words, less in example.less.items():
            text = text.replace(words, less)
        first = text.partition("\n")[0]
        if first.startswith("# ") and first.endswith(".py"):  # a file that the page shows, for blocks that import it
            Path(first.removeprefix("# ")).write_text(text, encoding="utf-8")
        exec(compile("\n" * block.line + text, str(block.path), "exec"), names)
    return names


PYTHON = [page for page in pages() if shown(page, "python")]
FILES = [page for page in pages() if shown(page, *LANGUAGES)]


@pytest.fixture
def working(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """An empty working folder, from which a page's files are imported, as by a script in it, and then forgotten."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(sys, "argv", [""])
    yield tmp_path
    for name, module in list(sys.modules.items()):
        if str(getattr(module, "__file__", None)).startswith(str(tmp_path)):
            del sys.modules[name]


@pytest.mark.parametrize(
    "page",
    [pytest.param(page, marks=pytest.mark.long if page.name in LONG else ()) for page in PYTHON],
    ids=lambda page: page.name,
)
def test_python_blocks_run(page: Path, working: Path) -> None:
    if page.name not in EXAMPLES:
        pytest.fail(
            f"{page.name} has a Python block and no entry in EXAMPLES of tests/helpers/doc_pages.py: add one that "
            "makes what the block assumes (`Example()` where it assumes nothing)"
        )
    example = EXAMPLES[page.name]
    example.check(run_python(page, shown(page, "python"), example))


@pytest.mark.parametrize("page", FILES, ids=lambda page: page.name)
def test_files_of_data_are_read(page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    found, readers = shown(page, *LANGUAGES), READERS.get(page.name, ())
    if len(found) != len(readers):
        pytest.fail(
            f"{page.name} has {len(found)} blocks of {', '.join(LANGUAGES)} and {len(readers)} readers in READERS of "
            "tests/helpers/doc_files.py: give each the code that reads such a file"
        )
    for number, (block, reader) in enumerate(zip(found, readers, strict=True)):
        (tmp_path / str(number)).mkdir()
        monkeypatch.chdir(tmp_path / str(number))
        reader(block.text)


@pytest.mark.parametrize("page", pages(), ids=lambda page: page.name)
def test_no_block_is_passed_over(page: Path) -> None:
    """Each is run, read, a command, or sphinx's own; or it says that it is not run, and stands in the list above."""
    known = ("python", *LANGUAGES, *CONSOLE)
    strange = [
        f"{block.place}: a block of {block.language or 'no language'!r}, which nothing runs"
        for block in blocks(page)
        if block.not_run is None and block.language not in known and not is_sphinx(block.language)
    ]
    assert not strange
    assert [block.not_run for block in blocks(page) if block.not_run is not None] == NOT_RUN.get(page.name, [])


def test_every_entry_is_of_a_page_that_needs_it() -> None:
    assert set(EXAMPLES) == {page.name for page in PYTHON}
    assert set(READERS) == {page.name for page in FILES}


def test_every_part_is_included_by_a_page() -> None:
    """Or its blocks would not be run."""
    used = {block.path.name for page in pages() for block in blocks(page)}
    parts = [path for path in DOCS.glob("_*.md") if any(blocks(path))]
    assert {path.name for path in parts} <= used


def test_cells_are_run_where_they_are_built() -> None:
    settings: Names = {}
    exec("\n".join(line for line in (DOCS / "conf.py").read_text().splitlines() if line.startswith("nb_")), settings)
    assert settings["nb_execution_mode"] == "force"
    assert settings["nb_execution_raise_on_error"] is True


def test_a_block_that_does_not_run_is_found(working: Path) -> None:
    """The twin: blocks of an included page are seen in their places, and an error has the page's line."""
    (working / "_part.md").write_text("```python\nassert a == 2\n```\n")
    page = working / "page.md"
    page.write_text(
        "```python\na = 1\n```\n\n```{include} _part.md\n```\n\n<!-- not run: hours -->\n```python\nb\n```\n"
        "- in a list\n\n  ```python\n  c = 3\n  ```\n\n````{note}\n```python\nd = 4\n```\n````\n"
    )
    assert [(block.text, block.not_run) for block in blocks(page)] == [
        ("a = 1\n", None),
        ("assert a == 2\n", None),
        ("b\n", "hours"),
        ("c = 3\n", None),
        ("```python\nd = 4\n```\n", None),
        ("d = 4\n", None),
    ]
    found = shown(page, "python")
    assert run_python(page, found, Example(less={"a = 1": "a = 2"}))["c"] == 3
    with pytest.raises(AssertionError) as error:
        run_python(page, found, Example())
    assert (Path(error.traceback[-1].path).name, error.traceback[-1].lineno) == ("_part.md", 1)
    with pytest.raises(AssertionError, match="are not on the page"):
        run_python(page, found, Example(less={"no such words": ""}))
    assert [is_sphinx(name) for name in ("{note}", CELL, "{code-block} python", "rust")] == [True, True, False, False]
    page.write_text("```python\na = 1\n")
    with pytest.raises(ValueError, match=r"page\.md:1: nothing closes"):
        list(blocks(page))
