"""The fenced blocks of a page of the documentation, those of the pages that it includes in their places."""

import re
import textwrap
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"

_OPEN = re.compile(r"^( *)(`{3,}|:{3,})(.*)$")
_INCLUDE = re.compile(r"^\{include\}\s+(\S+)$")
_NOT_RUN = re.compile(r"^ *<!-- not run: *(.*?) *-->$")


@dataclass(frozen=True)
class Block:
    """A fenced block.

    Attributes:
        path: the file that it stands in.
        line: the number of its fence; its text begins in the next.
        language: what follows the fence: `python`, `{figure} a.png`, or nothing.
        text: without the fence's indentation.
        not_run: the reason in the comment `<!-- not run: reason -->` right above it, which readers do not see.
    """

    path: Path
    line: int
    language: str
    text: str
    not_run: str | None = None

    @property
    def place(self) -> str:
        return f"{self.path.name}:{self.line}"


def pages() -> list[Path]:
    """README and the pages of the site; a file whose name begins with `_` is a part of the page that includes it."""
    return [ROOT / "README.md", *(path for path in sorted(DOCS.glob("*.md")) if not path.name.startswith("_"))]


def blocks(path: Path) -> Iterator[Block]:
    """Raises ValueError at a fence that nothing closes."""
    yield from _blocks(path, path.read_text(encoding="utf-8").splitlines(), 0)


def _blocks(path: Path, lines: list[str], above: int) -> Iterator[Block]:
    """Those of some lines of a page, which has so many above them; a directive's, as of a note, come after itself."""
    number = 0
    while number < len(lines):
        opened = _OPEN.match(lines[number])
        if opened is None:
            number += 1
            continue
        indent, fence, language = opened[1], opened[2], opened[3].strip()
        closing = (i for i in range(number + 1, len(lines)) if lines[i].strip() == fence)
        end = next(closing, None)
        if end is None:
            raise ValueError(f"{path.name}:{above + number + 1}: nothing closes this block")
        inside = [line.removeprefix(indent) for line in lines[number + 1 : end]]
        if included := _INCLUDE.match(language):
            yield from blocks(path.parent / included[1])
        else:
            said = _NOT_RUN.match(lines[number - 1]) if number else None
            text = textwrap.dedent("\n".join(inside) + "\n")
            yield Block(path, above + number + 1, language, text, said and said[1])
            if language.startswith("{") and not language.startswith("{code"):
                yield from _blocks(path, inside, above + number + 1)
        number = end + 1


def anchors(path: Path) -> set[str]:
    """What a link to a heading of the page, or of what it includes, has behind its `#`, as GitHub and MyST make it."""
    text = path.read_text(encoding="utf-8")
    fenced = {number for block in blocks(path) if block.path == path for number in _lines(block)}
    included = re.findall(r"^`{3}\{include\}\s+(\S+)$", text, re.MULTILINE)
    found = {anchor for name in included for anchor in anchors(path.parent / name)}
    for number, line in enumerate(text.splitlines(), start=1):
        heading = re.match(r"^#{1,3} +(.+?) *$", line)  # as deep as `myst_heading_anchors` in conf.py
        if heading and number not in fenced:
            words = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", heading[1]).lower()
            found.add(re.sub(r"[^\w\- ]", "", words).replace(" ", "-"))
        found.update(re.findall(r"^\(([\w-]+)\)=$", line))
    return found


def _lines(block: Block) -> range:
    return range(block.line, block.line + block.text.count("\n") + 2)
