"""The processes of one training: torchrun starts them, each computes its rows of every batch.

A process that was started alone is process 0 of 1, and every method here is then the identity: the trainer has one code
path. All processes call the same methods in the same order; what only one of them may do (files, pictures, scores,
messages) is asked of `is_main`.
"""

import contextlib
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import timedelta
from itertools import pairwise
from typing import TypeVar

import torch
import torch.distributed as dist
from torch import Tensor

from unirender.errors import UnirenderError

PATIENCE = timedelta(hours=6)  # process 0 scores and saves while the others wait for it
BUCKET = 2**24  # values that are summed in one message

T = TypeVar("T")


@dataclass(frozen=True)
class Processes:
    """This process among all of a training.

    Attributes:
        rank: number of this process, from 0.
        size: how many there are.
        local: number of this process on its machine, from 0.
    """

    rank: int = 0
    size: int = 1
    local: int = 0

    @property
    def is_main(self) -> bool:
        """Whether this is the process that writes and speaks."""
        return self.rank == 0

    @contextlib.contextmanager
    def one_first(self) -> Iterator[None]:
        """For a block that makes what the others of a machine then find on its disk: its first process goes before."""
        if self.local > 0:
            self.gather(None)
        yield
        if self.local == 0:
            self.gather(None)

    def gather(self, value: T) -> list[T]:
        """The value of every process, by rank; plain data."""
        if self.size == 1:
            return [value]
        values: list[T | None] = [None] * self.size
        with self._together():
            dist.all_gather_object(values, value)
        return values  # pyright: ignore[reportReturnType] - every place was filled

    def share(self, value: T) -> T:
        """What process 0 has for it; plain data."""
        if self.size == 1:
            return value
        values = [value]
        with self._together():
            dist.broadcast_object_list(values, src=0)
        return values[0]

    def sum(self, tensors: Sequence[Tensor]) -> list[Tensor]:
        """Sums over the processes; equal shapes, types and order on each. The result is bit for bit the same on all."""
        if self.size == 1:
            return list(tensors)
        sums: list[Tensor] = []
        for bucket in _buckets(tensors):
            flat = torch.cat([tensor.reshape(-1) for tensor in bucket])
            with self._together():
                dist.all_reduce(flat)
            pieces = flat.split([tensor.numel() for tensor in bucket])
            sums += [torch.empty_like(t).copy_(piece.view(t.shape)) for t, piece in zip(bucket, pieces, strict=True)]
        return sums

    def copy_from_main(self, tensors: Sequence[Tensor]) -> None:
        """Overwrites the tensors with those of process 0."""
        if self.size == 1:
            return
        for tensor in tensors:
            held = tensor.detach().contiguous()
            with self._together():
                dist.broadcast(held, src=0)
            tensor.detach().copy_(held)

    def close(self) -> None:
        """Leaves the group: the last thing that a process does, if all went well."""
        if self.size > 1:
            dist.destroy_process_group()

    @contextlib.contextmanager
    def _together(self) -> Iterator[None]:
        try:
            yield
        except RuntimeError as error:
            raise UnirenderError(
                f"process {self.rank} of {self.size} stops: another process of this training has ended, and its own "
                "message says why (UNIRENDER_DEBUG=1 shows what this one saw); run the same command again to go on"
            ) from error


ALONE = Processes()


def join_processes(device: torch.device) -> tuple[Processes, torch.device]:
    """Joins the processes that torchrun started, as its environment variables say.

    Args:
        device: the kind of device that was chosen.

    Returns:
        This process among the others, and its own device: with CUDA one GPU for each process of a machine.

    Raises:
        UnirenderError: the environment is incomplete, there are too few GPUs, or the others cannot be reached.
    """
    size = _variable("WORLD_SIZE") if "WORLD_SIZE" in os.environ else 1
    if size == 1:
        return ALONE, device
    rank, local = _variable("RANK"), _variable("LOCAL_RANK")
    if device.type not in ("cpu", "cuda"):
        raise UnirenderError(f"{size} processes on {device}: expected --device cpu or cuda")
    if device.type == "cuda":
        if local >= torch.cuda.device_count():
            raise UnirenderError(
                f"process {local} of this machine has no GPU of its own: there are {torch.cuda.device_count()}, "
                "expected one for each process; pass torchrun a smaller --nproc-per-node"
            )
        device = torch.device("cuda", local)
        torch.cuda.set_device(device)
    try:
        dist.init_process_group("cpu:gloo,cuda:nccl" if device.type == "cuda" else "gloo", timeout=PATIENCE)
    except (RuntimeError, ValueError) as error:
        raise UnirenderError(
            f"process {rank} of {size} cannot reach the others ({error}); start all of them with torchrun"
        ) from error
    return Processes(rank, size, local), device


def _variable(name: str) -> int:
    value = os.environ.get(name, "")
    if not value.isdecimal():
        raise UnirenderError(f"environment: got {name}={value!r}, expected the number that torchrun sets")
    return int(value)


def _buckets(tensors: Sequence[Tensor]) -> Iterator[Sequence[Tensor]]:
    """Runs of consecutive tensors of one type with about `BUCKET` values each."""
    ends, held = [0], 0
    for i, tensor in enumerate(tensors):
        if held and (held + tensor.numel() > BUCKET or tensor.dtype != tensors[i - 1].dtype):
            ends.append(i)
            held = 0
        held += tensor.numel()
    for first, last in pairwise([*ends, len(tensors)]):
        yield tensors[first:last]
