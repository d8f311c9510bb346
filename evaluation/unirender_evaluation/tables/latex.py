"""Tables as LaTeX, in the paper's layout; what stands in them is that of the other formats (`tables.formats`)."""

import re
import textwrap
import unicodedata
from collections.abc import Iterable
from itertools import groupby

from unirender_evaluation.metrics import Metric
from unirender_evaluation.tables.build import Row, Table
from unirender_evaluation.tables.counts import cell_counts
from unirender_evaluation.tables.formats import (
    MISSING,
    few,
    format_estimate,
    format_number,
    measured_text,
    row_cells,
    row_label,
)
from unirender_evaluation.tables.protocol import protocol_text
from unirender_evaluation.tables.text import TextTable

GREEK = (  # TeX's names from U+03B1 on
    "alpha beta gamma delta varepsilon zeta eta theta iota kappa lambda mu nu xi o pi rho varsigma sigma tau "
    "upsilon varphi chi psi omega"
)
GREEK_CAPITALS = (  # from U+0391 on; U+03A2 is no letter
    r"A B \Gamma \Delta E Z H \Theta I K \Lambda M N \Xi O \Pi P - \Sigma T \Upsilon \Phi X \Psi \Omega"
)
# Of the letters up to `LATIN` those that pdflatex stops at, and of those beyond it some that it has.
LATIN, TEX_LACKS = 0x17F, frozenset("«»ÐÞðþĄąĐđĘęĦħĮįĸĿŀŉŊŋŦŧŲųſ")
TEX_HAS = frozenset("ȘșȚț\u2010\u2011\u2013\u2014\u2018\u2019\u201c\u201d\u2022\u2026\u20ac\u2122")
TEX_COLUMN = 13  # letters of a column's heading in LaTeX: longer ones are broken, so that the column stays narrow


def to_latex(table: Table) -> str:
    """A booktabs `table*` in the paper's layout; needs packages booktabs and graphicx, and nothing else.

    The title is the caption, protocol and notes stand below; a table that is wider than the page is scaled to it. A
    name in letters that LaTeX's own fonts do not have needs another engine than pdflatex. A comment above says both.
    """
    groups = [(name, list(columns)) for name, columns in groupby(table.columns, key=lambda column: column.group)]
    doubled = dict(zip(map(id, table.columns), table.published_columns, strict=True))
    top, rules, start = [""], [], 2
    for name, columns in groups:
        span = sum(1 + doubled[id(column)] for column in columns)
        top.append(rf"\multicolumn{{{span}}}{{c}}{{{_tex_stacked(name, TEX_COLUMN * span)}}}")
        rules.append(rf"\cmidrule(lr){{{start}-{start + span - 1}}}")
        start += span
    second, third = ["Method"], [""]
    for column in table.columns:
        name = tex_text(_named(column.metric)) + (r"$\uparrow$" if column.metric.higher_is_better else r"$\downarrow$")
        second.append(rf"\multicolumn{{2}}{{c}}{{{name}}}" if doubled[id(column)] else name)
        third += ["paper", "here"] if doubled[id(column)] else [""]
    lines = [
        r"\begin{table*}[t]",
        r"\centering",
        r"\setlength{\belowcaptionskip}{4pt}",
        rf"\caption{{\textbf{{{tex_text(table.heading)}.}}{_tex_watermark(table)}}}",
        rf"\label{{tab:{table.name}-{table.protocol_key}-{table.variant.label}}}",
        r"\setlength{\tabcolsep}{4pt}",
        r"\resizebox{\ifdim\width>\textwidth\textwidth\else\width\fi}{!}{%",
        rf"\begin{{tabular}}{{l{'c' * (start - 2)}}}",
        r"\toprule",
    ]
    lines += [tex_row(top), "".join(rules), tex_row(second)]
    lines += [tex_row(third)] if any(doubled.values()) else []
    for _, rows in groupby(table.rows, key=lambda row: row.section):
        lines += [r"\midrule", *(tex_row(_latex_cells(row, table)) for row in rows)]
    lines += [r"\bottomrule", r"\end{tabular}}"]
    lines += [r"\par\smallskip", rf"\parbox{{\textwidth}}{{\scriptsize {_tex_below(table)}}}"]
    text = "\n".join([*lines, r"\end{table*}"]) + "\n"
    return tex_needs(text) + text


def text_latex(table: TextTable, label: str, names: int = 1) -> str:
    """A table of texts likewise, its notes below; the first `names` columns to the left, numbers to the right."""
    rows = [tex_row(map(tex_text, row)) for section in table.sections for row in section]
    below = " ".join(map(tex_text, table.notes))
    lines = [
        r"\begin{table*}[t]",
        r"\centering",
        rf"\caption{{\textbf{{{tex_text(table.title)}.}}}}",
        rf"\label{{tab:{label}}}",
        r"\setlength{\tabcolsep}{4pt}",
        r"\resizebox{\ifdim\width>\textwidth\textwidth\else\width\fi}{!}{%",
        rf"\begin{{tabular}}{{{'l' * names}{'r' * (len(table.columns) - names)}}}",
        r"\toprule",
        tex_row(map(tex_text, table.columns)),
        *(r"\midrule", *rows, r"\bottomrule", r"\end{tabular}}"),
        *(r"\par\smallskip", rf"\parbox{{\textwidth}}{{\scriptsize {below}}}", r"\end{table*}"),
    ]
    text = "\n".join(lines) + "\n"
    return tex_needs(text) + text


def _latex_cells(row: Row, table: Table) -> list[str]:
    texts, counts = [tex_text(row_label(row, table))], cell_counts(table.rows, row)
    for i, (column, cell, doubled) in enumerate(row_cells(row, table)):
        digits = column.metric.decimals
        if doubled:
            published = MISSING if cell.published is None else tex_text(format_number(cell.published, digits))
            texts.append(_tex_rank(published, cell.published_rank) + (r"$^\dagger$" if cell.dagger else ""))
        if cell.measured is None:
            texts.append(measured_text(cell))
        else:
            mean, spread = map(tex_text, format_estimate(cell.measured, digits))
            beside = f"{spread}{few(counts, i)}".strip()
            small = rf" {{\scriptsize {beside}}}" if beside else ""
            texts.append(_tex_rank(mean, cell.measured_rank) + small)
    return texts


def _named(metric: Metric) -> str:
    """A metric with its unit, which a PSNR, as everywhere in print, is taken to have."""
    return f"{metric.label} ({metric.unit})" if metric.unit and metric.name != "psnr" else metric.label


def _tex_stacked(text: str, width: int) -> str:
    """The text in as many lines as it needs where one has `width` letters."""
    lines = [tex_text(line) for line in textwrap.wrap(text, width, break_long_words=False)]
    stacked = r" \\ ".join(lines)
    return rf"\shortstack{{{stacked}}}" if len(lines) > 1 else stacked


def _tex_watermark(table: Table) -> str:
    return rf" \textbf{{{tex_text(table.watermark)}.}}" if table.watermark else ""


def _tex_below(table: Table) -> str:
    """Protocol and notes, each a sentence."""
    return " ".join(tex_text(f"{text.rstrip('.')}.") for text in (protocol_text(table.protocol), *table.notes))


def _tex_rank(text: str, rank: int | None) -> str:
    return {1: rf"\textbf{{{text}}}", 2: rf"\underline{{{text}}}"}.get(rank or 0, text)


# Characters that mean something to TeX, or are no letters of its fonts; `--` would become a dash.
_TEX = str.maketrans(
    {character: rf"\{character}" for character in "&%_#${}"}
    | {
        "\\": r"\textbackslash{}",
        "~": r"\textasciitilde{}",
        "^": r"\textasciicircum{}",
        "<": r"\textless{}",
        ">": r"\textgreater{}",
        "|": r"\textbar{}",
        "†": r"$^\dagger$",
        "·": r"$\cdot$",
        "±": r"$\pm$",
        "\N{MULTIPLICATION SIGN}": r"$\times$",
        "≥": r"$\geq$",
        "≤": r"$\leq$",
        "→": r"$\to$",
        "↑": r"$\uparrow$",
        "↓": r"$\downarrow$",
        "\N{MINUS SIGN}": r"$-$",
        "∞": r"$\infty$",
    }
    | {chr(0x3B1 + i): rf"$\{name}$" if len(name) > 1 else f"${name}$" for i, name in enumerate(GREEK.split())}
    | {chr(0x391 + i): rf"$\mathrm{{{name}}}$" for i, name in enumerate(GREEK_CAPITALS.split())}
)


# The sign of a number, or of its exponent: in TeX a hyphen is shorter.
_MINUS = re.compile(r"(?<![\w\-])-(?=[\d.∞])|(?<=\de)-(?=\d)")


def tex_text(text: str) -> str:
    """A text as TeX shows it as it is, on one line."""
    line = _MINUS.sub("\N{MINUS SIGN}", unicodedata.normalize("NFC", " ".join(text.split())))
    return line.translate(_TEX).replace("--", "-{}-")


def tex_needs(text: str) -> str:
    """The comment above a table: what compiles it."""
    lines = [r"% Needs \usepackage{booktabs,graphicx}."]
    strange = sorted({character for character in text if _is_strange(character)})
    if strange:
        lines.append(f"% Needs lualatex or xelatex, and a font that has {' '.join(strange)}: pdflatex has not.")
    return "\n".join(lines) + "\n"


def _is_strange(character: str) -> bool:
    """Whether pdflatex stops at a character, with the fonts that it takes where none is named."""
    return character in TEX_LACKS or (ord(character) > LATIN and character not in TEX_HAS)


def tex_row(texts: Iterable[str]) -> str:
    """A row; what it begins with is no option of the command before it, as [ and * would be."""
    line = " & ".join(texts)
    return ("{}" if line.startswith(("[", "*")) else "") + line + r" \\"
