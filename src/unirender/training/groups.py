"""From WebDataset shards to packed groups: decode each EXR once, then index memory.

A shard is a tar whose samples are *groups*: an object under a few lights with its materials. Members of group KEY:
`KEY.shared.exr` (albedo, normal, mask), `KEY.l0.environment.exr`, `KEY.l0.diffuse.exr`, `KEY.l0.r030.specular.exr`,
`KEY.l0.m050_r030.exr` (the image; metallic and roughness in percent) and `KEY.json` (with `vary`). Where roughness and
metallic are the object's own maps, `KEY.shared.exr` holds them too, and a light has `KEY.l0.maps.specular.exr` and
`KEY.l0.maps.exr`.

Decoding the fifty EXRs of a group takes longer than a training step, so `open_packed` decodes a shard once into three
memory-mapped files under `${UNIRENDER_CACHE}/packed/<sha256 of the shard>`:

    pixels.npy       float16 [n, 3, h, w]          images, s and d
    shared.npy       float16 [groups, 7, h, w]     albedo, normal, mask; 9 with roughness and metallic maps
    environment.npy  float32 [lights, 4, 3, 16, 32]  the light at the model's size under 0 to 3 quarter turns
    index.json       which row is what
"""

import contextlib
import json
import re
import tarfile
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Float16

from unirender.errors import UnirenderError
from unirender.exr import HALF_MAX, Channels, channels_rgb, read_exr_bytes
from unirender.files import file_sha256
from unirender.paths import cache_dir, cached_folder
from unirender.training.environments import turned_environments

PACK_VERSION = 1  # part of the cache's path: raise it when the packed layout changes
ENVIRONMENT_SIZE = (16, 32)  # the environment that the model predicts

SCALAR_CHANNELS = 7  # of `Shard.shared` without maps of roughness and metallic

_LIGHT = re.compile(
    r"l(?P<light>\d+)\.(?:(?P<environment>environment)|(?P<diffuse>diffuse)|(?:r(?P<level>\d+)|maps)\.(?P<specular>specular)"
    r"|m(?P<metallic>\d+)_r(?P<roughness>\d+)|maps)\.exr"
)


@dataclass(frozen=True)
class Pair:
    """One picture of a group and the rows of its buffers in `Shard.pixels` (`light`: row of `Shard.environment`).

    Metallic and roughness are both None where they are the group's maps.
    """

    light: int
    metallic: float | None
    roughness: float | None
    image: int
    specular: int
    diffuse: int


@dataclass(frozen=True)
class Group:
    """An object under its lights; `shared` is a row of `Shard.shared`, `light_index[i]` names the light of pairs[i]."""

    key: str
    vary: str
    shared: int
    pairs: tuple[Pair, ...]


@dataclass(frozen=True)
class Shard:
    """A packed shard: arrays are read-only memory maps."""

    name: str
    sha256: str
    pixels: Float16[np.ndarray, "n 3 h w"]
    shared: Float16[np.ndarray, "g c h w"]
    environment: Float[np.ndarray, "l 4 3 16 32"]
    groups: tuple[Group, ...]


def list_shards(folder: str | Path) -> dict[Path, str | None]:
    """The complete shards of a data folder in order of name, each with the sha256 the manifest gives, if it lists it.

    The folder has shards itself, or is a training set in parts: its folders have them. Works while shards are still
    being written: a shard gets its `.tar` name when it is complete. A shard in which every mesh file failed, so that
    the manifest gives it no groups, is left out.

    Raises:
        UnirenderError: there is none, or one that the manifest lists is missing or of another size.
    """
    folder = Path(folder)
    parts = [folder] if _is_data(folder) else sorted(part for part in folder.glob("*/") if _is_data(part))
    found = {path: sha256 for part in parts for path, sha256 in _own_shards(part).items()}
    if not found:
        kind = "only shards without groups" if any(any(part.glob("*.tar")) for part in parts) else "no .tar shard found"
        raise UnirenderError(f"{folder}: {kind}, expected a folder written by `unirender dataset`")
    return found


def _is_data(folder: Path) -> bool:
    return (folder / "manifest.json").exists() or any(folder.glob("*.tar"))


def _own_shards(folder: Path) -> dict[Path, str | None]:
    """Those that lie in the folder itself.

    Raises:
        UnirenderError: a broken manifest, or one that lists a shard that is missing or of another size.
    """
    listed: dict[str, str] = {}
    sizes: dict[str, int] = {}
    empty: set[str] = set()
    manifest = folder / "manifest.json"
    if manifest.exists():
        try:
            journal = _journal_entries(folder / "shards.jsonl")  # first: the manifest takes its lines over
            entries = journal + json.loads(manifest.read_text())["shards"]
            listed = {entry["name"]: entry["sha256"] for entry in entries}
            sizes = {entry["name"]: int(entry["bytes"]) for entry in entries if "bytes" in entry}
            empty = {entry["name"] for entry in entries if entry.get("groups") == 0}
        except (ValueError, KeyError, TypeError) as error:
            raise UnirenderError(f"{manifest}: not a readable manifest ({error!r}); remake the dataset") from error
    present = {path.name: path for path in sorted(folder.glob("*.tar"))}
    missing = sorted(set(listed) - set(present))
    if missing:
        raise UnirenderError(f"{folder}: shards {', '.join(missing)} of the manifest are missing; remake the dataset")
    for name in sorted(sizes.keys() & present.keys()):
        if (size := present[name].stat().st_size) != sizes[name]:
            raise UnirenderError(
                f"{present[name]}: has {size:,} bytes, expected the {sizes[name]:,} of the manifest; run the same "
                "`unirender dataset` again, which renders it anew"
            )
    return {path: listed.get(name) for name, path in present.items() if name not in empty}


def _journal_entries(path: Path) -> list[dict[str, Any]]:
    """What a run that is writing has to add to its manifest, a line for each shard; one cut short does not count."""
    entries = []
    with contextlib.suppress(FileNotFoundError):
        for line in path.read_text().splitlines():
            with contextlib.suppress(json.JSONDecodeError):
                entries.append(json.loads(line))
    return entries


def read_groups(path: str | Path) -> Iterator[tuple[str, dict[str, bytes]]]:
    """Yields (key, members by name without the key) of a tar shard, in its order.

    Raises:
        UnirenderError: not a readable tar, or a member occurs twice (two groups would merge).
    """
    key, members, seen = "", {}, set()
    try:
        with tarfile.open(path, "r:") as tar:
            for info in tar:
                if not info.isfile():
                    continue
                name, _, rest = Path(info.name).name.partition(".")
                if name != key:
                    if members:
                        yield key, members
                    if name in seen:
                        raise UnirenderError(f"{path}: group {name} occurs twice, expected each key once")
                    key, members = name, {}
                    seen.add(name)
                if rest in members:
                    raise UnirenderError(f"{path}: member {info.name} occurs twice, expected each member once")
                stream = tar.extractfile(info)
                members[rest] = stream.read() if stream else b""
    except (tarfile.TarError, OSError) as error:
        raise UnirenderError(f"{path}: not a readable tar shard ({error})") from error
    if members:
        yield key, members


def read_environments(path: str | Path) -> Iterator[tuple[str, list[Float[np.ndarray, "eh ew 3"]]]]:
    """Yields (key, lights at their stored resolution, in the order of their rows in the packed shard) of a tar shard.

    Raises:
        UnirenderError: as `read_groups`, or a light is no readable EXR.
    """
    for key, members in read_groups(path):
        names = sorted(name for name in members if name.endswith(".environment.exr"))
        files = ((members[name], f"{path}: group {key}.{name}") for name in names)
        yield key, [channels_rgb(read_exr_bytes(data, name=name)[0]) for data, name in files]


def open_packed(path: str | Path, sha256: str | None = None, name: str | None = None) -> Shard:
    """Opens a shard for training, packing it first if that has not been done.

    Args:
        path: the tar.
        sha256: its hash as the manifest gives it: verified when the shard is packed, trusted afterwards.
        name: of the shard in its data folder; the file's if None.
    """
    path = Path(path)
    known = sha256 or file_sha256(path)
    folder = cache_dir() / "packed" / f"{known}-v{PACK_VERSION}"
    if not folder.exists():
        if sha256 is not None and (actual := file_sha256(path)) != sha256:
            raise UnirenderError(
                f"{path}: sha256 is {actual}, the manifest says {sha256}; delete the shard and remake the dataset"
            )
        _pack(path, folder)
    arrays = {}
    for array in ("pixels", "shared", "environment"):
        arrays[array] = np.asarray(np.load(folder / f"{array}.npy", mmap_mode="r"))  # a plain view of the memory map
    groups = tuple(
        Group(**{**group, "pairs": tuple(Pair(**pair) for pair in group["pairs"])})
        for group in json.loads((folder / "index.json").read_text())
    )
    return Shard(name=name or path.name, sha256=known, groups=groups, **arrays)


def _pack(path: Path, folder: Path) -> None:
    """Decodes a shard into `folder`, which appears when it is complete."""
    packer = _Packer(str(path))
    groups = [packer.add(key, members) for key, members in read_groups(path)]
    if not groups:
        raise UnirenderError(f"{path}: the shard has no groups; delete it and remake the dataset")
    with cached_folder(folder) as made:
        np.save(made / "pixels.npy", packer.stack(packer.pixels))
        np.save(made / "shared.npy", packer.stack(packer.shared))
        np.save(made / "environment.npy", np.stack(packer.environment))
        (made / "index.json").write_text(json.dumps([asdict(group) for group in groups]))


class _Packer:
    """Collects the rows of a shard's arrays."""

    def __init__(self, path: str) -> None:
        self.path = path
        self.pixels: list[Float16[np.ndarray, "3 h w"]] = []
        self.shared: list[Float16[np.ndarray, "7 h w"]] = []
        self.environment: list[Float[np.ndarray, "4 3 16 32"]] = []

    def add(self, key: str, members: dict[str, bytes]) -> Group:
        where = f"{self.path}: group {key}"
        rows: dict[tuple, int] = {}
        images: list[tuple[int, int | None, int | None]] = []  # light, metallic, roughness in percent
        lights: dict[int, int] = {}
        for name in sorted(members):
            if name in ("json", "shared.exr"):
                continue
            match = _LIGHT.fullmatch(name)
            if name == "visible.npy":
                raise UnirenderError(
                    f"{where}: has no pictures but {name}, which directions the object hides; `unirender "
                    "train-visibility` learns from that, `unirender train` from data of another --vary"
                )
            if match is None:
                raise UnirenderError(f"{where}: unknown member {name!r}; was it written by another version?")
            light = int(match["light"])
            channels, _ = read_exr_bytes(members[name], name=f"{where}.{name}")
            if match["environment"]:
                turned = turned_environments(channels_rgb(channels), ENVIRONMENT_SIZE)
                lights[light] = len(self.environment)
                self.environment.append(np.ascontiguousarray(np.moveaxis(turned, -1, 1)))
            elif match["diffuse"]:
                rows[light, "diffuse"] = self._row(channels, name, "diffuse")
            elif match["specular"]:
                rows[light, "specular", _percent(match["level"])] = self._row(channels, name, "specular")
            else:
                image = (light, _percent(match["metallic"]), _percent(match["roughness"]))
                rows[image] = self._row(channels, name, "")
                images.append(image)
        own_maps = any(metallic is None for _, metallic, _ in images)
        try:
            vary = json.loads(members["json"])["vary"]
            shared, _ = read_exr_bytes(members["shared.exr"], name=f"{where}.shared.exr")
            pairs = tuple(
                Pair(
                    light=lights[light],
                    metallic=None if metallic is None else metallic / 100,
                    roughness=None if roughness is None else roughness / 100,
                    image=rows[light, metallic, roughness],
                    specular=rows[light, "specular", roughness],
                    diffuse=rows[light, "diffuse"],
                )
                for light, metallic, roughness in sorted(images, key=lambda image: tuple(part or 0 for part in image))
            )
        except KeyError as error:
            raise UnirenderError(f"{where}: member or entry {error} is missing; remake the dataset") from error
        maps = [
            channels_rgb(shared, "albedo"),
            channels_rgb(shared, "normal", "XYZ"),
            channels_rgb(shared, "mask", "Y"),
        ]
        if own_maps:
            maps += [channels_rgb(shared, "roughness", "Y"), channels_rgb(shared, "metallic", "Y")]
        self.shared.append(np.moveaxis(np.concatenate(maps, axis=-1), -1, 0).astype(np.float16))
        return Group(key=key, vary=vary, shared=len(self.shared) - 1, pairs=pairs)

    def _row(self, channels: Channels, name: str, prefix: str) -> int:
        rgb = channels_rgb(channels, prefix if f"{prefix}.R" in channels else "")
        if not np.isfinite(rgb).all() or np.abs(rgb).max() > HALF_MAX:
            raise UnirenderError(f"{self.path}: {name}: values are not finite or overflow half precision")
        self.pixels.append(np.moveaxis(rgb, -1, 0).astype(np.float16))
        return len(self.pixels) - 1

    def stack(self, rows: list[np.ndarray]) -> np.ndarray:
        sizes = {row.shape for row in rows}
        if len(sizes) != 1:
            raise UnirenderError(f"{self.path}: pictures have sizes {sorted(sizes)}, expected one size")
        return np.stack(rows)


def _percent(digits: str | None) -> int | None:
    return None if digits is None else int(digits)
