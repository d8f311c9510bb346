"""The lights of a suite: bundled maps, seeds of the generator, files of a folder; and which scene gets which."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from unirender.errors import UnirenderError
from unirender.light.resampling import resample_environment
from unirender.system.whole_files import file_sha256
from unirender_evaluation.suites.objects import drawn, missing_folder
from unirender_evaluation.suites.spec import SuiteSpec
from unirender_reference.mesh_folder import MeshFile

Environment = Float[np.ndarray, "h w 3"]


@dataclass(frozen=True)
class SuiteLight:
    """A light as it is rendered, before turn and exposure; `provenance` of those that are files: which, and how it was
    read."""

    environment: Environment
    provenance: Mapping[str, str] = field(default_factory=dict)


Pool = Mapping[str, Callable[[], SuiteLight]]


def light_sources(spec: SuiteSpec) -> Pool:
    """The suite's pool of lights: by name, what makes each at `light_rows`. Files are opened when they are asked for.

    Raises:
        UnirenderError: the folder of lights is missing, or has not what the suite's file asks for.
    """
    from unirender_reference.lights import Light, bundled_lights, make_light

    def built_in(light: Light) -> Callable[[], SuiteLight]:
        shape = (spec.light_rows, 2 * spec.light_rows)
        return lambda: SuiteLight(resample_environment(light.environment, shape))

    bundled = sorted(bundled_lights(spec.split), key=lambda light: light.name)[: spec.bundled_lights]
    lights = bundled + [make_light(seed, spec.split) for seed in spec.procedural_lights]
    return {**{light.name: built_in(light) for light in lights}, **_files(spec)}


def _files(spec: SuiteSpec) -> Pool:
    """The lights that are files, named after file and path: plain characters, no two alike."""
    from unirender_reference.lights.pool import LightPool, divide

    if spec.light_files is None:
        return {}
    folder = spec.folder("lights")
    if folder is None:
        raise UnirenderError(f"suite {spec.name!r}: {missing_folder(spec, 'lights')}")
    holdout = spec.light_files.holdout
    sides = divide(folder, holdout or 2)
    names = sides[spec.split] if holdout else tuple(sorted(sides["train"] + sides["test"]))
    held = f", split {spec.split!r} with holdout {holdout}" if holdout else ""
    chosen = drawn(names, spec.light_files, f"suite {spec.name!r}: lights in {folder}{held}")
    pool = LightPool(folder, spec.split, tuple(chosen), height=spec.light_rows)

    def read(name: str) -> Callable[[], SuiteLight]:
        def load() -> SuiteLight:
            light = pool.load(name)
            made = {"file": name, "file_sha256": file_sha256(folder / name), "rule": light.provenance["rule"]}
            return SuiteLight(light.environment, made)

        return load

    return {MeshFile(folder.absolute() / name, name).key: read(name) for name in chosen}


def load_lights(
    spec: SuiteSpec, names: Sequence[str], pool: Mapping[str, Callable[[], SuiteLight]]
) -> dict[str, SuiteLight]:
    """Those lights of the pool that scenes have.

    Raises:
        UnirenderError: files that are no lights; all of them.
    """
    lights: dict[str, SuiteLight] = {}
    problems = []
    for name in pool:
        if name in names:
            try:
                lights[name] = pool[name]()
            except UnirenderError as error:
                problems.append(str(error))
    if problems:
        raise UnirenderError(
            f"suite {spec.name!r}: {len(problems)} of its lights cannot be read; repair the files, or name them under "
            "`without` in [light_files]:\n" + "\n".join(f"  {problem}" for problem in problems)
        )
    return lights


def assign_lights(spec: SuiteSpec, names: list[str], objects: int) -> list[tuple[str, int]]:
    """(light, turn in columns) of every scene, objects outermost.

    All lights are used about equally often, those of one object differ, and every scene has its own turn about +y.

    Raises:
        UnirenderError: there are fewer lights than an object is to have.
    """
    per_object, count = spec.lights_per_object, objects * spec.lights_per_object
    if len(names) < per_object:
        raise UnirenderError(
            f"suite {spec.name!r}: got {len(names)} lights, expected at least {per_object} (lights_per_object)"
        )
    rng, order = np.random.default_rng(spec.assignment_seed), np.empty(0, int)
    while len(order) < count:
        longer = np.concatenate([order, rng.permutation(len(names))])
        rows = longer[: len(longer) // per_object * per_object].reshape(-1, per_object)
        if all(len(set(row)) == per_object for row in rows):  # else that permutation is drawn again
            order = longer
    turns = rng.integers(0, 2 * spec.light_rows, count)
    return [(names[i], int(turn)) for i, turn in zip(order[:count], turns, strict=True)]
