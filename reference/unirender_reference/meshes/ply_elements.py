"""PLY files as columns of numbers: text or binary of either byte order, lists of any type and length, any elements.

A file is a header and one row for each vertex, face and so on; a text has a line for each row. A property of an
element is a number in each of its rows, or a list of them behind their count. trimesh reads no binary file whose lists
differ in length, and shifts the rows of a text behind a blank line.
"""

import re
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import Int, Num

from unirender.errors import UnirenderError

INTEGERS = {"char": "int8", "uchar": "uint8", "short": "int16", "ushort": "uint16", "int": "int32", "uint": "uint32"}
KINDS = INTEGERS | {"float": "float32", "double": "float64"}
KINDS |= {name: name for name in [*KINDS.values(), "int64", "uint64", "float16"]}
MAX_LISTS = 8  # of an element: each costs memory for each row
ORDERS = {"ascii": None, "binary_little_endian": "<", "binary_big_endian": ">"}
END = re.compile(rb"[\r\n]end_header[^\r\n]*")


@dataclass(frozen=True)
class PlyProperty:
    """A number or a list in each row of an element.

    Attributes:
        name: as the file spells it.
        kind: of the numbers, in the file's byte order.
        counts: the type of a list's length; None for a single number.
    """

    name: str
    kind: np.dtype
    counts: np.dtype | None


@dataclass(frozen=True)
class PlyElement:
    """How many rows an element has, and what each holds."""

    rows: int
    properties: list[PlyProperty] = field(default_factory=list)

    def doubles(self) -> set[str]:
        """The names of its properties of double precision."""
        return {each.name for each in self.properties if each.kind.name == "float64"}


@dataclass(frozen=True)
class PlyHeader:
    """What stands before the numbers.

    Attributes:
        text: whether the numbers are text.
        start: where they begin, in bytes.
        elements: by name, in the file's order.
        comments: each without its first word.
    """

    text: bool
    start: int
    elements: dict[str, PlyElement]
    comments: list[bytes]


@dataclass(frozen=True)
class _Numbers:
    """All numbers of a file: of a text one after the other, else its bytes."""

    stored: np.ndarray
    text: bool

    def width(self, kind: np.dtype) -> int:
        return 1 if self.text else kind.itemsize

    def take(self, at: Int[np.ndarray, " n"], kind: np.dtype) -> Num[np.ndarray, " n"]:
        """Those that stand at some places, in this machine's byte order."""
        if self.text:
            with np.errstate(invalid="ignore"):
                return self.stored[at].astype(kind.newbyteorder("="))
        parts = self.stored[at[:, None] + np.arange(kind.itemsize)]
        return parts.reshape(-1).view(kind).astype(kind.newbyteorder("="))


@dataclass(frozen=True)
class PlyLists:
    """A list in each row: its length, and where its numbers begin."""

    sizes: Int[np.ndarray, " n"]
    _at: Int[np.ndarray, " n"]
    _kind: np.dtype
    _numbers: _Numbers

    def joined(self, rows: np.ndarray) -> Num[np.ndarray, " k"]:
        """The lists of some rows (a mask), one after the other; the caller sees to it that they are not too many."""
        sizes = self.sizes[rows]
        step = np.arange(sizes.sum()) - np.repeat(np.cumsum(sizes) - sizes, sizes)
        at = np.repeat(self._at[rows], sizes) + step * self._numbers.width(self._kind)
        return self._numbers.take(at, self._kind)


PlyColumns = Mapping[str, Num[np.ndarray, " n"] | PlyLists]


def read_header(head: bytes) -> PlyHeader:
    """The header of a file.

    Args:
        head: its first bytes.

    Raises:
        UnirenderError: no PLY, a header that goes on behind `head`, or a line that is not understood.
    """
    first = re.match(rb"(?:\xef\xbb\xbf)?ply[ \t]*(\r\n|\r|\n)", head, re.IGNORECASE)
    if first is None:
        raise UnirenderError(f"starts with {head[:20]!r}, expected a line 'ply'; is it a PLY file?")
    end = END.search(head)
    if end is None:
        raise UnirenderError(f"truncated: its header does not end within {len(head):,} bytes; export it again")
    start = min(end.end() + len(first[1]), len(head))
    lines = [line.strip() for line in head[first.end() : end.start()].splitlines()]
    elements: dict[str, PlyElement] = {}
    form, comments = "", []
    properties: list[PlyProperty] = []
    for line in lines:
        keyword, *words = line.decode("utf-8", "replace").split() or ["comment"]
        try:
            if keyword == "format":
                form = words[0].lower()
                if form not in ORDERS:
                    raise ValueError
            elif keyword == "element":
                name, rows = words
                if name in elements or int(rows) < 0:
                    raise ValueError
                properties = []
                elements[name] = PlyElement(int(rows), properties)
            elif keyword == "property" and words[0] == "list":
                properties.append(PlyProperty(words[3], _kind(words[2], form), _kind(words[1], form)))
            elif keyword == "property":
                properties.append(PlyProperty(words[1], _kind(words[0], form), None))
            elif keyword in ("comment", "obj_info"):
                comments.append(line[len(keyword) :].strip())
            else:
                raise ValueError
        except (ValueError, IndexError, KeyError):
            raise UnirenderError(f"its header has the line {line[:60]!r}, not understood; export it again") from None
    for element, each in elements.items():
        if len({found.name for found in each.properties}) < len(each.properties):
            raise UnirenderError(f"its element {element} has two properties of one name; export it again")
        lists = sum(found.counts is not None for found in each.properties)
        if lists > MAX_LISTS:
            raise UnirenderError(
                f"its element {element} has {lists} lists, expected at most {MAX_LISTS}; leave some out"
            )
    if not form:
        raise UnirenderError(f"its header has no line 'format', expected one of {', '.join(ORDERS)}; export it again")
    return PlyHeader(ORDERS[form] is None, start, elements, comments)


def _kind(word: str, form: str) -> np.dtype:
    return np.dtype(KINDS[word]).newbyteorder(ORDERS[form] or "=")


def read_columns(path: Path, header: PlyHeader, wanted: Collection[str]) -> dict[str, PlyColumns]:
    """The columns of each element, by the names of its properties.

    Args:
        path: the file.
        header: its own.
        wanted: which properties that are no lists; lists are all there, and cost nothing before they are joined.

    Raises:
        UnirenderError: the file ends before its elements do, a line of a text is shorter than its row, or a list has a
            negative length.
    """
    with path.open("rb") as file:
        file.seek(header.start)
        body = file.read()
    if header.text:
        return _of_text(body, header.elements, wanted)
    numbers = _Numbers(np.frombuffer(body, np.uint8), text=False)
    result: dict[str, PlyColumns] = {}
    position = 0
    for name, element in header.elements.items():
        starts = _starts(body, position, name, element)
        limit = np.broadcast_to(len(body), element.rows)
        result[name], ends = _columns(numbers, (starts, limit), name, element, wanted)
        position = int(ends[-1]) if len(ends) else position
    return result


def _of_text(body: bytes, elements: Mapping[str, PlyElement], wanted: Collection[str]) -> dict[str, PlyColumns]:
    """The wanted elements of a text PLY."""
    claimed = sum(element.rows for element in elements.values())
    lines = [line for line in body.splitlines() if line.strip()][:claimed]
    if len(lines) < claimed:
        raise UnirenderError(f"truncated: its header claims {claimed:,} lines, it has {len(lines):,}; copy it again")
    ends = np.cumsum([len(line.split()) for line in lines], dtype=np.int64)
    try:
        numbers = _Numbers(np.fromstring(b"\n".join(lines), sep=" "), text=True)
    except ValueError:
        numbers = None
    if numbers is None or len(numbers.stored) != ends[-1:].sum():  # "1-2" is two numbers for numpy
        raise UnirenderError(f"{_first_word(lines)}, expected numbers alone; export it again")
    starts = np.concatenate([[0], ends[:-1]])
    result: dict[str, PlyColumns] = {}
    row = 0
    for name, element in elements.items():
        part = slice(row, row + element.rows)
        result[name], _ = _columns(numbers, (starts[part], ends[part]), name, element, wanted)
        row += element.rows
    return result


def _first_word(lines: list[bytes]) -> str:
    for line in lines:
        for word in line.split():
            try:
                float(word)
            except ValueError:
                return f"has the word {word[:20]!r} in the line {line[:60]!r}"
    return "has other characters than spaces between its numbers"


def _columns(
    numbers: _Numbers,
    rows: tuple[Int[np.ndarray, " n"], Int[np.ndarray, " n"]],
    name: str,
    element: PlyElement,
    wanted: Collection[str],
) -> tuple[PlyColumns, Int[np.ndarray, " n"]]:
    """The columns of rows, of which the first and the last possible place are given, and where they do end."""
    at, ends = np.array(rows[0], np.int64), rows[1]
    result: dict[str, Num[np.ndarray, " n"] | PlyLists] = {}

    def moved(by: Int[np.ndarray, " n"] | int) -> Int[np.ndarray, " n"]:
        beyond = np.flatnonzero(at + by > ends)
        if len(beyond):
            raise UnirenderError(f"truncated: row {beyond[0] + 1:,} of its element {name} is cut off; copy it again")
        return at + by

    for each in element.properties:
        if each.counts is None:
            after = moved(numbers.width(each.kind))
            if each.name in wanted:
                result[each.name] = numbers.take(at, each.kind)
            at = after
            continue
        first = moved(numbers.width(each.counts))
        sizes, at = numbers.take(at, each.counts).astype(np.int64), first
        if len(sizes) and sizes.min() < 0:
            raise UnirenderError(f"a list of its element {name} has {sizes.min():,} numbers; export it again")
        result[each.name] = PlyLists(sizes, first, each.kind, numbers)
        at = moved(sizes * numbers.width(each.kind))
    return result, at


def _starts(body: bytes, position: int, name: str, element: PlyElement) -> Int[np.ndarray, " n"]:
    """Where each row of a binary element begins; most have rows of one size."""
    counters, size = _row(body, position, name, element)
    guess = position + size * np.arange(element.rows, dtype=np.int64)
    numbers = _Numbers(np.frombuffer(body, np.uint8), text=False)
    if position + size * element.rows <= len(body) and all(
        (numbers.take(guess + at, kind) == count).all() for at, kind, count in counters
    ):
        return guess
    if not counters:
        raise UnirenderError(f"truncated: its {element.rows:,} rows of element {name} end too early; copy it again")
    starts = np.empty(element.rows, np.int64)
    for row in range(element.rows):
        starts[row] = position
        position += _row(body, position, name, element)[1]
    return starts


def _row(body: bytes, position: int, name: str, element: PlyElement) -> tuple[list[tuple[int, np.dtype, int]], int]:
    """Of the row there: the place, type and value of each list's count, and its bytes."""
    counters: list[tuple[int, np.dtype, int]] = []
    at = position
    for each in element.properties if element.rows else ():
        if each.counts is None:
            at += each.kind.itemsize
            continue
        stored = body[at : at + each.counts.itemsize]
        if len(stored) < each.counts.itemsize:
            raise UnirenderError(f"truncated: its element {name} ends too early; copy it again")
        count = stored[0] if each.counts.itemsize == 1 else int(np.frombuffer(stored, each.counts)[0])
        counters.append((at - position, each.counts, count))
        at += each.counts.itemsize + count * each.kind.itemsize
    return counters, at - position
