"""`unirender bench shards`. Light to import."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from unirender.command_line.option_checks import at_least
from unirender.command_line.options import Device, ModelOptions
from unirender.errors import UsageError

if TYPE_CHECKING:
    from unirender_evaluation.shard_scores import Scored


@dataclass(frozen=True)
class BenchShards:
    """Score a model's maps on pictures of data sets: those it was trained on beside those it never saw.

    Where both score alike, more training is wanted; where they do not, more objects. A suite decides how good a model
    is; this says why.
    """

    data: tuple[Path, ...] = field()
    """Folders that `unirender dataset` wrote: a row each."""
    checkpoint: Path | None = None
    """Folder of our model, or a shipped one by its name. None: tiny."""
    against: Path | None = None
    """Another model, likewise: tables of what ours has more than it, of the same pictures."""
    objects: int = 60
    """Drawn from each folder."""
    pairs: int = 2
    """Pictures drawn of each object."""
    seed: int = 0
    """Seed of what is drawn."""
    renders: bool = False
    """Render the pictures as well: from their true maps, and from those but s and d."""
    out: Path | None = None
    """Markdown file for the tables; None: they are printed only."""
    device: Device = "cpu"
    """Where the model runs. auto: cuda, then mps, then cpu, whichever is there."""

    def check(self) -> None:
        """Looks at the values; `UsageError` where one is outside its range, or a folder is named twice, or none."""
        at_least(1, objects=self.objects, pairs=self.pairs)
        at_least(0, seed=self.seed)
        if not self.data or len(set(self.data)) < len(self.data):
            shown = " ".join(map(str, self.data))
            raise UsageError(f"--data {shown}: expected at least one folder, and none of them twice")

    def run(self) -> int:
        """Prints the tables; returns the exit status."""
        self.check()
        from rich.console import Console

        from unirender_evaluation.shard_scores import minus, shard_tables
        from unirender_reference.output_files import check_file, write_file

        check_file("--out", self.out)

        console = Console()
        name, found = self._scored(self.checkpoint)
        what = f"Up to {self.objects} objects a folder, {self.pairs} pictures each; one step, closed."
        tables = shard_tables(found, f"Checkpoint {name}. {what}")
        if self.against is not None:
            other, base = self._scored(self.against)
            tables += shard_tables(minus(found, base), f"Checkpoint {name} minus {other}. {what}", ": differences")
        for table in tables:
            table.show(console)
        if self.out is not None:
            write_file("--out", self.out, "\n".join(table.markdown() for table in tables))
        return 0

    def _scored(self, named: Path | None) -> "tuple[str, list[Scored]]":
        """What a checkpoint is called in a note, and its scores of every folder's pictures."""
        from rich.console import Console
        from rich.progress import track

        from unirender.shipped import checkpoint_folder, checkpoint_sha256
        from unirender_evaluation.shard_scores import scored

        checkpoint, errors, found = checkpoint_folder(named), Console(stderr=True), []
        pipeline = ModelOptions(checkpoint, self.device, "float32", progress=False).load()
        for folder in self.data:
            pictures = scored(pipeline, folder, self.objects, self.pairs, self.seed, self.renders)
            described = f"{checkpoint.name}: {folder}"
            found += list(track(pictures, description=described, console=errors, transient=True))
        return checkpoint_sha256(checkpoint)[:12], found
