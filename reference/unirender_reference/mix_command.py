"""`unirender mix-meshes`. Light to import: what reads meshes is loaded when the command runs."""

import json
import shutil
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from unirender.errors import UnirenderError, UsageError

if TYPE_CHECKING:
    from unirender_reference.mesh_folder import MeshFile
    from unirender_reference.meshes.surface import Model

MANIFEST = "mix.json"


@dataclass(frozen=True)
class MixMeshes:
    """Make new meshes of a folder's: in other proportions, put together, with other colours; for training.

    Running the same command again goes on where it was stopped. The exit status is 1 where mesh files were refused:
    each is listed with its reason, and others took their place.
    """

    patterns: Annotated[tuple[str, ...], tyro.conf.Positional]
    """Folders (searched with their folders) or quoted globs, whose meshes are used."""
    out: Path
    """Folder of the new meshes, each an OBJ in a folder of its own; `--meshes` of `unirender dataset`."""
    count: int = 100
    """How many."""
    seed: int = 0
    """Another seed makes others."""
    holdout: int = 0
    """Every N-th file of each folder, in order of name, is left out: `--split test` of a data set or suite with the
    same --holdout. 0: all are used."""
    max_faces: int = 60_000
    """Meshes with more triangles are not used."""

    def check(self) -> None:
        """Looks at the values.

        Raises:
            UsageError: one is outside its range.
        """
        if not self.patterns:
            raise UsageError("mix-meshes: got no folder, expected at least one with meshes")
        for name, least in (("count", 1), ("seed", 0), ("max_faces", 1)):
            if getattr(self, name) < least:
                raise UsageError(f"--{name.replace('_', '-')}: got {getattr(self, name)}, expected at least {least}")
        if self.holdout < 0 or self.holdout == 1:
            raise UsageError(f"--holdout: got {self.holdout}, expected 0 or at least 2")

    def run(self) -> int:
        """Returns the exit status: 1 where a mesh was refused."""
        from rich.console import Console

        self.check()
        console = Console(soft_wrap=True, highlight=False)
        refused = mix_meshes(self)
        for reason in refused:
            console.print(f"refused  {reason}", markup=False)
        console.print(f"{self.count:,} meshes in {self.out}", markup=False)
        return 1 if refused else 0


def mix_meshes(options: MixMeshes) -> list[str]:
    """Writes what is missing of the mixes; returns why meshes were refused, each once.

    Mix number i depends on the names of the files, the seed and i alone, as long as the files can be read.

    Raises:
        UnirenderError: no meshes, none that can be used, or `out` holds something else.
    """
    from unirender_reference.mesh_folder import mesh_folder

    folders = [mesh_folder(pattern, "train", options.holdout) for pattern in options.patterns]
    files = [folder[i] for folder in folders for i in range(len(folder))]
    _claim(options, len(files))
    drawn = _Drawn(files, options.max_faces)
    for number in range(options.count):
        name = f"mix-{options.seed}-{number:05d}"
        if not (options.out / name).is_dir():
            _write(options, drawn, number, name)
    return list(drawn.refused.values())


def _claim(options: MixMeshes, files: int) -> None:
    """Says in the folder what it holds.

    Raises:
        UnirenderError: it holds something else.
    """
    made = {"patterns": list(options.patterns), "files": files}
    made |= {name: getattr(options, name) for name in ("seed", "holdout", "max_faces")}
    path = options.out / MANIFEST
    if path.is_file():
        before: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        for name, value in made.items():
            if before.get(name) != value:
                raise UnirenderError(
                    f"{options.out}: holds mixes with {name} {before.get(name)!r}, got {value!r}; repeat that command, "
                    "or pass another --out"
                )
        return
    if options.out.exists() and (not options.out.is_dir() or any(options.out.iterdir())):
        raise UnirenderError(f"{options.out}: is no folder of mixes and not empty; pass another --out")
    options.out.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(made, indent=2) + "\n", encoding="utf-8")


class _Drawn:
    """Files at random, read; what cannot be used is left out from then on."""

    def __init__(self, files: Sequence["MeshFile"], max_faces: int) -> None:
        self.files, self.max_faces = files, max_faces
        self.refused: dict[int, str] = {}
        self.too_large: set[int] = set()

    def read(self, index: int) -> "Model | None":
        """A file's model; None where it cannot be used."""
        from unirender_reference.meshes.load import read_model

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

    def next(self, rng: Any) -> tuple[int, "Model"]:
        """One that can be used.

        Raises:
            UnirenderError: there is none.
        """
        while len(self.refused) + len(self.too_large) < len(self.files):
            index = int(rng.integers(len(self.files)))
            if (model := self.read(index)) is not None:
                return index, model
        raise UnirenderError(
            f"mix-meshes: none of the {len(self.files):,} meshes can be used ({len(self.refused):,} refused, "
            f"{len(self.too_large):,} with more than {self.max_faces:,} triangles); `unirender meshes` says why"
        )


def _write(options: MixMeshes, drawn: _Drawn, number: int, name: str) -> None:
    """Makes one mix, complete or not at all."""
    import numpy as np

    from unirender_reference.meshes.mix import draw_count, mixed, pictures_of
    from unirender_reference.meshes.write_obj import write_obj

    rng = np.random.default_rng((options.seed, number))
    turn, place = divmod(number, len(drawn.files))  # every mesh begins one mix before any begins another
    first = int(np.random.default_rng((options.seed, 2**31 + turn)).permutation(len(drawn.files))[place])
    model = drawn.read(first)
    chosen = [(first, model)] if model is not None else [drawn.next(rng)]
    chosen += [drawn.next(rng) for _ in range(draw_count(rng) - 1)]
    _, donor = drawn.next(rng)
    mix = mixed([model for _, model in chosen], pictures_of(donor), rng)
    temporary = Path(tempfile.mkdtemp(prefix=f".{name}.", dir=options.out))
    try:
        path = write_obj(mix, temporary, name)
        sources = "".join(f"# made of {drawn.files[index].name}\n" for index, _ in chosen)
        path.write_text(sources + path.read_text(encoding="utf-8"), encoding="utf-8")
        temporary.chmod(0o755)
        temporary.rename(options.out / name)
    except BaseException:
        shutil.rmtree(temporary, ignore_errors=True)
        raise
