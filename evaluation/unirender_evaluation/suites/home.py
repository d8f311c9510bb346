"""Where the truth of a suite lies, and its TOML file with the folders and the hash that belong to it.

A suite whose truth is not part of the package (`standard`, `paper`) is a definition: `bench truth` writes a copy of its
TOML file that names the folders it was made from and the truth's hash, and the truth beside it. By name, that copy is
looked for in `${UNIRENDER_CACHE}/suites/NAME`, then in the folder `suites` of a checkout, where the truth lies that the
results in it were measured on; elsewhere (`--out`) it is any suite of its own, by the path of its file.
"""

import json
import os
import re
import tomllib
from dataclasses import replace
from pathlib import Path
from typing import Literal

from unirender.errors import UnirenderError
from unirender.system.paths import cache_dir
from unirender_evaluation.suites.spec import (
    SuiteSpec,
    is_bundled,
    parse_spec,
    read_spec,
    read_text,
    suite_folder,
    suite_path,
)

TABLE = re.compile(r"^[ \t]*\[", re.MULTILINE)
FOLDERS = re.compile(r"^[ \t]*\[[ \t]*folders[ \t]*\][^\n]*\n?", re.MULTILINE)


def home(name: str) -> Path:
    """The copy of a bundled suite's TOML file that `bench truth NAME` writes."""
    return cache_dir() / "suites" / name / f"{name}.toml"


def shared(name: str) -> Path:
    """The copy that comes with a checkout: one truth for everybody, so that results can stand in one table."""
    return suite_folder().parents[2] / "suites" / name / f"{name}.toml"


def ships_truth(spec: SuiteSpec) -> bool:
    """Whether a bundled suite comes with its truth: its file then has the hash."""
    return bool(spec.truth_sha256)


def found_spec(name_or_path: str | Path) -> SuiteSpec:
    """A suite's file with a truth: of a bundled suite without one the copy that was made here, else the shared one.

    Raises:
        UnirenderError: as `read_spec` and `check_name`; or neither is there, or it is of another version of the suite.
    """
    spec = read_spec(name_or_path)
    check_name(spec)
    if not is_bundled(spec.path) or ships_truth(spec):
        return spec
    path = next((place for place in (home(spec.name), shared(spec.name)) if place.is_file()), None)
    if path is None:
        raise UnirenderError(f"suite {spec.name!r} has no truth here: make it once with {truth_command(spec)}")
    made = read_spec(path)
    if definition(made) != definition(spec):
        raise UnirenderError(
            f"the truth in {path.parent} is of another version of suite {spec.name!r}: make it anew with "
            f"{truth_command(spec)}, or use it by its path"
        )
    return made


def definition(spec: SuiteSpec) -> SuiteSpec:
    """What a suite's file says but for the place of its folders and the hash of its truth."""
    return replace(spec, objects_folder="", lights_folder="", objects_from="", lights_from="", truth_sha256="")


def check_name(spec: SuiteSpec) -> None:
    """Looks at the name of a suite, under which its results stand in tables.

    Raises:
        UnirenderError: it is that of a suite of the package, and the file is neither that nor a copy that `bench truth`
            wrote of it.
    """
    ours = suite_folder() / f"{spec.name}.toml"
    if is_bundled(spec.path) or not ours.is_file():
        return
    if spec.path.stem != spec.name or definition(spec) != definition(read_spec(ours)):
        raise UnirenderError(
            f"{spec.path}: name is {spec.name!r}, that of a suite of the package, as which its tables would read; "
            "expected one of its own, change the line that begins with name"
        )


def truth_command(spec: SuiteSpec) -> str:
    """The command that makes a suite's truth, how long that takes, and where to get what it needs."""
    asked = ""
    if spec.meshes and not spec.objects_folder:
        asked += " --objects FOLDER"
    if spec.light_files is not None and not spec.lights_folder:
        asked += " --lights FOLDER"
    name = spec.name if is_bundled(spec.path) else spec.path
    sources = [
        f"{what}: {where}"
        for what, where, needed in (
            ("objects", spec.objects_from, bool(spec.meshes) and not spec.objects_folder),
            ("lights", spec.lights_from, spec.light_files is not None and not spec.lights_folder),
        )
        if where and needed
    ]
    cost = f", which takes {spec.truth_cost}" if spec.truth_cost else ""
    return f"`unirender bench truth {name}{asked}`{cost}" + (f" ({'; '.join(sources)})" if sources else "")


def target(
    name_or_path: str | Path, out: Path | None = None, objects: Path | None = None, lights: Path | None = None
) -> tuple[SuiteSpec, str]:
    """The suite that a truth is made of, and the text of its TOML file, whose place is the spec's `path`.

    Args:
        name_or_path: of the suite.
        out: folder for the TOML file and the truth. None: `home` of a bundled suite that ships without its truth; the
            folder of any other.
        objects, lights: folders in place of those that the file names.

    Raises:
        UnirenderError: as `read_spec` and `check_name`; a folder that is not there or that the suite has no use for.
    """
    source = suite_path(name_or_path)
    text = read_text(source)
    spec = parse_spec(text, source)
    check_name(spec)
    path = source
    if out is not None:
        path = out / f"{spec.name}.toml"
    elif is_bundled(source) and not ships_truth(spec):
        path = home(spec.name)
    uses = {"objects": bool(spec.meshes), "lights": spec.light_files is not None}
    asked: tuple[tuple[Literal["objects", "lights"], Path | None], ...] = (("objects", objects), ("lights", lights))
    for kind, given in asked:
        if given is not None and not uses[kind]:
            raise UnirenderError(
                f"--{kind} {given}: suite {spec.name!r} takes no {kind} from a folder; leave --{kind} out"
            )
        if given is not None and not given.expanduser().is_dir():
            raise UnirenderError(f"--{kind} {given}: no such folder, expected that of the suite's {kind}")
        folder = spec.folder(kind) if given is None else given.expanduser()
        if folder is not None and (given is not None or path != source):
            text = with_folder(text, source, kind, _from(path.parent, folder))
    return parse_spec(text, path), text


def _from(home_folder: Path, folder: Path) -> str:
    """The path of a folder of files as a suite's TOML file has it: relative where it lies in that file's own folder, so
    that both can be moved together; else absolute."""
    start, absolute = Path(os.path.abspath(home_folder)), Path(os.path.abspath(folder))
    return absolute.relative_to(start).as_posix() if absolute.is_relative_to(start) else str(absolute)


def with_folder(text: str, path: Path, key: str, value: str) -> str:
    """The text of a TOML file with another value of a key of its table [folders]; comments and layout stay.

    Raises:
        UnirenderError: the file writes the table or the key in a way that is not recognised here.
    """
    changed = _with_value(text, key, json.dumps(value, ensure_ascii=False))  # a JSON string is a TOML string
    before = tomllib.loads(text)
    folders = before.get("folders", {})
    try:
        written = tomllib.loads(changed) == before | {"folders": folders | {key: value}}
    except tomllib.TOMLDecodeError:
        written = False
    if not written:
        raise UnirenderError(
            f'{path}: the folder of {key} cannot be written into it; write [folders] with `{key} = "..."` on a line '
            "of its own"
        )
    return changed


def _with_value(text: str, key: str, quoted: str) -> str:
    """`with_folder` where table and key are plainly written; anything else may come out wrong."""
    text = f"{text.rstrip()}\n"
    header = FOLDERS.search(text)
    if header is None:
        return f"{text}\n[folders]\n{key} = {quoted}\n"
    following = TABLE.search(text, header.end())
    end = following.start() if following else len(text)
    before, inner, after = text[: header.end()], text[header.end() : end], text[end:]
    old = re.compile(rf"""^([ \t]*{key}[ \t]*=[ \t]*)(?:"(?:[^"\\\n]|\\.)*"|'[^'\n]*')""", re.MULTILINE)
    inner, count = old.subn(lambda found: found[1] + quoted, inner, count=1)
    return before + (inner if count else f"{key} = {quoted}\n{inner}") + after
