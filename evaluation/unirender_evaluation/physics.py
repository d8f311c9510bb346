"""The physics table: what light does whatever the scene, asked of a method's renderer and of its decomposition.

Each test has a formula, a unit, a direction and the value of a perfect renderer (`PHYSICS`). Notation: R(x) is the
method's `render` of the maps x, in linear light, premultiplied; sums run over the mask's pixels and channels;
*unclipped* are pixels where no term exceeds display white.

    superposition       sum |R(a+b) - R(a) - R(b)| / sum (R(a) + R(b)); a, b: two lights at half strength; unclipped
    exposure linearity  sum |R(x/2) - R(x)/2| / sum R(x)/2; unclipped
    white furnace       sum |R(x) - L| / sum L; x: a mirror (albedo, metallic 1, roughness 0) in uniform light L: it
                        vanishes
    mirror flip         sum |R(flip x) - flip R(x)| / sum R(x)
    roll                sum |R(turn x) - turn R(x)| / sum R(x); a quarter turn of all about the view axis
    metallic linearity  sum |R(m = .5) - (R(0) + R(1)) / 2| / sum R(.5); exact for one bounce, not for interreflection
    roughness response  correlation of R(r = .9) - R(r = .1) with the same difference of the true images
    closed loop         masked PSNR (sRGB) against the true picture of the predicted maps, shaded again under the true
                        light: that of the picture, or a held-out one; the row of the true maps is its ceiling
"""

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import numpy as np
from jaxtyping import Float

from unirender.intrinsics import Intrinsics
from unirender.symmetries import mirror, quarter_turn, scale_light
from unirender_evaluation.methods import Composite, Image
from unirender_evaluation.metrics import METRICS, Metric
from unirender_evaluation.specs import Column, TableSpec
from unirender_evaluation.suites import Scene, Suite

Render = Callable[[Intrinsics], Image]
FURNACE_RADIANCE = 0.5


def changed(maps: Intrinsics, change: Callable[[dict[str, np.ndarray]], dict[str, np.ndarray]]) -> Intrinsics:
    """The scene after a change of `unirender.symmetries`, in arrays of its own."""
    return maps.replace(**{name: np.ascontiguousarray(value) for name, value in change(maps.maps).items()})


def add_lights(a: Intrinsics, b: Intrinsics) -> Intrinsics:
    """The scene under both lights: s, d and environment add."""
    changes = {
        name: getattr(a, name) + getattr(b, name)
        for name in ("specular", "diffuse", "environment")
        if name in a.present
    }
    return a.replace(**changes)


def relative_error(a: Image, b: Image, keep: Float[np.ndarray, "h w"] | None = None) -> float:
    """`sum |a - b| / sum |b|` over the pixels to keep."""
    weight = np.ones(a.shape[:2]) if keep is None else keep
    return float(np.sum(np.abs(a - b) * weight[..., None]) / max(float(np.sum(np.abs(b) * weight[..., None])), 1e-9))


def _unclipped(*images: Image) -> Float[np.ndarray, "h w"]:
    return np.all([np.max(image, axis=-1) < 1.0 for image in images], axis=0).astype(np.float32)


def superposition(render: Render, a: Intrinsics, b: Intrinsics) -> float:
    """Relative error of adding two lights; `a`, `b` are one scene under two lights."""
    a, b = (changed(maps, partial(scale_light, factor=0.5)) for maps in (a, b))
    both, separate = render(add_lights(a, b)), render(a) + render(b)
    return relative_error(both, separate, _unclipped(both, separate))


def exposure_linearity(render: Render, maps: Intrinsics) -> float:
    """Relative error of halving the light."""
    half, full = render(changed(maps, partial(scale_light, factor=0.5))), render(maps)
    return relative_error(half, full / 2, _unclipped(full))


def white_furnace(render: Render, maps: Intrinsics) -> float:
    """Relative error of a perfect mirror in uniform light, where it must vanish; only shape and mask of `maps` are
    used."""
    mask = maps.require("normal", "mask")["mask"]
    inside = (mask > 0).astype(np.float32)
    uniform = np.broadcast_to(inside * FURNACE_RADIANCE, (*mask.shape[:2], 3)).copy()
    furnace = maps.replace(
        albedo=np.broadcast_to(inside, (*mask.shape[:2], 3)).copy(),
        metallic=inside,
        roughness=np.zeros_like(inside),
        specular=uniform,
        diffuse=uniform,
        environment=np.full((16, 32, 3), FURNACE_RADIANCE, np.float32),
    )
    return relative_error(render(furnace), mask * uniform)


def mirror_flip(render: Render, maps: Intrinsics) -> float:
    """Relative error of rendering the mirrored scene."""
    return relative_error(render(changed(maps, mirror)), render(maps)[:, ::-1])


def roll(render: Render, maps: Intrinsics) -> float:
    """Relative error of rendering the scene turned about the view axis."""
    return relative_error(render(changed(maps, quarter_turn)), np.rot90(render(maps)))


def metallic_linearity(render: Render, maps: Intrinsics) -> float:
    """Relative error of the mean of metallic 0 and 1 against metallic 0.5."""
    inside = (maps.require("mask")["mask"] > 0).astype(np.float32)
    low, middle, high = (render(maps.replace(metallic=inside * np.float32(m))) for m in (0.0, 0.5, 1.0))
    return relative_error((low + high) / 2, middle)


def roughness_response(render: Render, low: Intrinsics, high: Intrinsics, true_low: Image, true_high: Image) -> float:
    """Correlation over the mask of the rendered with the true change from low to high roughness, in [-1, 1]."""
    inside = low.require("mask")["mask"][..., 0] > 0.5
    predicted, true = (render(high) - render(low))[inside].ravel(), (true_high - true_low)[inside].ravel()
    if np.std(predicted) < 1e-9 or np.std(true) < 1e-9:
        return 0.0
    return float(np.corrcoef(predicted, true)[0, 1])


def renderer_tests(render: Render, suite: Suite, scene: Scene) -> dict[str, float]:
    """All tests of a renderer on one scene, from its true maps with true s, d and light."""
    base, other = suite.intrinsics(scene, suite.spec.base), suite.intrinsics(suite.other_light(scene), suite.spec.base)
    m = suite.spec.base[0]
    r_low, r_high = min(suite.spec.specular_roughness), max(suite.spec.specular_roughness)
    return {
        "superposition": superposition(render, base, other),
        "exposure_linearity": exposure_linearity(render, base),
        "white_furnace": white_furnace(render, base),
        "mirror_flip": mirror_flip(render, base),
        "roll": roll(render, base),
        "metallic_linearity": metallic_linearity(render, base),
        "roughness_response": roughness_response(
            render,
            suite.intrinsics(scene, (m, r_low)),
            suite.intrinsics(scene, (m, r_high)),
            suite.image(scene, (m, r_low)),
            suite.image(scene, (m, r_high)),
        ),
    }


def closed_loop(
    maps: Intrinsics, suite: Suite, scene: Scene, shaders: Mapping[str, Callable[[Intrinsics, Any], Image]]
) -> dict[str, Image]:
    """The maps shaded again by each shader under the picture's true light and under the held-out one.

    Args:
        maps: albedo, normal, roughness, metallic and mask, predicted from the picture of `scene` in the base material,
            or true.
        suite: the suite.
        scene: whose picture was decomposed.
        shaders: name -> (intrinsics, environment) -> linear image, premultiplied.

    Returns:
        `<shader>_input` and `<shader>_heldout` -> linear image.
    """
    surface = maps.replace(specular=None, diffuse=None, environment=None)
    lights = {"input": suite.environment(scene), "heldout": suite.environment(suite.other_light(scene))}
    return {
        f"{name}_{light}": shade(surface, environment)
        for name, shade in shaders.items()
        for light, environment in lights.items()
    }


def composite_shader(maps: Intrinsics, environment: Float[np.ndarray, "eh ew 3"]) -> Image:
    """Closed-form shading without shadows or interreflection."""
    return Composite().render(maps.replace(environment=environment))


def _metric(name: str, label: str, higher: bool, perfect: float, formula: str) -> Metric:
    return Metric(name, label, "", higher, perfect, (), 4 if not higher else 3, formula)


RELATIVE = _metric("relative", "rel. error", False, 0.0, "sum |difference| / sum radiance, linear light")
CORRELATION = _metric("correlation", "corr.", True, 1.0, "Pearson, masked pixels, linear light")
RENDERER_TESTS: dict[str, tuple[str, Metric]] = {
    "superposition": ("Superposition", RELATIVE),
    "exposure_linearity": ("Exposure linearity", RELATIVE),
    "white_furnace": ("White furnace", RELATIVE),
    "mirror_flip": ("Mirror flip", RELATIVE),
    "roll": ("Roll", RELATIVE),
    "metallic_linearity": ("Metallic linearity", RELATIVE),
    "roughness_response": ("Roughness response", CORRELATION),
}
CLOSED_LOOPS = {
    "shade_input": "Closed loop, input light",
    "shade_heldout": "Closed loop, held-out light",
    "composite_input": "Composite loop, input light",
    "composite_heldout": "Composite loop, held-out light",
}
PHYSICS_TABLE = TableSpec(
    "physics",
    "Physics",
    (
        *(Column(label, name, metric, published=False) for name, (label, metric) in RENDERER_TESTS.items()),
        *(
            Column(label, name, METRICS["psnr"], {"mask": "masked"}, published=False)
            for name, label in CLOSED_LOOPS.items()
        ),
    ),
    ("physics",),
    "Renderer tests from true maps; closed loops from the maps that were found in the picture. "
    "Formulas: unirender_evaluation.physics.",
)
