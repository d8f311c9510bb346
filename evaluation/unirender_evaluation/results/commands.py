"""`unirender bench ls | validate | tables | verdict | compare`: what there is to run, and work on files of results.

Light to import; each command loads what it needs when it runs. None of them measures anything.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from unirender.errors import UnirenderError, UsageError

if TYPE_CHECKING:
    from unirender_evaluation.metrics import Variant
    from unirender_evaluation.records import Record, RunInfo
    from unirender_evaluation.tables.build import Table
    from unirender_evaluation.tables.specs import TableSpec

Format = Literal["text", "markdown", "latex", "json"]
Files = Annotated[tuple[Path, ...], tyro.conf.Positional]


@dataclass(frozen=True)
class BenchLs:
    """List the suites, tables, methods, metrics and variants that the benchmark knows."""

    what: Annotated[
        tuple[Literal["suites", "tables", "methods", "metrics", "variants"], ...], tyro.conf.Positional
    ] = ()
    """Which of them; none: all."""

    def run(self) -> int:
        """Prints the lists."""
        from unirender_evaluation.results.listing import LISTINGS

        for name in self.what or LISTINGS:
            print(f"{name}\n" + "\n".join(f"  {line}" for line in LISTINGS[name]()))
        return 0


@dataclass(frozen=True)
class BenchValidate:
    """Check files of results: layout, content, and that they fit this version and suite. Every problem has its line."""

    files: Files
    """`results.json`, packed by gzip or not, or folders of runs."""

    def run(self) -> int:
        """Returns 1 where a file is not valid."""
        some(self.files, "validate")
        return max([_validate(path) for path in self.files])


@dataclass(frozen=True)
class BenchTables:
    """Print the tables of results, of several files as one: `unirender bench tables a/results.json b/results.json`.

    Files are validated first. Rows that two files share appear once; others say which file they are from. Nothing is
    measured: the rows of a merged table are marked as stored.
    """

    files: Files
    """`results.json`, packed by gzip or not, or folders of runs, of one suite."""
    table: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    """Print only this table (rendering, inverse, relighting, light, multi-view, physics); repeatable. None: all."""
    method: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    """Key of a row; only these are printed, and ranked among themselves. Repeatable."""
    metric: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    """Only columns of this metric (psnr, lpips_vgg, mse ...), for a table that fits a page; repeatable."""
    variant: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    """How numbers are taken: masked or whole, srgb or linear, raw, aligned or aligned_rgb, with - between
    (masked-linear), or all; repeatable. None: whole beside the published values, and masked."""
    interval: Literal["objects", "objects-and-lights"] = "objects"
    """What intervals count as drawn: objects, under the suite's lights; or lights, too, which several objects share."""
    format: Format = "text"
    """What is printed."""

    def run(self) -> int:
        """Prints the tables; returns 1 where there is none."""
        some(self.files, "tables")
        from unirender_evaluation.results.file import read_results
        from unirender_evaluation.results.lights import lights_of
        from unirender_evaluation.results.merge import merge
        from unirender_evaluation.results.schema_check import did_you_mean
        from unirender_evaluation.table_list import ALL_TABLES
        from unirender_evaluation.tables.build import build_tables

        for name in self.table:
            if name not in ALL_TABLES:
                raise UsageError(f"--table {name}: no such table{did_you_mean(name, ALL_TABLES)}")
        variants = asked_variants(self.variant)
        found = [read_results(path) for path in self.files]
        run, records = merge(found)
        run, records = rows_of(run, records, self.method)
        specs = {name: spec for name in self.table or ALL_TABLES if (spec := columns_of(ALL_TABLES[name], self.metric))}
        lights = lights_of(found) if self.interval == "objects-and-lights" else None
        tables = [table for table in build_tables(records, run, specs, variants, lights) if table.rows]
        if not tables:
            asked = ", ".join([*(self.table or ALL_TABLES), *self.method, *self.metric, *self.variant])
            raise UnirenderError(
                f"tables: the files have no values of {asked}; name fewer --table, --method, --metric, --variant"
            )
        _print_tables(tables, self.format)
        return 0


def rows_of(run: "RunInfo", records: "Sequence[Record]", methods: Sequence[str]) -> "tuple[RunInfo, Sequence[Record]]":
    """Run and records of these rows; without names, of all.

    Raises:
        UsageError: there is no such row.
    """
    from unirender_evaluation.results.schema_check import did_you_mean

    keys = [info.key for info in run.methods]
    for name in methods:
        if name not in keys:
            raise UsageError(f"--method {name}: no such row{did_you_mean(name, keys)}")
    if not methods:
        return run, records
    kept = tuple(info for info in run.methods if info.key in methods)
    return replace(run, methods=kept), [record for record in records if record.method in methods]


def columns_of(spec: "TableSpec", metrics: Sequence[str]) -> "TableSpec | None":
    """The table with the columns of these metrics; without names, as it is; None where it has none of them.

    Raises:
        UsageError: no column of any table has such a metric.
    """
    from unirender_evaluation.results.schema_check import did_you_mean
    from unirender_evaluation.table_list import ALL_TABLES

    known = dict.fromkeys(column.metric.name for each in ALL_TABLES.values() for column in each.columns)
    for name in metrics:
        if name not in known:
            raise UsageError(f"--metric {name}: no column has that metric{did_you_mean(name, known)}")
    kept = tuple(column for column in spec.columns if not metrics or column.metric.name in metrics)
    return replace(spec, columns=kept) if kept else None


@dataclass(frozen=True)
class BenchVerdict:
    """Print the verdict on results, of several files as one: which row beats which, over the objects of the suite under
    its lights, and under other lights. Nothing is measured, and the truth is not checked.
    """

    files: Files
    """`results.json`, packed by gzip or not, or folders of runs, of one suite."""
    format: Format = "text"
    """What is printed: the lines of `verdict.txt`, or its claims as a table (in LaTeX without distances that are only
    stated) or list."""

    def run(self) -> int:
        """Prints the verdict."""
        some(self.files, "verdict")
        from unirender_evaluation.results.file import read_results
        from unirender_evaluation.results.lights import lights_of
        from unirender_evaluation.results.merge import merge
        from unirender_evaluation.results.verdict import VERDICTS

        found = [read_results(path) for path in self.files]
        print(VERDICTS[self.format](*merge(found), lights_of(found)), end="")
        return 0


@dataclass(frozen=True)
class BenchCompare:
    """Compare two results, paired by sample: differences with intervals, verdicts and ranks.

    Without `--method`: every row that both have. To compare two rows of one run, give its file twice.
    """

    a: Annotated[Path, tyro.conf.Positional]
    """`results.json`, packed by gzip or not, or the folder of a run: A."""
    b: Annotated[Path, tyro.conf.Positional]
    """The same: B."""
    method: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    """KEY, a row of both files, or KEY=KEY, a row of A and one of B; repeatable."""
    variant: str = "masked-srgb-raw"
    """How numbers are taken, as in `bench tables`."""

    def run(self) -> int:
        """Prints a table for each pair of rows and each of their tables; returns 1 where nothing can be compared."""
        from rich.console import Console

        from unirender_evaluation.results.compare import chosen_pairs, compare_pair
        from unirender_evaluation.results.file import read_results
        from unirender_evaluation.results.format import comparison_table
        from unirender_evaluation.results.merge import differences, obstacles
        from unirender_evaluation.tables.text import print_whole

        variant = parsed(self.variant)
        a = read_results(self.a)
        b = a if self.b == self.a else read_results(self.b)
        found = obstacles(a, b)
        if found:
            raise UnirenderError(f"{self.a} and {self.b} cannot be compared: {'; '.join(found)}")
        pairs = chosen_pairs(a.run, b.run, self.method)
        console = Console()
        facts = f"A: {a.source}\nB: {b.source}\nsuite {a.run.suite} {a.run.suite_hash[:12]}, {variant.label}"
        console.print("\n".join([facts, *(f"note: {line}" for line in differences(a, b))]), markup=False)
        compared = 0
        for pair in pairs:
            for comparison in compare_pair(a, b, *pair, variant):
                print_whole(console, comparison_table(comparison))
                compared += 1
        if not compared:
            raise UnirenderError(
                "compare: the rows share no sample of any table, expected answers to the same questions"
            )
        return 0


def some(files: tuple[Path, ...], command: str) -> None:
    """Looks whether there are files at all; raises UsageError where there are none."""
    if not files:
        raise UsageError(f"bench {command}: got no file, expected a results.json, or the folder of a run")


def parsed(text: str) -> "Variant":
    """A variant from the command line; raises UsageError where it has a word that no axis knows."""
    from unirender_evaluation.metrics import Variant

    try:
        return Variant.parse(text)
    except UnirenderError as error:
        raise UsageError(f"--{error}") from None  # which begins with "variant" and the text


def asked_variants(texts: tuple[str, ...]) -> "tuple[Variant, ...] | None":
    """Those of `--variant`, None where it is not given.

    Raises:
        UsageError: a text is neither "all" nor a variant.
    """
    from unirender_evaluation.metrics import chosen_variants

    try:
        return chosen_variants(texts)
    except UnirenderError as error:
        raise UsageError(f"--{error}") from None


def _validate(path: Path) -> int:
    from unirender_evaluation.results.check import remarks
    from unirender_evaluation.results.file import inspect_document, read_document

    try:
        results, problems = inspect_document(read_document(path), str(path))
    except UnirenderError as error:
        print(f"not valid: {error}")
        return 1
    if results is None or problems:
        print(f"{path}: not valid, {len(problems)} problem{'s' if len(problems) > 1 else ''}")
        print("\n".join(f"  {problem}" for problem in problems))
        return 1
    run = results.run
    where = f"suite {run.suite} {run.suite_hash[:12]}, code {run.code or '-'}, {run.date or 'no date'}"
    print(f"{path}: valid, {len(run.methods)} rows, {len(results.records)} records; {where}")
    print("".join(f"  note: {line}\n" for line in remarks(results)), end="")
    return 0


def _print_tables(tables: "list[Table]", kind: str) -> None:
    from rich.console import Console

    from unirender_evaluation.tables.formats import print_tables, to_json, to_markdown
    from unirender_evaluation.tables.latex import to_latex

    if kind == "text":
        print_tables(Console(), tables)
    elif kind == "json":
        print(to_json(tables), end="")
    else:
        print("\n\n".join(map(to_latex if kind == "latex" else to_markdown, tables)))
