"""Making a suite's truth: every buffer is rendered until a *noise-free* prediction could score the suite's target
against it, object by object, so that a killed run resumes.

What one object needs is in `truth.object`, when sampling stops in `truth.render`, the file format in
`suites.truth_file`.
"""

import hashlib
import importlib.metadata
import json
import re
from collections.abc import Generator, Iterable, Mapping, Sequence
from concurrent.futures import as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import closing
from importlib import resources
from pathlib import Path

import numpy as np

from unirender.errors import UnirenderError
from unirender.exr import exr_bytes, image_channels
from unirender.system.whole_files import replace_file
from unirender.system.worker_pool import WorkerPool
from unirender_evaluation.suites.definition import recorded
from unirender_evaluation.suites.home import target
from unirender_evaluation.suites.lights import Pool, SuiteLight, assign_lights, light_sources, load_lights
from unirender_evaluation.suites.objects import ObjectSource, broken_meshes, suite_sources
from unirender_evaluation.suites.spec import SuiteSpec
from unirender_evaluation.suites.suite import Suite
from unirender_evaluation.suites.truth_file import Kind, Stored, light_member, list_tar, member_kind, write_tar
from unirender_evaluation.truth.object import PART, ObjectJob, render_object
from unirender_evaluation.truth.sources import check_files
from unirender_reference.processes import start_worker

CODE = {  # what a rendered part depends on
    "unirender": ("camera.py", "color.py", "exr.py", "intrinsics.py", "light/environment.py", "light/exposure.py"),
    "unirender_reference": ("**/*.py",),
    "unirender_evaluation": (
        *("truth/object.py", "truth/render.py", "suites/truth_file.py", "methods/ceiling.py"),
        *("suites/objects.py", "suites/lights.py"),
    ),
}
SHA256_LINE = re.compile(r"""^([ \t]*sha256[ \t]*=[ \t]*)(?:"[^"\n]*"|'[^'\n]*')""", re.MULTILINE)


def make_truth(
    suite: str | Path,
    work: Path,
    workers: int = 1,
    *,
    out: Path | None = None,
    objects: Path | None = None,
    lights: Path | None = None,
) -> Generator[tuple[int, int], None, None]:
    """Renders a suite's truth, writes the tar, and beside it the suite's TOML file with the truth's hash.

    Args:
        suite: by name or path.
        work: folder for the finished objects; running the same command again resumes from it. Parts made by another
            suite file, from other files, by other code or another Mitsuba are not used.
        workers: processes, each with one thread and its own Mitsuba.
        out: folder of the truth; None: see `suites.home.target`.
        objects, lights: folders of meshes and light files in place of those that the suite's file names.

    Yields:
        (objects done, objects).

    Raises:
        UnirenderError: the suite's file, its folders, meshes or lights, or the work folder cannot be used; nothing was
            rendered then. Or objects could not be rendered, all of which are named: the others are kept for the next
            run, and no truth is written.
    """
    spec, text = target(suite, out, objects, lights)
    with_sha256(text, spec.path, "")  # before hours of rendering: can the hash be written?
    sources, pool = suite_sources(spec), light_sources(spec)
    assigned = assign_lights(spec, list(pool), len(sources))
    used = _checked(spec, sources, [name for name, _ in assigned], pool)
    check_files(spec, sources, used)
    folder = work / _fingerprint(spec, text, used)
    for needed in (folder, spec.path.parent):
        try:
            needed.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            option = "--work" if needed == folder else "--out"
            raise UnirenderError(f"{needed}: cannot be made ({error.strerror}); choose another {option}") from error
    jobs = _jobs(spec, sources, assigned, used, folder)
    parts: dict[int, Path] = {}
    failures: list[str] = []
    with closing(_rendered(jobs, workers)) as outcomes:
        for number, outcome in outcomes:
            if isinstance(outcome, UnirenderError):
                failures.append(f"{jobs[number].source.name}: {outcome}")
            else:
                parts[number] = outcome
                yield len(parts), len(jobs)
    if failures:
        raise UnirenderError(
            f"suite {spec.name!r}: {len(failures)} of its objects could not be rendered; repair them and run the "
            "command again (the others are kept), or leave them out (all objects then get other lights and materials, "
            "and are rendered anew):\n" + "\n".join(f"  {line}" for line in sorted(failures))
        )
    pack_truth(spec, text, [parts[number] for number in range(len(jobs))], used)


def _checked(
    spec: SuiteSpec, sources: Sequence[ObjectSource], lights: Sequence[str], pool: Pool
) -> dict[str, SuiteLight]:
    """The lights of these names, once every mesh and every one of them has been read."""
    problems: list[str] = []
    broken = list(broken_meshes(sources, spec))
    if broken:
        problems.append(
            f"suite {spec.name!r}: {len(broken)} of its meshes cannot be used; repair them, or name them under "
            "`without` of their group:\n" + "\n".join(f"  {line}" for line in broken)
        )
    used: dict[str, SuiteLight] = {}
    try:
        used = load_lights(spec, lights, pool)
    except UnirenderError as error:
        problems.append(str(error))
    if problems:
        raise UnirenderError("\n".join(problems))
    return used


def _rendered(jobs: Sequence[ObjectJob], workers: int) -> Generator[tuple[int, Path | UnirenderError], None, None]:
    """The part of each object, or why there is none, as they are done; the numbers are those of the jobs."""
    with WorkerPool(min(workers, max(len(jobs), 1)), start_worker) as pool:
        numbers = {pool.submit(render_object, job): number for number, job in enumerate(jobs)}
        try:
            for future in as_completed(numbers):
                try:
                    yield numbers[future], future.result()
                except UnirenderError as error:
                    yield numbers[future], error
        except BrokenProcessPool as error:
            raise UnirenderError(
                "a worker process died, perhaps for want of memory; run the same command again, with fewer --workers"
            ) from error


def _jobs(
    spec: SuiteSpec,
    sources: Sequence[ObjectSource],
    assigned: Sequence[tuple[str, int]],
    lights: Mapping[str, SuiteLight],
    folder: Path,
) -> list[ObjectJob]:
    """A job for each object; each carries its own lights alone."""
    n, materials = spec.lights_per_object, spec.materials(len(sources) - len(spec.objects))
    jobs = []
    for i, source in enumerate(sources):
        own = tuple(assigned[i * n : (i + 1) * n])
        environments = {name: lights[name].environment for name, _ in own}
        chosen = tuple(map(tuple, materials[i * n : (i + 1) * n]))
        jobs.append(ObjectJob(spec, source, own, environments, chosen, folder))
    return jobs


def _fingerprint(spec: SuiteSpec, text: str, lights: Mapping[str, SuiteLight]) -> str:
    """Names the work folder: the suite's file but for the truth's hash, the lights, the code, Mitsuba. (Parts are named
    after what `render_object` is given.)"""
    digest = hashlib.sha256(with_sha256(text, spec.path, "").encode())
    for name, light in lights.items():
        digest.update(name.encode() + light.environment.tobytes())
    for package, patterns in CODE.items():
        root = Path(str(resources.files(package)))
        for path in sorted({p for pattern in patterns for p in root.glob(pattern)}):
            digest.update(path.relative_to(root).as_posix().encode() + path.read_bytes())
    digest.update(importlib.metadata.version("mitsuba").encode())
    return digest.hexdigest()[:16]


def pack_truth(spec: SuiteSpec, text: str, parts: Iterable[Path], lights: Mapping[str, SuiteLight]) -> None:
    """Packs rendered objects and their lights into the suite's tar, and writes the TOML file with its hash."""
    from unirender_reference.render import shared_scene_hash

    members: dict[str, bytes | Stored] = {}
    scenes: list[dict] = []
    hashes: dict[str, list[str]] = {}
    quality: dict[str, dict] = {}
    objects: dict[str, dict] = {}
    header: dict[str, str] = {}
    for path in parts:
        found = list_tar(path)
        part = json.loads(found.pop(PART).read())
        members |= found
        header = part["header"]
        scenes += part["scenes"]
        hashes |= part["hashes"]
        quality |= part["quality"]
        objects |= part["object"]
    made = {name: header[name] for name in ("mitsuba", "variant", "camera")}
    for name, light in lights.items():
        lit = [scene for scene in scenes if scene["light"] == name]
        attributes = {
            **made,
            "light": name,
            "object": ",".join(dict.fromkeys(scene["object"] for scene in lit)),
            "scene": shared_scene_hash(h for scene in lit for h in hashes[scene["key"]]),
            "exposure_factor": "1",
        }
        members[light_member(name)] = exr_bytes(image_channels(light.environment), half=False, attributes=attributes)
    files = {name: dict(light.provenance) for name, light in lights.items() if light.provenance}
    provenance = {
        "suite": spec.name,
        **recorded(spec),
        **made,
        "batches": spec.batches,
        "objects": objects,
        **({"lights": files} if files else {}),
        "scenes": scenes,
        "quality": quality,
    }
    members["suite.json"] = json.dumps(provenance, indent=1).encode()
    write_tar(spec.truth_path, members)
    with spec.truth_path.open("rb") as stream:
        digest = hashlib.file_digest(stream, "sha256").hexdigest()
    replace_file(spec.path, with_sha256(text, spec.path, digest))


def with_sha256(text: str, path: Path, digest: str) -> str:
    """The text of a suite's TOML file with another hash of its truth; comments and layout stay.

    Raises:
        UnirenderError: there is not exactly one line `sha256 = "..."`.
    """
    changed, count = SHA256_LINE.subn(rf'\g<1>"{digest}"', text)
    if count != 1:
        raise UnirenderError(
            f'{path}: got {count} lines like sha256 = "...", expected exactly one, in [truth], for the hash of the '
            "truth file"
        )
    return changed


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
    for kind, wanted in targets.items():
        rows = [row for member, row in suite.provenance["quality"].items() if member_kind(member) == kind]
        ceilings, spp = (np.array([row[name] for row in rows]) for name in ("ceiling_db", "spp"))
        summary[kind] = {
            "n": len(rows),
            "mean_db": float(ceilings.mean()),
            "min_db": float(ceilings.min()),
            "share_below_target": float(np.mean(ceilings < wanted)),
            "mean_spp": float(spp.mean()),
            "max_spp": int(spp.max()),
        }
    return summary
