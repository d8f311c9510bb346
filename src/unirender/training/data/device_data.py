"""Batches made on the device: a GPU trains faster than a few cores can mix its pictures.

The packed shards lie on the device (`unirender.training.data.device_groups`) where there is room for them beside the
training; a run goes on with the batches of either source.
"""

from typing import Any

import torch

from unirender.training.data.dataset import Batch, GroupDataset
from unirender.training.data.device_groups import SHARED_CHANNELS, DeviceGroups
from unirender.training.data.source import ShardSource
from unirender.training.optim.memory import TrainingBytes

SHARE = 1 / 3  # of a GPU's free memory that data may take of themselves: activations and mixing need the rest


class DeviceSource:
    """The batches of a `ShardSource`, made on a device where its groups lie.

    Its place in the stream is the other's: a run goes on with either.

    Args:
        source: that nothing has been read from; of this process's rows.
        device: has room for `packed_bytes` and for what a batch is mixed of.
    """

    def __init__(self, source: ShardSource, device: torch.device) -> None:
        self.source, self.device = source, device
        self._groups: DeviceGroups | None = None

    @property
    def dataset(self) -> GroupDataset | None:
        """What the batches are made of; None before it is opened."""
        return self.source.dataset

    def next(self) -> Batch:
        own = self.source
        dataset = own.open()
        if self._groups is None or self._groups.dataset is not dataset:
            self._groups = None  # a folder that grew: not both at once
            self._groups = DeviceGroups(dataset, self.device)
        indices = range(own.consumed, own.consumed + own.batch_size)[own.rows]
        batch = self._groups.batch([dataset.drawn(index, own.seed, own.augmentation) for index in indices])
        own.consumed += own.batch_size
        return batch

    def last_keys(self) -> list[str]:
        return self.source.last_keys()

    def read_ahead(self) -> None:
        """There is nothing to read: all lies on the device."""

    def state_dict(self) -> dict[str, Any]:
        return self.source.state_dict()

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.source.load_state_dict(state)

    def refresh(self) -> str | None:
        return self.source.refresh()

    def close(self) -> None:
        """Frees the device's memory."""
        self._groups = None
        self.source.close()


def fits(dataset: GroupDataset, device: torch.device, training: TrainingBytes) -> bool:
    """Whether a GPU holds a data set beside a training; never on a device that is none.

    Args:
        dataset: opened.
        device: of the training, whose weights are there already.
        training: what it will hold besides.
    """
    if device.type != "cuda":
        return False
    free, _ = torch.cuda.mem_get_info(device)
    return packed_bytes(dataset) <= room(free, training)


def room(free: int, training: TrainingBytes) -> int:
    """Bytes that data may take of the free memory of a device: `SHARE` of what gradients and moments leave."""
    return max(0, int(SHARE * (free - training.gradients - training.moments)))


def packed_bytes(dataset: GroupDataset) -> int:
    """Of the groups on a device."""
    shards, derived = dataset.shards, dataset.derived or ()
    arrays = [array for shard in shards for array in (shard.pixels, shard.environment)]
    arrays += [array for own in derived for array in (own.unshadowed, own.shadowed)]
    shared = sum(shard.shared.nbytes * SHARED_CHANNELS // shard.shared.shape[1] for shard in shards)
    return shared + sum(array.nbytes for array in arrays)
