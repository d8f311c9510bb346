"""The physics tests, a row each (`definition` says what the fields mean), and the table that `bench run` prints."""

import math
from collections.abc import Callable
from functools import partial

from unirender_evaluation.metrics import HIGHER, LOWER, METRICS, Metric
from unirender_evaluation.physics import formulas, region, twins
from unirender_evaluation.physics.ambiguity import EXPLANATIONS, POSTERIOR
from unirender_evaluation.physics.definition import PhysicsTest
from unirender_evaluation.physics.questions import (
    loop,
    loop_by_roughness,
    loss,
    region_volume,
    rough_loss,
    roughness_response,
    share_inside,
    tau,
)
from unirender_evaluation.physics.stage import ROUGH, Light, Shader, Stage
from unirender_evaluation.tables.specs import Column, TableSpec

PSNR = METRICS["psnr"]


def _metric(name: str, label: str, unit: str, higher: bool, perfect: float, decimals: int, formula: str) -> Metric:
    return Metric(name, label, unit, higher, perfect, (), decimals, formula)


RELATIVE = _metric("relative", "rel. error", "", LOWER, 0.0, 4, "sum |difference| / sum radiance, linear light")
CORRELATION = _metric("correlation", "corr.", "", HIGHER, 1.0, 3, "Pearson, masked pixels, linear light")
LOSS = _metric("loss", "loss", "dB", LOWER, 0.0, 2, "masked sRGB PSNR of the true maps' loop minus that of the row's")
TAU = _metric("tau", "tau", "", HIGHER, 1.0, 3, "Kendall's tau-b over 11 renders")
SHARE = _metric("share", "share", "", HIGHER, region.perfect_share(POSTERIOR), 2, "of what explains the input")
VOLUME = _metric("volume", "volume", "", LOWER, 0.0, 4, "share of the unit cube (metallic, roughness, luminance)")

CEILING = "true maps' loop"
GRADIENT = "a left-to-right gradient on the picture"
GAMMA = "radiance to the power 0.8"


def _identity(
    name: str,
    label: str,
    formula: str,
    run: Callable[[formulas.Render, Stage], float],
    twin: formulas.Render,
    twin_is: str,
) -> PhysicsTest:
    """A renderer test of something that light does whatever the scene: a relative error, 0 for a perfect renderer."""

    def of_object(render: formulas.Render, stage: Stage) -> float:
        return run(formulas.inside(render), stage)

    return PhysicsTest(name, label, formula, RELATIVE, 0.0, "render", of_object, twin, twin_is, margin=0.02)


def _of_maps(
    name: str,
    label: str,
    formula: str,
    metric: Metric,
    expected: float | str,
    run: Callable[..., float],
    in_run: bool = True,
) -> PhysicsTest:
    """A test of found maps, in dB; its twin has the true ones, but for their normals."""
    twin, twin_is = twins.dents_for_bumps, "true maps with dents for bumps"
    return PhysicsTest(name, label, formula, metric, expected, "decompose", run, twin, twin_is, 1.0, in_run)


_RENDERER = (
    _identity(
        "superposition",
        "Superposition",
        "sum |R(a+b) - R(a) - R(b)| / sum (R(a) + R(b)); a, b: two lights at half strength; unclipped",
        lambda render, stage: formulas.superposition(render, stage.base, stage.other),
        twins.gamma,
        GAMMA,
    ),
    _identity(
        "exposure_linearity",
        "Exposure linearity",
        "sum |R(x/2) - R(x)/2| / sum R(x)/2; unclipped",
        lambda render, stage: formulas.exposure_linearity(render, stage.base),
        twins.gamma,
        GAMMA,
    ),
    _identity(
        "white_furnace",
        "White furnace",
        "sum |R(x) - L| / sum L; x: a mirror (albedo, metallic 1, roughness 0) in uniform light L: it vanishes",
        lambda render, stage: formulas.white_furnace(render, stage.base),
        twins.darkening,
        "0.8 of the radiance",
    ),
    _identity(
        "mirror_flip",
        "Mirror flip",
        "sum |R(flip x) - flip R(x)| / sum R(x)",
        lambda render, stage: formulas.mirror_flip(render, stage.base),
        twins.gradient,
        GRADIENT,
    ),
    _identity(
        "roll",
        "Roll",
        "sum |R(turn x) - turn R(x)| / sum R(x); a quarter turn of all about the view axis",
        lambda render, stage: formulas.roll(render, stage.base),
        twins.gradient,
        GRADIENT,
    ),
    _identity(
        "metallic_linearity",
        "Metallic linearity",
        "sum |R(m = .5) - (R(0) + R(1)) / 2| / sum R(.5); exact for one bounce, not for interreflection",
        lambda render, stage: formulas.metallic_linearity(render, stage.base),
        twins.squared_metallic,
        "metallic squared",
    ),
    PhysicsTest(
        name="roughness_response",
        label="Roughness response",
        formula="correlation of R(r = .9) - R(r = .1) with the same difference of the true images",
        metric=CORRELATION,
        expected=1.0,
        asks="render",
        run=roughness_response,
        twin=twins.blind_to_roughness,
        twin_is="s replaced by d: blind to roughness",
        margin=0.5,
    ),
)
_LOOP = "masked PSNR (sRGB) of the found maps, shaded again by {} under the {} light, against the true picture"
_SHADERS: dict[Shader, str] = {"shade": "Mitsuba", "composite": "the composite"}
_LIGHTS: dict[Light, str] = {"input": "input", "heldout": "held-out"}
_LOOPS: dict[str, tuple[str, Shader, Light]] = {
    "shade_input": ("Closed loop, input light", "shade", "input"),
    "shade_heldout": ("Closed loop, held-out light", "shade", "heldout"),
    "composite_input": ("Composite loop, input light", "composite", "input"),
    "composite_heldout": ("Composite loop, held-out light", "composite", "heldout"),
}
_BASE_LOOPS = tuple(
    _of_maps(name, label, _LOOP.format(_SHADERS[shader], _LIGHTS[light]), PSNR, CEILING, partial(loop, shader, light))
    for name, (label, shader, light) in _LOOPS.items()
)
_LOSSES = tuple(
    _of_maps(
        f"loss_{light}",
        f"Loss to the true maps, {words} light",
        "closed loop of the true maps minus that of the found ones, the same picture and light",
        LOSS,
        0.0,
        partial(loss, light),
    )
    for light, words in _LIGHTS.items()
)
_ROUGH_LOOPS = (
    _of_maps(
        "loop_rough",
        f"Closed loop, roughness >= {ROUGH}",
        f"mean of Mitsuba's closed loops over base and edits of roughness >= {ROUGH}, both lights: the primary figure",
        PSNR,
        CEILING,
        partial(loop_by_roughness, rough=True),
        in_run=False,
    ),
    _of_maps(
        "loss_rough",
        f"Loss to the true maps, roughness >= {ROUGH}",
        "the same of the true maps minus that of the found ones",
        LOSS,
        0.0,
        rough_loss,
        in_run=False,
    ),
    _of_maps(
        "loop_smooth",
        f"Closed loop, roughness < {ROUGH}",
        "as the primary figure, over the smoother pictures: one point per pixel is not a render of them",
        PSNR,
        CEILING,
        partial(loop_by_roughness, rough=False),
        in_run=False,
    ),
)
_TAUS = tuple(
    PhysicsTest(
        name=f"tau_{parameter}",
        label=f"Rank of {parameter}",
        formula=f"Kendall's tau-b of the found mean {parameter} against the true one over 11 pictures, 0, .1 .. 1",
        metric=TAU,
        expected=1.0,
        asks="decompose",
        run=partial(tau, parameter),
        twin=twins.constant_material,
        twin_is="metallic and roughness 0.5 for every picture",
        margin=0.5,
        in_run=False,
    )
    for parameter in ("roughness", "metallic")
)
_AMBIGUITY = (
    PhysicsTest(
        name="ambiguity_share",
        label="Ambiguity: explanations inside",
        formula=f"share of {EXPLANATIONS} materials that re-render within 2 sigma of the input, inside the 90 % region "
        f"of {POSTERIOR} samples; below the expected: too sure, above: too broad",
        metric=SHARE,
        expected=SHARE.perfect,
        asks="sample",
        run=share_inside,
        twin=twins.too_sure,
        twin_is="a posterior shrunk to a tenth",
        margin=0.3,
        in_run=False,
    ),
    PhysicsTest(
        name="ambiguity_volume",
        label="Ambiguity: volume of the region",
        formula="of the unit cube (metallic, roughness, albedo luminance): what the share was bought with",
        metric=VOLUME,
        expected="Mitsuba's",
        asks="sample",
        run=region_volume,
        twin=twins.anything,
        twin_is="any material, whatever the picture",
        margin=0.3,
        in_run=False,
    ),
)
TESTS: dict[str, PhysicsTest] = {
    test.name: test for test in (*_RENDERER, *_BASE_LOOPS, *_LOSSES, *_ROUGH_LOOPS, *_TAUS, *_AMBIGUITY)
}


def renderer_tests(render: formulas.Render, stage: Stage) -> dict[str, float]:
    """All renderer tests on one scene, from its true maps with true s, d and light: name -> value. A law that is asked
    of black pictures, or of none but clipped pixels, has none."""
    values = {test.name: test.run(render, stage) for test in TESTS.values() if test.asks == "render"}
    return {name: value for name, value in values.items() if not math.isnan(value)}


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
