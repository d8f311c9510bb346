"""Copies the tables of a benchmark run into the README and into the documentation, so that no number is typed.

    python -m unirender_evaluation.pages.readme RUN [--readme README.md] [--stored FOLDER] [--of CHECKPOINT]

`RUN` is the folder that `unirender bench run` wrote, or its results file. The README shows results of `standard` alone,
between comments made for them: where our model stands (`STANDING`), and rows and columns of the paper's tables and of
the physics table, with the counts of the verdict; and the facts of the checkpoints.
The stored folder (`evaluation/results` of a checkout, which the documentation reads) gets a folder by the name of the
suite, with every value (`results.json.gz`) and one Markdown file per table; from that file the command makes both anew.
Its rows of ours must be those of the shipped checkpoint that the suite takes by itself. With `--of` those of another
get a folder SUITE-CHECKPOINT instead, and the README nothing. A partial run (`--limit`) is refused.
"""

import argparse
import json
import math
import re
import sys
from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from safetensors import safe_open

from unirender.errors import UnirenderError
from unirender.shipped import checkpoint_folder, checkpoint_sha256, shipped_for, shipped_names, trained_pixels
from unirender.system.whole_files import replace_file
from unirender_evaluation.claims import OPTIMISED
from unirender_evaluation.light_balls import MATTE_BALL
from unirender_evaluation.metrics import DEFAULT_VARIANT, PUBLISHED_VARIANT, Variant
from unirender_evaluation.pages.findings import Question, against_trivial
from unirender_evaluation.records import Record
from unirender_evaluation.results.commands import asked_specs
from unirender_evaluation.results.data import NAME, PACKED, Results
from unirender_evaluation.results.file import read_results, write_results
from unirender_evaluation.results.lights import lights_of
from unirender_evaluation.subsets import STANDARD
from unirender_evaluation.table_list import ALL_TABLES
from unirender_evaluation.tables.build import Table, build_tables
from unirender_evaluation.tables.formats import to_markdown
from unirender_evaluation.tables.protocol import protocol_text
from unirender_evaluation.tables.text import plain_paragraph
from unirender_evaluation.task import LIGHT
from unirender_evaluation.verdict import judged, summary

README_SUITE = "standard"
PAPER = {"rendering": "from-image", "inverse": "single-image", "relighting": "from-image-sd"}  # protocols, by table
PHYSICS = {"physics": "physics"}
PAPER_METRICS = ("psnr", "lpips_vgg", "mse", "cosine")
OURS, SAMPLED = "ours-mean", "ours-sample"
PAPER_ROWS = (
    OURS,
    "ours-mean-anchored",
    "ours-mean-6-looks",
    "composite-of-ours-mean-anchored",
    "nvdiffrec-mitsuba",
    "unedited-input",
    "input-as-albedo",
    "constant-0-5",
    "mean-normal",
    "noise-ceiling",
)
PHYSICS_ROWS = (OURS, "shade-true-maps", "true-maps")
SUBSETS = (  # method of the dear rows, scenes it sees without an option, and that option
    (OPTIMISED, STANDARD.optimise, "--optimise-scenes"),
    (SAMPLED, STANDARD.sample, "--sample-scenes"),
)
WORDS = {"HOLDS": "hold", "open": "are open", "FAILS": "fail"}
VERDICT = "### The verdict"
COMMON = "### What holds for these tables"
STANDING = (
    Question("albedo", "inverse", "single-image", "albedo", "psnr", OURS),
    Question("normals", "inverse", "single-image", "normal", "cosine", OURS),
    Question("roughness", "inverse", "single-image", "roughness", "mse", OURS),
    Question("metallic", "inverse", "single-image", "metallic", "mse", OURS),
    Question("light, on a matte ball", *LIGHT, MATTE_BALL, "rmse_relative", OURS, scale="aligned"),
    Question("edit of metallic", "rendering", "from-image", "edit_metallic", "psnr", OURS),
    Question("edit of roughness", "rendering", "from-image", "edit_roughness", "psnr", OURS),
    Question("relit by a given HDRI", "relighting", "from-image-hdri", "relit", "psnr", OURS),
)


def whole_run(path: Path) -> tuple[Results, list[Table]]:
    """The results in a run's folder or in a results file, and their tables.

    Raises:
        UnirenderError: there is no complete run.
    """
    results = read_results(path)
    if results.run.limit is not None:
        raise UnirenderError(
            f"{path}: a partial run (--limit {results.run.limit}), expected a whole one; run it without --limit"
        )
    return results, build_tables(results.records, results.run, ALL_TABLES)


def fill(readme: str, name: str, text: str) -> str:
    """The README with what stands between the comments `name:begin` and `name:end` replaced.

    Raises:
        UnirenderError: the comments are not there, once each and in order.
    """
    begin, end = f"<!-- {name}:begin -->", f"<!-- {name}:end -->"
    pattern = re.compile(f"{re.escape(begin)}.*?{re.escape(end)}", re.DOTALL)
    if readme.count(begin) != 1 or readme.count(end) != 1 or not pattern.search(readme):
        raise UnirenderError(f"README: expected one {begin!r} followed by one {end!r}")
    return pattern.sub(lambda _: f"{begin}\n\n{text.strip()}\n\n{end}", readme)


def place(results: Results, checkpoint: str | None) -> str:
    """The stored folder's name: the suite's, or SUITE-CHECKPOINT for a shipped one that the suite does not take itself.

    Args:
        results: of the run; rows that have no weights count for nothing.
        checkpoint: name of that one; None: the run has the checkpoint that the suite takes.

    Raises:
        UnirenderError: the run has other weights than that checkpoint.
    """
    run = results.run
    got = {info.config["weights"] for info in run.methods if "weights" in info.config}
    folder, name, way = shipped_for(run.resolution), run.suite, "without --checkpoint, or name the run's by --of"
    if checkpoint is not None:
        folder, name = checkpoint_folder(checkpoint), f"{run.suite}-{checkpoint}"
        way = f"with --checkpoint {checkpoint}"
    expected = checkpoint_sha256(folder)
    if got - {expected} or (checkpoint and not got):
        names = ", ".join(sorted(weights[:12] for weights in got)) or "no weights"
        wanted = f"expected {expected[:12]}, those of {folder.name}"
        raise UnirenderError(f"weights: got {names}, {wanted}; run the benchmark {way}")
    return name


def run_command(suite: str, records: Iterable[Record]) -> str:
    """The command that prints results with these records."""
    command = f"unirender bench run --suite {suite}"
    lit = [record for record in records if (record.table, record.protocol) == LIGHT]  # it asks once a scene
    for method, usual, option in SUBSETS:
        scenes = {record.sample for record in lit if record.method == method}
        if scenes and len(scenes) != usual:
            command += f" {option} {len(scenes)}"
    return command


def checkpoint_text(folder: Path) -> str:
    """What a shipped checkpoint was trained on, from the files that the training wrote beside its weights."""
    facts = json.loads((folder / "training.json").read_text())
    runs = [*facts.get("continues", []), facts]
    steps, samples = (sum(run[name] for run in runs) for name in ("steps", "samples"))
    minutes: dict[str, float] = {}
    for run in runs:
        device = run.get("device", facts["device"])
        minutes[device] = minutes.get(device, 0.0) + run["minutes"]
    spent = " and ".join(f"{count:.0f} minutes on {device}" for device, count in minutes.items())
    pixels = [run.get("train", facts["train"])["model"]["resolution"] for run in runs]
    parts = f" in {len(runs)} runs, each from the weights of the one before" if len(runs) > 1 else ""
    if len(set(pixels)) > 1:
        own = [run["minutes"] for run, size in zip(runs, pixels, strict=True) if size == pixels[-1]]
        parts += f", {sum(own):.0f} minutes of them at {pixels[-1]} pixels, those before at {pixels[0]}"
    parameters = 0
    for path in folder.rglob("*.safetensors"):
        with safe_open(path, framework="numpy") as weights:
            parameters += sum(math.prod(weights.get_slice(name).get_shape()) for name in weights.keys())  # noqa: SIM118 - no dict
    return (
        f"- `{folder.name}`, {pixels[-1]} pixels: {parameters / 1e6:.1f} million parameters. It was trained for "
        f"{spent} ({facts['autocast']}): {steps:,} steps, {samples:,} samples{parts}."
    )


def chosen(
    results: Results, asked: Mapping[str, str], rows: Collection[str], metrics: Sequence[str], variant: Variant
) -> list[Table]:
    """Those tables that have records, of some rows and metrics alone; `asked`: protocols by the tables' names."""
    run = replace(results.run, methods=tuple(info for info in results.run.methods if info.key in rows))
    records = [record for record in results.records if record.method in rows]
    tables = build_tables(records, run, asked_specs(tuple(asked), metrics), [variant])
    return [table for table in tables if (asked[table.name], "main") == (table.protocol_key, table.subset)]


def together(tables: Sequence[Table]) -> str:
    """Tables as Markdown; notes of more than one of them, and the protocol that more of them have than any other,
    follow the last, once."""
    notes = Counter(note for table in tables for note in table.notes)
    usual = {}
    for item, count in Counter(item for table in tables for item in table.protocol).most_common():
        if count > 1:
            usual.setdefault(*item)
    texts = [
        to_markdown(
            replace(
                table,
                notes=tuple(note for note in table.notes if notes[note] == 1),
                protocol=tuple((name, value) for name, value in table.protocol if usual.get(name) != value),
            )
        )
        for table in tables
    ]
    if usual:
        line = plain_paragraph(f"Protocol where a table says nothing else: {protocol_text([*usual.items()])}.")
        texts.append("\n".join([COMMON, "", line, "", *(f"- {plain_paragraph(n)}" for n in notes if notes[n] > 1)]))
    return "\n".join(texts)


def verdict_counts(results: Results) -> str:
    """How many claims hold, each by itself, by Holm's correction, and under other lights."""
    found = judged(results.records, results.run, lights_of([results]))
    words = Counter(finding.word for finding in found if finding.comparison and finding.holds is not None)
    counts = ", ".join(f"{words[word]} {said}" for word, said in WORDS.items())
    lines = summary(found, lambda finding: f"{finding.claim.table} {finding.claim.quantity}")
    said = (f"of {words.total()} claims {counts}", *lines)
    return "\n".join(f"- {plain_paragraph(line[0].upper() + line[1:])}." for line in said)


def results_text(results: Results) -> str:
    """What the README shows of the results of `README_SUITE`; what the paper leaves open it says in prose."""
    run = results.run
    head = f"Rows and columns of what `{run_command(run.suite, results.records)}` prints ({run.suite}, {run.date})."
    tables = chosen(results, PAPER, PAPER_ROWS, PAPER_METRICS, PUBLISHED_VARIANT)
    tables += chosen(results, PHYSICS, PHYSICS_ROWS, (), DEFAULT_VARIANT)
    measured = [
        replace(table, protocol=tuple(item for item in table.protocol if item[0] != "published")) for table in tables
    ]
    return "\n\n".join([head, together(measured).strip(), VERDICT, verdict_counts(results)])


def standing_text(results: Results) -> str:
    """Our row against the best that needs no model: `STANDING`, and what it was measured on."""
    run, objects = results.run, len({record.object for record in results.records})
    facts = (
        f"`{shipped_for(run.resolution).name}` on `{run.suite}`: {objects} objects, none of them trained on, at "
        f"{run.resolution} x {run.resolution} pixels ({run.date}). Inside the mask, sRGB, not aligned but for the "
        "ball; intervals are over objects, under the suite's lights."
    )
    return f"{against_trivial(results, STANDING)}\n{facts}"


def store(folder: Path, results: Results, tables: Sequence[Table]) -> None:
    """Every value, and one Markdown file per table, numbered in order; those of an earlier run with other tables go."""
    write_results(folder / (NAME + PACKED), results.run, results.records, results.lights)
    names = [
        f"{number:02d}-{table.name}-{table.protocol_key}-{table.variant.mask}-{table.subset}.md"
        for number, table in enumerate(tables)
    ]
    for name, table in zip(names, tables, strict=True):
        (folder / name).write_text(to_markdown(table), encoding="utf-8")
    for path in folder.glob("[0-9][0-9]-*.md"):
        if path.name not in names:
            path.unlink()


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; 0, or 1 with one line on standard error."""
    parser = argparse.ArgumentParser(
        prog="python -m unirender_evaluation.pages.readme", description="Copies result tables into the README."
    )
    parser.add_argument("run", type=Path, help="folder that `unirender bench run --out` wrote, or its results file")
    parser.add_argument(
        "--readme", type=Path, help="rewritten in place, between its comments `standing`, `results` and `checkpoint`"
    )
    parser.add_argument(
        "--checkpoint",
        type=checkpoint_folder,
        nargs="+",
        default=[checkpoint_folder(name) for name in shipped_names()],
        help="checkpoints to list in the README; those that ship if none is named",
    )
    parser.add_argument("--stored", type=Path, help="gets a folder by the suite's name: values, and a file per table")
    parser.add_argument("--of", choices=shipped_names(), help="checkpoint of the run: its stored folder is SUITE-OF")
    arguments = parser.parse_args(argv)
    if arguments.of and arguments.readme:
        parser.error("--of: the README shows the default checkpoint alone; leave out --readme")
    try:
        results, tables = whole_run(arguments.run)
        folder = place(results, arguments.of)
        if arguments.readme:
            if results.run.suite != README_SUITE:
                raise UnirenderError(
                    f"--readme: got results of {results.run.suite}, expected those of {README_SUITE}, which alone the "
                    "README shows; leave out --readme"
                )
            text = fill(arguments.readme.read_text(encoding="utf-8"), "results", results_text(results))
            text = fill(text, "standing", standing_text(results))
            facts = "\n".join(map(checkpoint_text, sorted(arguments.checkpoint, key=trained_pixels)))
            replace_file(arguments.readme, fill(text, "checkpoint", facts))
        if arguments.stored:
            store(arguments.stored / folder, results, tables)
    except (UnirenderError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
