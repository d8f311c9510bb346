"""Tables of texts, for measurements whose rows are no systems of the benchmark: to a terminal and as Markdown.

And what all tables in Markdown need: a text that shows as it is (`plain_markdown`), and a row of a table.
"""

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from rich import box
from rich.console import Console
from rich.markup import escape
from rich.table import Table as RichTable

# What our own texts mark: code, and bold numbers with their intervals.
OWN_MARKUP = re.compile(r"(?<!`)`[^`<>\\]+`(?!`)|\*\*[-+\d.,±∞% ]+\*\*")
# What begins or ends markup where it stands: HTML, entities, emphasis, code, mathematics, links.
MARKUP = re.compile(r"[`\\]|<(?=[A-Za-z/!?])|&(?=#?\w+;)|[*~$](?=\S)|(?<![^\W_])_(?=\S)|\](?=[(\[])")
NUMBERS = re.compile(r"± (?=[\d.∞])|\(n = \d+\)|\[[-+\d.∞]+, [-+\d.∞]+\]")  # what stays on one line of a cell
WIDEST = 10_000  # of a table, characters
BLOCK = re.compile(r"^(\d*)([-+*#>.)\[])")  # what makes a line a list, a heading, a quotation, a link's definition


def plain_markdown(text: str, own: bool = False) -> str:
    """Markdown that shows a text from outside as it is, on one line.

    Characters that mark nothing where they stand are left: one * at the end of a name, the _ inside it.

    Args:
        text: a name, or a sentence.
        own: code and bold numbers in it are ours and stay (`OWN_MARKUP`).
    """
    text = " ".join(text.split())
    kept = [found.span() for found in OWN_MARKUP.finditer(text)] if own else []

    def shown(found: re.Match[str]) -> str:
        if any(first <= found.start() < last for first, last in kept):
            return found[0]
        return "&lt;" if found[0] == "<" else f"\\{found[0]}"

    return MARKUP.sub(shown, text)


def plain_paragraph(text: str) -> str:
    """The same of a sentence of ours with names from outside, which begins a line: its code is kept."""
    return BLOCK.sub(r"\1\\\2", plain_markdown(text, own=True))


def markdown_row(texts: Iterable[str]) -> str:
    """A row of a table; `texts` are Markdown.

    Where a column is narrow, half an interval stays with its sign, a count with its n, an interval in one piece: their
    spaces are no-break spaces.
    """

    def together(found: re.Match[str]) -> str:
        return found[0].replace(" ", "\N{NO-BREAK SPACE}")

    return "| " + " | ".join(NUMBERS.sub(together, text.replace("|", r"\|")) for text in texts) + " |"


def print_whole(console: Console, table: RichTable) -> None:
    """Prints a table in which no word is cut short: where the console is too narrow for whole cells the widest columns
    are broken into lines first, and where it is too narrow for the words of all, beyond its width.
    """
    wide = console.options.update(max_width=WIDEST)
    least, most = [], []
    for column in table.columns:
        texts = [console.measure(text, options=wide) for text in (column.header, *column.cells)]
        most.append(max(text.maximum for text in texts))
        least.append(most[-1] if column.no_wrap else max(text.minimum for text in texts))
    room = console.width - (console.measure(table, options=wide).maximum - sum(most))  # for cells
    cap = next((cap for cap in range(max(most), 0, -1) if sum(_capped(least, most, cap)) <= room), 0)
    for column, width in zip(table.columns, _capped(least, most, cap), strict=True):
        column.width = width
    table.width = console.measure(table, options=wide).maximum
    console.print(table, crop=False)


def _capped(least: Sequence[int], most: Sequence[int], cap: int) -> list[int]:
    """Widths of columns where none is wider than `cap`, but for its longest word."""
    return [max(low, min(high, cap)) for low, high in zip(least, most, strict=True)]


@dataclass(frozen=True)
class TextTable:
    """A finished table.

    Attributes:
        title: what it shows.
        columns: headers; the first names the rows.
        sections: groups of rows, each row one text for each column; code and bold numbers in them are marked up.
        notes: sentences below it.
    """

    title: str
    columns: tuple[str, ...]
    sections: tuple[tuple[tuple[str, ...], ...], ...]
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        wrong = [row for section in self.sections for row in section if len(row) != len(self.columns)]
        if wrong:
            raise ValueError(f"table {self.title!r}: got {len(wrong[0])} cells, expected {len(self.columns)}")

    def markdown(self) -> str:
        """GitHub-flavoured; the first column to the left, numbers to the right."""
        lines = [f"### {self.title}", "", markdown_row(self.columns)]
        lines += [markdown_row((":--", *["--:"] * (len(self.columns) - 1)))]
        rows = [row for section in self.sections for row in section]
        lines += [markdown_row(plain_markdown(text, own=True) for text in row) for row in rows]
        lines += [line for note in self.notes for line in ("", note)]
        return "\n".join(lines) + "\n"

    def show(self, console: Console) -> None:
        """Prints it to a terminal or a file."""
        table = RichTable(title=escape(self.title), box=box.SIMPLE_HEAD, title_justify="left", pad_edge=False)
        for index, name in enumerate(self.columns):
            table.add_column(escape(name), justify="right" if index else "left")
        for section in self.sections:
            for row in section:
                table.add_row(*map(escape, row))
            table.add_section()
        print_whole(console, table)
        for note in self.notes:
            console.print(note, style="dim", highlight=False, markup=False)
