"""`unirender bench ls | validate | tables | verdict | compare`: what there is to run, and work on files of results.

Light to import; each command loads what it needs when it runs. None of them measures anything.
"""

from collections.abc import Sequence, Set
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from unirender.errors import UnirenderError, UsageError
from unirender.system.wording import counted, instead

if TYPE_CHECKING:
    from unirender_evaluation.metrics import Variant
    from unirender_evaluation.records import Record, RunInfo
    from unirender_evaluation.tables.build import Table
    from unirender_evaluation.tables.specs import TableSpec

Format = Literal["text", "markdown", "latex", "json"]
Interval = Literal["objects", "objects-and-lights"]
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
    """Key of a row, as one of the files has it or as the merged table; only these are printed, and ranked among
    themselves. Repeatable."""
    metric: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    """Only columns of this metric (psnr, lpips_vgg, mse ...), for a table that fits a page; repeatable."""
    variant: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    """How numbers are taken: masked or whole, srgb or linear, raw, aligned or aligned_rgb, with - between
    (masked-linear), or all; repeatable. None: whole beside the published values, and masked."""
    interval: Interval = "objects"
    """What intervals count as drawn: objects, under the suite's lights; or lights, too, which several objects share."""
    format: Format = "text"
    """What is printed."""

    def run(self) -> int:
        """Prints the tables; returns 1 where there is none."""
        some(self.files, "tables")
        from unirender_evaluation.results.file import read_results
        from unirender_evaluation.results.lights import lights_of
        from unirender_evaluation.results.merge import merge
        from unirender_evaluation.tables.build import build_tables

        specs = asked_specs(self.table, self.metric)
        variants = asked_variants(self.variant)
        found = [read_results(path) for path in self.files]
        run, records = merge(found)
        run, records = rows_of(run, records, self.method, {info.key for file in found for info in file.run.methods})
        lights = lights_of(found) if self.interval == "objects-and-lights" else None
        tables = [table for table in build_tables(records, run, specs, variants, lights) if table.rows]
        if not tables:
            asked = ", ".join([*(self.table or specs), *self.method, *self.metric, *self.variant])
            raise UnirenderError(
                f"tables: the files have no values of {asked}; name fewer --table, --method, --metric, --variant"
            )
        _print_tables(tables, self.format)
        return 0


def rows_of(
    run: "RunInfo", records: "Sequence[Record]", methods: Sequence[str], unmerged: Set[str]
) -> "tuple[RunInfo, Sequence[Record]]":
    """Run and records of these rows; without names, of all.

    Args:
        run: of all files.
        records: of all files.
        methods: the names; one that a file has stands for its rows of every file.
        unmerged: the keys that the files have themselves.

    Raises:
        UsageError: there is no such row.
    """
    keys = [info.key for info in run.methods]
    for name in methods:
        if name not in keys:
            raise UsageError(f"--method {name}: no such row{instead(name, keys)}")
    if not methods:
        return run, records
    twins = tuple(f"{name}-from-" for name in methods)  # as `merge` calls the rows of further files
    kept = {key for key in keys if key in methods or (key not in unmerged and key.startswith(twins))}
    infos = tuple(info for info in run.methods if info.key in kept)
    return replace(run, methods=infos), [record for record in records if record.method in kept]


def asked_specs(tables: Sequence[str], metrics: Sequence[str]) -> "dict[str, TableSpec]":
    """These tables with the columns of these metrics; without names all. A table that has none of the columns is left
    out.

    Raises:
        UsageError: there is no such table, or no column of any table has such a metric.
    """
    from unirender_evaluation.table_list import ALL_TABLES

    for name in tables:
        if name not in ALL_TABLES:
            raise UsageError(f"--table {name}: no such table{instead(name, ALL_TABLES)}")
    known = dict.fromkeys(column.metric.name for each in ALL_TABLES.values() for column in each.columns)
    for name in metrics:
        if name not in known:
            raise UsageError(f"--metric {name}: no column has that metric{instead(name, known)}")
    specs = {}
    for name in tables or ALL_TABLES:
        spec = ALL_TABLES[name]
        kept = tuple(column for column in spec.columns if not metrics or column.metric.name in metrics)
        if kept:
            specs[name] = replace(spec, columns=kept)
    return specs


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
    table: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    """Only this table, as in `bench tables`; repeatable."""
    method: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    """KEY, a row of both files, or KEY=KEY, a row of A and one of B; repeatable."""
    metric: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    """Only numbers of this metric, as in `bench tables`; repeatable."""
    variant: str = "masked-srgb-raw"
    """How numbers are taken, as in `bench tables`."""
    interval: Interval = "objects"
    """What intervals, and with them verdicts, count as drawn, as in `bench tables`."""
    format: Format = "text"
    """What is printed."""

    def run(self) -> int:
        """Prints a table for each pair of rows and each of their tables; returns 1 where nothing can be compared."""
        from unirender_evaluation.results.compare import Compared, chosen_pairs, compare_pair
        from unirender_evaluation.results.file import read_results
        from unirender_evaluation.results.format import COMPARISONS
        from unirender_evaluation.results.lights import lights_of
        from unirender_evaluation.results.merge import differences, obstacles

        variant, specs = parsed(self.variant), asked_specs(self.table, self.metric)
        a = read_results(self.a)
        b = a if self.b == self.a else read_results(self.b)
        if found := obstacles(a, b):
            raise UnirenderError(f"{self.a} and {self.b} cannot be compared: {'; '.join(found)}")
        lights = lights_of([a, b]) if self.interval == "objects-and-lights" else None
        pairs = tuple(
            comparison
            for pair in chosen_pairs(a.run, b.run, self.method)
            for comparison in compare_pair(a, b, *pair, variant, specs.values(), lights)
        )
        if not pairs:
            raise UnirenderError(
                "compare: the rows share no sample of any table that is asked for, expected answers to the same "
                "questions; name fewer --table, --metric, --variant"
            )
        told = Compared(a.source, b.source, a.run, variant, lights is not None, tuple(differences(a, b)), pairs)
        COMPARISONS[self.format](told)
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
        print(f"{path}: not valid, {counted(len(problems), 'problem')}")
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
