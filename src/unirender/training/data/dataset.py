"""Training samples from the group shards of a data folder.

Sample i of an endless stream is a pure function of (folder, seed, i): epoch and place follow from i, each epoch is a
permutation of the folder's items, and the augmentation is drawn from (seed, i). An exact resume therefore starts at
`start_sample`, reading nothing before it. An item is a whole *basis* group, out of which one new sample is mixed each
time, or one pair of any other group.
"""

import functools
import hashlib
from collections import Counter
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from unirender.arguments import as_path
from unirender.errors import UnirenderError
from unirender.intrinsics import Intrinsics
from unirender.light.exposure import exposure_factor
from unirender.light.symmetries import Maps, mirror, permute_channels, quarter_turn, scale_light
from unirender.training.augmentations.augment import Draw, draw, from_maps, interpolate_metallic, mix_lights
from unirender.training.augmentations.moving import moved
from unirender.training.augmentations.repaint import mean_colour, recoloured, repaint
from unirender.training.config import Augmentation
from unirender.training.data.derived import DerivedLight, open_derived
from unirender.training.data.groups import Shard, list_shards, open_packed, read_environments
from unirender.training.data.packing import Pair
from unirender.training.data.rows import SampleRows, basis_rows, shared_maps, trailing, with_material

DERIVED_MAPS = ("derived_specular", "derived_diffuse")  # s and d as derived from the light, where `derived` is 1
DERIVED_FLAGS = ("derived", "shadowed")  # 0 or 1 of a sample; shadowed: they have the shadows that the picture shows
BATCH_MAPS = ("image", "albedo", "normal", "roughness", "metallic", "specular", "diffuse", "environment", "mask")

ALL_ROWS = slice(None)

Batch = dict[str, Float[Tensor, "b c h w"]]


class GroupDataset:
    """The groups of a data folder, packed and mapped into memory.

    Attributes:
        keys: the groups' keys, in order of shard and place.
        fingerprint: sha256 over the shards' hashes; equal fingerprints give equal sample streams.
        resolution: height and width of the pictures.
    """

    def __init__(
        self,
        folder: str | Path,
        shards: tuple[str, ...] | None = None,
        derived: bool = False,
    ) -> None:
        """Opens a folder; shards not used before are decoded once.

        Args:
            folder: as written by `unirender dataset`, with or without a recipe; it may still be growing.
            shards: names of the shards to use; None: all that are complete. A resumed training passes `shard_names` of
                the interrupted one, so that a folder that grew in between gives the same stream.
            derived: whether samples may have s and d derived from their light besides; takes one or two seconds
                for each group that was not derived before (`unirender.training.data.derived`).
        """
        self.folder = as_path(folder, "data")
        available = list_shards(self.folder)
        names = {path: path.relative_to(self.folder).as_posix() for path in available}
        if shards is not None:
            missing = sorted(set(shards) - set(names.values()))
            if missing:
                raise UnirenderError(
                    f"{folder}: {len(missing)} of the {len(shards)} shards that a run was trained on are missing "
                    f"(first: {missing[0]}), expected all; put them back, pass --data with all of them, or "
                    "another --out to start anew"
                )
            available = {path: sha256 for path, sha256 in available.items() if names[path] in shards}
        self._paths = tuple(available)
        self.shards: list[Shard] = [open_packed(path, sha256, names[path]) for path, sha256 in available.items()]
        self._derived: list[DerivedLight] | None = None
        sizes = {shard.shared.shape[-2:]: shard.name for shard in self.shards}
        if len(sizes) != 1:
            named = ", ".join(f"{width} x {height} ({name})" for (height, width), name in sorted(sizes.items()))
            raise UnirenderError(f"{folder}: pictures have the sizes {named}, expected one; make one folder per size")
        self.resolution: tuple[int, int] = next(iter(sizes))
        self._groups = [(shard, group) for shard in self.shards for group in shard.groups]
        self._shard_of = [number for number, shard in enumerate(self.shards) for _ in shard.groups]
        self.keys = tuple(group.key for _, group in self._groups)
        self._check_keys()
        basis = [i for i, (_, group) in enumerate(self._groups) if group.vary == "basis"]
        self._basis = {i: basis_rows(*self._groups[i]) for i in basis}
        self._items: list[tuple[int, Pair | None]] = []
        for i, (_, group) in enumerate(self._groups):
            self._items += [(i, None)] if i in self._basis else [(i, pair) for pair in group.pairs]
        self.fingerprint = hashlib.sha256(" ".join(shard.sha256 for shard in self.shards).encode()).hexdigest()
        if derived:  # the last, as it may take long: a folder that is refused is refused before
            self.derive()

    def __repr__(self) -> str:
        height, width = self.resolution
        return f"GroupDataset({self.folder}, {len(self.keys)} groups of {height} x {width} px)"

    def derive(self) -> None:
        """Opens s and d as derived from their light, and derives first what was not derived before."""
        self._derived = open_derived(list(zip(self._paths, self.shards, strict=True)))

    def _check_keys(self) -> None:
        """Looks for groups that are there twice; meshes of one name in two parts are two objects.

        Raises:
            UnirenderError: two groups of one folder have one key, or two of any have key, surface, materials and lights
                in common.
        """
        counts, where = Counter(self.keys), dict[tuple[str, str], str]()
        twice: list[str] = []
        for shard, group in self._groups:
            if counts[group.key] == 1:
                continue
            lights = sorted({pair.light for pair in group.pairs})
            content = shard.shared[group.shared].tobytes() + shard.environment[lights].tobytes()
            content += repr([(pair.metallic, pair.roughness) for pair in group.pairs]).encode()
            for same in (f"folder {shard.name.rpartition('/')[0]}", hashlib.sha256(content).hexdigest()):
                if (first := where.setdefault((group.key, same), shard.name)) != shard.name:
                    twice.append(f"{group.key} in {first}, {shard.name}")
                    break
        if twice:
            raise UnirenderError(
                f"{self.folder}: {len(twice)} groups occur twice ({twice[0]}), expected each key once in a folder and "
                "no copies; take one of the shards away, or render one set with another --seed"
            )

    @property
    def shard_names(self) -> tuple[str, ...]:
        return tuple(shard.name for shard in self.shards)

    @property
    def num_pairs(self) -> int:
        """Stored pictures."""
        return sum(len(group.pairs) for _, group in self._groups)

    @property
    def has_material_maps(self) -> bool:
        """Whether roughness and metallic of some pictures are maps, not one value over the object."""
        return any(pair.roughness is None for _, group in self._groups for pair in group.pairs)

    def __len__(self) -> int:
        """Items, the samples of an epoch: basis groups count once, other groups by their pairs."""
        return len(self._items)

    def pairs(self, group: int) -> tuple[Pair, ...]:
        """The stored pictures of group number `group`."""
        return self._groups[group][1].pairs

    def stored(self, group: int, pair: Pair) -> tuple[Float[np.ndarray, "h w 3"], Intrinsics]:
        """A stored pair as it is: premultiplied linear image and intrinsics (environment at the model's size)."""
        shard, entry = self._groups[group]
        maps = with_material(shared_maps(shard, entry), pair.metallic, pair.roughness)
        rows = {"image": pair.image, "specular": pair.specular, "diffuse": pair.diffuse}
        maps |= {name: trailing(shard.pixels[row]) for name, row in rows.items()}
        return from_maps(maps | {"environment": trailing(shard.environment[pair.light, 0])})

    def whole_light(self, group: int, pair: Pair) -> Float[np.ndarray, "eh ew 3"]:
        """The light of a stored pair as its tar has it; `stored` has it at the model's size.

        The lights of one shard are kept in memory: ask in the order of groups.
        """
        entry = self._groups[group][1]
        return self._whole_lights(self._shard_of[group])[entry.key][pair.light]

    @functools.lru_cache(maxsize=1)  # noqa: B019 - a dataset lives as long as what reads it
    def _whole_lights(self, shard: int) -> dict[str, dict[int, Float[np.ndarray, "eh ew 3"]]]:
        return dict(read_environments(self._paths[shard]))

    def sample(self, index: int, seed: int, augmentation: Augmentation) -> Maps:
        """Sample number `index` of the stream: `[h w c]` float32 maps by the names of a batch.

        It is where it was rendered: samples are moved with their batch.
        """
        return self.augmented(*self.drawn(index, seed, augmentation))

    def drawn(self, index: int, seed: int, augmentation: Augmentation) -> tuple[int, Pair | None, Draw]:
        """What sample number `index` of the stream is made of: the arguments of `augmented`."""
        epoch, place = divmod(index, len(self))
        group, pair = self._items[self._order(seed, epoch)[place]]
        rng = np.random.default_rng([seed, 1, index])
        basis = None if pair is not None else self._basis[group]
        lights, roughnesses = (len(basis.diffuse), len(basis.roughness)) if basis else (1, 1)
        return group, pair, draw(rng, augmentation, lights, roughnesses, len(self._groups))

    def augmented(self, group: int, pair: Pair | None, drawn: Draw) -> Maps:
        """A basis group (`pair` None) or a pair of another group under the augmentation `drawn`.

        For a pair, the draw's lights, roughness and metallic do not apply; its weights tint the light.
        """
        rows = self.rows(group, pair, drawn)
        shard, entry = self._groups[group]
        maps = shared_maps(shard, entry)
        nodes = np.stack([trailing(shard.pixels[of_node]) for of_node in rows.image.T])
        maps["image"] = nodes[0] if pair is not None else interpolate_metallic(nodes, drawn.metallic)
        maps |= {"specular": trailing(shard.pixels[rows.specular]), "diffuse": trailing(shard.pixels[rows.diffuse])}
        maps = mix_lights(with_material(maps, rows.metallic, rows.roughness), drawn.weights)
        if drawn.paint is not None:
            maps = repaint(maps, recoloured(maps["albedo"], maps["mask"], self.mean_colour(drawn.paint)))
        maps = quarter_turn(maps, drawn.turns)
        environment = shard.environment[rows.environment, drawn.turns]  # stored under each quarter turn
        maps |= mix_lights({"environment": trailing(environment)}, drawn.weights)
        maps = permute_channels(mirror(maps) if drawn.mirror else maps, drawn.order)
        factor = 1.0
        if drawn.exposure_target is not None:
            try:
                factor = exposure_factor(maps["diffuse"], maps["mask"], drawn.exposure_target)
            except UnirenderError as error:
                raise UnirenderError(f"{shard.name}: group {entry.key}: {error}") from error
        light = self._derived_light(rows, drawn) if drawn.derived else None
        return scale_light(maps, factor) | self._named_derived(light, drawn.shadowed, factor, maps["diffuse"])

    def rows(self, group: int, pair: Pair | None, drawn: Draw) -> SampleRows:
        """What `augmented` mixes, for the same arguments."""
        shared, number = self._groups[group][1].shared, self._shard_of[group]
        if pair is not None:
            s, d, light, image = (np.array([row]) for row in (pair.specular, pair.diffuse, pair.light, pair.image))
            return SampleRows(number, shared, image[None], s, d, light, pair.metallic, pair.roughness)
        basis, on, r = self._basis[group], list(drawn.lights), drawn.roughness_index
        s, d, light = basis.specular[on, r], basis.diffuse[on], basis.environment[on]
        return SampleRows(number, shared, basis.image[on, r], s, d, light, drawn.metallic, basis.roughness[r])

    def surface(self, group: int) -> Maps:
        """What the pictures of group number `group` share: albedo, normal, mask, and materials that are its own."""
        return shared_maps(*self._groups[group])

    @functools.cache  # noqa: B019 - a dataset lives as long as the training that reads it
    def mean_colour(self, group: int) -> Float[np.ndarray, " 3"]:
        """Of a group's object, as `unirender.training.augmentations.repaint` has it."""
        maps = self.surface(group)
        return mean_colour(maps["albedo"], maps["mask"])

    @property
    def derived(self) -> list[DerivedLight] | None:
        """Of each shard; None: the folder was opened without."""
        return self._derived

    def _derived_light(self, rows: SampleRows, drawn: Draw) -> Maps:
        """s and d as derived for what stands in `rows`, under the same augmentation but for the exposure.

        Raises:
            UnirenderError: the folder was opened without them.
        """
        if self._derived is None:
            raise UnirenderError("derived light was drawn, but the data was opened without it; pass derived=True")
        stored = self._derived[rows.shard]
        own = {name: stored.of(getattr(rows, name), drawn.shadowed) for name in ("specular", "diffuse")}
        maps = mix_lights({name: trailing(pixels) for name, pixels in own.items()}, drawn.weights)
        maps = quarter_turn(maps, drawn.turns)
        return permute_channels(mirror(maps) if drawn.mirror else maps, drawn.order)

    def _named_derived(self, light: Maps | None, shadowed: bool, factor: float, like: np.ndarray) -> Maps:
        """As a batch has it: zeros for a sample without it; nothing where the folder was opened without."""
        if self._derived is None:
            return {}
        scaled = {} if light is None else scale_light(light, factor)
        maps = {f"derived_{name}": scaled.get(name, np.zeros_like(like)) for name in ("specular", "diffuse")}
        flags = {"derived": light is not None, "shadowed": shadowed}
        return maps | {name: np.full((1, 1, 1), flag, dtype=np.float32) for name, flag in flags.items()}

    @functools.lru_cache(maxsize=4)  # noqa: B019 - a dataset lives as long as the training that reads it
    def _order(self, seed: int, epoch: int) -> Int[np.ndarray, " items"]:
        return np.random.default_rng([seed, 0, epoch]).permutation(len(self))


def make_batch(
    dataset: GroupDataset, first: int, size: int, seed: int, augmentation: Augmentation, rows: slice = ALL_ROWS
) -> Batch:
    """Samples `first` to `first + size` of the stream as float32 tensors; `rows`: these of them only."""
    drawn = [dataset.drawn(index, seed, augmentation) for index in range(first, first + size)[rows]]
    samples = [dataset.augmented(*each) for each in drawn]
    batch: Batch = {}
    derived = (*DERIVED_MAPS, *DERIVED_FLAGS) if "derived" in samples[0] else ()
    for name in (*BATCH_MAPS, *derived):
        height, width, channels = samples[0][name].shape
        stacked = np.empty((len(samples), channels, height, width), dtype=np.float32)
        for i, sample in enumerate(samples):
            stacked[i] = np.moveaxis(sample[name], -1, 0)
        batch[name] = torch.from_numpy(stacked)
    return moved(batch, [draw.move for _, _, draw in drawn])
