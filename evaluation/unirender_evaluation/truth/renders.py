"""The renders of a truth check that is under way: kept in a folder, so that one that is stopped goes on from there.

    check.json    what is checked, and the seed that chose its scenes
    *.npz         a render each, by the hash of its name

The folder is gone when the check is done.
"""

import hashlib
import io
import json
import shutil
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from unirender.intrinsics import Intrinsics
from unirender.system.whole_files import replace_file, whole_file

Arrays = Mapping[str, np.ndarray]


def _stored(path: Path) -> Arrays | None:
    """The arrays of a file; None of a damaged one."""
    data = path.read_bytes()
    try:
        with np.load(io.BytesIO(data)) as stored:
            return dict(stored)
    except Exception:  # NumPy raises half a dozen kinds for a damaged file
        return None


@dataclass(frozen=True)
class TruthRenders:
    """Renders by name: made once, then read from `folder`; None keeps none."""

    folder: Path | None = None

    def of(self, name: str, make: Callable[[], Arrays]) -> Arrays:
        """The arrays of a render."""
        if self.folder is None:
            return make()
        path = self.folder / f"{hashlib.sha256(name.encode()).hexdigest()[:32]}.npz"
        if path.is_file() and (stored := _stored(path)) is not None:
            return stored
        made = make()
        with whole_file(path) as file:
            np.savez(file, **made)  # pyright: ignore[reportArgumentType] - no array has the name of an option
        return made

    def count(self) -> int:
        """How many are kept."""
        return 0 if self.folder is None else sum(1 for _ in self.folder.glob("*.npz"))

    def begin(self, identity: Any, seed: int) -> None:
        """Keeps what is there of the same check under the same seed, and nothing else."""
        if self.folder is None or self.begun(identity) == seed:
            return
        self.remove()
        replace_file(self.folder / "check.json", json.dumps({"identity": identity, "seed": seed}) + "\n")

    def begun(self, identity: Any) -> int | None:
        """The seed under which this check has begun, None where none has."""
        with suppress(OSError, ValueError, AttributeError):
            found = json.loads((self.folder or Path()).joinpath("check.json").read_text(encoding="utf-8"))
            return found.get("seed") if found.get("identity") == identity else None
        return None

    def remove(self) -> None:
        """Removes the folder, if there is one."""
        if self.folder is not None and self.folder.is_dir():
            shutil.rmtree(self.folder)


@dataclass(frozen=True)
class Again:
    """Renders of one object, made only where they are not kept yet."""

    renderer: Callable[[], Any]  # makes its `Renderer`, once
    kept: TruthRenders  # the renders of the whole check

    def geometry(self, name: str, spp: int, seed: int) -> Intrinsics:
        """Mask, albedo and normal of the object of that name."""
        maps = self.kept.of(
            f"{name} geometry {seed}", lambda: self.renderer().geometry(spp, seed).require("mask", "albedo", "normal")
        )
        return Intrinsics(mask=maps["mask"], albedo=maps["albedo"], normal=maps["normal"])

    def render(self, kind: str, name: str, *arguments: Any) -> tuple[np.ndarray, np.ndarray]:
        """Mean and variance of what the renderer's function `kind` makes of the arguments; `name` says all of them."""

        def make() -> dict[str, np.ndarray]:
            found = getattr(self.renderer(), kind)(*arguments)
            return {"mean": found.mean, "variance": found.variance}

        arrays = self.kept.of(name, make)
        return arrays["mean"], arrays["variance"]
