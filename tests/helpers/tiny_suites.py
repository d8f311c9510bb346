"""A closed-form suite of two scenes, written in milliseconds: the composite is its truth, with a stated noise."""

import functools
import hashlib
import json
import tempfile
from dataclasses import asdict
from importlib import resources
from pathlib import Path

import numpy as np

from unirender.camera import Camera
from unirender.composite import composite
from unirender.exr import exr_bytes, image_channels
from unirender.light.surface_light import diffuse_light, specular_light
from unirender_evaluation.suites.spec import read_spec
from unirender_evaluation.suites.suite import Scene, Suite, SuiteSpec, load_suite
from unirender_evaluation.suites.truth_file import (
    CEILING,
    diffuse_member,
    estimate_channels,
    image_member,
    light_member,
    member_kind,
    shared_member,
    specular_member,
    write_tar,
)

SIZE = 32
NOISE = 1e-3  # relative standard deviation that the suite claims
TWIN_SCENE = (0, 0)  # the object and light whose base, edits, s and d have a twin of more samples


def write_suite(folder: Path, objects: int = 2, per_scene: int = 2) -> Path:
    """Writes `ball.toml` and `ball.tar`: spheres under two lights, images by the composite. Returns the TOML's path."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, content in _files(objects, per_scene).items():
        (folder / name).write_bytes(content)
    return folder / "ball.toml"


@functools.cache
def _files(objects: int, per_scene: int) -> dict[str, bytes]:
    """Made once in a process: many tests have a suite of their own."""
    with tempfile.TemporaryDirectory() as folder:
        _make(Path(folder), objects, per_scene)
        return {path.name: path.read_bytes() for path in Path(folder).iterdir()}


def _make(folder: Path, objects: int, per_scene: int) -> None:
    text = (resources.files("unirender_evaluation") / "data/suites/tiny.toml").read_text()
    lines = []
    changes = {
        "name": '"ball"',
        "resolution": str(SIZE),
        "objects": str(list(range(objects))),
        "per_scene": str(per_scene),
        "light_rows": "8",
        "file": '"ball.tar"',
        "sha256": '""',
        "ceiling_scenes": str([list(TWIN_SCENE)]),
    }
    for line in text.splitlines():
        name = line.split("=")[0].strip()
        lines.append(f"{name} = {changes[name]}" if name in changes else line)
    path = folder / "ball.toml"
    path.write_text("\n".join(lines) + "\n")
    spec = read_spec(path)
    members: dict[str, bytes] = {}
    rows, quality, made = [], {}, {}
    materials = spec.materials()
    lights = _lights(spec.light_rows)
    for name, light in lights.items():
        members[light_member(name)] = exr_bytes(image_channels(light), half=False)
    for index in range(objects):
        name = f"ball-{index}"
        normal, mask = _sphere(0.9 - 0.2 * index)
        albedo = (mask > 0) * np.array([0.7, 0.4 - 0.1 * index, 0.2 + 0.2 * index], np.float32)
        shared = {"mask.Y": mask[..., 0]} | {f"albedo.{c}": albedo[..., i] for i, c in enumerate("RGB")}
        members[shared_member(name)] = exr_bytes(shared | {f"normal.{c}": normal[..., i] for i, c in enumerate("XYZ")})
        made[name] = {"seed": index, "sha256": "none"}
        for k in range(spec.lights_per_object):
            key, light_name = f"{name}_l{k}", list(lights)[k]
            environment = lights[light_name]
            diffuse = diffuse_light(normal, environment)
            buffers = {diffuse_member(key): diffuse}
            chosen = materials[index * spec.lights_per_object + k]
            for m, r in dict.fromkeys([spec.base, *spec.edits, *chosen]):
                specular = specular_light(normal, r, environment, Camera())
                buffers[specular_member(key, r)] = specular
                buffers[image_member(key, (m, r))] = composite(albedo, m, diffuse, specular) * mask
            for member, value in buffers.items():
                members[member] = _encode(member, value, mask)
                quality[member] = {"spp": 8, "ceiling_db": 50.0, "nan_pixels": 0}
            if (index, k) == TWIN_SCENE:
                for member in _twin_members(spec, key):
                    members[CEILING + member] = _twin(member, buffers[member], mask)
            rows.append(asdict(Scene(key, name, "sphere", False, light_name, 0, 1.0, tuple(chosen))))
    provenance = {"suite": "ball", "mitsuba": "none", "batches": 8, "objects": made, "scenes": rows, "quality": quality}
    members["suite.json"] = json.dumps(provenance).encode()
    write_tar(spec.truth_path, members)
    digest = hashlib.sha256(spec.truth_path.read_bytes()).hexdigest()
    path.write_text(path.read_text().replace('sha256 = ""', f'sha256 = "{digest}"'))


def make_suite(folder: Path, **options: int) -> Suite:
    """The same, loaded."""
    return load_suite(write_suite(folder, **options))


def _encode(member: str, value: np.ndarray, mask: np.ndarray) -> bytes:
    value = value.astype(np.float16).astype(np.float32)
    variance = np.square(NOISE * np.abs(value))
    return exr_bytes(estimate_channels(member_kind(member), value, variance, mask))


def _twin_members(spec: SuiteSpec, key: str) -> list[str]:
    images = [image_member(key, material) for material in (spec.base, *spec.edits)]
    return [diffuse_member(key), specular_member(key, spec.base[1]), *images]


def _twin(member: str, value: np.ndarray, mask: np.ndarray) -> bytes:
    noise = np.random.default_rng(len(member)).standard_normal(value.shape, np.float32)
    return exr_bytes(estimate_channels(member_kind(member), value * (1 + NOISE * noise), None, mask))


def _sphere(radius: float) -> tuple[np.ndarray, np.ndarray]:
    y, x = np.mgrid[:SIZE, :SIZE].astype(np.float32)
    x, y = (x + 0.5) / SIZE * 2 - 1, -((y + 0.5) / SIZE * 2 - 1)
    squared = (x**2 + y**2) / radius**2
    inside = (squared < 1)[..., None]
    normal = np.stack([x / radius, y / radius, np.sqrt(np.maximum(1 - squared, 0))], axis=-1)
    return np.where(inside, normal, 0).astype(np.float32), inside.astype(np.float32)


def _lights(rows: int) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(0)
    uniform = np.full((rows, 2 * rows, 3), 0.4, np.float32)
    spots = uniform.copy()
    spots[1:3, 3:6] = 3.0
    return {"a": uniform + 0.1 * rng.random(uniform.shape, np.float32), "b": spots}
