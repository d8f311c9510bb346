"""Scores of a multi-view result: its maps from all cameras, its light, and its pictures from cameras it never saw.

The result is an object with textures and a light. Everything is rendered from it by the truth's own renderers, so that
two results are compared by what they look like, not by their texture layout. Per object:

    albedo, roughness, metallic   all cameras (seen and held out) as one picture: one error, one scale factor
    environment                   `light_metrics`
    novel, relit                  held-out cameras under the light *found*, and under the object's other light *given*;
                                  mean over the cameras, whose own values are kept as `novel_0`, `novel_1`, ...

A result's albedo and light are known only up to a common factor: the raw `relit` score pays for a wrong one, the
scale-aligned one does not; `novel` never does.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from unirender.intrinsics import Intrinsics
from unirender_evaluation.light_metrics import light_values
from unirender_evaluation.lpips import Lpips
from unirender_evaluation.methods.ceiling import noise_ceiling
from unirender_evaluation.multiview.scenes import LitPictures, MultiviewScene
from unirender_evaluation.scoring import score_image, score_maps
from unirender_reference.optimize.solution import Solution

NEIGHBOURS = (".ssim@", ".lpips_")  # metrics that would see the seams between stacked pictures


@dataclass(frozen=True)
class Looks:
    """What an object looks like from the scene's cameras."""

    buffers: Intrinsics  # its maps from all cameras, one below the other
    novel: LitPictures  # from the held-out cameras, under the light that belongs to it
    relit: LitPictures  # the same under the scene's other light


def true_looks(scene: MultiviewScene) -> Looks:
    """The truth."""
    return Looks(scene.buffers, scene.novel, scene.relit)


def solution_looks(scene: MultiviewScene, solution: Solution) -> Looks:
    """A result, rendered from the scene's cameras; `solution` lies in the scene's world."""
    return Looks(
        scene.buffers_of(solution.obj),
        scene.pictures_of(solution.obj, solution.environment, "novel"),
        scene.pictures_of(solution.obj, scene.other_light, "relit"),
    )


def score_solution(
    scene: MultiviewScene,
    solution: Solution,
    networks: Sequence[Lpips] = (),
    looks: Looks | None = None,
    own_outline: bool = False,
) -> dict[str, float]:
    """Metric key -> value of a result; `own_outline`: its mesh is another than the true one."""
    looks = solution_looks(scene, solution) if looks is None else looks
    buffers = looks.buffers if own_outline else looks.buffers.replace(mask=None)
    values = score_maps(buffers.replace(normal=None), scene.buffers)
    values = {key: value for key, value in values.items() if not any(name in key for name in NEIGHBOURS)}
    values |= light_values(solution.environment, scene.light)
    for what, found, truth in (("novel", looks.novel, scene.novel), ("relit", looks.relit, scene.relit)):
        values |= _picture_values(what, found, truth, networks, own_outline)
    return values


def _picture_values(
    what: str, found: LitPictures, truth: LitPictures, networks: Sequence[Lpips], own_outline: bool
) -> dict[str, float]:
    """Scores of each camera's picture under `<what>_<camera>`, and their means under `<what>`."""
    values: dict[str, float] = {}
    for index in range(len(truth.pictures)):
        own = np.asarray(found.mask(index), np.float32) if own_outline else None
        parts = found.rgb(index), truth.rgb(index), truth.mask(index)
        values |= score_image(*parts, prediction_mask=own, quantity=f"{what}_{index}", lpips=networks)
    return values | camera_means(what, values, len(truth.pictures))


def ceiling_values(scene: MultiviewScene) -> dict[str, float]:
    """PSNR of a noise-free picture against the noisy truth, from the truth's variance; means over the cameras."""
    values: dict[str, float] = {}
    for what, truth in (("novel", scene.novel), ("relit", scene.relit)):
        own: dict[str, float] = {}
        for index in range(len(truth.pictures)):
            parts = truth.rgb(index), truth.variance(index), truth.mask(index)
            own |= noise_ceiling(f"{what}_{index}", *parts, premultiplied=True)
        values |= own | camera_means(what, own, len(truth.pictures))
    return values


def camera_means(what: str, values: dict[str, float], cameras: int) -> dict[str, float]:
    """`<what>.<metric>` as the mean of `<what>_<camera>.<metric>`, for every metric there is."""
    names = [key.removeprefix(f"{what}_0") for key in values if key.startswith(f"{what}_0.")]
    return {what + name: float(np.mean([values[f"{what}_{i}{name}"] for i in range(cameras)])) for name in names}
