"""Reads batches ahead, in background threads, at moments that the training chooses.

While the passes of a batch run side by side, every core is busy; what is read then takes its time from one of them, and
the other waits at the end. The optimiser leaves all cores but one idle: `BatchReader.read_ahead` belongs there.
"""

from collections import deque
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path

from unirender.errors import UnirenderError
from unirender.training.augmentations.augment import DEFAULT_AUGMENTATION
from unirender.training.config import Augmentation
from unirender.training.data.dataset import ALL_ROWS, Batch, GroupDataset, make_batch


class BatchReader(Iterator[Batch]):
    """Endless batches; the k-th holds samples `start_sample + k * batch_size` onwards.

    They have image (linear, premultiplied), albedo, normal, specular, diffuse `[b 3 h w]` (linear, not premultiplied),
    roughness, metallic, mask `[b 1 h w]`, environment `[b 3 16 32]`; float32.

    Args:
        folder: a data folder, or an opened one.
        batch_size: samples per batch; batches run across the end of an epoch.
        seed: of the order and of the augmentations.
        start_sample: samples consumed before; an interrupted run continues exactly where it was.
        workers: background threads that prepare batches ahead, one each; 0: prepare when asked. It changes no value.
        augmentation: what is drawn; `NO_AUGMENTATION` for pictures as they are stored.
        rows: of each batch; the others are not read.
    """

    def __init__(
        self,
        folder: str | Path | GroupDataset,
        batch_size: int,
        seed: int,
        start_sample: int = 0,
        workers: int = 1,
        augmentation: Augmentation = DEFAULT_AUGMENTATION,
        rows: slice = ALL_ROWS,
    ) -> None:
        if batch_size < 1 or start_sample < 0 or workers < 0:
            raise UnirenderError(
                f"batches: got batch_size {batch_size}, start_sample {start_sample}, workers {workers}; "
                "expected at least 1, 0 and 0"
            )
        self.dataset = folder if isinstance(folder, GroupDataset) else GroupDataset(folder)
        self.batch_size, self.seed, self.workers = batch_size, seed, workers
        self.augmentation, self.rows = augmentation, rows
        self._first = start_sample  # of the next batch that is begun
        self._pending: deque[Future[Batch]] = deque()
        self._executor = ThreadPoolExecutor(workers, thread_name_prefix="unirender-data") if workers else None

    def __next__(self) -> Batch:
        """The next batch; where none was read ahead, that is done now.

        After an error it is the same batch that is asked for again: none is left out.
        """
        if self._executor is None:
            batch = self._make(self._first)
            self._begin()
            return batch
        if not self._pending:
            self.read_ahead()
        batch = self._pending[0].result()
        self._pending.popleft()
        return batch

    def read_ahead(self) -> None:
        """Lets the threads begin until one batch is ready beside each in the making; returns at once."""
        while self._executor is not None and len(self._pending) <= self.workers:
            self._pending.append(self._executor.submit(self._make, self._begin()))

    def close(self) -> None:
        """Ends the threads."""
        if self._executor is not None:
            self._executor.shutdown(wait=True, cancel_futures=True)

    def _begin(self) -> int:
        first, self._first = self._first, self._first + self.batch_size
        return first

    def _make(self, first: int) -> Batch:
        return make_batch(self.dataset, first, self.batch_size, self.seed, self.augmentation, self.rows)
