"""Where a training run's batches come from, and how it remembers where it was."""

from pathlib import Path
from typing import Any, Protocol, runtime_checkable

from unirender.errors import UnirenderError
from unirender.training.augmentations.augment import DEFAULT_AUGMENTATION
from unirender.training.config import Augmentation
from unirender.training.data.contrasts import ContrastDataset
from unirender.training.data.dataset import ALL_ROWS, Batch, GroupDataset
from unirender.training.data.groups import split_of
from unirender.training.data.reader import BatchReader


@runtime_checkable
class BatchSource(Protocol):
    """An endless source of batches whose place can be saved."""

    def next(self) -> Batch:
        """The next batch: of several processes, the rows `Split.own` of it."""
        ...

    def read_ahead(self) -> None:
        """Makes use of idle cores for the batches to come; returns at once."""
        ...

    def state_dict(self) -> dict[str, Any]:
        """Plain data from which `load_state_dict` continues."""
        ...

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continues where the state was taken."""
        ...

    def refresh(self) -> str | None:
        """Takes in data that came since; returns a line about it, or None."""
        ...


@runtime_checkable
class NamesGroups(Protocol):
    """A source that knows which groups its batches are made of."""

    def last_keys(self) -> list[str]:
        """Of each sample of the last batch, the key of its group."""
        ...


class ShardSource:
    """Batches from a data folder; the folder may still be growing.

    The stream is a function of (shards, seed, samples consumed); the shards in use are part of the state, so that a
    resumed run sees the same samples. `refresh` is the one place where the shards change, and it says so.

    Args:
        folder: of the shards.
        batch_size: samples of a batch, over all processes.
        seed: of order and augmentation.
        workers: background threads.
        augmentation: what is drawn.
        size: of the pictures, one way; None: whatever they have.
        rows: of each batch, those of this process; the others are not read.
        group_size: a batch is made of runs of so many pictures that differ in one thing; 1: of pictures in any order.

    Raises:
        UnirenderError: a batch does not hold whole runs.
    """

    def __init__(
        self,
        folder: str | Path,
        batch_size: int,
        seed: int,
        workers: int = 1,
        augmentation: Augmentation = DEFAULT_AUGMENTATION,
        size: int | None = None,
        rows: slice = ALL_ROWS,
        group_size: int = 1,
    ) -> None:
        if group_size < 1 or batch_size % group_size:
            raise UnirenderError(
                f"training: got batches of {batch_size}, expected a multiple of {group_size}, the pictures of a run "
                "that differ in one thing; pass another --batch-size, or choose a preset without group_size"
            )
        self.folder, self.batch_size, self.seed, self.workers = Path(folder), batch_size, seed, workers
        self.augmentation, self.size, self.rows, self.group_size = augmentation, size, rows, group_size
        self.consumed = 0  # samples, over all processes
        self.dataset: GroupDataset | None = None
        self._batches: BatchReader | None = None

    def next(self) -> Batch:
        if self._batches is None:
            self._batches = BatchReader(
                self.open(), self.batch_size, self.seed, self.consumed, self.workers, self.augmentation, self.rows
            )
        batch = next(self._batches)
        self.consumed += self.batch_size
        return batch

    def last_keys(self) -> list[str]:
        dataset, last = self.open(), range(self.consumed - self.batch_size, self.consumed)[self.rows]
        return [dataset.keys[dataset.drawn(index, self.seed, self.augmentation)[0]] for index in last]

    def read_ahead(self) -> None:
        if self._batches is not None:
            self._batches.read_ahead()

    def open(self) -> GroupDataset:
        """Opens the folder, unless it is open.

        Raises:
            UnirenderError: no usable shards, some for training and some for tests, or pictures of another size than
                `size`, where that is given.
        """
        self.dataset = self.dataset or self._open()
        return self.dataset

    def _open(self, shards: tuple[str, ...] | None = None) -> GroupDataset:
        """The shards as pairs, or as runs of contrasts; refused where their size is not the network's."""
        if shards is None:
            split_of(self.folder)
        if self.group_size == 1:
            dataset = GroupDataset(self.folder, shards)
        else:
            dataset = ContrastDataset(self.folder, shards, run_length=self.group_size)
        height, width = dataset.resolution
        if self.size is not None and (height, width) != (self.size, self.size):
            raise UnirenderError(
                f"{self.folder}: got pictures of {height} x {width}, expected {self.size} x {self.size}, the size that "
                f"the network is made for; render data with --resolution {self.size}, or train with another "
                "--resolution or --preset"
            )
        if self.augmentation.derived > 0:
            dataset.derive()
        return dataset

    def state_dict(self) -> dict[str, Any]:
        shards = list(self.dataset.shard_names) if self.dataset else None
        fingerprint = self.dataset.fingerprint if self.dataset else None
        return {"consumed": self.consumed, "seed": self.seed, "shards": shards, "fingerprint": fingerprint}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continues a run.

        Raises:
            UnirenderError: the folder's shards of the same names have other contents.
        """
        self.close()
        self.consumed, self.seed = state["consumed"], state["seed"]
        if state["shards"] is None:
            return
        self.dataset = self._open(tuple(state["shards"]))
        if self.dataset.fingerprint != state["fingerprint"]:
            raise UnirenderError(
                f"{self.folder}: the shards differ from those that this run was trained on, expected the same data; "
                "pass the old folder, or another --out to start anew"
            )

    def refresh(self) -> str | None:
        if self.dataset is None:
            return None
        dataset = self._open()
        if dataset.fingerprint == self.dataset.fingerprint:
            return None
        grown = f"data: {len(self.dataset.shard_names)} -> {len(dataset.shard_names)} shards at sample {self.consumed}"
        self.close()
        self.dataset = dataset
        return grown

    def close(self) -> None:
        """Stops the background threads."""
        if self._batches is not None:
            self._batches.close()
        self._batches, self.dataset = None, None
