"""Rows that are no method's: the noise ceiling, the true light at our resolution, the reference with another seed, and
Mitsuba's own shading of true maps."""

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from functools import partial
from types import MappingProxyType
from typing import Any

import numpy as np

from unirender.errors import UnirenderError
from unirender.intrinsics import Intrinsics
from unirender.light.resampling import resample_environment
from unirender_evaluation.engine import record_of
from unirender_evaluation.light_metrics import SHAPE as LIGHT_SHAPE
from unirender_evaluation.light_metrics import score_light
from unirender_evaluation.methods.ceiling import noise_ceiling, similarity_ceiling
from unirender_evaluation.methods.method import Image
from unirender_evaluation.records import MethodInfo, Record
from unirender_evaluation.rows import Row, make_row
from unirender_evaluation.store import Job
from unirender_evaluation.suites.suite import Scene, Suite, material_key
from unirender_evaluation.task import PROTOCOLS, Task
from unirender_evaluation.tasks import tasks
from unirender_evaluation.versions import LPIPS, REFERENCE

KeyOf = Callable[[str, MethodInfo, Collection[str]], str]  # question, row, parts that it uses -> content key
SHADE_SPP = 256

CEILING_KEY, REFERENCE_KEY = "noise-ceiling", "reference-other-seed"


def ceiling_info(suite: Suite) -> MethodInfo:
    """The row of the noise ceiling."""
    note = "a noise-free prediction against the noisy truth; PSNR from the truth's batch variance (delta method)"
    if suite.spec.ceiling_scenes:
        note += (
            f"; SSIM and LPIPS from an independent render of {suite.spec.ceiling_factor} times the samples, on "
            f"{len(suite.spec.ceiling_scenes)} scenes of the suite"
        )
    return MethodInfo(CEILING_KEY, "Noise ceiling", "ceiling", note=note, config={"bound": CEILING_KEY})


def reference_info(seed: int, scenes: int) -> MethodInfo:
    """The row of the re-rendered truth."""
    return MethodInfo(
        REFERENCE_KEY,
        "Reference (other seed)",
        "reference",
        seed=seed,
        note=f"Mitsuba again, on the {'scene' if scenes == 1 else f'{scenes} scenes'} of the truth check",
        config={"bound": "other-seed", "seed": seed},
    )


class Shade:
    """Mitsuba's shading of given maps under a given light, one surface point per pixel: no shadows, no
    interreflection."""

    name = "shade(true maps)"
    config: Mapping[str, Any] = MappingProxyType({"shade": SHADE_SPP})

    def render(self, intrinsics: Intrinsics) -> Image:
        from unirender_reference.shade import shade

        return shade(intrinsics, spp=SHADE_SPP)


def shade_row(scenes: int | None = None) -> Row:
    """`shade(true maps)`, the ceiling of every closed loop, on that many scenes (None = all)."""
    note = "Mitsuba, one point per pixel, no shadows or interreflection"
    given_light = frozenset({("rendering", "given-light")})
    uses = frozenset({REFERENCE})
    return make_row(Shade(), "reference", protocols=given_light, scenes=scenes, note=note, uses=uses)


def ceiling_values(suite: Suite, task: Task, backbones: Sequence[str] = ()) -> dict[str, float]:
    """The noise ceiling's values for one task; empty where the truth has no variance (maps)."""
    values: dict[str, float] = {}
    if task.truth_image is not None and task.truth_variance is not None:
        values |= noise_ceiling(task.quantity, task.truth_image, task.truth_variance, task.mask, premultiplied=True)
        if task.truth_twin is not None:
            pair = task.truth_twin, task.truth_image
            values |= similarity_ceiling(task.quantity, *pair, task.mask, premultiplied=True, backbones=backbones)
    maps, scene, roughness = task.truth_maps, task.scene, suite.spec.base[1]
    if maps is None or maps.diffuse is None or maps.specular is None:
        return values
    lights = {
        "diffuse": (maps.diffuse, suite.diffuse_variance(scene), suite.ceiling_diffuse(scene)),
        "specular": (
            maps.specular,
            suite.specular_variance(scene, roughness),
            suite.ceiling_specular(scene, roughness),
        ),
    }
    for quantity, (truth, variance, twin) in lights.items():
        values |= noise_ceiling(quantity, truth, variance, task.mask, premultiplied=False)
        if twin is not None:
            values |= similarity_ceiling(quantity, twin, truth, task.mask, premultiplied=False, backbones=backbones)
    return values


TRUE_LIGHT = MethodInfo(
    "true-light-16-x-32",
    "True light, 16 x 32 texels",
    "ceiling",
    note="what the resolution of our light alone costs; on the balls a finer one may do better, maps are compared so",
    config={"bound": "true-light", "shape": list(LIGHT_SHAPE)},
)


def _light_record(task: Task, key: str) -> Record:
    true = task.truth_maps
    if true is None or true.environment is None:
        raise UnirenderError(f"{task.identity}: the suite's truth has no light, expected one")
    found = true.replace(environment=resample_environment(true.environment, LIGHT_SHAPE))
    return record_of(task, TRUE_LIGHT, score_light(found, true), key)


def ceiling_jobs(suite: Suite, scene: Scene, key_of: KeyOf, backbones: Sequence[str]) -> Iterator[Job]:
    """The records of one scene of the bounds that a truth has in itself: the noise ceiling of what is a picture, the
    coarse true light of what is a light."""
    info = ceiling_info(suite)
    for table, protocol in PROTOCOLS:
        for task in tasks(suite, table, protocol, [scene]):
            if task.asks_light:
                key = key_of(task.identity, TRUE_LIGHT, ())
                yield Job(key, TRUE_LIGHT.label, partial(_light_record, task, key))
            elif task.scores_picture:
                key = key_of(task.identity, info, {LPIPS})
                yield Job(key, info.label, partial(_ceiling_record, suite, task, info, key, backbones))


def _ceiling_record(suite: Suite, task: Task, info: MethodInfo, key: str, backbones: Sequence[str]) -> Record:
    return record_of(task, info, ceiling_values(suite, task, backbones), key)


def reference_prediction(
    task: Task, images: dict[str, np.ndarray], suite: Suite
) -> tuple[Image | None, Intrinsics | None]:
    """What the re-rendered truth says to a task: the image, or s and d, as far as they were rendered again."""
    base = suite.spec.base
    if task.table == "rendering":
        return images.get(f"{task.scene.key}.{task.sample.removeprefix(task.scene.key + '_')}"), None
    if task.table != "relighting":
        return None, None
    image = images.get(f"{suite.other_light(task.scene).key}.{material_key(base)}")
    specular, diffuse = (images.get(f"{task.scene.key}.{kind}") for kind in ("specular", "diffuse"))
    if specular is None or diffuse is None or task.truth_maps is None:  # the truth last: it has to be read
        return image, None
    inside = task.mask > 0
    maps = Intrinsics(
        specular=np.where(inside, specular, 0),
        diffuse=np.where(inside, diffuse, 0),
        mask=task.mask,
        camera=suite.spec.camera,
    )
    return image, maps
