"""A folder of mixed meshes (`meshes.mix`): what it holds, which files each mix is made of, complete or not there."""

import json
import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from unirender.errors import UnirenderError
from unirender.system.whole_files import aside, replace_file
from unirender.system.writing import writing
from unirender_reference.dataset_sides import MIXES, check_sides
from unirender_reference.folder_lock import LOCK, locked, made_folder
from unirender_reference.mesh_folder import MeshFile, files_hash, mesh_folder
from unirender_reference.meshes.load import read_model
from unirender_reference.meshes.mix import draw_count, mixed, pictures_of
from unirender_reference.meshes.surface import Model, Texture
from unirender_reference.meshes.write_obj import write_obj
from unirender_reference.mix_command import MixMeshes

DONORS_TRIED = 8  # meshes that are read for one that has pictures


@dataclass(frozen=True)
class MixReport:
    """What came of a run.

    Attributes:
        made: mixes that it made.
        there: mixes that were there, asked for or not.
        refused: why files that it read cannot be used, and folders not be listed, a sentence each.
        too_large: files that it read that have too many triangles.
    """

    made: int
    there: int
    refused: Sequence[str]
    too_large: int


def mix_meshes(options: MixMeshes, progress: Callable[[int], None] = lambda done: None) -> MixReport:
    """Writes the mixes that are missing.

    Mix number i depends on i, the files and the options but `count` and `out` alone.

    Args:
        options: of the command, checked.
        progress: is told after each mix how many there are.

    Raises:
        UnirenderError: no meshes, none that can be used, or one that `holdout` would divide; two patterns name one
            file; `out` cannot be made, holds meshes or something else, or another process writes to it; or a mix cannot
            be written, and nothing of it stays.
    """
    folders = [mesh_folder(pattern, "train", options.holdout) for pattern in options.patterns]
    unreadable = [
        f"folder {folder.base / name}: cannot be listed ({reason}); check its permissions"
        for folder in folders
        for name, reason in folder.unreadable
    ]
    for pattern in options.patterns:
        check_sides(pattern, options.holdout)
    out, made = options.out, 0
    files = [folder[i] for folder in folders for i in range(len(folder))]
    _check_places(files, out)
    drawn = _Drawn(files, options.max_faces)
    with made_folder(out), locked(out):
        _claim(options, drawn.files)
        for leftover in out.glob(".mix-*"):  # of a run that was killed
            shutil.rmtree(leftover, ignore_errors=True)
        for leftover in out.glob(f".{MIXES}.*"):
            leftover.unlink(missing_ok=True)
        there = sum(folder.is_dir() for folder in out.glob("mix-*"))
        for number in range(options.count):
            folder = out / f"mix-{options.seed}-{number:05d}"
            if not folder.is_dir():
                _write(folder, drawn, options.seed, number)
                made += 1
            progress(number + 1)
    return MixReport(made, there, [*unreadable, *drawn.refused.values()], len(drawn.too_large))


def _check_places(files: Sequence[MeshFile], out: Path) -> None:
    """Looks where the files lie.

    Raises:
        UnirenderError: two patterns name one file, of which one may hold it out; or a file lies in `out`.
    """
    seen: set[Path] = set()
    for file in files:
        path = file.path.resolve()
        if path in seen:
            raise UnirenderError(
                f"mix-meshes: {file.path} is named by two of the patterns, expected it once; leave one out"
            )
        if path.is_relative_to(out.resolve()):
            raise UnirenderError(
                f"--out: got {out}, which holds one of the meshes that are mixed ({file.name}); expected another place"
            )
        seen.add(path)


def _claim(options: MixMeshes, files: Sequence[MeshFile]) -> None:
    """Says in the folder what it holds.

    Raises:
        UnirenderError: it holds something else.
    """
    out, path = options.out, options.out / MIXES
    made: dict[str, Any] = {name: getattr(options, name) for name in ("seed", "holdout", "max_faces")}
    made |= {"meshes": len(files), "meshes_sha256": files_hash(files)}
    if any(out.glob("mix-*")):
        try:
            before = {name: json.loads(path.read_text(encoding="utf-8"))[name] for name in made}
        except (OSError, ValueError, TypeError, KeyError) as error:
            raise UnirenderError(
                f"{path}: cannot be read ({error}), so that nobody knows what its mixes are of; pass another --out"
            ) from error
        for name, value in made.items():
            if before[name] == value:
                continue
            if name.startswith("meshes"):
                raise UnirenderError(
                    f"{out}: its mixes are of other meshes, by their names and sizes ({before['meshes']} then, "
                    f"{len(files)} now); bring those back, or pass another --out"
                )
            raise UnirenderError(
                f"{out}: holds mixes with {name} {before[name]!r}, got {value!r}; repeat that option, or pass "
                "another --out"
            )
    else:
        own = (MIXES, LOCK)
        others = [p.name for p in out.iterdir() if p.name not in own and not p.name.startswith((".mix-", ".mix.json."))]
        if others:
            raise UnirenderError(f"{out}: is not empty and holds no mixes ({min(others)}); pass another --out")
    replace_file(path, json.dumps(made, indent=2) + "\n")


class _Drawn:
    """Files at random, read; what cannot be used is left out from then on."""

    def __init__(self, files: Sequence[MeshFile], max_faces: int) -> None:
        self.files, self.max_faces = files, max_faces
        self.refused: dict[int, str] = {}
        self.too_large: set[int] = set()

    def read(self, index: int) -> Model | None:
        """A file's model; None where it cannot be used."""
        if index in self.refused or index in self.too_large:
            return None
        file = self.files[index]
        try:
            model = read_model(file.path, file.folder)
        except UnirenderError as error:
            self.refused[index] = str(error)
            return None
        if sum(len(piece.faces) for piece in model.pieces) > self.max_faces:
            self.too_large.add(index)
            return None
        return model

    def next(self, rng: np.random.Generator) -> tuple[int, Model]:
        """One that can be used.

        Raises:
            UnirenderError: there is none.
        """
        while len(self.refused) + len(self.too_large) < len(self.files):
            index = int(rng.integers(len(self.files)))
            if (model := self.read(index)) is not None:
                return index, model
        first = f", the first because {next(iter(self.refused.values()))}" if self.refused else ""
        raise UnirenderError(
            f"mix-meshes: none of the {len(self.files):,} meshes can be used: {len(self.too_large):,} have more than "
            f"{self.max_faces:,} triangles (--max-faces), {len(self.refused):,} are refused{first}; "
            "raise --max-faces, or give other meshes"
        )

    def donor(self, rng: np.random.Generator, parts: Sequence[int]) -> tuple[int, list[Texture]]:
        """A mesh that has pictures and is none of the parts, as far as a few tries find one; and its pictures."""
        index, pictures = -1, []
        for _ in range(DONORS_TRIED):
            index, model = self.next(rng)
            pictures = [] if index in parts else pictures_of(model)
            if pictures:
                break
        return index, pictures


def _write(folder: Path, drawn: _Drawn, seed: int, number: int) -> None:
    """Makes one mix, complete or not at all.

    Raises:
        UnirenderError: it cannot be written, or no mesh can be used.
    """
    rng = np.random.default_rng((seed, number))
    turn, place = divmod(number, len(drawn.files))  # every mesh begins one mix before any begins another
    first = int(np.random.default_rng((seed, 2**31 + turn)).permutation(len(drawn.files))[place])
    model = drawn.read(first)
    chosen = [(first, model)] if model is not None else [drawn.next(rng)]
    chosen += [drawn.next(rng) for _ in range(draw_count(rng) - 1)]
    parts = [index for index, _ in chosen]
    donor, pictures = drawn.donor(rng, parts) if any(pictures_of(model) for _, model in chosen) else (-1, [])
    mix = mixed([model for _, model in chosen], pictures, rng)
    header = [f"made of {_named(drawn.files[index])}" for index in parts]
    borrowed = {id(picture.texels) for picture in pictures}
    if any(id(texture.texels) in borrowed for texture in pictures_of(mix)):
        header.append(f"with a picture of {_named(drawn.files[donor])}")
    temporary = aside(folder)
    try:
        with writing(folder):
            temporary.mkdir()
            write_obj(mix, temporary, folder.name, header)
            temporary.rename(folder)
    except BaseException:
        shutil.rmtree(temporary, ignore_errors=True)
        raise


def _named(file: MeshFile) -> str:
    """A file with the name of its folder of meshes, on one line of UTF-8."""
    name = f"{file.folder.name}/{file.name}".encode("utf-8", "backslashreplace").decode()
    return " ".join(name.split())
