"""Measures how near s and d come to Mitsuba's when they are derived from (normal, roughness, light) in closed form.

The truth is the unshadowed pass of the mirror-tinted reflector (s) and of the white Lambertian (d), rendered until its
noise floor is sure to be above `FLOOR_DB`. What is derived from sees the same light, the coverage-weighted mean normal
of each pixel, and the roughness:

    full          `unirender.light.surface_light`, the light at its own resolution
    small light   the same, the light reduced to 16 x 32 first, as the network has it
    prefiltered   s by the lookup that is usual in real time: the lobe seen head-on about the mirror direction
                  (N = V = R), times the lobe's albedo from where it is really seen
    sub-pixels    as `full`, from 3 x 3 normals a pixel: what one normal a pixel leaves out
"""

import hashlib
import json
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from jaxtyping import Float

from unirender.camera import Camera
from unirender.color import image_srgb
from unirender.errors import UnirenderError
from unirender.intrinsics import Intrinsics
from unirender.light.ggx import facing_normal
from unirender.light.resampling import resample_environment
from unirender.light.surface_light import diffuse_light, lobe_light, specular_light
from unirender_evaluation.metrics import metric_key, psnr
from unirender_evaluation.records import Record
from unirender_evaluation.store import KEY_PREFIX, Store
from unirender_evaluation.versions import (
    REFERENCE,
    SEPARATOR,
    Part,
    Versions,
    modules_version,
    package_folder,
    part_version,
)
from unirender_reference.checks.ball import ball
from unirender_reference.effects import render_unshadowed
from unirender_reference.exposure import scene_exposure
from unirender_reference.lights import bundled_light, catalogue
from unirender_reference.noise import FLOOR_BATCHES, FloorEstimate, render_to_floor
from unirender_reference.passes import Estimate, derive_seed
from unirender_reference.render import Renderer
from unirender_reference.scene_spec import object_hash
from unirender_reference.shapes import MeshObject, make_object

FULL, SMALL, PREFILTERED, SUBPIXELS, TRUTH = "full", "small-light", "prefiltered", "sub-pixels", "truth"
TABLE, DIFFUSE = "derived-light", "d"
SPHERE = "sphere"
FLOOR_DB = 45.0
GEOMETRY_SPP = 1024  # rays a pixel; a pixel is covered where every one of them meets the object
SUBPIXEL_SIDE, SUBPIXEL_SPP = 3, 64
SMALL_SHAPE = (16, 32)
TRUTH_PART = Part({"unirender_reference": ("effects.py", "checks/ball.py")}, ())  # no other record needs them
MASKED, COVERED = metric_key("light", "psnr"), metric_key("light_covered", "psnr")
SURE = metric_key("light_sure", "psnr")  # of the truth: its floor, even if the noise is 2 standard errors worse


@dataclass(frozen=True)
class DerivedLight:
    """What is measured."""

    out: Path  # folder of the records
    lights: tuple[str, ...]  # names of bundled lights
    objects: tuple[int, ...]  # seeds of procedural objects (training families) beside the sphere
    roughness: tuple[float, ...]  # of s
    resolution: int  # of the pictures, pixels
    versions: Versions  # of the code, for the content keys

    def __post_init__(self) -> None:
        unknown = sorted(set(self.lights) - set(catalogue()))
        if unknown:
            raise UnirenderError(f"light {unknown[0]!r}: not bundled, expected one of {', '.join(sorted(catalogue()))}")

    @property
    def questions(self) -> tuple[str, ...]:
        """What is derived: s at each roughness, and d."""
        return (*(specular_name(value) for value in self.roughness), DIFFUSE)

    @property
    def code(self) -> str:
        """Versions of what the figures depend on."""
        truth = part_version(TRUTH_PART, {package: package_folder(package) for package in TRUTH_PART.files})
        return f"{self.versions.of({REFERENCE})}{SEPARATOR}{modules_version('studies/derived_light/measure')} {truth}"

    def cases(self) -> Iterator["Case"]:
        """Every object under every light."""
        for seed in (None, *self.objects):
            obj = ball() if seed is None else make_object(seed, "train")
            surface = Surface(SPHERE if seed is None else f"{obj.family} {seed}", obj, self.resolution)
            for light in self.lights:
                yield Case(self, surface, light)


def specular_name(roughness: float) -> str:
    """The name of s at a roughness, as records have it."""
    return f"s-{roughness:g}"


def methods(question: str) -> tuple[str, ...]:
    """What answers a question; the truth's own record holds its noise floor."""
    return tuple(m for m in (TRUTH, FULL, SMALL, PREFILTERED, SUBPIXELS) if question != DIFFUSE or m != PREFILTERED)


def measure(what: DerivedLight) -> Iterator[tuple[Record, bool]]:
    """All records, and whether each was measured now; a truth is rendered only where one of its records is missing."""
    store = Store.open(what.out / "records.jsonl")
    for case in what.cases():
        for question in what.questions:
            keys = {method: case.key(question, method) for method in methods(question)}
            missing = [method for method, key in keys.items() if not store.has(key)]
            if missing:
                truth = case.truth(question)
                for method in missing:
                    values = case.values(question, method, truth)
                    name = case.surface.name
                    store.add(Record(TABLE, question, method, f"{name}/{case.light}", name, values, keys[method]))
            for method, key in keys.items():
                yield store.used[key], method in missing
    store.close()


class Surface:
    """An object's normals and coverage, traced when they are first asked for."""

    def __init__(self, name: str, obj: MeshObject, resolution: int) -> None:
        self.name, self.obj, self.resolution = name, obj, resolution
        self.renderer = Renderer(obj, Camera(), resolution)
        self.hash = object_hash(obj)

    @cached_property
    def maps(self) -> Intrinsics:
        """A normal a pixel: the mean over its coverage."""
        return self.renderer.geometry(GEOMETRY_SPP)

    @cached_property
    def fine(self) -> Intrinsics:
        """`SUBPIXEL_SIDE` squared normals a pixel."""
        return Renderer(self.obj, Camera(), self.resolution * SUBPIXEL_SIDE).geometry(SUBPIXEL_SPP)


class Case:
    """One object under one light; the exposure is folded into the light by the gauge of all data."""

    def __init__(self, what: DerivedLight, surface: Surface, light: str) -> None:
        self.what, self.surface, self.light = what, surface, light

    def key(self, question: str, method: str) -> str:
        """The content key of a record; it begins with the code's hash, as `Store` wants it."""
        light = hashlib.sha256(bundled_light(self.light).environment.tobytes()).hexdigest()
        told = [self.surface.hash, light, self.what.resolution, FLOOR_DB, question, method]
        core = hashlib.sha256(self.what.code.encode()).hexdigest()
        return core[:KEY_PREFIX] + hashlib.sha256(json.dumps([core, *told]).encode()).hexdigest()[KEY_PREFIX:]

    @cached_property
    def environment(self) -> Float[np.ndarray, "h w 3"]:
        """The light in display units."""
        environment = bundled_light(self.light).environment
        return (environment * scene_exposure(self.surface.renderer, environment, 0)).astype(np.float32)

    def truth(self, question: str) -> FloorEstimate:
        """Mitsuba's unshadowed pass, divided by coverage."""

        def render(spp: int, seed: int) -> Estimate:
            surface = "white" if question == DIFFUSE else "mirror"
            roughness = None if question == DIFFUSE else roughness_of(question)
            return render_unshadowed(
                self.surface.renderer, surface, self.environment, roughness, spp, seed, FLOOR_BATCHES
            )

        seed = derive_seed(TABLE, self.light, question)
        mask = self.surface.maps.require("mask")["mask"]
        return render_to_floor(render, mask, FLOOR_DB, premultiplied=False, spp=256, seed=seed)

    def values(self, question: str, method: str, truth: FloorEstimate) -> dict[str, float]:
        """Masked sRGB PSNR over all pixels, weighted by coverage, and over those that are covered whole; of the truth,
        its noise floor."""
        if method == TRUTH:
            return {MASKED: truth.floor_db, SURE: truth.sure_db}
        mask = self.surface.maps.require("mask")["mask"]
        made, true = image_srgb(self.derived(question, method)), image_srgb(truth.estimate.mean)
        covered = (mask > 1 - 0.5 / GEOMETRY_SPP).astype(np.float32)
        values = {MASKED: psnr(made, true, mask)}
        return values | ({COVERED: psnr(made, true, covered)} if covered.any() else {})

    def derived(self, question: str, method: str) -> Float[np.ndarray, "h w 3"]:
        """What a method makes of normal, roughness and light."""
        light: Callable[..., Float[np.ndarray, "h w 3"]] = (
            prefiltered_light if method == PREFILTERED else specular_light
        )
        environment = resample_environment(self.environment, SMALL_SHAPE) if method == SMALL else self.environment
        maps = (self.surface.fine if method == SUBPIXELS else self.surface.maps).require("normal", "mask")
        if question == DIFFUSE:
            made = diffuse_light(maps["normal"], environment)
        else:
            made = light(maps["normal"], roughness_of(question), environment)
        return pixel_means(made, maps["mask"], SUBPIXEL_SIDE) if method == SUBPIXELS else made


def roughness_of(question: str) -> float:
    """Inverse of `specular_name`."""
    return float(question.removeprefix("s-"))


def prefiltered_light(
    normal: Float[np.ndarray, "h w 3"], roughness: float, environment: Float[np.ndarray, "eh ew 3"]
) -> Float[np.ndarray, "h w 3"]:
    """s with the light filtered for N = V = R: as if every lobe were seen head-on.

    A prefiltered map holds these values; here they are integrated at each pixel's R, so that no table adds an error.
    """
    inside = np.any(normal != 0, axis=-1)
    v = Camera().view_directions(*normal.shape[:2])[inside]
    n = facing_normal(normal[inside].T, v.T).T
    mirrored = 2 * np.sum(n * v, axis=-1, keepdims=True) * n - v
    mirrored /= np.linalg.norm(mirrored, axis=-1, keepdims=True)
    rough, white = np.full(len(n), roughness, np.float32), np.ones((*SMALL_SHAPE, 3), np.float32)
    albedo = lobe_light(n, v, rough, white) / lobe_light(mirrored, mirrored, rough, white)
    out = np.zeros((*normal.shape[:2], 3), np.float32)
    out[inside] = lobe_light(mirrored, mirrored, rough, environment) * albedo
    return out


def pixel_means(
    values: Float[np.ndarray, "H W 3"], mask: Float[np.ndarray, "H W 1"], side: int
) -> Float[np.ndarray, "h w 3"]:
    """Coverage-weighted means over blocks of side x side; 0 where nothing is covered."""

    def blocks(x: Float[np.ndarray, "H W c"]) -> Float[np.ndarray, "h w c"]:
        height, width, channels = x.shape
        return x.reshape(height // side, side, width // side, side, channels).sum(axis=(1, 3))

    total = blocks(mask)
    return np.divide(blocks(values * mask), total, out=np.zeros((*total.shape[:2], 3), np.float32), where=total > 0)


def settings(what: DerivedLight) -> dict[str, object]:
    """What was measured, for the results' file."""
    plain = asdict(what)
    return {name: plain[name] for name in ("lights", "objects", "roughness", "resolution")}
