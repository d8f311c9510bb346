"""The files that a suite's truth is made from: none is left out or counts twice without a word, and those of a truth
that is there are still the same.
"""

import logging
import os
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path, PurePosixPath

from unirender.errors import UnirenderError
from unirender_evaluation.suites.lights import SuiteLight
from unirender_evaluation.suites.objects import ObjectSource
from unirender_evaluation.suites.spec import SuiteSpec, read_spec
from unirender_evaluation.suites.suite import Suite

logger = logging.getLogger(__name__)

Hashes = Mapping[str, str]  # path below the folder -> sha256 of the file


def file_hashes(entries: Iterable[Mapping[str, int | str]]) -> dict[str, str]:
    """The hashes of those objects or lights that are files, of what `suite.json` says of them."""
    return {str(entry["file"]): str(entry["file_sha256"]) for entry in entries if "file" in entry}


def check_files(spec: SuiteSpec, sources: Sequence[ObjectSource], lights: Mapping[str, SuiteLight]) -> None:
    """Looks at the files of the folders, once all of them can be read; warns of those that show one thing.

    Raises:
        UnirenderError: a link to a folder, whose files are not taken; or a file that is another one than that of the
            truth that is there.
    """
    if links := list(_links(spec)):
        listed = "\n".join(f"  {line}" for line in links)
        raise UnirenderError(
            f"suite {spec.name!r}: a truth takes no files behind links to folders; put the folders themselves there, "
            f"or remove the links:\n{listed}"
        )
    found = {
        "objects": file_hashes(source.provenance() for source in sources),
        "lights": file_hashes(light.provenance for light in lights.values()),
    }
    _keep_truth(spec, found)
    for kind, files in found.items():
        for names, what in _alike(files):
            logger.warning(
                "suite %r: %s: %s, and count as %d %s; leave all but one out (`without`)",
                *(spec.name, ", ".join(names), what, len(names), kind),
            )


def _links(spec: SuiteSpec) -> Iterator[str]:
    """The links to folders among the files, which are not followed."""
    meshes, lights = spec.folder("objects"), spec.folder("lights")
    taken = [(meshes, [group.files for group in spec.meshes]), (lights, ["*"] if spec.light_files else [])]
    for folder, patterns in ((folder, patterns) for folder, patterns in taken if folder is not None):
        for link in _linked_folders(folder):
            if any(_may_hold(link.relative_to(folder).as_posix(), pattern) for pattern in patterns):
                yield f"{link}: copy the folder, or remove the link"


def _linked_folders(folder: Path) -> Iterator[Path]:
    for root, folders, _ in os.walk(folder):
        folders[:] = sorted(name for name in folders if not name.startswith("."))
        yield from (path for name in folders if (path := Path(root, name)).is_symlink())


def _may_hold(folder: str, pattern: str) -> bool:
    """Whether a folder may hold files of a pattern: by what stands before its first wildcard."""
    start = pattern.partition("*")[0].partition("?")[0].partition("[")[0]
    return f"{folder}/".startswith(start) or start.startswith(f"{folder}/")


def _alike(files: Hashes) -> Iterator[tuple[list[str], str]]:
    """Files that show one thing, and why: the same content, or the same name in two formats."""
    contents: defaultdict[str, list[str]] = defaultdict(list)
    stems: defaultdict[str, list[str]] = defaultdict(list)
    for name, sha256 in files.items():
        contents[sha256].append(name)
        stems[str(PurePosixPath(name).with_suffix(""))].append(name)
    same = [names for names in contents.values() if len(names) > 1]
    yield from ((names, "have the same content") for names in same)
    yield from (
        (names, "look like one in several formats") for names in stems.values() if len(names) > 1 and names not in same
    )


def _keep_truth(spec: SuiteSpec, found: Mapping[str, Hashes]) -> None:
    """Looks whether the truth that is there was made from the same files."""
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
