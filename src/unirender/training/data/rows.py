"""The rows of packed shards that a sample is mixed of, and what stands in them as maps `[h w c]`."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float16, Int

from unirender.errors import UnirenderError
from unirender.light.symmetries import Maps
from unirender.training.augmentations.augment import METALLIC_NODES
from unirender.training.data.groups import Shard
from unirender.training.data.packing import SCALAR_CHANNELS, Group


@dataclass(frozen=True)
class SampleRows:
    """Which rows of its packed shard a sample is mixed of.

    Attributes:
        shard: number of the shard.
        shared: row of albedo, normal and mask.
        image: rows of the pictures, by light and metallic node; one node for a pair.
        specular: row by light, and so the others.
        metallic: of the object; None: its own map.
        roughness: likewise.
    """

    shard: int
    shared: int
    image: Int[np.ndarray, "l n"]
    specular: Int[np.ndarray, " l"]
    diffuse: Int[np.ndarray, " l"]
    environment: Int[np.ndarray, " l"]
    metallic: float | None
    roughness: float | None


@dataclass(frozen=True)
class BasisRows:
    """Rows of a basis group, by light, roughness and metallic node."""

    roughness: tuple[float, ...]
    image: Int[np.ndarray, "l r 3"]
    specular: Int[np.ndarray, "l r"]
    diffuse: Int[np.ndarray, " l"]
    environment: Int[np.ndarray, " l"]


def basis_rows(shard: Shard, group: Group) -> BasisRows:
    """Sorts a basis group's pairs into its grid.

    Raises:
        UnirenderError: the grid is not complete.
    """
    where = f"{shard.name}: group {group.key}"
    lights = sorted({pair.light for pair in group.pairs})
    roughness = sorted({pair.roughness for pair in group.pairs if pair.roughness is not None})
    by_node = {(pair.light, pair.roughness, pair.metallic): pair for pair in group.pairs}
    try:
        grid = [[[by_node[light, r, m] for m in METALLIC_NODES] for r in roughness] for light in lights]
    except KeyError as error:
        raise UnirenderError(
            f"{where}: no picture for (light, roughness, metallic) {error}, expected a full basis grid"
        ) from error
    if len(by_node) != len(lights) * len(roughness) * len(METALLIC_NODES):
        others = {"maps" if m is None else f"{m:g}" for _, _, m in by_node if m not in METALLIC_NODES}
        raise UnirenderError(
            f"{where}: got pictures at metallic {', '.join(sorted(others))} in a basis group, expected "
            f"{', '.join(map(str, METALLIC_NODES))} alone; write vary independent"
        )
    return BasisRows(
        roughness=tuple(roughness),
        image=np.array([[[pair.image for pair in nodes] for nodes in row] for row in grid]),
        specular=np.array([[nodes[0].specular for nodes in row] for row in grid]),
        diffuse=np.array([row[0][0].diffuse for row in grid]),
        environment=np.array(lights),
    )


def trailing(stored: Float16[np.ndarray, "*l c h w"] | Float[np.ndarray, "*l c h w"]) -> Float[np.ndarray, "*l h w c"]:
    """Stored arrays as float32 maps, the channels last."""
    return np.moveaxis(stored.astype(np.float32, copy=False), -3, -1)


def shared_maps(shard: Shard, group: Group) -> Maps:
    """What does not depend on the light: albedo, normal, mask, and the object's own materials, if it has any."""
    shared = trailing(shard.shared[group.shared])
    maps = {"albedo": shared[..., :3], "normal": shared[..., 3:6], "mask": shared[..., 6:7]}
    if shared.shape[-1] > SCALAR_CHANNELS:
        maps |= {"roughness": shared[..., 7:8], "metallic": shared[..., 8:9]}
    return maps


def with_material(maps: Maps, metallic: float | None, roughness: float | None) -> Maps:
    """The maps with a material that is one value over the object; None: it is in the maps already."""
    if metallic is None or roughness is None:
        return maps
    inside = (maps["mask"] > 0).astype(np.float32)
    return maps | {"metallic": inside * np.float32(metallic), "roughness": inside * np.float32(roughness)}
