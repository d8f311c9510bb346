"""s and d of stored groups as a renderer derives them that is given the light alone, but for what the object reflects.

A renderer that has only ever seen s and d with all their shadows takes those without for such, and leaves the shadows
out. So some of its training pictures come with both (`Augmentation.derived`): in closed form without shadows, or with
those that the picture shows (`unirender.pipelines.shadowed_light`). A lobe takes long to integrate, a group of 64
pixels one or two seconds. The lights of a shard are derived once, from its own tar, where they have
their full resolution, and stored beside its packed form: `${UNIRENDER_CACHE}/derived/<sha256 of the shard>-v6` holds

    unshadowed.npy   float16 [m, 3, h, w]   s and d without shadows, not premultiplied
    shadowed.npy     float16 [m, 3, h, w]   the same with the shadows that the picture shows
    rows.npy         int32 [n]              for each row of the packed shard's `pixels` the row here; -1: not s or d
"""

import logging
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import threadpoolctl
import torch
from jaxtyping import Float, Float16, Int

from unirender.errors import UnirenderError
from unirender.exr import HALF_MAX
from unirender.intrinsics import Intrinsics
from unirender.light.surface_light import diffuse_light, specular_light
from unirender.pipelines.shadowed_light import SeenShadows
from unirender.system.paths import cache_dir, cached_folder
from unirender.system.worker_pool import WorkerPool
from unirender.training.data.groups import Shard, mapped, read_environments, store
from unirender.training.data.packing import Group

logger = logging.getLogger(__name__)

DERIVED_VERSION = 6  # part of the cache's path: raise it when what is derived changes

_STORED = ("unshadowed", "shadowed")


@dataclass(frozen=True)
class DerivedLight:
    """Of a shard: arrays are read-only memory maps of files in `folder`, which other processes map, too."""

    folder: Path
    unshadowed: Float16[np.ndarray, "m 3 h w"]
    shadowed: Float16[np.ndarray, "m 3 h w"]
    rows: Int[np.ndarray, " n"]

    def __reduce__(self) -> tuple[Callable[[Path], "DerivedLight"], tuple[Path]]:
        return _open, (self.folder,)

    def of(self, rows: Sequence[int] | Int[np.ndarray, " l"], shadows: bool) -> Float16[np.ndarray, "l 3 h w"]:
        """What stands in the packed shard's `rows`, all of s or d, derived: with the shadows that are seen, or none."""
        pixels = self.shadowed if shadows else self.unshadowed
        return pixels[self.rows[np.asarray(rows)]]


def open_derived(shards: Sequence[tuple[Path, Shard]]) -> list[DerivedLight]:
    """Opens the derived light of shards, a `DerivedLight` each; what has not been derived yet is, on all cores.

    Args:
        shards: with the tars that they were packed from.

    Raises:
        UnirenderError: the cache cannot be written, or a tar is not what was packed.
    """
    missing = [(path, shard) for path, shard in shards if not _folder(shard).exists()]
    if missing:
        groups = sum(len(shard.groups) for _, shard in missing)
        logger.warning("deriving the light of %d groups of %d shards once, 1 or 2 seconds each", groups, len(missing))
        workers = min(len(missing), os.cpu_count() or 1)
        with WorkerPool(workers, one_thread) as pool:
            list(pool.map(_derive, *zip(*missing, strict=True)))
    return [_open(_folder(shard)) for _, shard in shards]


def _folder(shard: Shard) -> Path:
    return cache_dir() / "derived" / f"{shard.sha256}-v{DERIVED_VERSION}"


def _open(folder: Path) -> DerivedLight:
    return DerivedLight(folder, *(mapped(folder / f"{name}.npy") for name in (*_STORED, "rows")))


def one_thread() -> None:
    """A process to a core: their matrix products would wait for one another's threads."""
    threadpoolctl.threadpool_limits(1)
    torch.set_num_threads(1)


def _derive(path: Path, shard: Shard) -> None:
    """Derives the light of a shard into its folder, which appears when it is complete."""
    folder = _folder(shard)
    groups = {group.key: group for group in shard.groups}
    pixels: list[Float16[np.ndarray, "2 3 h w"]] = []
    rows = np.full(len(shard.pixels), -1, dtype=np.int32)
    for key, lights in read_environments(path):
        if key not in groups:
            raise UnirenderError(f"{path}: group {key} is not in the packed shard; delete it from the cache")
        for row, light in _of_group(shard, groups[key], lights):
            rows[row] = len(pixels)
            pixels.append(light)
    with cached_folder(folder) as made:
        for name, maps in zip(_STORED, np.stack(pixels, axis=1), strict=True):
            store(made / f"{name}.npy", maps)
        store(made / "rows.npy", rows)


def _of_group(
    shard: Shard, group: Group, lights: Mapping[int, Float[np.ndarray, "eh ew 3"]]
) -> list[tuple[int, Float16[np.ndarray, "2 3 h w"]]]:
    """(row of the packed shard, derived light without and with shadows) of every s and d of a group, once each."""
    shared = np.moveaxis(shard.shared[group.shared].astype(np.float32), 0, -1)
    normal, mask = shared[..., 3:6], shared[..., 6:7]
    shadows = SeenShadows(Intrinsics(normal=normal, mask=mask))
    found: dict[int, Float[np.ndarray, "2 h w 3"]] = {}
    for pair in group.pairs:
        light = lights[pair.light]
        rough = shared[..., 7:8] if pair.roughness is None else np.float32(pair.roughness) * (mask > 0)
        if pair.diffuse not in found:
            d = diffuse_light(normal, light)
            found[pair.diffuse] = np.stack([d, d * shadows.diffuse_share(light)])
        if pair.specular not in found:
            s = specular_light(normal, rough, light)
            found[pair.specular] = np.stack([s, s * shadows.specular_share(rough, light)])
    return [(row, np.moveaxis(np.minimum(v, HALF_MAX), -1, 1).astype(np.float16)) for row, v in found.items()]
