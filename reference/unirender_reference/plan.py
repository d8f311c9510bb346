"""What a data set contains, as a pure function of its configuration: which groups, lights and materials.

A *group* is one object under up to `MAX_LIGHTS` lights; a *pair* is one picture, (light, roughness, metallic).
Roughness and metallic are whole percents, since they stand in member names.

| vary | groups of an object |
|---|---|
| basis | L lights x R roughness values x metallic {0, 50, 100}; every mixture of lights and metallic follows exactly |
| independent | every pair has its own light and material |
| one-at-a-time | three kinds of groups that share all but one of light, material, object (the paper's) |
| paper | 121 pairs: metallic and roughness on the grid {0, 10 .. 100} percent, a light each |
"""

import dataclasses
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from unirender.errors import UnirenderError
from unirender_reference.passes import SAMPLES_PER_PASS, derive_seed, pass_count

Vary = Literal["basis", "independent", "one-at-a-time", "paper"]
MAX_LIGHTS = 8
METALLIC_NODES = (0, 50, 100)
PERCENTS = 101  # 0 .. 100
GRID = tuple(range(0, PERCENTS, 10))
OBJECT_BLOCK = 8  # objects that share a light and a material in "one-at-a-time"
SHARD_GROUPS = 16


@dataclass(frozen=True)
class DatasetConfig:
    """A data set to generate.

    Attributes:
        objects: number of objects.
        pairs: pictures per object.
        resolution: height and width in pixels.
        vary: what the pictures of an object differ in.
        out: folder of the shards.
        seed: another seed gives other objects, lights and materials.
        split: "train" or "test": disjoint objects and lights.
        spp: samples per pixel of every picture, s and d (batches are not kept: training data has no variance).
        workers: processes; 0 means one for each CPU core.
    """

    objects: int
    pairs: int
    resolution: int
    vary: Vary
    out: Path
    seed: int = 0
    split: Literal["train", "test"] = "train"
    spp: int = 64
    workers: int = 0

    def __post_init__(self) -> None:
        object.__setattr__(self, "out", Path(self.out))
        for name in ("objects", "pairs", "resolution", "spp"):
            if getattr(self, name) < 1:
                raise UnirenderError(f"dataset {name}: got {getattr(self, name)}, expected at least 1")
        for name in ("seed", "workers"):
            if getattr(self, name) < 0:
                raise UnirenderError(f"dataset {name}: got {getattr(self, name)}, expected 0 or more")
        pass_count(self.spp, 1, SAMPLES_PER_PASS // self.resolution**2)
        if self.vary not in ("basis", "independent", "one-at-a-time", "paper"):
            raise UnirenderError(
                f"dataset vary: got {self.vary!r}, expected basis, independent, one-at-a-time or paper"
            )
        if self.vary == "basis":
            basis_shape(self.pairs)
        if self.vary == "paper" and self.pairs != len(GRID) ** 2:
            raise UnirenderError(f"dataset pairs: got {self.pairs}, expected {len(GRID) ** 2} with --vary paper")
        if self.vary == "independent" and self.pairs > PERCENTS**2:
            raise UnirenderError(
                f"dataset pairs: got {self.pairs}, expected at most {PERCENTS**2} materials of whole percents with "
                "--vary independent"
            )
        if self.vary == "one-at-a-time" and not 3 <= self.pairs <= 3 * PERCENTS**2:
            raise UnirenderError(
                f"dataset pairs: got {self.pairs}, expected at least 3 and at most {3 * PERCENTS**2} with "
                "--vary one-at-a-time"
            )

    def content(self) -> dict[str, object]:
        """The part that decides the bytes of a group, JSON-serialisable; `objects` may grow later."""
        values = dataclasses.asdict(self)
        return {name: value for name, value in values.items() if name not in ("out", "workers", "objects")}


@dataclass(frozen=True)
class LightPlan:
    """A light of a group and its pictures, distinct (roughness, metallic) in percent: they name the members."""

    seed: int
    exposure_seed: int
    pairs: tuple[tuple[int, int], ...]

    def __post_init__(self) -> None:
        assert len(set(self.pairs)) == len(self.pairs), f"pairs of a light occur twice: {self.pairs}"


@dataclass(frozen=True)
class GroupPlan:
    """One group: which object, which lights, how the group relates to others (`shares`)."""

    index: int
    object_seed: int
    number: int  # among the object's groups: the k of its key
    shares: str
    lights: tuple[LightPlan, ...]
    render_seed: int

    @property
    def samples(self) -> int:
        return sum(len(light.pairs) for light in self.lights)


def basis_shape(pairs: int) -> tuple[int, int]:
    """(lights, roughness values) with lights * roughness values * 3 = pairs, lights >= roughness, nearly square.

    Raises:
        UnirenderError: `pairs` has no such form with at most `MAX_LIGHTS` lights.
    """
    product = pairs // len(METALLIC_NODES)
    shapes = [
        (lights, product // lights)
        for lights in range(1, MAX_LIGHTS + 1)
        if pairs % len(METALLIC_NODES) == 0 and product and product % lights == 0 and lights >= product // lights
    ]
    if not shapes:
        raise UnirenderError(
            f"dataset pairs: got {pairs} with --vary basis, expected 3 x lights x roughness values with at most "
            f"{MAX_LIGHTS} lights and no more roughness values than lights: 3, 6, 12, 18, 27, 36, 48, 75, 108, ..."
        )
    return min(shapes, key=lambda shape: shape[0] - shape[1])


def plan_groups(config: DatasetConfig) -> list[GroupPlan]:
    """All groups in the order in which they are stored."""
    groups: list[GroupPlan] = []
    for index in range(config.objects):
        for number, (shares, lights) in enumerate(_object_groups(config, index)):
            groups.append(
                GroupPlan(
                    index=len(groups),
                    object_seed=config.seed * 1_000_000 + index,
                    number=number,
                    shares=shares,
                    lights=tuple(lights),
                    render_seed=derive_seed(config.seed, "render", index, number),
                )
            )
    return groups


def _object_groups(config: DatasetConfig, index: int) -> Iterator[tuple[str, list[LightPlan]]]:
    rng = np.random.default_rng(derive_seed(config.seed, "plan", config.split, config.vary, index))
    if config.vary == "basis":
        lights, levels = basis_shape(config.pairs)
        materials = tuple((r, m) for r in _stratified(rng, levels) for m in METALLIC_NODES)
        yield "object", [_light(rng, materials) for _ in range(lights)]
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


def _light(rng: np.random.Generator, pairs: tuple[tuple[int, int], ...]) -> LightPlan:
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
