"""What a data set contains, as a pure function of its configuration: which groups, lights and materials.

A *group* is one object under up to `MAX_LIGHTS` lights; a *pair* is one picture, (light, roughness, metallic).
Roughness and metallic are whole percents, since they stand in member names.

| vary | groups of an object |
|---|---|
| basis | L lights x R roughness values x metallic {0, 50, 100}; every mixture of lights and metallic follows exactly |
| independent | every pair has its own light and material; with `materials="maps"` its own light |
| one-at-a-time | three kinds of groups that share all but one of light, material, object (the paper's contribution) |
| paper | the paper's Sec. 3.3, 121 pairs: metallic and roughness on the grid {0, 10 .. 100} percent, a light each |
| sweep | the same 121 pairs under one light |
| visibility | no pictures and no lights: which directions the object hides from itself (`visibility`) |

Every object has equally many groups, so the plan is indexed, not stored: its size does not grow with the data set.
"""

import functools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import overload

import numpy as np

from unirender_reference.dataset_config import (
    DEFAULT_OBJECTS,
    GRID,
    MAX_LIGHTS,
    METALLIC_PERCENTS,
    PERCENTS,
    DatasetConfig,
    basis_shape,
)
from unirender_reference.dataset_sides import check_sides
from unirender_reference.mesh_folder import MeshFile, MeshFolder, mesh_folder
from unirender_reference.passes import derive_seed

OBJECT_BLOCK = 8  # objects that share a light and a material in "one-at-a-time"
SHARD_GROUPS = 16

Materials = tuple[tuple[int, int], ...]  # distinct (roughness, metallic) in percent
Lights = list["LightPlan"]


@dataclass(frozen=True)
class LightPlan:
    """A light of a group and its pictures, which the materials name. None: one picture, of the object's maps."""

    seed: int
    exposure_seed: int
    pairs: Materials

    def __post_init__(self) -> None:
        assert len(set(self.pairs)) == len(self.pairs), f"pairs of a light occur twice: {self.pairs}"

    @property
    def pictures(self) -> int:
        return len(self.pairs) or 1


@dataclass(frozen=True)
class GroupPlan:
    """One group: which object, which lights, how the group relates to others (`shares`).

    `mesh` is the object's file; None: the procedural object number `object_seed`.
    """

    index: int
    object_seed: int
    number: int  # among the object's groups: the k of its key
    shares: str
    lights: tuple[LightPlan, ...]
    render_seed: int
    mesh: MeshFile | None = None

    @property
    def samples(self) -> int:
        return sum(light.pictures for light in self.lights)


class Plan(Sequence[GroupPlan]):
    """All groups in the order in which they are stored, each made when it is asked for.

    Attributes:
        objects: how many objects there are.
        per_object: groups of each.
    """

    def __init__(self, config: DatasetConfig, meshes: MeshFolder | None) -> None:
        self.config = config
        self.meshes = meshes
        self.objects = (config.objects or DEFAULT_OBJECTS) if meshes is None else len(meshes)
        self.per_object = sum(1 for _ in _object_groups(config, 0))

    def __len__(self) -> int:
        return self.objects * self.per_object

    @overload
    def __getitem__(self, index: int) -> GroupPlan: ...
    @overload
    def __getitem__(self, index: slice) -> list[GroupPlan]: ...
    def __getitem__(self, index: int | slice) -> GroupPlan | list[GroupPlan]:
        if isinstance(index, slice):
            return [self[i] for i in range(*index.indices(len(self)))]
        number_of_object, number = divmod(range(len(self))[index], self.per_object)
        return self._object(number_of_object)[number]

    @functools.lru_cache(maxsize=4)  # noqa: B019 - a plan lives as long as the run that follows it
    def _object(self, index: int) -> list[GroupPlan]:
        """The groups of an object, with the seeds of their renders."""
        config = self.config
        return [
            GroupPlan(
                index=index * self.per_object + number,
                object_seed=config.seed * 1_000_000 + index,
                number=number,
                shares=shares,
                lights=tuple(lights),
                render_seed=derive_seed(config.seed, "render", index, number),
                mesh=None if self.meshes is None else self.meshes[index],
            )
            for number, (shares, lights) in enumerate(_object_groups(config, index))
        ]


def plan_groups(config: DatasetConfig) -> Plan:
    """The plan of a data set; with meshes their folder is listed, and nothing in it is opened.

    Raises:
        UnirenderError: there are no such meshes, or one object of them would be on both sides.
    """
    if config.meshes is None:
        return Plan(config, None)
    meshes = mesh_folder(config.meshes, config.split, config.holdout, config.objects)
    check_sides(config.meshes, config.holdout)
    return Plan(config, meshes)


def _object_groups(config: DatasetConfig, index: int) -> Iterator[tuple[str, Lights]]:
    """The groups of one object: what all pairs of a group share, and its lights with their materials."""
    rng = np.random.default_rng(derive_seed(config.seed, "plan", config.split, config.vary, index))
    if config.materials == "maps":
        lights = [_light(rng, ()) for _ in range(config.pairs)]
        for start in range(0, len(lights), MAX_LIGHTS):
            yield "object material", lights[start : start + MAX_LIGHTS]
    elif config.vary == "basis":
        count, levels = basis_shape(config.pairs)
        materials = tuple((r, m) for r in _stratified(rng, levels) for m in METALLIC_PERCENTS)
        yield "object", [_light(rng, materials) for _ in range(count)]
    elif config.vary == "sweep":
        yield "object light", [_light(rng, tuple((r, m) for m in GRID for r in GRID))]
    elif config.vary == "visibility":
        yield "object", []
    elif config.vary == "independent":
        for pairs in _chunks(_materials(rng, config.pairs), MAX_LIGHTS):
            yield "object", [_light(rng, (pair,)) for pair in pairs]
    elif config.vary == "paper":
        grid = [(r, m) for m in GRID for r in GRID]
        order = [grid[i] for i in rng.permutation(len(grid))]
        for pairs in _chunks(order, MAX_LIGHTS):
            yield "object", [_light(rng, (pair,)) for pair in pairs]
    else:
        each = config.pairs // 3
        material = _materials(rng, 1)
        for pairs in _chunks(material * (config.pairs - 2 * each), MAX_LIGHTS):
            yield "object material", [_light(rng, (pair,)) for pair in pairs]
        yield "object light", [_light(rng, tuple(_materials(rng, each)))]
        block = np.random.default_rng(derive_seed(config.seed, "block", config.split, index // OBJECT_BLOCK))
        for pairs in _chunks(_materials(block, each), MAX_LIGHTS):
            yield "light material", [_light(block, (pair,)) for pair in pairs]


def _light(rng: np.random.Generator, pairs: Materials) -> LightPlan:
    return LightPlan(int(rng.integers(1 << 31)), int(rng.integers(1 << 31)), pairs)


def _stratified(rng: np.random.Generator, levels: int) -> list[int]:
    """One roughness (percent) from each of `levels` equal strata of [0, 100], ends included; all distinct.

    Draws just below and just above a border of strata can round to the same percent: the upper one is then one more.
    """
    values = (np.arange(levels) + rng.random(levels)) / levels * PERCENTS - 0.5
    percents = [int(value) for value in np.clip(np.round(values), 0, 100)]
    for upper in range(1, levels):
        percents[upper] = max(percents[upper], percents[upper - 1] + 1)
    return percents


def _materials(rng: np.random.Generator, count: int) -> list[tuple[int, int]]:
    """`count` distinct materials, uniform in (roughness, metallic)."""
    cells = rng.choice(PERCENTS**2, size=count, replace=False)
    return [(int(cell // PERCENTS), int(cell % PERCENTS)) for cell in cells]


def _chunks(items: list[tuple[int, int]], size: int) -> Iterator[list[tuple[int, int]]]:
    for start in range(0, len(items), size):
        yield items[start : start + size]
