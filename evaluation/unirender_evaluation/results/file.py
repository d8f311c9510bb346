"""A run's results as one file that other people can check, merge and compare: `results.json`.

    format        "unirender-results"
    schema        version of this layout
    run           suite, hashes, versions, one entry for each row of the tables (`records.RunInfo`)
    definitions   what each protocol gives a method, and each metric's formula and direction, as they were in the run
    lights        the lights that each sample's values depend on, one a line; absent where they are not known
    records       every value of every row on every sample (`records.Record`), one a line

`bench run` writes it at its end, beside the `run.json` and `records.jsonl` that it is made from. One whose name ends in
`.gz` is packed by gzip, to a fifth of its size; the same results are always the same bytes. Reading validates: by the
schema (`schema`), and by what no schema can say (`results.check`).
"""

import gzip
import json
import zlib
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from unirender.arguments import as_path
from unirender.errors import UnirenderError
from unirender.system.whole_files import replace_file
from unirender_evaluation.comparisons import Lights
from unirender_evaluation.records import (
    SCHEMA_VERSION,
    Record,
    RunInfo,
    read_records,
    read_run,
    run_from_plain,
)
from unirender_evaluation.results.check import content_problems
from unirender_evaluation.results.data import NAME, PACKED, Definitions, Results, definitions
from unirender_evaluation.results.schema import FORMAT, json_schema
from unirender_evaluation.results.schema_check import Problem, quoted, schema_problems

SHOWN = 20  # problems that an error lists
# Files that lie beside it, and are easily taken for it.
NEIGHBOURS = {
    "tables.json": "has the tables' means, from which no interval and no paired test can be made",
    "run.json": "describes a run without its values",
    "records.jsonl": "has the values without the run's description",
    "records.csv": "has the values without the run's description",
    "report.html": "is for reading",
    "truth_check.json": "is about the suite, not about a method",
}


def write_results(path: Path, run: RunInfo, records: Sequence[Record], lights: Lights | None = None) -> None:
    """Writes a file, atomically; packed, if the name ends in `.gz`.

    Args:
        path: of the file.
        run: its description.
        records: of the run.
        lights: of the samples (`results.lights.sample_lights`), and of others, which are left out; None: not known.

    Raises:
        UnirenderError: it would not be valid; nothing is written.
    """
    samples = {record.sample for record in records}
    kept = {sample: lights[sample] for sample in sorted(samples & lights.keys())} if lights else None
    document = to_document(run, records, definitions(records), kept)
    from_document(document, str(path))
    lines = [json.dumps(record, sort_keys=True, allow_nan=False) for record in document.pop("records")]
    named = [f"{json.dumps(sample)}: {json.dumps(names)}" for sample, names in document.pop("lights", {}).items()]
    head = json.dumps(document, indent=1, allow_nan=False, ensure_ascii=False).removesuffix("\n}")
    text = head + (',\n "lights": {\n  ' + ",\n  ".join(named) + "\n }" if named else "")
    text += ',\n "records": [\n  ' + ",\n  ".join(lines) + "\n ]\n}\n"
    replace_file(path, gzip.compress(text.encode(), mtime=0) if path.suffix == PACKED else text)


def to_document(
    run: RunInfo, records: Sequence[Record], meaning: Definitions, lights: Lights | None = None
) -> dict[str, Any]:
    """The JSON document of a run; without `lights` where none are known."""
    described = json.loads(json.dumps(asdict(run), allow_nan=False))  # tuples become lists, as in a file
    described.pop("schema")
    return {
        "format": FORMAT,
        "schema": SCHEMA_VERSION,
        "run": described,
        "definitions": asdict(meaning),
        **({"lights": {sample: list(names) for sample, names in lights.items()}} if lights else {}),
        "records": [record.to_plain() for record in records],
    }


def read_results(path: str | Path) -> Results:
    """Reads a results file, or the folder of a run.

    Raises:
        UnirenderError: it cannot be read or is not valid; the message lists the problems.
    """
    return from_document(read_document(as_path(path)), str(path))


def read_document(path: Path) -> Any:
    """The JSON of a results file, not looked at yet; of a run's folder without one, made from its two files.

    Raises:
        UnirenderError: no such file, or no JSON: the message says what the file is instead, as far as it can be told.
    """
    if path.is_dir():
        files = [path / name for name in (NAME, NAME + PACKED) if (path / name).is_file()]
        return read_document(files[0]) if files else _document_of_folder(path)
    if path.name in NEIGHBOURS and path.is_file():
        raise UnirenderError(f"{path}: {NEIGHBOURS[path.name]}; expected {NAME} or the folder of the run")
    try:
        text = (gzip.decompress if path.suffix == PACKED else bytes)(path.read_bytes()).decode("utf-8-sig")
    except (gzip.BadGzipFile, EOFError, zlib.error) as error:
        raise UnirenderError(f"{path}: cannot be unpacked ({error}); was it copied whole, and is it gzip?") from None
    except FileNotFoundError:
        raise UnirenderError(
            f"{path}: no such file, expected the {NAME} that `unirender bench run` writes, or the folder of the run"
        ) from None
    except UnicodeDecodeError:
        expected = f"expected JSON, or JSON packed by gzip in a file whose name ends in {PACKED}"
        raise UnirenderError(f"{path}: is no text in UTF-8, {expected}") from None
    except OSError as error:
        raise UnirenderError(f"{path}: cannot be read ({error.strerror}); check its permissions") from None
    try:
        return json.loads(text, parse_constant=_refuse_constant, object_pairs_hook=_no_name_twice)
    except json.JSONDecodeError as error:
        cut = " (the file ends too early: was it copied whole?)" if error.pos >= len(text.rstrip()) else ""
        raise UnirenderError(f"{path}: is no JSON: {error}{cut}") from None
    except RecursionError:
        raise UnirenderError(f"{path}: is nested too deeply to be results, expected the {NAME} of a run") from None
    except UnirenderError as error:
        raise UnirenderError(f"{path}: {error}") from None
    except ValueError as error:  # a whole number of thousands of digits
        raise UnirenderError(f"{path}: holds a number that cannot be read ({error}); copy the file again") from None


def from_document(document: Any, source: str) -> Results:
    """The results in a JSON document.

    Raises:
        UnirenderError: it is not valid.
    """
    results, problems = inspect_document(document, source)
    if results is None or problems:
        raise UnirenderError(f"{source}: no valid results: {listed(problems)}")
    return results


def inspect_document(document: Any, source: str) -> tuple[Results | None, list[Problem]]:
    """The results, where the layout allows to read them, and all that is wrong: with the layout, or the content."""
    problems = _kind_problems(document) or schema_problems(document, json_schema())
    if problems:
        return None, problems
    meaning = Definitions(document["definitions"]["protocols"], document["definitions"]["metrics"])
    records = tuple(map(Record.from_plain, document["records"]))
    lights = {sample: tuple(names) for sample, names in document.get("lights", {}).items()}
    results = Results(run_from_plain(document["run"]), records, meaning, source, lights)
    return results, content_problems(results)


def listed(problems: Sequence[Problem]) -> str:
    """Problems as one text, the first ones in full."""
    more = f"; and {len(problems) - SHOWN} more" if len(problems) > SHOWN else ""
    return "; ".join(map(str, problems[:SHOWN])) + more


def _kind_problems(document: Any) -> list[Problem]:
    """Whether it is another kind of document altogether, before each of its fields is called unknown."""
    if not isinstance(document, dict) or document.get("format") != FORMAT:
        got = quoted(document.get("format")) if isinstance(document, dict) else f"a {type(document).__name__}"
        return [Problem("format", f"got {got}, expected {FORMAT!r}: is this the {NAME} of `unirender bench run`?")]
    if document.get("schema") != SCHEMA_VERSION:
        what = f"got version {quoted(document.get('schema'))}, expected {SCHEMA_VERSION}"
        return [Problem("schema", f"{what}: read it with the unirender that wrote it, or make the run again")]
    return []


def _document_of_folder(folder: Path) -> dict[str, Any]:
    if not (folder / "run.json").is_file():
        raise UnirenderError(f"{folder}: has no {NAME} and no run.json, expected the folder of a finished run")
    records = [record for record in read_records(folder / "records.jsonl") if record.values]
    return to_document(read_run(folder / "run.json"), records, definitions(records))


def _refuse_constant(text: str) -> Any:
    raise UnirenderError(f'has the number {text}, which JSON does not know: write "inf", and leave out what is not one')


def _no_name_twice(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for name, value in pairs:
        if name in found:
            raise UnirenderError(f"an object has the field {name!r} twice, expected it once")
        found[name] = value
    return found
