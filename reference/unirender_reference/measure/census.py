"""How often Mitsuba gives NaN, infinite or negative pixels, where, and whether one gets through.

Random objects, materials and lights are rendered by `Renderer.image`, the function that every data set and suite uses.
What `mi.render` returned is looked at before the repair, what `image` returned after it.

    place   pole      the normal reflects or faces a pole of the light map (within 6 degrees)
            edge      the object covers the pixel in part
            grazing   normal and view direction at more than 75 degrees
            inside    all others
"""

import contextlib
import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from unirender.system.worker_pool import WorkerPool
from unirender_reference import backend
from unirender_reference.lights import make_light
from unirender_reference.passes import derive_seed
from unirender_reference.processes import start_worker
from unirender_reference.render import DIRECT_DEPTH, IMAGE_DEPTH, Renderer
from unirender_reference.shapes import MeshObject, make_object

RENDERS_PER_OBJECT = 8
DEPTHS = (IMAGE_DEPTH, IMAGE_DEPTH, IMAGE_DEPTH, DIRECT_DEPTH)
EXACT = 0.3  # share of roughness and metallic values that are exactly 0 or 1
KINDS = ("nan", "infinite", "negative")
GRAZING = np.cos(np.radians(75))
POLE = np.cos(np.radians(6))


@dataclass(frozen=True)
class RenderDraw:
    """What a render draws: None is the object's own map."""

    light_seed: int
    roughness: float | None
    metallic: float | None
    depth: int


@dataclass(frozen=True)
class BadPixel:
    """One pixel of one `mi.render` that is no radiance, with what it takes to render it again.

    Attributes:
        kind: "nan", "infinite" or "negative".
        place: see the module.
        bumped: the object has a normal map.
        seed, spp: of that `mi.render`.
        values: the pixel's RGBA.
    """

    kind: str
    place: str
    object_seed: int
    family: str
    bumped: bool
    light: str
    material: RenderDraw
    seed: int
    spp: int
    row: int
    column: int
    values: tuple[float, ...]


@dataclass(frozen=True)
class ObjectCensus:
    """What the renders of one object gave.

    Attributes:
        renders: calls of `Renderer.image`.
        calls: calls of `mi.render`, repairs included.
        bad: every bad pixel before the repair.
        written: values that are not finite or below 0 in what `image` returned.
        repaired: pixels that `image` says it rendered again.
    """

    renders: int
    calls: int
    bad: tuple[BadPixel, ...]
    written: int
    repaired: int


def draw_renders(obj: MeshObject, object_seed: int, count: int) -> list[RenderDraw]:
    """The renders of an object: lights of the train pool, materials with many exact zeros and ones, two depths."""
    rng = np.random.default_rng([object_seed, 7])

    def value(own: np.ndarray | None) -> float | None:
        if own is not None and rng.random() < 0.5:
            return None
        return float(rng.integers(2)) if rng.random() < EXACT else float(rng.random())

    return [
        RenderDraw(
            int(rng.integers(1 << 31)),
            value(obj.roughness),
            value(obj.metallic),
            DEPTHS[int(rng.integers(len(DEPTHS)))],
        )
        for _ in range(count)
    ]


def census_of_object(object_seed: int, renders: int, resolution: int, spp: int) -> ObjectCensus:
    """Renders one object `renders` times; a pure function of its arguments."""
    obj = make_object(object_seed, "train", maps=object_seed % 2 == 1)
    renderer = Renderer(obj, resolution=resolution)
    bad: list[BadPixel] = []
    calls = written = repaired = 0
    for number, draw in enumerate(draw_renders(obj, object_seed, renders)):
        light = make_light(draw.light_seed, "train")
        with _raw_renders() as raw:
            seed = derive_seed(object_seed, "census", number)
            arguments = (light.environment, draw.roughness, draw.metallic, spp, seed)
            estimate = renderer.image(*arguments, depth=draw.depth, batches=1)
        calls += len(raw)
        written += int((~np.isfinite(estimate.mean)).sum() + (estimate.mean < 0).sum())
        repaired += estimate.nan_pixels
        for pass_seed, pass_spp, picture in raw:
            kinds = classify(picture)
            if not kinds.any():
                continue
            places = _places(renderer)
            for kind, row, column in zip(*np.nonzero(kinds), strict=True):
                values = tuple(float(x) for x in picture[row, column])
                where = (obj.family, obj.normal_map is not None, light.provenance.get("kind", light.name))
                pixel = (pass_seed, pass_spp, int(row), int(column), values)
                bad.append(BadPixel(KINDS[kind], str(places[row, column]), object_seed, *where, draw, *pixel))
    return ObjectCensus(renders, calls, tuple(bad), written, repaired)


def classify(picture: Float[np.ndarray, "h w c"]) -> Bool[np.ndarray, "3 h w"]:
    """Which pixels hold a NaN, an infinite and a negative value."""
    return np.asarray(np.stack([np.isnan(picture), np.isinf(picture), picture < 0]).any(axis=-1))


def run_census(renders: int, resolution: int, spp: int, seed: int, workers: int) -> Iterator[ObjectCensus]:
    """Censuses of as many objects as it takes, in order, from worker processes of one thread each."""
    counts = [RENDERS_PER_OBJECT] * (renders // RENDERS_PER_OBJECT)
    if renders % RENDERS_PER_OBJECT:
        counts.append(renders % RENDERS_PER_OBJECT)
    with WorkerPool(workers, start_worker) as pool:
        futures = [
            pool.submit(census_of_object, seed * 1_000_000 + index, count, resolution, spp)
            for index, count in enumerate(counts)
        ]
        for future in futures:
            yield future.result()


@contextlib.contextmanager
def _raw_renders() -> Iterator[list[tuple[int, int, Float[np.ndarray, "h w c"]]]]:
    """Collects (seed, spp, picture) of every `mi.render` while the block runs: copies from before any repair."""
    mi = backend.mitsuba()
    original, seen = mi.render, []

    def render(*arguments: Any, **options: Any) -> Any:
        picture = original(*arguments, **options)
        seen.append((int(options["seed"]), int(options["spp"]), np.array(picture, dtype=np.float32)))
        return picture

    mi.render = render
    try:
        yield seen
    finally:
        mi.render = original


def _places(renderer: Renderer) -> np.ndarray:
    """The place of each pixel, as text."""
    geometry = renderer.geometry(64)
    assert geometry.normal is not None
    assert geometry.mask is not None
    view = renderer.camera.view_directions(renderer.resolution, renderer.resolution)
    cosine = (geometry.normal * view).sum(axis=-1)
    reflected_up = np.abs(2 * cosine * geometry.normal[..., 1] - view[..., 1])
    pole = (np.abs(geometry.normal[..., 1]) > POLE) | (reflected_up > POLE)
    conditions = [geometry.mask[..., 0] < 1, pole, cosine < GRAZING]
    return np.select(conditions, ["edge", "pole", "grazing"], "inside")


def timed(censuses: Iterator[ObjectCensus]) -> tuple[list[ObjectCensus], float]:
    """All censuses and the seconds they took."""
    start = time.perf_counter()
    return list(censuses), time.perf_counter() - start
