"""Making a suite's truth.

`make_truth` renders every image of a suite until a *noise-free* prediction could score `target_db` against it (the
noise ceiling), object by object so that a killed run resumes.

The noise ceiling is computed in `ceiling` (delta method).
"""

import hashlib
import io
import json
import math
import os
import re
import tarfile
import tempfile
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from unirender.errors import UnirenderError
from unirender.exr import exr_bytes, intrinsics_channels
from unirender.lighting import resample_environment
from unirender_evaluation.ceiling import noise_mse
from unirender_evaluation.metrics import Variant, psnr_from_mse
from unirender_evaluation.suites import STD_FLOOR, Material, Scene, Suite, SuiteSpec, material_key, read_spec

STD_MANTISSA_BITS = (
    4  # of the stored standard deviation: 3 % steps, far inside its own sampling error, and it compresses
)
MARGIN_DB = 0.15  # aimed at above the target, so that few images need a third render
Map = Float[np.ndarray, "h w c"]


def noise_ceiling_db(mean: Map, variance: Map, mask: Float[np.ndarray, "h w 1"], premultiplied: bool) -> float:
    """Masked sRGB PSNR in dB that a noise-free prediction would score against `mean` (see `ceiling`); inf without
    noise."""
    return psnr_from_mse(noise_mse(mean, variance, mask, Variant("masked", "srgb", "raw"), premultiplied))


def item_seed(*parts: Any) -> int:
    """A render seed that is a pure function of what is rendered."""
    digest = hashlib.sha256("/".join(map(str, parts)).encode()).digest()
    return int.from_bytes(digest[:4], "little") & 0x3FFFFFFF


def good_spp(wanted: float, batches: int) -> int:
    """The least samples per pixel >= `wanted` that are `batches` full multi-jittered grids."""
    size = max(math.ceil(wanted / batches), 1)
    while size % math.isqrt(size):
        size += 1
    return batches * size


def render_to_ceiling(
    render: Callable[[int, int], Any], mask: Float[np.ndarray, "h w 1"], spec: SuiteSpec, seed: int, is_image: bool
) -> tuple[Map, Map, int, float]:
    """Adds samples until the noise ceiling reaches the suite's target, or the samples `spec.max_spp`.

    The error falls as 1 / samples, so that the first estimate says how many are missing.

    Args:
        render: (spp, seed) -> estimate with `.mean` and `.variance` (of the mean).
        mask: coverage.
        spec: gives target, limit, batches and the samples to begin with.
        seed: of the first render; each further one takes the next.
        is_image: an image, premultiplied by coverage; else s or d, which are not.

    Returns:
        mean, variance of the mean, samples per pixel, ceiling in dB.
    """
    first, target = (spec.spp, spec.target_db) if is_image else (spec.light_spp, spec.light_target_db)
    spp = good_spp(first, spec.batches)
    estimate = render(spp, seed)
    mean, variance = estimate.mean[..., :3].astype(np.float64), estimate.variance[..., :3].astype(np.float64)
    ceiling, index = noise_ceiling_db(mean, variance, mask, is_image), 0
    while ceiling < target and spp < spec.max_spp:
        missing = min(spp * 10 ** ((target + MARGIN_DB - ceiling) / 10), spec.max_spp) - spp
        more, index = good_spp(missing, spec.batches), index + 1
        estimate = render(more, seed + index)
        share = more / (spp + more)
        mean = (1 - share) * mean + share * estimate.mean[..., :3]
        variance = (1 - share) ** 2 * variance + share**2 * estimate.variance[..., :3]
        spp, ceiling = spp + more, noise_ceiling_db(mean, variance, mask, is_image)
    return mean.astype(np.float32), variance.astype(np.float32), spp, ceiling


def _relative_std(mean: Map, variance: Map) -> Map:
    relative = np.sqrt(variance) / np.maximum(np.abs(mean), STD_FLOOR)
    mantissa, exponent = np.frexp(relative)
    return np.ldexp(np.round(mantissa * 2**STD_MANTISSA_BITS) / 2**STD_MANTISSA_BITS, exponent).astype(np.float32)


def _estimate_channels(mean: Map, variance: Map) -> dict[str, np.ndarray]:
    mean = mean.astype(np.float16).astype(np.float32)  # the std is relative to what is stored
    std = _relative_std(mean, variance)
    return {c: mean[..., i] for i, c in enumerate("RGB")} | {f"std.{c}": std[..., i] for i, c in enumerate("RGB")}


def suite_lights(spec: SuiteSpec) -> dict[str, Float[np.ndarray, "h w 3"]]:
    """The suite's pool of lights by name, brought to `light_rows`."""
    from unirender_reference.lights import bundled_lights, make_light

    bundled = sorted(bundled_lights(spec.split), key=lambda light: light.name)[: spec.bundled_lights]
    lights = bundled + [make_light(seed, spec.split) for seed in spec.procedural_lights]
    shape = (spec.light_rows, 2 * spec.light_rows)
    return {light.name.replace(".", "-"): resample_environment(light.environment, shape) for light in lights}


def assign_lights(spec: SuiteSpec, names: list[str]) -> list[tuple[str, int]]:
    """(light, turn in columns) of every scene, objects outermost.

    All lights are used about equally often, those of one object differ, and every scene has its own turn about +y.
    """
    per_object, count = spec.lights_per_object, len(spec.objects) * spec.lights_per_object
    if len(names) < per_object:
        raise UnirenderError(
            f"suite {spec.name!r}: got {len(names)} lights, expected at least {per_object} (lights_per_object)"
        )
    rng = np.random.default_rng(spec.assignment_seed)
    while True:
        order = np.concatenate([rng.permutation(len(names)) for _ in range(-(-count // len(names)))])[:count]
        if all(len(set(row)) == per_object for row in order.reshape(-1, per_object)):
            break
    turns = rng.integers(0, 2 * spec.light_rows, count)
    return [(names[i], int(turn)) for i, turn in zip(order, turns, strict=True)]


@dataclass(frozen=True)
class ObjectJob:
    """Everything one worker needs to render one object."""

    spec: SuiteSpec
    seed: int
    lights: tuple[tuple[str, int], ...]
    environments: dict[str, Float[np.ndarray, "h w 3"]]
    materials: tuple[tuple[Material, ...], ...]
    out: Path


def object_hash(obj: Any) -> str:
    """sha256 over an object's geometry and texture."""
    digest = hashlib.sha256()
    for array in (obj.vertices, obj.faces, obj.normals, obj.uv, obj.albedo):
        digest.update(b"none" if array is None else np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()


def render_object(job: ObjectJob) -> Path:
    """Renders all members of one object into `<out>/<seed>-<object hash>.tar`; returns at once if that file exists."""
    from unirender_reference.exposure import scene_exposure
    from unirender_reference.render import Renderer
    from unirender_reference.shapes import make_object

    spec = job.spec
    obj = make_object(job.seed, spec.split)
    path = job.out / f"{job.seed}-{object_hash(obj)[:12]}.tar"
    if path.exists():
        return path
    renderer = Renderer(obj, camera=spec.camera, resolution=spec.resolution)
    name = obj.name.replace(".", "-")
    geometry = renderer.geometry(spec.geometry_spp, item_seed(spec.name, name, "geometry"))
    mask = geometry.require("mask")["mask"]
    members: dict[str, bytes] = {f"{name}.shared.exr": exr_bytes(intrinsics_channels(geometry))}
    scenes, quality = [], {}

    def add(member: str, render: Callable[[int, int], Any], is_image: bool) -> None:
        mean, variance, used, ceiling = render_to_ceiling(render, mask, spec, item_seed(spec.name, member), is_image)
        members[member] = exr_bytes(_estimate_channels(mean, variance))
        quality[member] = {"spp": used, "ceiling_db": round(ceiling, 3)}

    for index, (light, turn) in enumerate(job.lights):
        key = f"{name}_l{index}"
        environment = np.roll(job.environments[light], turn, axis=1)
        exposure = float(np.float32(scene_exposure(renderer, environment, item_seed(spec.name, key, "gauge"))))
        environment = environment * np.float32(exposure)
        add(f"{key}.diffuse.exr", lambda n, s, e=environment: renderer.diffuse(e, n, s), False)
        for r in spec.specular_roughness:
            member = f"{key}.r{round(100 * r):03d}.specular.exr"
            add(member, lambda n, s, e=environment, r=r: renderer.specular(e, r, n, s), False)
        for m, r in dict.fromkeys([spec.base, *spec.edits, *job.materials[index]]):
            member = f"{key}.{material_key((m, r))}.exr"
            add(member, lambda n, s, e=environment, m=m, r=r: renderer.image(e, r, m, n, s), True)
        textured = np.ndim(obj.albedo) == 3
        scenes.append(asdict(Scene(key, name, obj.family, textured, light, turn, exposure, job.materials[index])))
    row = {"scenes": scenes, "quality": quality, "object": {name: {"seed": job.seed, "sha256": object_hash(obj)}}}
    members["scenes.json"] = json.dumps(row).encode()
    _write_tar(path, members)
    return path


def _write_tar(path: Path, members: dict[str, bytes]) -> None:
    """Writes a reproducible tar (sorted, no times or owners), moved into place when complete."""
    handle, temporary = tempfile.mkstemp(prefix=f".{path.name}.", dir=path.parent)
    with os.fdopen(handle, "wb") as stream:
        with tarfile.open(fileobj=stream, mode="w") as tar:
            for name in sorted(members):
                info = tarfile.TarInfo(name)
                info.size = len(members[name])
                tar.addfile(info, io.BytesIO(members[name]))
        stream.flush()
        os.fsync(stream.fileno())
    Path(temporary).chmod(0o644)
    Path(temporary).replace(path)


def make_truth(suite_toml: str | Path, work: Path, workers: int = 1) -> Iterator[tuple[int, int]]:
    """Renders a suite's truth, writes the tar beside the TOML file and its hash into it.

    Args:
        suite_toml: the suite, by name or path.
        work: folder for the finished objects; running the same command again resumes from it.
        workers: processes; each holds its own Mitsuba.

    Yields:
        (objects done, objects).
    """
    spec = read_spec(suite_toml)
    environments = suite_lights(spec)
    fingerprint = hashlib.sha256(re.sub(r'sha256 = ".*"', "", spec.path.read_text(encoding="utf-8")).encode())
    for name, environment in environments.items():
        fingerprint.update(name.encode() + environment.tobytes())
    folder = work / fingerprint.hexdigest()[:16]
    folder.mkdir(parents=True, exist_ok=True)
    lights, materials, n = assign_lights(spec, list(environments)), spec.materials(), spec.lights_per_object
    jobs = [
        ObjectJob(
            spec,
            seed,
            tuple(lights[i * n : (i + 1) * n]),
            environments,
            tuple(map(tuple, materials[i * n : (i + 1) * n])),
            folder,
        )
        for i, seed in enumerate(spec.objects)
    ]
    if workers == 1:
        results: Any = map(render_object, jobs)
        parts = []
        for part in results:
            parts.append(part)
            yield len(parts), len(jobs)
    else:
        parts = []
        with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
            for part in pool.map(render_object, jobs):
                parts.append(part)
                yield len(parts), len(jobs)
    pack_truth(spec, parts, environments)


def pack_truth(spec: SuiteSpec, parts: list[Path], environments: dict[str, Float[np.ndarray, "h w 3"]]) -> None:
    """Packs rendered objects and lights into the suite's tar and writes its hash into the TOML file."""
    from unirender_reference.backend import mitsuba

    members: dict[str, bytes] = {}
    scenes: list[dict] = []
    quality: dict[str, dict] = {}
    objects: dict[str, dict] = {}
    for part in parts:
        with tarfile.open(part) as tar:
            for info in tar.getmembers():
                stream = tar.extractfile(info)
                assert stream is not None
                members[info.name] = stream.read()
        rows = json.loads(members.pop("scenes.json"))
        scenes += rows["scenes"]
        quality |= rows["quality"]
        objects |= rows["object"]
    for name, environment in environments.items():
        channels = {c: environment[..., i] for i, c in enumerate("RGB")}
        members[f"light_{name}.exr"] = exr_bytes(channels, half=False)
    provenance = {
        "suite": spec.name,
        "mitsuba": mitsuba().__version__,
        "variant": mitsuba().variant(),
        "batches": spec.batches,
    }
    provenance |= {"objects": objects, "scenes": scenes, "quality": quality}
    members["suite.json"] = json.dumps(provenance, indent=1).encode()
    _write_tar(spec.truth_path, members)
    digest = hashlib.sha256(spec.truth_path.read_bytes()).hexdigest()
    text = re.sub(r'sha256 = ".*"', f'sha256 = "{digest}"', spec.path.read_text(encoding="utf-8"))
    spec.path.write_text(text, encoding="utf-8")


def quality_summary(suite: Suite) -> dict[str, dict[str, float]]:
    """Noise ceilings (dB) and samples per pixel over the members of each kind: mean, min, and the share below
    target."""
    groups: dict[str, list[dict]] = {"image": [], "specular": [], "diffuse": []}
    for member, row in suite.provenance["quality"].items():
        kind = "diffuse" if ".diffuse" in member else "specular" if ".specular" in member else "image"
        groups[kind].append(row)
    summary = {}
    for kind, rows in groups.items():
        ceilings = np.array([row["ceiling_db"] for row in rows])
        summary[kind] = {
            "n": len(rows),
            "mean_db": float(ceilings.mean()),
            "min_db": float(ceilings.min()),
            "share_below_target": float(np.mean(ceilings < suite.spec.target_db)),
            "mean_spp": float(np.mean([row["spp"] for row in rows])),
        }
    return summary
