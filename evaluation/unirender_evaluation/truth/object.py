"""Renders everything that a suite's truth holds of one object; what one worker process does."""

import hashlib
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from unirender.exr import exr_bytes, intrinsics_channels
from unirender_evaluation.suites.objects import ObjectSource
from unirender_evaluation.suites.spec import SuiteSpec
from unirender_evaluation.suites.stratification import Material
from unirender_evaluation.suites.suite import Scene
from unirender_evaluation.suites.truth_file import (
    CEILING,
    Kind,
    diffuse_member,
    estimate_channels,
    image_member,
    shared_member,
    specular_member,
    write_tar,
)
from unirender_evaluation.truth.render import good_spp, item_seed, render_to_ceiling, stored_ceiling_db
from unirender_reference.noise import noise_floor_db
from unirender_reference.scene_spec import object_hash

__all__ = ["PART", "ObjectJob", "object_hash", "render_object"]

PART = "part.json"
Environment = Float[np.ndarray, "eh ew 3"]
Mask = Float[np.ndarray, "h w 1"]


@dataclass(frozen=True)
class ObjectJob:
    """Everything that one worker needs: where the object is from; `lights` are (name, turn in columns) and `materials`
    the stratified ones of each scene; `environments` are its lights by name; the finished part goes to the folder
    `out`."""

    spec: SuiteSpec
    source: ObjectSource
    lights: tuple[tuple[str, int], ...]
    environments: dict[str, Environment]
    materials: tuple[tuple[Material, ...], ...]
    out: Path


@dataclass(frozen=True)
class _Buffer:
    """An image, s or d that has to be rendered: `render` takes (samples per pixel, seed)."""

    name: str
    kind: Kind
    render: Callable[[int, int], Any]
    attributes: dict[str, str]
    has_twin: bool = False  # a near-noise-free one, for scenes in `ceiling_scenes`


def render_object(job: ObjectJob) -> Path:
    """Renders all members of one object into `<out>/<object>-<hash>.tar`; returns at once if that file exists.

    The hash is over the object's arrays and file and over its lights, turns and materials: which ones an object gets
    follows from how many objects the suite has, which a folder of meshes changes and the suite's file does not say.

    Raises:
        UnirenderError: the object cannot be loaded, or not be seen.
    """
    from unirender_reference.render import Renderer, renderer_provenance, shared_scene_hash

    spec = job.spec
    obj = job.source.load()
    made_of = {**job.source.provenance(), "sha256": object_hash(obj)}
    given = json.dumps([made_of, job.lights, job.materials], sort_keys=True)
    path = job.out / f"{obj.name}-{hashlib.sha256(given.encode()).hexdigest()[:12]}.tar"
    if path.exists():
        return path
    renderer = Renderer(obj, camera=spec.camera, resolution=spec.resolution)
    header = renderer_provenance(renderer)
    name = obj.name.replace(".", "-")
    seed = item_seed(spec.name, name, "geometry")
    geometry = renderer.geometry(spec.geometry_spp, seed)
    mask = geometry.require("mask")["mask"]
    members: dict[str, bytes] = {}
    scenes, quality, hashes = [], {}, {}
    for index, (light, turn) in enumerate(job.lights):
        key = f"{name}_l{index}"
        scene, environment, hash_of = _light_scene(renderer, job, key, light, turn, job.materials[index])
        scenes.append(asdict(scene))
        hashes[key] = list(hash_of.values())
        twins = (job.source.name, index) in spec.ceiling_scenes
        for buffer in _buffers(renderer, spec, scene, environment, hash_of):
            members[buffer.name], quality[buffer.name] = _member(buffer, spec, mask, header)
            if twins and buffer.has_twin:
                spp = good_spp(spec.ceiling_factor * quality[buffer.name]["spp"], spec)
                members[CEILING + buffer.name] = _twin_member(buffer, spec, spp, mask, header)
    shared = {**header, "spp": str(spec.geometry_spp), "seed": str(seed)}
    shared["scene"] = shared_scene_hash(h for own in hashes.values() for h in own)
    members[shared_member(name)] = exr_bytes(intrinsics_channels(geometry), attributes=shared)
    part = {
        "header": header,
        "scenes": scenes,
        "hashes": hashes,
        "quality": quality,
        "object": {name: made_of},
    }
    members[PART] = json.dumps(part).encode()
    write_tar(path, members)
    return path


def _light_scene(
    renderer: Any, job: ObjectJob, key: str, light: str, turn: int, materials: Sequence[Material]
) -> tuple[Scene, Environment, dict[Material, str]]:
    """The scene, its exposed light, and the scene hash of each of its materials."""
    from unirender_reference.exposure import scene_exposure
    from unirender_reference.lights import Light
    from unirender_reference.render import SceneSpec, scene_hashes

    spec, obj = job.spec, renderer.obj
    turned = np.roll(job.environments[light], turn, axis=1)
    gauge = item_seed(spec.name, key, "gauge")
    exposure = float(np.float32(scene_exposure(renderer, turned, gauge)))
    textured = np.ndim(obj.albedo) == 3
    scene = Scene(key, obj.name.replace(".", "-"), obj.family, textured, light, turn, exposure, tuple(materials))
    pairs, lit = list(dict.fromkeys([spec.base, *spec.edits, *materials])), Light(light, turned)
    specs = [SceneSpec(obj, lit, r, m, spec.camera, spec.resolution, gauge) for m, r in pairs]
    hash_of = dict(zip(pairs, scene_hashes(specs), strict=True))
    return scene, turned * np.float32(exposure), hash_of


def _buffers(
    renderer: Any, spec: SuiteSpec, scene: Scene, environment: Environment, hash_of: dict[Material, str]
) -> Iterator[_Buffer]:
    """d, s at the suite's roughness values, and the images of a scene."""
    from unirender_reference.render import DIRECT_DEPTH, IMAGE_DEPTH, shared_scene_hash

    common = {
        "light": scene.light,
        "turn_columns": str(scene.turn_columns),
        "exposure_factor": repr(scene.exposure),
        "batches": str(spec.batches),
    }

    def diffuse(spp: int, seed: int) -> Any:
        return renderer.diffuse(environment, spp, seed, spec.batches)

    direct = {**common, "depth": str(DIRECT_DEPTH)}
    whole = {**direct, "scene": shared_scene_hash(hash_of.values())}
    yield _Buffer(diffuse_member(scene.key), "diffuse", diffuse, whole, has_twin=True)
    for roughness in spec.specular_roughness:

        def specular(spp: int, seed: int, roughness: float = roughness) -> Any:
            return renderer.specular(environment, roughness, spp, seed, spec.batches)

        scenes = shared_scene_hash(h for (_, r), h in hash_of.items() if r == roughness)
        attributes = {**direct, "roughness": f"{roughness:g}", "scene": scenes}
        name, is_base = specular_member(scene.key, roughness), roughness == spec.base[1]
        yield _Buffer(name, "specular", specular, attributes, has_twin=is_base)
    for (m, r), own in hash_of.items():

        def image(spp: int, seed: int, m: float = m, r: float = r) -> Any:
            return renderer.image(environment, r, m, spp, seed, batches=spec.batches)

        attributes = {**common, "depth": str(IMAGE_DEPTH), "metallic": f"{m:g}", "roughness": f"{r:g}", "scene": own}
        yield _Buffer(image_member(scene.key, (m, r)), "image", image, attributes, (m, r) in (spec.base, *spec.edits))


def _member(buffer: _Buffer, spec: SuiteSpec, mask: Mask, header: Mapping[str, str]) -> tuple[bytes, dict[str, Any]]:
    """A buffer rendered to the suite's ceiling, as an EXR; and the samples, the ceiling and the NaN pixels it had."""
    seed = item_seed(spec.name, buffer.name)
    found, channels = render_to_ceiling(buffer.render, mask, spec, seed, buffer.kind)
    ceiling = stored_ceiling_db(channels, mask, buffer.kind)
    made = _made(buffer, found.spp, found.nan_pixels, ceiling, seed)
    quality = {"spp": found.spp, "ceiling_db": round(ceiling, 3), "nan_pixels": found.nan_pixels}
    return exr_bytes(channels, attributes={**header, **made}), quality


def _twin_member(buffer: _Buffer, spec: SuiteSpec, spp: int, mask: Mask, header: Mapping[str, str]) -> bytes:
    """A buffer's near-noise-free twin as an EXR: other noise and more samples, and no variance beside it."""
    seed = item_seed(spec.name, CEILING, buffer.name)
    twin = buffer.render(spp, seed)
    mean, variance = (x[..., :3].astype(np.float64) for x in (twin.mean, twin.variance))
    ceiling = noise_floor_db(mean, variance, mask, buffer.kind == "image")
    made = _made(buffer, spp, twin.nan_pixels, ceiling, seed)
    return exr_bytes(estimate_channels(buffer.kind, mean, None, mask), attributes={**header, **made})


def _made(buffer: _Buffer, spp: int, nan_pixels: int, ceiling_db: float, seed: int) -> dict[str, str]:
    """The attributes of a member that tell one render from another."""
    return {
        **buffer.attributes,
        "spp": str(spp),
        "seed": str(seed),
        "nan_pixels": str(nan_pixels),
        "noise_ceiling_db": f"{ceiling_db:.3f}",
    }
