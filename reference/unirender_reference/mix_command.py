"""`unirender mix-meshes`. Light to import: what reads meshes is loaded when the command runs."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from unirender.errors import UsageError
from unirender_reference.option_checks import require_least

PROGRESS_EVERY = 100


@dataclass(frozen=True)
class MixMeshes:
    """Make new meshes of a folder's: in other proportions, put together, with other colours; for training.

    Running the same command again goes on where it was stopped. The exit status is 1 where a mesh file that was read is
    refused, or a folder cannot be listed: each is named with its reason, and other meshes took their place.
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
    """Every N-th file of each folder, in order of name, is left out: `--split test` of a data set of that folder with
    the same --holdout. 0: all are used."""
    max_faces: int = 60_000
    """Meshes with more triangles are not used."""

    def check(self) -> None:
        """Looks at the values.

        Raises:
            UsageError: one is outside its range, or `out` lies in a folder of meshes.
        """
        from unirender_reference.meshes.limits import MAX_FACES
        from unirender_reference.meshes.mix import MAX_PARTS

        if not self.patterns:
            raise UsageError("mix-meshes: got no folder, expected at least one with meshes")
        require_least(self, "", {"count": 1, "seed": 0, "max_faces": 1})
        if self.max_faces > (most := MAX_FACES // MAX_PARTS):
            raise UsageError(
                f"--max-faces: got {self.max_faces:,}, expected at most {most:,}: {MAX_PARTS} such meshes are as many "
                "triangles as a data set reads"
            )
        if self.holdout < 0 or self.holdout == 1:
            raise UsageError(f"--holdout: got {self.holdout}, expected 0 or at least 2")
        for pattern in self.patterns:
            folder = Path(pattern).expanduser()
            if folder.is_dir() and self.out.resolve().is_relative_to(folder.resolve()):
                raise UsageError(
                    f"--out: got {self.out}, which lies in {pattern}, whose meshes are mixed; expected another place"
                )

    def run(self) -> int:
        """Returns the exit status: 1 where a mesh was refused or a folder cannot be listed."""
        from rich.console import Console

        from unirender_reference.mix_folder import mix_meshes

        self.check()
        console = Console(soft_wrap=True, highlight=False)

        def progress(done: int) -> None:
            if done % PROGRESS_EVERY == 0:
                console.print(f"{done:,} of {self.count:,}", markup=False)

        report = mix_meshes(self, progress)
        for reason in report.refused:
            console.print(f"refused  {reason}", markup=False)
        if report.too_large:
            console.print(f"not used: {report.too_large:,} with more than {self.max_faces:,} triangles (--max-faces)")
        console.print(f"{report.made:,} meshes made, {report.there:,} were there: {self.out}", markup=False)
        return 1 if report.refused else 0
