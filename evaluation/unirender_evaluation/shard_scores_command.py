"""`unirender bench shards`. Light to import."""

from dataclasses import dataclass, field
from pathlib import Path

from unirender.errors import UsageError
from unirender.options import Device, ModelOptions, at_least


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
    objects: int = 60
    """Drawn from each folder."""
    pairs: int = 2
    """Pictures drawn of each object."""
    seed: int = 0
    """Of what is drawn."""
    renders: bool = False
    """Render the pictures as well: from their true maps, and from those but s and d."""
    out: Path | None = None
    """Markdown file for the table; None: it is printed only."""
    device: Device = "cpu"
    """Where the model runs. auto: cuda, then mps, then cpu, whichever is there."""

    def check(self) -> None:
        """Looks at the values.

        Raises:
            UsageError: one is outside its range, or a folder is named twice, or none.
        """
        at_least(1, objects=self.objects, pairs=self.pairs)
        at_least(0, seed=self.seed)
        if not self.data or len(set(self.data)) < len(self.data):
            shown = " ".join(map(str, self.data))
            raise UsageError(f"--data {shown}: expected at least one folder, and none of them twice")

    def run(self) -> int:
        """Prints the table; returns the exit status."""
        self.check()
        from rich.console import Console
        from rich.progress import track

        from unirender.files import checkpoint_sha256, replace_file
        from unirender.shipped import checkpoint_folder
        from unirender_evaluation.shard_scores import scored, shard_table

        console, errors = Console(), Console(stderr=True)
        checkpoint = checkpoint_folder(self.checkpoint)
        pipeline = ModelOptions(checkpoint, self.device, "float32", progress=False).load()
        found = []
        for folder in self.data:
            pictures = scored(pipeline, folder, self.objects, self.pairs, self.seed, self.renders)
            found += list(track(pictures, description=str(folder), console=errors, transient=True))
        what = f"Checkpoint {checkpoint_sha256(checkpoint)[:12]}, one step, closed."
        table = shard_table(found, f"{what} Up to {self.objects} objects a folder, {self.pairs} pictures each.")
        table.show(console)
        if self.out is not None:
            replace_file(self.out, table.markdown())
        return 0
