"""The groups of a data set on a device, and whole batches that are augmented there at once.

The rows of the packed shards lie there as they are stored. What a sample is, `GroupDataset.drawn` says as ever, from
(seed, index); the operations are twins of those of `unirender.training.augmentations.augment`, `.repaint` and
`unirender.light.symmetries`, so that the batches are those of a `ShardSource` to rounding
(tests/unirender/test_device_data.py).

What is linear in the light is a weighted sum of rows. A sample with fewer lights or metallic nodes than others of its
batch has rows of weight 0 in their place:

    image = sum over lights l and nodes n of  weight[l] node[n] pixels[row[l, n]]

Notation: b samples, l lights, n nodes.
"""

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from unirender.camera import Camera
from unirender.color import LUMINANCE_REC709
from unirender.errors import UnirenderError
from unirender.light.exposure import MASK_THRESHOLD, PERCENTILE
from unirender.light.symmetries import COLOUR_MAPS, LIGHT_MAPS
from unirender.models.priors import PRIORS
from unirender.training.augmentations.augment import Draw, metallic_weights
from unirender.training.augmentations.moving import moved
from unirender.training.augmentations.repaint import CHANNEL_RANGE, POWER_RANGE
from unirender.training.data.dataset import DERIVED_MAPS, Batch, GroupDataset
from unirender.training.data.packing import SCALAR_CHANNELS, Pair
from unirender.training.data.rows import SampleRows

SHARED_CHANNELS = SCALAR_CHANNELS + 2  # with roughness and metallic maps, whether a group has them or not

Drawn = tuple[int, Pair | None, Draw]


class DeviceGroups:
    """The groups of a data set on a device."""

    def __init__(self, dataset: GroupDataset, device: torch.device) -> None:
        self.dataset, self.device = dataset, device
        shards = dataset.shards
        self.pixels = _joined([shard.pixels for shard in shards], device)
        self.shared = _joined([shard.shared for shard in shards], device, SHARED_CHANNELS)
        self.environment = _joined([shard.environment for shard in shards], device)
        self.first = {
            name: _starts([len(getattr(s, name)) for s in shards]) for name in ("pixels", "shared", "environment")
        }
        self.derived: tuple[Tensor, Tensor] | None = None  # without and with shadows
        if dataset.derived is not None:
            kinds = [[getattr(own, kind) for own in dataset.derived] for kind in ("unshadowed", "shadowed")]
            self.derived = _joined(kinds[0], device), _joined(kinds[1], device)
            self.first["derived"] = _starts([len(own.unshadowed) for own in dataset.derived])

    def batch(self, drawn: Sequence[Drawn]) -> Batch:
        """Float32 maps [b c h w] by the names of a batch, as `unirender.training.data.dataset.make_batch` gives them.

        Args:
            drawn: what each sample is made of, as `GroupDataset.drawn` says it.

        Raises:
            UnirenderError: derived light was drawn, but the data was opened without; an object receives no light.
        """
        draws = [draw for _, _, draw in drawn]
        if self.derived is None and any(draw.derived for draw in draws):
            raise UnirenderError("derived light was drawn, but the data was opened without it; pass derived=True")
        rows = [self.dataset.rows(*each) for each in drawn]
        lights = max(len(own.diffuse) for own in rows)
        weight = self._tensor(_filled([draw.weights for draw in draws], (lights, 3)))
        maps = self._shared(rows)
        maps["image"] = self._pictures(rows, draws, weight)
        for name in ("specular", "diffuse"):
            maps[name] = self._mixed(self.pixels, [self._at("pixels", own, getattr(own, name)) for own in rows], weight)
        maps = self._repainted(maps, draws)
        if self.derived is not None:
            maps |= self._derived_light(rows, draws, weight, self.derived)
        maps = self._turned(maps, [draw.turns for draw in draws])
        environment = self.environment.flatten(0, 1)  # stored under each quarter turn
        at = [
            4 * self._at("environment", own, own.environment) + draw.turns
            for own, draw in zip(rows, draws, strict=True)
        ]
        maps["environment"] = self._mixed(environment, at, weight)
        maps = self._mirrored(maps, self._tensor([draw.mirror for draw in draws]))
        order = self._tensor([draw.order for draw in draws])
        for name in {*COLOUR_MAPS, *DERIVED_MAPS} & maps.keys():
            maps[name] = maps[name].gather(1, order[:, :, None, None].expand_as(maps[name]))
        maps = self._exposed(maps, draws, [self.dataset.keys[group] for group, _, _ in drawn])
        if self.derived is not None:
            for name in ("derived", "shadowed"):
                maps[name] = self._tensor([float(getattr(draw, name)) for draw in draws])[:, None, None, None]
        return moved(maps, [draw.move for draw in draws])

    def _tensor(self, values: Sequence | np.ndarray) -> Tensor:
        array = np.asarray(values)
        return torch.from_numpy(array.astype(np.float32) if array.dtype == np.float64 else array).to(self.device)

    def _at(self, of: str, rows: SampleRows, own: Int[np.ndarray, "..."] | int) -> Int[np.ndarray, "..."]:
        """Rows of a shard as rows on the device."""
        return np.asarray(self.first[of][rows.shard] + own)

    def _mixed(
        self, bank: Float[Tensor, "m 3 h w"], at: Sequence[np.ndarray], weight: Float[Tensor, "b l 3"]
    ) -> Float[Tensor, "b 3 h w"]:
        places = self._tensor(_filled(at, (weight.shape[1],)))
        return torch.einsum("blchw,blc->bchw", bank[places].float(), weight)

    def _pictures(
        self, rows: Sequence[SampleRows], draws: Sequence[Draw], weight: Float[Tensor, "b l 3"]
    ) -> Float[Tensor, "b 3 h w"]:
        nodes = max(own.image.shape[1] for own in rows)
        at = _filled([self._at("pixels", own, own.image) for own in rows], (weight.shape[1], nodes))
        parts = [
            metallic_weights(draw.metallic) if own.image.shape[1] > 1 else np.ones(1)
            for own, draw in zip(rows, draws, strict=True)
        ]
        node = self._tensor(_filled(parts, (nodes,)))
        weights = weight[:, :, None] * node[:, None, :, None]
        return torch.einsum("blnchw,blnc->bchw", self.pixels[self._tensor(at)].float(), weights)

    def _shared(self, rows: Sequence[SampleRows]) -> Batch:
        """What does not depend on the light."""
        shared = self.shared[self._tensor([self._at("shared", own, own.shared) for own in rows])].float()
        maps = {"albedo": shared[:, :3], "normal": shared[:, 3:6], "mask": shared[:, 6:7]}
        inside = (maps["mask"] > 0).float()
        for channel, name in enumerate(("roughness", "metallic"), start=SCALAR_CHANNELS):
            one = [getattr(own, name) for own in rows]
            value = self._tensor([np.nan if own is None else own for own in one])[:, None, None, None]
            maps[name] = torch.where(value.isnan(), shared[:, channel : channel + 1], inside * value)
        return maps

    def _repainted(self, maps: Batch, draws: Sequence[Draw]) -> Batch:
        """Twin of `unirender.training.augmentations.repaint`."""
        rows = [i for i, draw in enumerate(draws) if draw.paint is not None]
        if not rows:
            return maps
        own = {name: value[rows] for name, value in maps.items()}
        colours = self._tensor([self.dataset.mean_colour(draw.paint) for draw in draws if draw.paint is not None])
        power = (colours.log() / _mean_colour(own["albedo"], own["mask"]).log()).clamp(*POWER_RANGE)
        albedo = own["albedo"].clamp(0, 1) ** power[:, :, None, None]
        closed_form = PRIORS["split_sum"].radiance
        difference = closed_form(own | {"albedo": albedo}, Camera()) - closed_form(own, Camera())
        image = (own["image"] + own["mask"] * difference).clamp(min=0)
        changed = {"image": image, "albedo": albedo * (own["mask"] > 0)}
        return maps | {name: _replaced(maps[name], rows, value) for name, value in changed.items()}

    def _derived_light(
        self, rows: Sequence[SampleRows], draws: Sequence[Draw], weight: Tensor, kinds: tuple[Tensor, Tensor]
    ) -> Batch:
        """s and d as derived from the light; zeros for samples without."""
        assert self.dataset.derived is not None
        maps = {
            name: self.pixels.new_zeros(len(rows), *self.pixels.shape[1:], dtype=torch.float32) for name in DERIVED_MAPS
        }
        for shadowed, bank in enumerate(kinds):
            some = [i for i, draw in enumerate(draws) if draw.derived and draw.shadowed == bool(shadowed)]
            for name in ("specular", "diffuse") if some else ():
                stored = [self.dataset.derived[rows[i].shard].rows[getattr(rows[i], name)] for i in some]
                at = [self._at("derived", rows[i], own) for i, own in zip(some, stored, strict=True)]
                maps[f"derived_{name}"][some] = self._mixed(bank, at, weight[some])
        return maps

    def _turned(self, maps: Batch, turns: Sequence[int]) -> Batch:
        """Twin of `unirender.light.symmetries.quarter_turn`; the light has its own."""
        for count in range(1, 4):
            rows = [i for i, own in enumerate(turns) if own == count]
            if not rows:
                continue
            turned = {name: torch.rot90(value[rows], count, dims=(2, 3)) for name, value in maps.items()}
            x, y, z = turned["normal"].unbind(dim=1)
            for _ in range(count):
                x, y = -y, x
            turned["normal"] = torch.stack([x, y, z], dim=1)
            maps = {name: _replaced(value, rows, turned[name]) for name, value in maps.items()}
        return maps

    def _mirrored(self, maps: Batch, flip: Bool[Tensor, " b"]) -> Batch:
        """Twin of `unirender.light.symmetries.mirror`."""
        rows = flip[:, None, None, None]
        flipped = {name: value.flip(-1) for name, value in maps.items()}
        flipped["normal"] = flipped["normal"] * flipped["normal"].new_tensor([-1, 1, 1])[:, None, None]
        return {name: torch.where(rows, flipped[name], value) for name, value in maps.items()}

    def _exposed(self, maps: Batch, draws: Sequence[Draw], keys: Sequence[str]) -> Batch:
        """The gauge with the drawn targets: twin of `unirender.light.exposure.exposure_factor`."""
        target = self._tensor([np.nan if draw.exposure_target is None else draw.exposure_target for draw in draws])
        luminance = (maps["diffuse"] * self._tensor(LUMINANCE_REC709)[:, None, None]).sum(dim=1).flatten(1)
        inside = (maps["mask"] > MASK_THRESHOLD).flatten(1)
        level = torch.nanquantile(torch.where(inside, luminance, torch.nan), PERCENTILE / 100, dim=1)
        usable = ((level > 0) & level.isfinite()) | target.isnan()
        if not usable.all():
            row = int((~usable).nonzero()[0])
            raise UnirenderError(
                f"exposure: the white-diffuse level of group {keys[row]} is {float(level[row]):g}, expected light on "
                f"an object with pixels of more coverage than {MASK_THRESHOLD}; remake the data set without it"
            )
        factor = torch.where(target.isnan(), 1.0, target / level)[:, None, None, None]
        linear = {*LIGHT_MAPS, *DERIVED_MAPS}
        return {name: value * factor if name in linear else value for name, value in maps.items()}


def _mean_colour(albedo: Float[Tensor, "b 3 h w"], mask: Float[Tensor, "b 1 h w"]) -> Float[Tensor, "b 3"]:
    """Twin of `unirender.training.augmentations.repaint.mean_colour`."""
    inside = (mask > 0).float()
    logarithms = albedo.clamp(*CHANNEL_RANGE).log() * inside
    return (logarithms.sum(dim=(2, 3)) / inside.sum(dim=(2, 3)).clamp(min=1)).exp()


def _replaced(values: Float[Tensor, "b c h w"], rows: Sequence[int], by: Tensor) -> Float[Tensor, "b c h w"]:
    return values.index_copy(0, torch.tensor(rows, device=values.device), by.to(values))


def _joined(arrays: Sequence[np.ndarray], device: torch.device, channels: int | None = None) -> Tensor:
    """One after the other, written in place; with zeros where they have fewer than `channels`."""
    first, rows = arrays[0], sum(map(len, arrays))
    shape = (rows, channels or first.shape[1], *first.shape[2:])
    joined = torch.zeros(shape, dtype=torch.from_numpy(first[:0].copy()).dtype, device=device)
    for start, array in zip(_starts(list(map(len, arrays))), arrays, strict=True):
        joined[start : start + len(array), : array.shape[1]] = torch.from_numpy(np.array(array)).to(device)
    return joined


def _starts(lengths: Sequence[int]) -> Int[np.ndarray, " shards"]:
    return np.concatenate([[0], np.cumsum(lengths)[:-1]]).astype(np.int64)


def _filled(values: Sequence[np.ndarray], shape: tuple[int, ...]) -> np.ndarray:
    """Rows or weights of samples in one array; zeros where they have fewer: of row 0 a share of 0."""
    filled = np.zeros((len(values), *shape), values[0].dtype)
    for i, own in enumerate(values):
        filled[(i, *map(slice, own.shape))] = own
    return filled
