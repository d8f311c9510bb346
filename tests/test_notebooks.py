"""The notebooks as files: valid, stored without outputs, in the table of contents, without paths of a machine.

That they run is the docs build's to show (`nb_execution_raise_on_error` in docs/conf.py).
"""

import copy
import json
import re
from pathlib import Path
from typing import Any

import pytest
from nbformat.validator import iter_validate

DOCS = Path(__file__).resolve().parents[1] / "docs"
NOTEBOOKS = sorted((DOCS / "notebooks").glob("*.ipynb"))
FORMAT = (4, 5)
MACHINE_PATH = re.compile(r"(?<![\w.)])(?:/(?:home|mnt|private|root|srv|tmp|Users|var|work)/|[A-Z]:\\)")


def read(path: Path) -> dict[str, Any]:
    return json.loads(path.read_text(encoding="utf-8"))


def toctree(page: Path) -> set[str]:
    """The documents that a page's toctrees list, as the page writes them."""
    blocks = re.findall(r"^```\{toctree\}\n(.*?)^```", page.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL)
    return {line for block in blocks for line in block.splitlines() if line and not line.startswith(":")}


def problems(notebook: dict[str, Any]) -> list[str]:
    """What is wrong with a notebook's content."""
    found = [f"format: {error.message}" for error in iter_validate(notebook)]
    stated = (notebook.get("nbformat"), notebook.get("nbformat_minor"))
    if stated != FORMAT:
        found.append(f"format {stated}, expected {FORMAT}")
    if notebook["metadata"].get("kernelspec", {}).get("name") != "python3":
        found.append("its kernel is not python3")
    for number, cell in enumerate(notebook["cells"]):
        if cell.get("outputs"):
            found.append(f"cell {number}: has outputs")
        if cell.get("execution_count") is not None:
            found.append(f"cell {number}: has an execution count")
    return found + [f"path of a machine: {hit}" for hit in MACHINE_PATH.findall(json.dumps(notebook))]


def test_there_are_notebooks() -> None:
    assert NOTEBOOKS


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_is_valid_and_clean(path: Path) -> None:
    assert problems(read(path)) == []


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_is_in_the_table_of_contents(path: Path) -> None:
    assert f"notebooks/{path.stem}" in toctree(DOCS / "notebooks.md")
    assert "notebooks" in toctree(DOCS / "index.md")


def test_the_table_of_contents_lists_nothing_else(tmp_path: Path) -> None:
    """The twin of the test above: what no toctree lists is not found."""
    assert toctree(DOCS / "notebooks.md") == {f"notebooks/{path.stem}" for path in NOTEBOOKS}
    page = tmp_path / "page.md"
    page.write_text("notebooks/a\n\n```{toctree}\n:maxdepth: 1\n\nnotebooks/b\n```\n\n```text\nnotebooks/c\n```\n")
    assert toctree(page) == {"notebooks/b"}


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        (lambda nb, cell: cell.update(outputs=[_printed("1\n")]), "has outputs"),
        (lambda nb, cell: cell.update(execution_count=3), "has an execution count"),
        (lambda nb, cell: cell.update(source="open('/home/somebody/mug.png')"), "path of a machine"),
        (lambda nb, cell: cell.update(source="open('C:\\\\mug.png')"), "path of a machine"),
        (lambda nb, cell: cell.pop("id"), "format: 'id' is a required property"),
        (lambda nb, cell: cell.update(cell_type="picture"), "format: "),
        (lambda nb, cell: nb.update(nbformat_minor=4), "expected (4, 5)"),
        (lambda nb, cell: nb["metadata"].pop("kernelspec"), "its kernel is not python3"),
    ],
)
def test_the_check_finds_a_bad_notebook(change: Any, problem: str) -> None:
    notebook = copy.deepcopy(read(NOTEBOOKS[0]))
    change(notebook, next(cell for cell in notebook["cells"] if cell["cell_type"] == "code"))
    assert any(problem in line for line in problems(notebook))


def _printed(text: str) -> dict[str, Any]:
    return {"output_type": "stream", "name": "stdout", "text": text}
