"""The LaTeX tables of a result, compiled by pdflatex with booktabs: `make test-latex`. A missing program is an error.

What is compiled is every table of a run over a closed-form suite, with the paper's rows, a stranger's row whose name
holds every character that means something to TeX, and the watermark of a partial run.
"""

import re
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path

import pytest
from tiny_suites import make_suite

from unirender_evaluation.bounds import TRUE_LIGHT, ceiling_info
from unirender_evaluation.methods.trivial import InputAsAlbedo
from unirender_evaluation.metrics import Variant
from unirender_evaluation.records import Record, RunInfo
from unirender_evaluation.rows import make_row, trivial_rows
from unirender_evaluation.runs.workers import Run
from unirender_evaluation.table_list import ALL_TABLES
from unirender_evaluation.tables.build import Table, build_tables
from unirender_evaluation.tables.latex import to_latex
from unirender_evaluation.versions import LPIPS, MODEL, REFERENCE, Versions

pytestmark = pytest.mark.latex

HARD_NAME = r"[*] Müller & al_2 50% #1 {x} ~ ^ \ $ <a|b> -- " "\N{MULTIPLICATION SIGN} ≥ → ±"
PAGE = r"""\documentclass[10pt,twocolumn]{article}
\usepackage[margin=2cm]{geometry}
\usepackage{booktabs,graphicx}
\begin{document}
%s
\end{document}
"""
HOW = "install it: apt-get install texlive-latex-base texlive-latex-recommended (Debian), or TeX Live, and run again"


@pytest.fixture(scope="module")
def pdflatex() -> str:
    """The program, with the packages that the tables need."""
    program, search = shutil.which("pdflatex"), shutil.which("kpsewhich")
    assert program is not None, f"no pdflatex on this machine; {HOW}"
    assert search is not None, f"no kpsewhich on this machine; {HOW}"
    for package in ("booktabs.sty", "graphicx.sty"):
        found = subprocess.run([search, package], capture_output=True, text=True, check=False).stdout
        assert found.strip(), f"pdflatex has no {package}; {HOW}"
    return program


@pytest.fixture(scope="module")
def tables(tmp_path_factory: pytest.TempPathFactory) -> list[Table]:
    folder = tmp_path_factory.mktemp("latex")
    suite = make_suite(folder)
    hard = make_row(InputAsAlbedo(), "external", label=HARD_NAME)
    rows = [*trivial_rows(), replace(hard, info=replace(hard.info, key="stranger"))]
    versions = Versions("test", {LPIPS: "none", MODEL: "1", REFERENCE: "1"})
    run = Run(suite, rows, list(suite.scenes), versions, (), folder / "pictures")
    jobs = [job for scene in suite.scenes for job in run.jobs(scene) if not job.label.startswith("physics")]
    records = [record for job in jobs if (record := job.make()).values]
    for table in ALL_TABLES.keys() - {record.table for record in records}:
        records += _filled(table, rows[0].info.key)
    info = RunInfo(
        suite=suite.spec.name,
        suite_hash=suite.sha256,
        resolution=suite.spec.resolution,
        methods=(*(row.info for row in rows), ceiling_info(suite), TRUE_LIGHT),
        coverage=0.4,
        lpips=("alex",),
        mitsuba="none",
        truth_spp=8,
        limit=2,
    )
    return build_tables(records, info, ALL_TABLES)


def _filled(table: str, method: str) -> list[Record]:
    """Records with a value in every column, for tables that Mitsuba fills: here columns matter, not values."""
    values = {column.key(Variant()): 0.5 for column in ALL_TABLES[table].columns}
    return [Record(table, protocol, method, "s", "o", values) for protocol in ALL_TABLES[table].protocols]


def compiled(program: str, text: str, folder: Path) -> subprocess.CompletedProcess[str]:
    """The second of two passes: references are right in it."""
    (folder / "page.tex").write_text(PAGE % text, encoding="utf-8")
    command = [program, "-interaction=nonstopmode", "-halt-on-error", "page.tex"]
    subprocess.run(command, cwd=folder, capture_output=True, check=False)
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, errors="replace", check=False)


def test_every_table_compiles(pdflatex: str, tables: list[Table], tmp_path: Path) -> None:
    text = "\n\n".join(map(to_latex, tables))
    assert {table.name for table in tables} == set(ALL_TABLES)
    assert text.count("Müller") >= 2
    result = compiled(pdflatex, text, tmp_path)
    assert result.returncode == 0, result.stdout[-3000:]
    log = (tmp_path / "page.log").read_text(errors="replace")
    assert not re.findall(r"Overfull .*|LaTeX Warning: .*|.*multiply.defined.*", log), "warnings of LaTeX"
    assert (tmp_path / "page.pdf").stat().st_size > 10_000


@pytest.mark.parametrize(("right", "wrong"), [(r"\&", "&"), (r"\_", "_"), (r"\{", "{"), (r"\#", "#")])
def test_what_is_not_escaped_does_not_compile(
    pdflatex: str, tables: list[Table], tmp_path: Path, right: str, wrong: str
) -> None:
    """The twin: TeX does notice."""
    text = next(found for found in map(to_latex, tables) if "Müller" in found)
    broken = "\n".join(line.replace(right, wrong) if "Müller" in line else line for line in text.splitlines())
    assert broken != text.strip()
    assert compiled(pdflatex, broken, tmp_path).returncode != 0
