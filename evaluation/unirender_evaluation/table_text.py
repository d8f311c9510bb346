"""Tables of texts, for measurements whose rows are no systems of the benchmark: to a terminal and as Markdown."""

from dataclasses import dataclass

from rich import box
from rich.console import Console
from rich.markup import escape
from rich.table import Table as RichTable


@dataclass(frozen=True)
class TextTable:
    """A finished table.

    Attributes:
        title: what it shows.
        columns: headers; the first names the rows.
        sections: groups of rows, each row one text for each column.
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
        lines = [f"### {self.title}", "", _pipe(self.columns), _pipe((":--", *["--:"] * (len(self.columns) - 1)))]
        lines += [_pipe(row) for section in self.sections for row in section]
        lines += [line for note in self.notes for line in ("", note)]
        return "\n".join(lines) + "\n"

    def show(self, console: Console) -> None:
        """Prints it to a terminal; where that is narrow, what does not fit goes on below."""
        table = RichTable(title=escape(self.title), box=box.SIMPLE_HEAD, title_justify="left", pad_edge=False)
        for index, name in enumerate(self.columns):
            table.add_column(escape(name), justify="right" if index else "left", overflow="fold")
        for section in self.sections:
            for row in section:
                table.add_row(*map(escape, row))
            table.add_section()
        console.print(table)
        for note in self.notes:
            console.print(note, style="dim", highlight=False, markup=False)


def _pipe(texts: tuple[str, ...]) -> str:
    return "| " + " | ".join(text.replace("|", r"\|") for text in texts) + " |"
