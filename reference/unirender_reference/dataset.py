"""Generates a data set: renders groups in worker processes and stores them as shards.

Mitsuba scales badly over threads at 64 pixels (a wavefront lasts tens of milliseconds), so every worker is one process
with one thread that renders whole groups and encodes its EXR files; the parent only writes tars, in the order of the
plan.
"""

import json
import multiprocessing
import os
import time
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass

import numpy as np

from unirender.errors import UnirenderError
from unirender.exr import exr_bytes, image_channels, intrinsics_channels
from unirender_reference import backend, exposure
from unirender_reference.lights import make_light
from unirender_reference.passes import derive_seed
from unirender_reference.plan import SHARD_GROUPS, DatasetConfig, GroupPlan, plan_groups
from unirender_reference.processes import exit_with_parent
from unirender_reference.render import Renderer, SceneSpec, renderer_provenance, scene_hashes, shared_scene_hash
from unirender_reference.shapes import make_object
from unirender_reference.shards import ShardRecord, finished_shards, shard_name, write_manifest, write_shard

AHEAD = 3  # groups under way per worker
GEOMETRY_SPP = 64  # multi-jittered: coverage to about 1/64
Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class RenderedGroup:
    """A group ready to be stored: its key, its members by name, what it cost."""

    key: str
    members: dict[str, bytes]
    samples: int
    nan_pixels: int
    render_seconds: float
    seconds: float


@dataclass(frozen=True)
class GenerateReport:
    """What a call of `generate` did (shards of earlier calls are not counted).

    Attributes:
        groups, samples: rendered and stored now.
        skipped_shards: found complete.
        seconds: wall time.
        render_seconds: sum of the seconds inside `mi.render`, over all workers.
        workers: processes that rendered.
        overhead: `seconds * workers / render_seconds`: 1 is a generator that does nothing but render.
        manifest_sha256: of the manifest written.
    """

    groups: int
    samples: int
    skipped_shards: int
    seconds: float
    render_seconds: float
    workers: int
    overhead: float
    nan_pixels: int
    manifest_sha256: str


def generate(config: DatasetConfig, progress: Progress | None = None) -> GenerateReport:
    """Writes the data set, or what is missing of it.

    Args:
        config: what to generate.
        progress: called with (groups done, groups in all) whenever a group is finished.

    Raises:
        UnirenderError: the folder is unusable or holds another data set, or a render failed.
    """
    start = time.perf_counter()
    if config.out.exists() and not config.out.is_dir():
        raise UnirenderError(f"{config.out}: is a file, expected a folder to write shards to; choose another --out")
    try:
        config.out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UnirenderError(f"{config.out}: cannot be made ({error.strerror}); choose another --out") from error
    backend.find_llvm()  # a clear error here rather than in a worker
    groups = plan_groups(config)
    content = {**config.content(), "shard_groups": SHARD_GROUPS}
    chunks = [groups[i : i + SHARD_GROUPS] for i in range(0, len(groups), SHARD_GROUPS)]
    shards = {shard_name(i): plans for i, plans in enumerate(chunks)}
    done = finished_shards(config.out, content, {name: len(plans) for name, plans in shards.items()})
    todo = {name: plans for name, plans in shards.items() if name not in done}
    skipped, count = len(done), len(groups) - sum(len(plans) for plans in todo.values())
    workers = min(config.workers or os.cpu_count() or 1, max(1, sum(len(plans) for plans in todo.values())))
    samples = nan_pixels = rendered = 0
    render_seconds = 0.0
    if progress:
        progress(count, len(groups))
    results = _render_groups(config, [plan for plans in todo.values() for plan in plans], workers)
    for name, plans in todo.items():
        finished: list[RenderedGroup] = []
        for group in (next(results) for _ in plans):
            finished.append(group)
            count += 1
            if progress:
                progress(count, len(groups))
        sha256 = write_shard(config.out / name, ((group.key, group.members) for group in finished))
        done[name] = ShardRecord(
            name=name,
            sha256=sha256,
            bytes=(config.out / name).stat().st_size,
            groups=len(finished),
            samples=sum(group.samples for group in finished),
            nan_pixels=sum(group.nan_pixels for group in finished),
        )
        write_manifest(config.out, content, done.values(), complete=False)
        rendered += len(finished)
        samples += done[name].samples
        nan_pixels += done[name].nan_pixels
        render_seconds += sum(group.render_seconds for group in finished)
    manifest_sha256 = write_manifest(config.out, content, done.values(), complete=True)
    seconds = time.perf_counter() - start
    overhead = seconds * workers / render_seconds if render_seconds else float("nan")
    return GenerateReport(
        rendered, samples, skipped, seconds, render_seconds, workers, overhead, nan_pixels, manifest_sha256
    )


def render_group(config: DatasetConfig, plan: GroupPlan) -> RenderedGroup:
    """Renders and encodes one group; a pure function of its arguments."""
    start = time.perf_counter()
    obj = make_object(plan.object_seed, config.split)
    renderer = Renderer(obj, resolution=config.resolution)
    geometry = renderer.geometry(GEOMETRY_SPP, derive_seed(plan.render_seed, "shared"))
    assert geometry.mask is not None
    covered = geometry.mask > 0
    header = {**renderer_provenance(renderer), "spp": str(config.spp), "seed": str(plan.render_seed)}
    drawn = [make_light(light_plan.seed, config.split) for light_plan in plan.lights]
    specs = {
        (i, r, m): SceneSpec(obj, light, r / 100, m / 100, renderer.camera, config.resolution, light_plan.exposure_seed)
        for i, (light, light_plan) in enumerate(zip(drawn, plan.lights, strict=True))
        for r, m in light_plan.pairs
    }
    scenes = dict(zip(specs, scene_hashes(specs.values()), strict=True))
    shared = {**header, "spp": str(GEOMETRY_SPP), "scene": shared_scene_hash(scenes.values())}
    members = {"shared.exr": exr_bytes(intrinsics_channels(geometry), attributes=shared)}
    lights = []
    for i, (light, light_plan) in enumerate(zip(drawn, plan.lights, strict=True)):
        own = {pair: scenes[i, *pair] for pair in light_plan.pairs}
        factor = exposure.scene_exposure(renderer, light.environment, light_plan.exposure_seed)
        environment = (light.environment * np.float32(factor)).astype(np.float32)
        attributes = {**header, "light": light.name, "exposure_factor": repr(factor)}
        lit = {**attributes, "scene": shared_scene_hash(own.values())}
        members[f"l{i}.environment.exr"] = exr_bytes(image_channels(environment), half=False, attributes=lit)
        seed = derive_seed(plan.render_seed, "light", i)
        diffuse = np.where(covered, renderer.diffuse(environment, config.spp, seed, batches=1).mean, 0)
        members[f"l{i}.diffuse.exr"] = _buffer("diffuse", diffuse, lit)
        for r in dict.fromkeys(pair[0] for pair in light_plan.pairs):
            s_seed = derive_seed(seed, r)
            specular = renderer.specular(environment, r / 100, config.spp, s_seed, batches=1).mean
            rough = {**attributes, "scene": shared_scene_hash(own[pair] for pair in own if pair[0] == r)}
            members[f"l{i}.r{r:03d}.specular.exr"] = _buffer("specular", np.where(covered, specular, 0), rough)
        for r, m in light_plan.pairs:
            image = renderer.image(environment, r / 100, m / 100, config.spp, derive_seed(seed, r, m), batches=1)
            scene = {**attributes, "scene": own[r, m]}
            members[f"l{i}.m{m:03d}_r{r:03d}.exr"] = exr_bytes(image_channels(image.mean), attributes=scene)
        lights.append(
            {
                "name": light.name,
                "seed": light_plan.seed,
                "exposure_factor": factor,
                "exposure_seed": light_plan.exposure_seed,
                "pairs": light_plan.pairs,
                "provenance": dict(light.provenance),
            }
        )
    key = f"{obj.name}_g{plan.number}"
    record = {
        **header,
        "family": obj.family,
        "vary": config.vary,
        "shares": plan.shares,
        "camera": {"fov_deg": renderer.camera.fov_deg, "principal": list(renderer.camera.principal)},
        "coverage": round(float(geometry.mask.mean()), 6),
        "lights": lights,
        "nan_pixels": renderer.counters.nan_pixels,
        "object_provenance": dict(obj.provenance),
    }
    members["json"] = json.dumps(record, sort_keys=True).encode()
    counters = renderer.counters
    seconds = time.perf_counter() - start
    return RenderedGroup(key, members, plan.samples, counters.nan_pixels, counters.render_seconds, seconds)


def _buffer(name: str, value: np.ndarray, attributes: dict[str, str]) -> bytes:
    channels = {f"{name}.{component}": value[..., i] for i, component in enumerate("RGB")}
    return exr_bytes(channels, attributes=attributes)


def _render_groups(config: DatasetConfig, plans: list[GroupPlan], workers: int) -> Iterator[RenderedGroup]:
    """Renders groups in `workers` processes; yields them in order, a bounded number ahead."""
    if not plans:
        return
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(workers, mp_context=context, initializer=_start_worker) as pool:
        under_way: deque[Future[RenderedGroup]] = deque()
        try:
            for plan in plans:
                under_way.append(pool.submit(render_group, config, plan))
                if len(under_way) >= workers * AHEAD:
                    yield under_way.popleft().result()
            while under_way:
                yield under_way.popleft().result()
        except BrokenProcessPool as error:
            raise UnirenderError(
                "dataset: a worker process died (out of memory?); complete shards are kept, run the same command again"
            ) from error
        finally:
            for future in under_way:
                future.cancel()


def _start_worker() -> None:
    """One thread per worker; a worker ends with its parent, even if that is killed."""
    exit_with_parent()
    backend.set_threads(1)
