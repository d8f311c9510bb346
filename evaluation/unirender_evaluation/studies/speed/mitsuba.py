"""How long Mitsuba takes for a picture as good as the model's.

The model renders the true maps (one step); its masked sRGB PSNR against the suite's truth is the target. Mitsuba
renders the same object under the same light with the fewest samples per pixel whose picture is at least as good against
the same truth: 1, 2, 4, ... and then halves of the last step, so that it is not timed for twice what is needed. Its
seconds are those of that picture alone, twice: with the scene loaded, and with the scene
loaded anew. Kernels are compiled in both.

    given         the model has the true s and d, which somebody must have rendered: nearly closed-form
    given light   it has the light alone and derives s and d in the time that is measured
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from unirender_evaluation.metrics import DEFAULT_VARIANT, metric_key
from unirender_evaluation.scoring import score_image
from unirender_evaluation.studies.optimiser.curves import geometric_mean
from unirender_evaluation.studies.speed.timing import Part, timed
from unirender_evaluation.suites.objects import scene_object
from unirender_evaluation.suites.suite import Scene, Suite
from unirender_evaluation.tables.formats import MISSING, format_number
from unirender_evaluation.tables.text import TextTable
from unirender_evaluation.truth.render import item_seed

GIVEN = {"given": ("environment",), "given light": ("specular", "diffuse")}  # what the model is not given
MOST_SPP = 1 << 14
NEAR = 16  # samples are found to this share of them: a quarter of a decibel
TITLES = (
    "scene",
    "model is",
    "PSNR (dB)",
    "model (ms)",
    "Mitsuba (spp)",
    "its PSNR (dB)",
    "warm (ms)",
    "with loading (ms)",
    "warm / model",
    "with loading / model",
)


@dataclass(frozen=True)
class EqualQuality:
    """One scene under one protocol; None where Mitsuba did not get there with `MOST_SPP`."""

    scene: str
    given: str
    psnr: float  # of the model, dB
    model_s: float
    spp: int | None
    mitsuba_psnr: float | None
    warm_s: float | None
    loading_s: float | None

    @property
    def ratio(self) -> float | None:
        """Mitsuba's warm seconds over the model's."""
        return None if self.warm_s is None else self.warm_s / self.model_s

    @property
    def loading_ratio(self) -> float | None:
        """The same with the scene loaded anew."""
        return None if self.loading_s is None else self.loading_s / self.model_s


def fewest_samples(
    psnr_at: Callable[[int], float], target: float, most: int, can_be: Callable[[int], bool]
) -> tuple[int, float] | None:
    """The fewest samples per pixel whose PSNR is at least the target, to a `NEAR`th of them, and that PSNR.

    Args:
        psnr_at: PSNR in dB of a picture with that many samples.
        target: dB.
        most: samples that are tried; None is returned if they are too few.
        can_be: whether a picture can have that many; powers of two are taken to be.
    """
    spp, below = 1, 0
    while (found := psnr_at(spp)) < target:
        below, spp = spp, 2 * spp
        if spp > most:
            return None
    between = [count for count in range(below + 1, spp) if can_be(count)]
    while between and spp - below > max(1, spp // NEAR):
        middle = between[len(between) // 2]
        if (psnr := psnr_at(middle)) >= target:
            spp, found = middle, psnr
        else:
            below = middle
        between = [count for count in between if below < count < spp]
    return spp, found


def is_sample_count(spp: int, resolution: int) -> bool:
    """Whether a picture of that many pixels a side can be rendered with so many samples per pixel in one batch."""
    from unirender_reference.sample_counts import SAMPLES_PER_PASS, next_spp

    return next_spp(spp, 1, SAMPLES_PER_PASS // resolution**2) == spp


def equal_quality(pipeline: Any, suite: Suite, scene: Scene, repeats: int, most: int = MOST_SPP) -> list[EqualQuality]:
    """The model against Mitsuba on one scene, a result for each entry of `GIVEN`."""
    from unirender.pipelines.remembered import forget_pictures
    from unirender_reference.render import Renderer

    # The suite has s for the materials of its edits; scenes take these in turn.
    metallic, roughness = material = suite.spec.edits[suite.scenes.index(scene) % len(suite.spec.edits)]
    obj, environment = scene_object(suite, scene), suite.environment(scene)
    truth, mask, maps = suite.image(scene, material), suite.mask(scene), suite.intrinsics(scene, material)

    def load() -> Any:
        return Renderer(obj, suite.spec.camera, suite.spec.resolution)

    def render(renderer: Any, spp: int) -> Any:
        seed = item_seed(suite.spec.name, scene.key, "speed", spp)
        return renderer.image(environment, roughness, metallic, spp, seed, batches=1).mean[..., :3]

    def model(known: Any) -> Any:
        forget_pictures()
        return pipeline.render(known)

    def psnr(image: Any) -> float:
        return score_image(image, truth, mask)[metric_key("relit", "psnr", DEFAULT_VARIANT)]

    def can_be(spp: int) -> bool:
        return is_sample_count(spp, suite.spec.resolution)

    renderer, found = load(), []
    for given, missing in GIVEN.items():
        known = maps.replace(**dict.fromkeys(missing))
        target = psnr(model(known))
        model_s = timed(lambda known=known: model(known), repeats).median
        reached = fewest_samples(lambda spp: psnr(render(renderer, spp)), target, most, can_be)
        spp, reached_psnr = reached or (None, None)
        warm = loading = None
        if spp is not None:
            warm = timed(lambda spp=spp: render(renderer, spp), repeats).median
            loading = timed(lambda spp=spp: render(load(), spp), repeats).median
        found.append(EqualQuality(scene.key, given, target, model_s, spp, reached_psnr, warm, loading))
    return found


def mitsuba_part(pipeline: Any, suite: Suite, scenes: Sequence[Scene], repeats: int) -> Part:
    """The part `mitsuba`."""
    found = [one for scene in scenes for one in equal_quality(pipeline, suite, scene, repeats)]
    data = [asdict(one) | {"ratio": one.ratio, "loading_ratio": one.loading_ratio} for one in found]
    return Part("mitsuba", (mitsuba_table(found, repeats),), {"scenes": data})


def mitsuba_table(found: Sequence[EqualQuality], repeats: int) -> TextTable:
    """A scene and protocol a row."""
    rows = [
        (
            one.scene,
            one.given,
            f"{one.psnr:.2f}",
            f"{1e3 * one.model_s:.1f}",
            MISSING if one.spp is None else str(one.spp),
            _number(one.mitsuba_psnr, 2),
            _number(None if one.warm_s is None else 1e3 * one.warm_s, 1),
            _number(None if one.loading_s is None else 1e3 * one.loading_s, 1),
            _number(one.ratio, 2),
            _number(one.loading_ratio, 2),
        )
        for one in found
    ]
    notes = (
        "The model renders the true maps in one step; Mitsuba the same object and light with the fewest samples per "
        f"pixel (to a {NEAR}th of them) that are as near to the suite's truth (masked sRGB). Given: the model has the "
        "true s and d. Given light: it derives them from the environment, in its time. Medians of "
        f"{repeats}; warm: scene loaded; a dash: not reached with {MOST_SPP} samples.",
        *(_mean_text(found, given) for given in GIVEN),
    )
    return TextTable("Mitsuba to the same PSNR", TITLES, (tuple(rows),), notes)


def _mean_text(found: Sequence[EqualQuality], given: str) -> str:
    own = [one for one in found if one.given == given]
    ratios = [ratio for one in own if (ratio := one.ratio) is not None]
    if not ratios:
        return f"{given}: no ratio."
    mean = geometric_mean(ratios)
    return f"{given}: Mitsuba, warm, takes {mean:.2f} times the model's time (geometric mean of {len(ratios)} scenes)."


def _number(value: float | None, decimals: int) -> str:
    return MISSING if value is None or math.isnan(value) else format_number(value, decimals)
