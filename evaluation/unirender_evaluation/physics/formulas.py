"""What light does whatever the scene: the formulas behind the physics table, asked of a renderer or a decomposition.

Notation: R(x) is the method's `render` of the maps x, in linear light, premultiplied; sums run over the mask's pixels
and channels; *unclipped* are pixels where no term exceeds display white. The tests that are made of these formulas,
each with its unit, direction, expected value and a broken twin, stand in `tests`.
"""

import math
from collections.abc import Callable, Sequence
from functools import partial

import numpy as np
from jaxtyping import Float

from unirender.intrinsics import Intrinsics
from unirender.light.symmetries import mirror, quarter_turn, scale_light
from unirender_evaluation.methods.composite import Composite
from unirender_evaluation.methods.method import Image

Render = Callable[[Intrinsics], Image]
FURNACE_RADIANCE = 0.5
NO_LIGHT = 1e-9  # sum of radiance up to which a picture is black


def inside(render: Render) -> Render:
    """The renderer, black where no object is: a background would thin out the errors of the object."""
    return lambda maps: (render(maps) * (maps.require("mask")["mask"] > 0)).astype(np.float32)


def changed(maps: Intrinsics, change: Callable[[dict[str, np.ndarray]], dict[str, np.ndarray]]) -> Intrinsics:
    """The scene after a change of `unirender.light.symmetries`, in arrays of its own."""
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
    """`sum |a - b| / sum |b|` over the pixels to keep; NaN where both are black there: every law holds of no light."""
    weight = np.ones(a.shape[:2]) if keep is None else keep
    error, radiance = (np.sum(np.abs(x) * weight[..., None]) for x in (a - b, b))
    return math.nan if max(error, radiance) <= NO_LIGHT else float(error / max(float(radiance), NO_LIGHT))


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


def composite_shader(maps: Intrinsics, environment: Float[np.ndarray, "eh ew 3"]) -> Image:
    """Closed-form shading without shadows or interreflection."""
    return Composite().render(maps.replace(environment=environment))


def kendall_tau(true: Sequence[float], predicted: Sequence[float]) -> float:
    """Kendall's tau-b of two sequences, in [-1, 1]: 1 where the predicted rises whenever the true one does.

    A predicted value that never changes has no order: 0.
    """
    from scipy.stats import kendalltau  # 0.5 s to import

    if np.ptp(predicted) == 0:
        return 0.0
    return float(np.asarray(kendalltau(true, predicted))[0])
