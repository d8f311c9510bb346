"""A run on disk: what it was given, where it stands, what it did. Killed at any time, it goes on where it was.

    out/history.jsonl         a line for each step
    out/state/run.json        configuration, fingerprint of the inputs, versions
    out/state/progress.json   where the run stands; it names the files that belong to that point
    out/state/*.npz           solutions of finished stages, the refinement under way

`progress.json` is replaced in one move, after the files that it names are complete. What it does not name counts for
nothing and is removed; lines of the history beyond its count are cut off.
"""

import contextlib
import dataclasses
import hashlib
import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from unirender.errors import UnirenderError
from unirender.system.whole_files import whole_file
from unirender_reference.folder_lock import LOCK, locked, made_folder
from unirender_reference.optimize.files.solution import read_solution_file, write_solution_file
from unirender_reference.optimize.solution import Solution
from unirender_reference.optimize.views import Step, View, Views
from unirender_reference.shapes import MeshObject

HISTORY, STATE, RUN, PROGRESS = "history.jsonl", "state", "run.json", "progress.json"
SHOWN = 8  # options in a sentence


@dataclass
class Progress:
    """Where a run stands.

    Attributes:
        lines: of the history.
        seconds: of all its processes together.
        stages: files of the stages that are finished, by name, in their order.
        live: files and figures of the stage under way.
    """

    lines: int = 0
    seconds: float = 0.0
    stages: dict[str, str] = field(default_factory=dict)
    live: dict[str, Any] = field(default_factory=dict)


class RunFolder:
    """The folder of one run; made by `open_run`.

    Attributes:
        out: the folder.
        progress: as it is on disk, or about to be.
    """

    def __init__(self, out: Path, progress: Progress) -> None:
        self.out, self.progress = out, progress
        self._lines = progress.lines

    @property
    def state(self) -> Path:
        return self.out / STATE

    def record(self, step: Step) -> None:
        """Adds a line to the history; it counts once `save` has been called."""
        with (self.out / HISTORY).open("a", encoding="utf-8") as stream:
            stream.write(history_line(step))
        self._lines += 1

    def finish(self, stage: str, found: Solution | MeshObject, seconds: float) -> None:
        """Records the result of a stage."""
        name = f"{stage}.npz"
        write_solution_file(self.state / name, found)
        self.progress.stages[stage] = name
        self.save(seconds, {})

    def result(self, stage: str) -> Solution | MeshObject | None:
        """The result of a stage that is finished."""
        name = self.progress.stages.get(stage)
        return None if name is None else read_solution_file(self.state / name)

    def save(self, seconds: float, live: Mapping[str, Any]) -> None:
        """Moves the record on to this point.

        Args:
            seconds: of the whole run.
            live: of the stage under way: figures, and the names of complete files in the state folder (`*.npz`).
        """
        self.progress = Progress(self._lines, seconds, self.progress.stages, dict(live))
        _replace(self.state / PROGRESS, dataclasses.asdict(self.progress))
        named = {*self.progress.stages.values(), *(name for name in live.values() if isinstance(name, str))}
        for path in self.state.glob("*.npz"):
            if path.name not in named:
                path.unlink()

    def history(self) -> list[dict[str, Any]]:
        """The lines that were recorded."""
        path = self.out / HISTORY
        return [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()] if path.exists() else []


@contextlib.contextmanager
def open_run(out: Path, header: Mapping[str, Any]) -> Iterator[RunFolder]:
    """Begins a run in a new folder, or goes on with the same one; one process at a time.

    Args:
        out: the folder.
        header: what makes it the same run: `config`, `inputs`, `versions`, each a dict of JSON.

    Raises:
        UnirenderError: the folder holds something else or another run, or another process works on it.
    """
    wanted = json.loads(json.dumps(header, default=str))
    with made_folder(out), locked(out):
        state = out / STATE
        if (state / RUN).is_file():
            _check_same(out, _read(state / RUN), wanted)
        elif any(path.name not in (LOCK, STATE) for path in out.iterdir()):
            raise UnirenderError(f"{out}: is not empty and holds no run of this command; choose another folder (--out)")
        else:
            state.mkdir(exist_ok=True)
            _replace(state / RUN, wanted)
        for stale in state.glob("*.part*"):
            stale.unlink()
        progress = Progress(**_read(state / PROGRESS)) if (state / PROGRESS).is_file() else Progress()
        _cut(out / HISTORY, progress.lines)
        yield RunFolder(out, progress)


def fingerprint(views: Views, *others: Solution | MeshObject | None) -> dict[str, str]:
    """Hashes of what a run is given: pictures with their cameras, mesh, start."""
    pictures = hashlib.sha256(repr((len(views.seen), views.hdr)).encode())
    for view in (*views.seen, *views.held_out):
        _update(pictures, view.image, view.mask, view.pose, view.clipped)
        pictures.update(_camera(view).encode())
    found = {"pictures": pictures.hexdigest()}
    for label, other in zip(("mesh", "start"), others, strict=False):
        digest = hashlib.sha256()
        if other is not None:
            obj = other.obj if isinstance(other, Solution) else other
            arrays = (obj.vertices, obj.faces, obj.normals, obj.uv, obj.albedo, obj.roughness, obj.metallic)
            _update(digest, *arrays, obj.normal_map, other.environment if isinstance(other, Solution) else None)
        found[label] = "none" if other is None else digest.hexdigest()
    return found


def history_line(step: Step) -> str:
    """A step as a line of JSON, its figures to seven digits: what float32 knows."""
    values = {name: float(f"{value:.7g}") for name, value in step.values.items()}
    return json.dumps({**dataclasses.asdict(step), "values": values}) + "\n"


def _camera(view: View) -> str:
    return view.camera.describe()


def _update(digest: Any, *arrays: np.ndarray | None) -> None:
    for array in arrays:
        digest.update(b"none" if array is None else repr(array.shape).encode() + np.ascontiguousarray(array).tobytes())


def _check_same(out: Path, found: Mapping[str, Any], wanted: Mapping[str, Any]) -> None:
    """Refuses a folder whose run differs in what decides its result."""
    there, here = _flat(found), _flat(wanted)
    differs = [key for key in sorted({*there, *here}) if there.get(key) != here.get(key)]
    if differs:
        shown = ", ".join(f"{key} ({there.get(key)!r:.20}, now {here.get(key)!r:.20})" for key in differs[:SHOWN])
        shown += f" and {len(differs) - SHOWN} more" if len(differs) > SHOWN else ""
        raise UnirenderError(
            f"{out}: holds a run with other {shown}; a run goes on with the same pictures, options and version alone: "
            "choose another folder (--out), or delete it"
        )


def _flat(values: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested dicts as one: `config.refine.spp` -> its value."""
    found = {}
    for key, value in values.items():
        found |= _flat(value, f"{prefix}{key}.") if isinstance(value, Mapping) else {f"{prefix}{key}": value}
    return found


def _read(path: Path) -> dict[str, Any]:
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise UnirenderError(f"{path}: not readable ({error}); delete the folder to begin anew") from error
    if not isinstance(content, dict):
        raise UnirenderError(f"{path}: no record of a run; delete the folder to begin anew")
    return content


def _replace(path: Path, content: Mapping[str, Any]) -> None:
    with whole_file(path) as file:
        file.write(json.dumps(content, indent=1).encode())


def _cut(path: Path, lines: int) -> None:
    """Keeps the first lines of a history: a killed run may have written some that it will write again."""
    written = path.read_text(encoding="utf-8").splitlines(keepends=True) if path.exists() else []
    if len(written) > lines:
        with whole_file(path) as file:
            file.write("".join(written[:lines]).encode())
