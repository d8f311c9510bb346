"""Making a suite's truth: every buffer is rendered until a *noise-free* prediction could score the suite's target
against it, object by object, so that a killed run resumes.

What one object needs is in `truth_object`, when sampling stops in `truth_render`, the file format in `truth_file`.
"""

import hashlib
import importlib.metadata
import json
import re
from collections.abc import Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from importlib import resources
from multiprocessing import get_context
from pathlib import Path

import numpy as np
from jaxtyping import Float

from unirender.errors import UnirenderError
from unirender.exr import exr_bytes, image_channels
from unirender.lighting import resample_environment
from unirender_evaluation.suite_spec import SuiteSpec, read_spec
from unirender_evaluation.suites import Suite
from unirender_evaluation.truth_file import Kind, light_member, member_kind, read_tar, write_tar
from unirender_evaluation.truth_object import PART, ObjectJob, render_object

CODE = {  # what a rendered part depends on
    "unirender": ("camera.py", "color.py", "exposure.py", "exr.py", "intrinsics.py", "lighting.py"),
    "unirender_reference": ("**/*.py",),
    "unirender_evaluation": ("truth_object.py", "truth_render.py", "truth_file.py", "ceiling.py"),
}
SHA256_LINE = re.compile(r"""^([ \t]*sha256[ \t]*=[ \t]*)(?:"[^"\n]*"|'[^'\n]*')""", re.MULTILINE)
Environment = Float[np.ndarray, "h w 3"]


def suite_lights(spec: SuiteSpec) -> dict[str, Environment]:
    """The suite's pool of lights by name, brought to `light_rows`."""
    from unirender_reference.lights import bundled_lights, make_light

    bundled = sorted(bundled_lights(spec.split), key=lambda light: light.name)[: spec.bundled_lights]
    lights = bundled + [make_light(seed, spec.split) for seed in spec.procedural_lights]
    shape = (spec.light_rows, 2 * spec.light_rows)
    return {light.name: resample_environment(light.environment, shape) for light in lights}


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


def make_truth(suite_toml: str | Path, work: Path, workers: int = 1) -> Iterator[tuple[int, int]]:
    """Renders a suite's truth, writes the tar beside the TOML file and its hash into it.

    Args:
        suite_toml: the suite, by name or path.
        work: folder for the finished objects; running the same command again resumes from it. Parts made by another
            suite file, other code or another Mitsuba are not used.
        workers: processes, each with one thread and its own Mitsuba.

    Yields:
        (objects done, objects).

    Raises:
        UnirenderError: the suite's file, its lights or the work folder cannot be used; nothing was rendered then.
    """
    spec = read_spec(suite_toml)
    environments = suite_lights(spec)
    folder = work / _fingerprint(spec, environments)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UnirenderError(f"{work}: cannot be written ({error.strerror}); choose another --work") from error
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
    parts = []
    with ProcessPoolExecutor(workers, get_context("spawn"), _start_worker) as pool:
        for part in pool.map(render_object, jobs):
            parts.append(part)
            yield len(parts), len(jobs)
    pack_truth(spec, parts, environments)


def _start_worker() -> None:
    from unirender_reference.backend import set_threads
    from unirender_reference.processes import exit_with_parent

    exit_with_parent()
    set_threads(1)


def _fingerprint(spec: SuiteSpec, environments: dict[str, Environment]) -> str:
    """Names the work folder: the suite file but for the truth's hash, the lights, the code, Mitsuba."""
    digest = hashlib.sha256(with_sha256(spec.path, "").encode())
    for name, environment in environments.items():
        digest.update(name.encode() + environment.tobytes())
    for package, patterns in CODE.items():
        root = Path(str(resources.files(package)))
        for path in sorted({p for pattern in patterns for p in root.glob(pattern)}):
            digest.update(path.relative_to(root).as_posix().encode() + path.read_bytes())
    digest.update(importlib.metadata.version("mitsuba").encode())
    return digest.hexdigest()[:16]


def pack_truth(spec: SuiteSpec, parts: Iterable[Path], environments: dict[str, Environment]) -> None:
    """Packs rendered objects and their lights into the suite's tar and writes its hash into the TOML file."""
    from unirender_reference.render import shared_scene_hash

    members: dict[str, bytes] = {}
    scenes: list[dict] = []
    hashes: dict[str, list[str]] = {}
    quality: dict[str, dict] = {}
    objects: dict[str, dict] = {}
    header: dict[str, str] = {}
    for path in parts:
        members |= read_tar(path.read_bytes())
        part = json.loads(members.pop(PART))
        header = part["header"]
        scenes += part["scenes"]
        hashes |= part["hashes"]
        quality |= part["quality"]
        objects |= part["object"]
    made = {name: header[name] for name in ("mitsuba", "variant", "camera")}
    for name, environment in environments.items():
        lit = [scene for scene in scenes if scene["light"] == name]
        if lit:
            attributes = {
                **made,
                "light": name,
                "object": ",".join(dict.fromkeys(scene["object"] for scene in lit)),
                "scene": shared_scene_hash(h for scene in lit for h in hashes[scene["key"]]),
                "exposure_factor": "1",
            }
            members[light_member(name)] = exr_bytes(image_channels(environment), half=False, attributes=attributes)
    provenance = {
        "suite": spec.name,
        **made,
        "batches": spec.batches,
        "objects": objects,
        "scenes": scenes,
        "quality": quality,
    }
    members["suite.json"] = json.dumps(provenance, indent=1).encode()
    write_tar(spec.truth_path, members)
    digest = hashlib.sha256(spec.truth_path.read_bytes()).hexdigest()
    spec.path.write_text(with_sha256(spec.path, digest), encoding="utf-8")


def with_sha256(path: Path, digest: str) -> str:
    """The text of a suite's TOML file with another hash of its truth; comments and layout stay.

    Raises:
        UnirenderError: there is not exactly one line `sha256 = "..."`.
    """
    text, count = SHA256_LINE.subn(rf'\g<1>"{digest}"', path.read_text(encoding="utf-8"))
    if count != 1:
        raise UnirenderError(
            f'{path}: got {count} lines like sha256 = "...", expected exactly one, in [truth], for the hash of the '
            "truth file"
        )
    return text


def quality_summary(suite: Suite) -> dict[str, dict[str, float]]:
    """Noise ceilings (dB) and samples per pixel over the members of each kind: mean, min, and the share below
    target."""
    spec = suite.spec
    targets: dict[Kind, float] = {
        "image": spec.target_db,
        "specular": spec.light_target_db,
        "diffuse": spec.light_target_db,
    }
    summary = {}
    for kind, target in targets.items():
        rows = [row for member, row in suite.provenance["quality"].items() if member_kind(member) == kind]
        ceilings, spp = (np.array([row[name] for row in rows]) for name in ("ceiling_db", "spp"))
        summary[kind] = {
            "n": len(rows),
            "mean_db": float(ceilings.mean()),
            "min_db": float(ceilings.min()),
            "share_below_target": float(np.mean(ceilings < target)),
            "mean_spp": float(spp.mean()),
            "max_spp": int(spp.max()),
        }
    return summary
