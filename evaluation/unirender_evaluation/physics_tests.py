"""The physics tests as a registry: formula, unit, direction, what a perfect renderer scores, and a twin that must fail.

A *renderer* test asks a function `maps -> image`, a *decomposer* test a function `(stage, material, picture) -> maps`,
a *posterior* test the same for samples of the material (a method sees the picture alone; Mitsuba and the twins know the
rest; see `physics_questions`). A test is sound where its twin (`physics_twins`) is worse than Mitsuba on the same
scenes by more than its margin.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal

from unirender_evaluation import physics, physics_region, physics_twins
from unirender_evaluation.metrics import METRICS, Metric, metric_key
from unirender_evaluation.physics_ambiguity import EXPLANATIONS, POSTERIOR
from unirender_evaluation.physics_questions import (
    loop,
    loss,
    region_volume,
    rough_loop,
    rough_loss,
    roughness_response,
    share_inside,
    tau,
)
from unirender_evaluation.physics_stage import ROUGH, Light, Shader, Stage
from unirender_evaluation.specs import Column, TableSpec

PSNR = METRICS["psnr"]


def _metric(name: str, label: str, unit: str, higher: bool, perfect: float, decimals: int, formula: str) -> Metric:
    return Metric(name, label, unit, higher, perfect, (), decimals, formula)


RELATIVE = _metric("relative", "rel. error", "", False, 0.0, 4, "sum |difference| / sum radiance, linear light")
CORRELATION = _metric("correlation", "corr.", "", True, 1.0, 3, "Pearson, masked pixels, linear light")
LOSS = _metric("loss", "loss", "dB", False, 0.0, 2, "masked sRGB PSNR of the true maps' loop minus that of the row's")
TAU = _metric("tau", "tau", "", True, 1.0, 3, "Kendall's tau-b over 11 renders")
SHARE = _metric("share", "share", "", True, physics_region.perfect_share(POSTERIOR), 2, "of what explains the input")
VOLUME = _metric("volume", "volume", "", False, 0.0, 4, "share of the unit cube (metallic, roughness, luminance)")


@dataclass(frozen=True)
class PhysicsTest:
    """One test.

    Attributes:
        name: as in records: the quantity of its metric key.
        label: as in tables.
        formula: one line; notation of `physics`.
        metric: unit, direction and decimals.
        expected: value of a perfect renderer, decomposer or posterior, noise apart; in words where it is the scene's.
        asks: what it asks of.
        run: (renderer, decomposer or posterior, stage) -> value.
        twin: a broken renderer, decomposer or posterior.
        twin_is: what is broken, in words.
        margin: how much worse than Mitsuba on the same scenes counts as failing.
        in_run: whether `bench run` measures it, or `bench physics` alone.
    """

    name: str
    label: str
    formula: str
    metric: Metric
    expected: float | str
    asks: Literal["render", "decompose", "sample"]
    run: Callable[[Any, Stage], float]
    twin: Any
    twin_is: str
    margin: float
    in_run: bool = True

    @property
    def key(self) -> str:
        """The metric key of its value."""
        return metric_key(self.name, self.metric)

    @property
    def unit(self) -> str:
        return self.metric.unit

    @property
    def direction(self) -> str:
        return "higher is better" if self.metric.higher_is_better else "lower is better"

    def fails(self, value: float, mitsuba: float) -> bool:
        """Whether a value is worse than Mitsuba's by more than the margin."""
        return (mitsuba - value if self.metric.higher_is_better else value - mitsuba) > self.margin


CEILING = "true maps' loop"
GRADIENT = "a left-to-right gradient on the picture"
GAMMA = "radiance to the power 0.8"
NORMALS = "true maps with dents for bumps"
CONSTANT = "metallic and roughness 0.5 for every picture"
_RENDERER = (
    PhysicsTest(
        "superposition",
        "Superposition",
        "sum |R(a+b) - R(a) - R(b)| / sum (R(a) + R(b)); a, b: two lights at half strength; unclipped",
        RELATIVE,
        0.0,
        "render",
        lambda render, stage: physics.superposition(render, stage.base, stage.other),
        physics_twins.gamma,
        GAMMA,
        0.02,
    ),
    PhysicsTest(
        "exposure_linearity",
        "Exposure linearity",
        "sum |R(x/2) - R(x)/2| / sum R(x)/2; unclipped",
        RELATIVE,
        0.0,
        "render",
        lambda render, stage: physics.exposure_linearity(render, stage.base),
        physics_twins.gamma,
        GAMMA,
        0.02,
    ),
    PhysicsTest(
        "white_furnace",
        "White furnace",
        "sum |R(x) - L| / sum L; x: a mirror (albedo, metallic 1, roughness 0) in uniform light L: it vanishes",
        RELATIVE,
        0.0,
        "render",
        lambda render, stage: physics.white_furnace(render, stage.base),
        physics_twins.darkening,
        "0.8 of the radiance",
        0.02,
    ),
    PhysicsTest(
        "mirror_flip",
        "Mirror flip",
        "sum |R(flip x) - flip R(x)| / sum R(x)",
        RELATIVE,
        0.0,
        "render",
        lambda render, stage: physics.mirror_flip(render, stage.base),
        physics_twins.gradient,
        GRADIENT,
        0.02,
    ),
    PhysicsTest(
        "roll",
        "Roll",
        "sum |R(turn x) - turn R(x)| / sum R(x); a quarter turn of all about the view axis",
        RELATIVE,
        0.0,
        "render",
        lambda render, stage: physics.roll(render, stage.base),
        physics_twins.gradient,
        GRADIENT,
        0.02,
    ),
    PhysicsTest(
        "metallic_linearity",
        "Metallic linearity",
        "sum |R(m = .5) - (R(0) + R(1)) / 2| / sum R(.5); exact for one bounce, not for interreflection",
        RELATIVE,
        0.0,
        "render",
        lambda render, stage: physics.metallic_linearity(render, stage.base),
        physics_twins.squared_metallic,
        "metallic squared",
        0.02,
    ),
    PhysicsTest(
        "roughness_response",
        "Roughness response",
        "correlation of R(r = .9) - R(r = .1) with the same difference of the true images",
        CORRELATION,
        1.0,
        "render",
        roughness_response,
        physics_twins.blind_to_roughness,
        "s replaced by d: blind to roughness",
        0.5,
    ),
)
_LOOP = "masked PSNR (sRGB) of the found maps, shaded again by {} under the {} light, against the true picture"
_LOOPS: dict[str, tuple[str, Shader, Light]] = {
    "shade_input": ("Closed loop, input light", "shade", "input"),
    "shade_heldout": ("Closed loop, held-out light", "shade", "heldout"),
    "composite_input": ("Composite loop, input light", "composite", "input"),
    "composite_heldout": ("Composite loop, held-out light", "composite", "heldout"),
}
_BASE_LOOPS = tuple(
    PhysicsTest(
        name,
        label,
        _LOOP.format("Mitsuba" if shader == "shade" else "the composite", "input" if light == "input" else "held-out"),
        PSNR,
        CEILING,
        "decompose",
        partial(loop, shader, light),
        physics_twins.dents_for_bumps,
        NORMALS,
        1.0,
    )
    for name, (label, shader, light) in _LOOPS.items()
)
_LOSSES = tuple(
    PhysicsTest(
        f"loss_{light}",
        f"Loss to the true maps, {'input' if light == 'input' else 'held-out'} light",
        "closed loop of the true maps minus that of the found ones, the same picture and light",
        LOSS,
        0.0,
        "decompose",
        partial(loss, light),
        physics_twins.dents_for_bumps,
        NORMALS,
        1.0,
    )
    for light in ("input", "heldout")
)
_ROUGH_LOOPS = (
    PhysicsTest(
        "loop_rough",
        f"Closed loop, roughness >= {ROUGH}",
        f"mean of Mitsuba's closed loops over base and edits of roughness >= {ROUGH}, both lights: the primary figure",
        PSNR,
        CEILING,
        "decompose",
        partial(rough_loop, True),
        physics_twins.dents_for_bumps,
        NORMALS,
        1.0,
        in_run=False,
    ),
    PhysicsTest(
        "loss_rough",
        f"Loss to the true maps, roughness >= {ROUGH}",
        "the same of the true maps minus that of the found ones",
        LOSS,
        0.0,
        "decompose",
        rough_loss,
        physics_twins.dents_for_bumps,
        NORMALS,
        1.0,
        in_run=False,
    ),
    PhysicsTest(
        "loop_smooth",
        f"Closed loop, roughness < {ROUGH}",
        "as the primary figure, over the smoother pictures: one point per pixel is not a render of them",
        PSNR,
        CEILING,
        "decompose",
        partial(rough_loop, False),
        physics_twins.dents_for_bumps,
        NORMALS,
        1.0,
        in_run=False,
    ),
)
_TAUS = tuple(
    PhysicsTest(
        f"tau_{parameter}",
        f"Rank of {parameter}",
        f"Kendall's tau-b of the found mean {parameter} against the true one over 11 pictures, 0, .1 .. 1",
        TAU,
        1.0,
        "decompose",
        partial(tau, parameter),
        physics_twins.constant_material,
        CONSTANT,
        0.5,
        in_run=False,
    )
    for parameter in ("roughness", "metallic")
)
_AMBIGUITY = (
    PhysicsTest(
        "ambiguity_share",
        "Ambiguity: explanations inside",
        f"share of {EXPLANATIONS} materials that re-render within 2 sigma of the input, inside the 90 % region of "
        f"{POSTERIOR} samples; below the expected: too sure, above: too broad",
        SHARE,
        SHARE.perfect,
        "sample",
        share_inside,
        physics_twins.too_sure,
        "a posterior shrunk to a tenth",
        0.3,
        in_run=False,
    ),
    PhysicsTest(
        "ambiguity_volume",
        "Ambiguity: volume of the region",
        "of the unit cube (metallic, roughness, albedo luminance): what the share was bought with",
        VOLUME,
        "Mitsuba's",
        "sample",
        region_volume,
        physics_twins.anything,
        "any material, whatever the picture",
        0.3,
        in_run=False,
    ),
)
TESTS: dict[str, PhysicsTest] = {
    test.name: test for test in (*_RENDERER, *_BASE_LOOPS, *_LOSSES, *_ROUGH_LOOPS, *_TAUS, *_AMBIGUITY)
}


def renderer_tests(render: physics.Render, stage: Stage) -> dict[str, float]:
    """All renderer tests on one scene, from its true maps with true s, d and light: name -> value."""
    return {test.name: test.run(render, stage) for test in TESTS.values() if test.asks == "render"}


PHYSICS_TABLE = TableSpec(
    "physics",
    "Physics",
    tuple(
        Column(test.label, test.name, test.metric, {"mask": "masked"} if test.metric is PSNR else {}, published=False)
        for test in TESTS.values()
        if test.in_run
    ),
    ("physics",),
    "Renderer tests from true maps; closed loops from the maps that were found in the picture of the base material "
    f"(roughness >= {ROUGH}, where shading one point per pixel is sound). Formulas: docs, The physics tests.",
)
