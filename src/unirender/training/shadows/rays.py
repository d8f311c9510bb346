"""What `unirender.models.visibility` learns from: rays of `unirender dataset --vary visibility`, sorted into bins.

For each pixel, class of the masks and bin of directions: the integral of the cosine over all directions, and over those
that traced rays found hidden. Looking at an object takes a second, so that is done once for a shard, on all cores, and
kept: `${UNIRENDER_CACHE}/visibility/<sha256 of the shard>-v1/items.npz`.

Notation: p pixels of the surface, c classes, k bins; `weight` and `hidden` uint8 in steps of 1 / `STEPS`, where the
cosine is integrated in units of a mean texel of `DIRECTIONS`.
"""

import io
import logging
import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Float16, UInt8

from unirender.camera import Camera
from unirender.errors import UnirenderError
from unirender.exr import channels_rgb, read_exr_bytes
from unirender.light.lobes import texel_directions
from unirender.models.visibility import AZIMUTHS, BANDS, bin_weights
from unirender.pipelines.self_shadow import SelfShadow
from unirender.system.paths import cache_dir, cached_folder
from unirender.system.whole_files import file_sha256
from unirender.system.worker_pool import WorkerPool
from unirender.training.data.derived import one_thread
from unirender.training.data.groups import check_sha256, damaged, list_shards, read_groups, split_of
from unirender.training.data.same_objects import object_of

VERSION = 1  # part of the cache's path: raise it when the masks or the bins change
DIRECTIONS = (16, 32)  # of the traced rays: texels of a lat-long map
STEPS = 12
LEAST_PIXELS = 100  # of a surface: smaller ones teach nothing

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class VisibilityItem:
    """An object as it is seen, and what it hides from itself.

    Attributes:
        normal: camera axes, unit.
        surface: its pixels.
        depth: along the view axis where there is a surface, up to a factor.
        weight: of the directions of each class and bin.
        hidden: of those of them that are hidden.
        object: its name, which other views of it have too; empty: nobody knows.
    """

    normal: Float[np.ndarray, "h w 3"] | Float16[np.ndarray, "h w 3"]
    surface: Bool[np.ndarray, "h w"]
    depth: Float[np.ndarray, "h w"]
    weight: UInt8[np.ndarray, "p c k"] | Float[np.ndarray, "p c k"]
    hidden: UInt8[np.ndarray, "p c k"] | Float[np.ndarray, "p c k"]
    object: str = ""

    def turned(self, turns: int, mirror: bool) -> "VisibilityItem":
        """Seen by a camera that is turned about its axis by quarter turns, and then mirrored left and right."""
        normal, surface, depth = self.normal.astype(np.float32), self.surface, self.depth
        pixel = np.zeros(surface.shape, np.int64)
        pixel[surface] = np.arange(len(self.weight))
        azimuth = np.arange(AZIMUTHS)
        for _ in range(turns):
            normal = np.stack([-normal[..., 1], normal[..., 0], normal[..., 2]], axis=-1)
            normal, depth = np.rot90(normal), np.rot90(depth)
            surface, pixel = np.rot90(surface), np.rot90(pixel)
            azimuth = azimuth[(np.arange(AZIMUTHS) - AZIMUTHS // 4) % AZIMUTHS]
        if mirror:
            normal = normal[:, ::-1] * np.array([-1, 1, 1], np.float32)
            surface, depth, pixel = surface[:, ::-1], depth[:, ::-1], pixel[:, ::-1]
            azimuth = azimuth[(AZIMUTHS // 2 - 1 - np.arange(AZIMUTHS)) % AZIMUTHS]
        bins = (np.arange(BANDS)[:, None] * AZIMUTHS + azimuth).ravel()
        order = pixel[surface]
        return VisibilityItem(normal, surface, depth, self.weight[order][..., bins], self.hidden[order][..., bins])

    def halved(self) -> "VisibilityItem":
        """At half the size, one way: the means over two by two pixels, where two or more are of the surface."""
        count = _pooled(self.surface[..., None])
        surface = count[..., 0] >= 2
        some = np.maximum(count, 1)
        normal = _pooled(self.normal.astype(np.float32) * self.surface[..., None])
        normal /= np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-6)
        depth = np.exp(_pooled(np.log(np.where(self.surface, self.depth, 1))[..., None]) / some)[..., 0]
        pooled = []
        for values in (self.weight, self.hidden):
            dense = np.zeros((*self.surface.shape, values[0].size), np.float32)
            dense[self.surface] = values.reshape(len(values), -1)
            pooled.append((_pooled(dense)[surface] / some[surface]).reshape(-1, *values.shape[1:]))
        return VisibilityItem(normal * surface[..., None], surface, depth, *pooled)


def read_items(
    folder: str | Path, progress: Callable[[int, int], None] | None = None
) -> tuple[list[VisibilityItem], dict[str, str]]:
    """The objects of a data folder in order, and the sha256 of its shards by name.

    Args:
        folder: as written by `unirender dataset --vary visibility`, with or without a recipe.
        progress: called with (shards looked at, shards in all).

    Raises:
        UnirenderError: no such folder, shards of another kind or damaged, or some for training and some for tests.
    """
    folder = Path(folder)
    split_of(folder)
    shards = {path: sha256 or file_sha256(path) for path, sha256 in list_shards(folder).items()}
    missing = [(path, sha256) for path, sha256 in shards.items() if not _place(sha256).exists()]
    if missing:
        logger.warning("looking at the objects of %d shards once, about a second each", len(missing))
        workers = min(len(missing), os.cpu_count() or 1)
        with WorkerPool(workers, one_thread) as pool:
            for done, _ in enumerate(pool.map(_prepare, *zip(*missing, strict=True)), start=1):
                if progress is not None:
                    progress(done, len(missing))
    items = [item for sha256 in shards.values() for item in _stored(_place(sha256))]
    if not items:
        raise UnirenderError(f"{folder}: no object covers {LEAST_PIXELS} pixels, expected larger pictures")
    return items, {path.relative_to(folder).as_posix(): sha256 for path, sha256 in shards.items()}


def look_at(
    normal: Float[np.ndarray, "h w 3"],
    mask: Float[np.ndarray, "h w 1"],
    camera: Camera,
    visible: Bool[np.ndarray, "p m"],
) -> VisibilityItem | None:
    """Sorts the rays of one object; None if it is too small.

    Args:
        normal: camera axes, unit.
        mask: coverage.
        camera: that took it.
        visible: which of `DIRECTIONS` are free, for each pixel that is covered by half or more.
    """
    shadow = SelfShadow.of(normal, mask, camera)
    surface = shadow.where
    visible = visible[surface[mask[..., 0] >= 0.5]]  # a pixel without a normal is no surface
    if surface.sum() < LEAST_PIXELS:
        return None
    directions = texel_directions(DIRECTIONS)
    n = normal[surface]
    weight, hidden = [], []
    for part in shadow.parts(directions.shape[1]):
        cosine = np.maximum(n[part] @ directions, 0)
        classes = shadow.classes(part, directions)
        weight.append(bin_weights(cosine, classes, directions))
        hidden.append(bin_weights(np.where(visible[part], 0, cosine), classes, directions))
    weights, hides = (
        np.clip(np.round(STEPS * np.concatenate(value)), 0, 255).astype(np.uint8) for value in (weight, hidden)
    )
    return VisibilityItem(normal.astype(np.float16), surface, np.where(surface, shadow.depth, 0), weights, hides)


def _place(sha256: str) -> Path:
    return cache_dir() / "visibility" / f"{sha256}-v{VERSION}"


def _prepare(path: Path, sha256: str) -> None:
    """Looks at the objects of a shard; its folder appears when all are done."""
    check_sha256(path, sha256)
    arrays = {}
    for key, members in read_groups(path):
        if "visible.npy" not in members:
            raise UnirenderError(
                f"{path}: group {key} has no visible.npy, expected a folder that `unirender dataset --vary visibility` "
                "wrote"
            )
        channels, _ = read_exr_bytes(members["shared.exr"], name=f"{path}: group {key}.shared.exr")
        normal, mask = channels_rgb(channels, "normal", "XYZ"), channels_rgb(channels, "mask", "Y")
        try:
            visible = np.unpackbits(np.load(io.BytesIO(members["visible.npy"])), axis=1).astype(bool)
        except Exception as error:  # NumPy raises half a dozen kinds for a damaged file
            raise UnirenderError(
                f"{path}: group {key}.visible.npy: cannot be read ({error!s:.200}); remake the shard"
            ) from error
        if (item := look_at(normal, mask, Camera(), visible)) is not None:
            arrays |= {f"{key}/{name}": getattr(item, name) for name in _FIELDS}
    with cached_folder(_place(sha256)) as made:
        np.savez(made / "items.npz", **arrays)


_FIELDS = ("normal", "surface", "depth", "weight", "hidden")


def _stored(place: Path) -> list[VisibilityItem]:
    try:
        with np.load(place / "items.npz") as arrays:
            keys = dict.fromkeys(name.rsplit("/", 1)[0] for name in arrays.files)
            maps = {key: {name: arrays[f"{key}/{name}"] for name in _FIELDS} for key in keys}
    except Exception as error:  # NumPy raises half a dozen kinds for a damaged file
        raise damaged(place, error) from error
    return [VisibilityItem(**own, object=object_of(key)) for key, own in maps.items()]


def _pooled(values: np.ndarray) -> Float[np.ndarray, "h w c"]:
    """Sums over two by two pixels."""
    height, width, channels = values.shape
    return values.reshape(height // 2, 2, width // 2, 2, channels).sum(axis=(1, 3), dtype=np.float32)
