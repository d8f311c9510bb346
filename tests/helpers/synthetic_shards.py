"""Tiny group shards with the dataset's member names and closed-form pictures, for tests of the reader."""

import hashlib
import io
import json
import tarfile
from pathlib import Path

import numpy as np

from unirender.composite import composite
from unirender.exr import exr_bytes, image_channels, intrinsics_channels
from unirender.intrinsics import Intrinsics
from unirender.light.surface_light import diffuse_light, specular_light


def sphere(size: int, rng: np.random.Generator) -> Intrinsics:
    """Albedo, normal and mask of an orthographic ball with a random base colour gradient."""
    axis = (np.arange(size) + 0.5) / size * 2 - 1
    x, y = np.meshgrid(axis * 1.25, -axis * 1.25)
    inside = x**2 + y**2 < 1
    normal = np.stack([x, y, np.sqrt(np.maximum(1 - x**2 - y**2, 0))], axis=-1) * inside[..., None]
    albedo = np.clip(rng.uniform(0.2, 0.8, 3) + 0.2 * x[..., None], 0, 1) * inside[..., None]
    return Intrinsics(albedo=albedo, normal=normal, mask=inside[..., None])


def own_picture(seed: int, size: int = 16) -> tuple[np.ndarray, Intrinsics]:
    """A ball with roughness and metallic maps: its picture (h, w, 4), premultiplied, and all maps."""
    rng = np.random.default_rng(seed)
    shape = sphere(size, rng)
    albedo, normal, mask = shape.require("albedo", "normal", "mask").values()
    ramp = np.broadcast_to(np.linspace(0.1, 0.9, size, dtype=np.float32)[:, None], (size, size, 1)) * mask
    environment = rng.uniform(0, 2, (16, 32, 3)).astype(np.float32)
    light = {"diffuse": diffuse_light(normal, environment), "specular": specular_light(normal, 0.5, environment)}
    maps = shape.replace(roughness=ramp, metallic=ramp[::-1], environment=environment, **light)
    image = composite(albedo, ramp[::-1], light["diffuse"], light["specular"]) * mask
    return np.concatenate([image, mask], axis=-1), maps


def group_members(
    vary: str, size: int, lights: int, roughness: tuple[int, ...], metallic: tuple[int, ...], seed: int
) -> dict[str, bytes]:
    """Members of one group; materials in percent."""
    rng = np.random.default_rng(seed)
    shape = sphere(size, rng)
    albedo, normal, mask = shape.require("albedo", "normal", "mask").values()
    members = {"shared.exr": exr_bytes(intrinsics_channels(shape)), "json": json.dumps({"vary": vary}).encode()}
    for light in range(lights):
        environment = rng.uniform(0, 2, (8, 16, 3)).astype(np.float32)
        diffuse = diffuse_light(normal, environment)
        members[f"l{light}.environment.exr"] = exr_bytes(image_channels(environment), half=False)
        members[f"l{light}.diffuse.exr"] = exr_bytes(intrinsics_channels(Intrinsics(diffuse=diffuse)))
        for r in roughness:
            specular = specular_light(normal, max(r / 100, 0.4), environment)
            members[f"l{light}.r{r:03d}.specular.exr"] = exr_bytes(intrinsics_channels(Intrinsics(specular=specular)))
            for m in metallic:
                image = composite(albedo, np.float32(m / 100), diffuse, specular) * mask
                rgba = np.concatenate([image, mask], axis=-1)
                members[f"l{light}.m{m:03d}_r{r:03d}.exr"] = exr_bytes(image_channels(rgba))
    return members


def maps_members(size: int, lights: int, seed: int) -> dict[str, bytes]:
    """Members of a group whose roughness and metallic are the object's own maps: a picture for each light."""
    rng = np.random.default_rng(seed)
    shape = sphere(size, rng)
    albedo, normal, mask = shape.require("albedo", "normal", "mask").values()
    ramp = np.linspace(0.1, 0.9, size, dtype=np.float32)
    roughness, metallic = (np.broadcast_to(v, (size, size))[..., None] * mask for v in (ramp, ramp[::-1, None]))
    shared = shape.replace(roughness=roughness, metallic=metallic)
    members = {"shared.exr": exr_bytes(intrinsics_channels(shared)), "json": b'{"vary": "independent"}'}
    for light in range(lights):
        environment = rng.uniform(0, 2, (8, 16, 3)).astype(np.float32)
        diffuse, specular = diffuse_light(normal, environment), specular_light(normal, 0.5, environment)
        members[f"l{light}.environment.exr"] = exr_bytes(image_channels(environment), half=False)
        members[f"l{light}.diffuse.exr"] = exr_bytes(intrinsics_channels(Intrinsics(diffuse=diffuse)))
        members[f"l{light}.maps.specular.exr"] = exr_bytes(intrinsics_channels(Intrinsics(specular=specular)))
        image = composite(albedo, metallic, diffuse, specular) * mask
        members[f"l{light}.maps.exr"] = exr_bytes(image_channels(np.concatenate([image, mask], axis=-1)))
    return members


def write_shard(path: Path, groups: dict[str, dict[str, bytes]]) -> None:
    with tarfile.open(path, "w") as tar:
        for key, members in groups.items():
            for name, data in members.items():
                info = tarfile.TarInfo(f"{key}.{name}")
                info.size = len(data)
                tar.addfile(info, io.BytesIO(data))


def write_dataset(
    folder: Path,
    vary: str = "basis",
    shards: int = 2,
    groups: int = 2,
    size: int = 16,
    lights: int = 2,
    roughness: tuple[int, ...] = (40, 70),
    metallic: tuple[int, ...] = (0, 50, 100),
) -> Path:
    """A data folder with a manifest."""
    folder.mkdir(parents=True, exist_ok=True)
    entries = []
    for shard in range(shards):
        path = folder / f"shard-{shard:06d}.tar"
        keys = [f"train-{shard * groups + i:06d}_g0" for i in range(groups)]
        write_shard(
            path,
            {
                key: group_members(vary, size, lights, roughness, metallic, shard * groups + i)
                for i, key in enumerate(keys)
            },
        )
        entries.append({"name": path.name, "sha256": hashlib.sha256(path.read_bytes()).hexdigest()})
    (folder / "manifest.json").write_text(json.dumps({"shards": entries}))
    return folder
