"""The files that a suite's truth is made from: none is left out without a word, none counts twice, and those of a truth
that is there are still the same.
"""

import os
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path

from unirender.errors import UnirenderError
from unirender_evaluation.suite_lights import SuiteLight
from unirender_evaluation.suite_objects import ObjectSource
from unirender_evaluation.suite_spec import SuiteSpec, read_spec
from unirender_evaluation.suites import Suite

Hashes = Mapping[str, str]  # path below the folder -> sha256 of the file


def file_hashes(entries: Iterable[Mapping[str, int | str]]) -> dict[str, str]:
    """The hashes of those objects or lights that are files, of what `suite.json` says of them."""
    return {str(entry["file"]): str(entry["file_sha256"]) for entry in entries if "file" in entry}


def check_files(spec: SuiteSpec, sources: Sequence[ObjectSource], lights: Mapping[str, SuiteLight]) -> None:
    """Looks at the files of the folders, once all of them can be read.

    Raises:
        UnirenderError: a link to a folder, whose files are not taken; two files that are the same; or a file that is
            another one than that of the truth that is there.
    """
    found = {
        "objects": file_hashes(source.provenance() for source in sources),
        "lights": file_hashes(light.provenance for light in lights.values()),
    }
    problems = [*_links(spec), *(line for files in found.values() for line in _same(files))]
    if problems:
        listed = "\n".join(f"  {line}" for line in problems)
        raise UnirenderError(f"suite {spec.name!r}: its folders have what a truth cannot be made from:\n{listed}")
    _keep_truth(spec, found)


def _links(spec: SuiteSpec) -> Iterator[str]:
    """The links to folders among the files, which are not followed."""
    meshes, lights = spec.folder("objects"), spec.folder("lights")
    taken = [(meshes, [group.files for group in spec.meshes]), (lights, ["*"] if spec.light_files else [])]
    for folder, patterns in ((folder, patterns) for folder, patterns in taken if folder is not None):
        for link in _linked_folders(folder):
            if any(_may_hold(link.relative_to(folder).as_posix(), pattern) for pattern in patterns):
                yield f"{link}: a link to a folder, whose files are not taken; copy it, or remove the link"


def _linked_folders(folder: Path) -> Iterator[Path]:
    for root, folders, _ in os.walk(folder):
        paths = (Path(root, name) for name in sorted(folders) if not name.startswith("."))
        yield from (path for path in paths if path.is_symlink())


def _may_hold(folder: str, pattern: str) -> bool:
    """Whether a folder may hold files of a pattern: by what stands before its first wildcard."""
    start = pattern.partition("*")[0].partition("?")[0].partition("[")[0]
    return f"{folder}/".startswith(start) or start.startswith(f"{folder}/")


def _same(files: Hashes) -> Iterator[str]:
    """Files with the same content: samples of one object, or light, would count as those of two."""
    names: defaultdict[str, list[str]] = defaultdict(list)
    for name, sha256 in files.items():
        names[sha256].append(name)
    for same in names.values():
        if len(same) > 1:
            yield f"{', '.join(same)}: the same file; remove all but one, or name them under `without`"


def _keep_truth(spec: SuiteSpec, found: Mapping[str, Hashes]) -> None:
    """Looks whether the truth that is there was made from the same files.

    Raises:
        UnirenderError: it was not: results on it would be results on nothing that is left.
    """
    if not (spec.truth_sha256 and spec.truth_path.is_file() and spec.path.is_file()):
        return
    try:
        made = Suite(read_spec(spec.path)).provenance
    except UnirenderError:
        return  # no results can be had on it
    before = {kind: file_hashes(made.get(kind, {}).values()) for kind in found}
    changed = [
        name for kind, now in found.items() for name, sha256 in now.items() if before[kind].get(name, sha256) != sha256
    ]
    if changed:
        raise UnirenderError(
            f"{spec.truth_path}: was made from other contents of {', '.join(changed)}; results on it and on a new "
            "truth do not belong together. Pass another --out, or remove it to make the truth anew"
        )
