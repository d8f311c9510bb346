"""Batches out of the paper's one-at-a-time groups: neighbours in the stream differ in light, material or object only.

A *set* holds all pictures that share two of the three. Of data rendered with `--vary one-at-a-time` these are, by what
a group of one object holds,

    several lights, one material      the group
    one light, several materials      the group
    a material for each light         the k-th picture of every group with the same list of materials: they stand for
                                      several objects under the same light

An epoch shuffles each set and cuts it into *runs* of one length; what is left over waits for another epoch. Every
picture of a run is augmented alike. Batches of whole runs follow where the length divides the batch size.
"""

import functools
from collections import defaultdict
from pathlib import Path

import numpy as np
from jaxtyping import Int

from unirender.errors import UnirenderError
from unirender.training.augmentations.augment import Draw, draw
from unirender.training.config import Augmentation
from unirender.training.data.dataset import GroupDataset
from unirender.training.data.packing import Group, Pair

Member = tuple[int, int]  # number of a group, number of a pair in it


class ContrastDataset(GroupDataset):
    """A data folder whose stream is made of runs; see the module.

    Attributes:
        run_length: pictures of a run.
    """

    def __init__(self, folder: str | Path, shards: tuple[str, ...] | None = None, *, run_length: int) -> None:
        """Opens a folder as `GroupDataset` does.

        Raises:
            UnirenderError: it was rendered with another `--vary`, or has no set as large as a run.
        """
        super().__init__(folder, shards)
        self.run_length = run_length
        groups = [group for _, group in self._groups]
        others = sorted({group.vary for group in groups} - {"one-at-a-time"})
        if others:
            raise UnirenderError(
                f"{folder}: got groups of --vary {', '.join(others)}, expected one-at-a-time, whose groups share all "
                "but one thing; render such data, or choose a preset without group_size"
            )
        members = ((i, k) for i, group in enumerate(groups) for k in range(len(group.pairs)))
        item = {member: number for number, member in enumerate(members)}
        self._sets = [np.array([item[member] for member in members]) for members in sets_of(groups)]
        self._length = sum(len(members) // run_length for members in self._sets) * run_length
        if not self._length:
            largest = max(len(members) for members in self._sets)
            raise UnirenderError(
                f"{folder}: the largest set has {largest} pictures that differ in one thing, expected {run_length}; "
                "render more pairs of an object, or more objects"
            )

    def __len__(self) -> int:
        """Samples of an epoch: those of whole runs."""
        return self._length

    def drawn(self, index: int, seed: int, augmentation: Augmentation) -> tuple[int, Pair | None, Draw]:
        epoch, place = divmod(index, len(self))
        group, pair = self._items[self._order(seed, epoch)[place]]
        rng = np.random.default_rng([seed, 1, index // self.run_length])
        return group, pair, draw(rng, augmentation, 1, 1, len(self._groups))

    @functools.lru_cache(maxsize=4)  # noqa: B019 - a dataset lives as long as the training that reads it
    def _order(self, seed: int, epoch: int) -> Int[np.ndarray, " items"]:
        rng, length = np.random.default_rng([seed, 0, epoch]), self.run_length
        shuffled = [rng.permutation(members) for members in self._sets]
        runs = [members[: len(members) // length * length].reshape(-1, length) for members in shuffled]
        return rng.permutation(np.concatenate(runs)).reshape(-1)


def sets_of(groups: list[Group]) -> list[list[Member]]:
    """The sets of one-at-a-time groups, each picture in one of them."""
    sets: list[list[Member]] = []
    across: dict[tuple, list[int]] = defaultdict(list)
    for i, group in enumerate(groups):
        materials = tuple((pair.metallic, pair.roughness) for pair in group.pairs)
        lights = {pair.light for pair in group.pairs}
        if len(lights) > 1 and len(set(materials)) > 1:
            across[materials].append(i)
        else:
            sets.append([(i, k) for k in range(len(group.pairs))])
    for materials, numbers in across.items():
        sets += [[(i, k) for i in numbers] for k in range(len(materials))]
    return sets
