"""Rows that are no method's: the noise ceiling, the reference with another seed, and Mitsuba's own shading of true
maps."""

from collections.abc import Callable, Iterator, Mapping
from functools import partial
from types import MappingProxyType
from typing import Any

import numpy as np

from unirender.intrinsics import Intrinsics
from unirender_evaluation.ceiling import noise_ceiling
from unirender_evaluation.engine import Job, record_of
from unirender_evaluation.methods import Image
from unirender_evaluation.records import MethodInfo, Record
from unirender_evaluation.rows import Row, make_row
from unirender_evaluation.suites import Scene, Suite, material_key
from unirender_evaluation.tasks import PROTOCOLS, Task, tasks
from unirender_evaluation.truth_check import TruthCheck

SHADE_SPP = 256
SHADE_SCENES = 12

CEILING = MethodInfo(
    "noise-ceiling",
    "Noise ceiling",
    "ceiling",
    note="a noise-free prediction against the noisy truth; PSNR only, from the truth's batch variance (delta method)",
    config={"bound": "noise-ceiling"},
)


def reference_info(check: dict[str, Any]) -> MethodInfo:
    """The row of the re-rendered truth; its configuration is the check that rendered it."""
    return MethodInfo(
        "reference-other-seed",
        "Reference (other seed)",
        "reference",
        seed=check["seed"],
        note=f"Mitsuba again, on the {len(check['checked_scenes'])} scenes of the truth check",
        config={"bound": "other-seed", "seed": check["seed"], "scenes": check["checked_scenes"]},
    )


class Shade:
    """Mitsuba's shading of given maps under a given light, one surface point per pixel: no shadows, no
    interreflection."""

    name = "shade(true maps)"
    config: Mapping[str, Any] = MappingProxyType({"shade": SHADE_SPP})

    def render(self, intrinsics: Intrinsics) -> Image:
        from unirender_reference.shade import shade

        return shade(intrinsics, spp=SHADE_SPP)


def shade_row() -> Row:
    """`shade(true maps)`: the ceiling of every closed loop."""
    note = "Mitsuba, one point per pixel, no shadows or interreflection"
    given_light = frozenset({("rendering", "given-light")})
    return make_row(Shade(), "reference", protocols=given_light, scenes=SHADE_SCENES, note=note)


def ceiling_values(suite: Suite, task: Task) -> dict[str, float]:
    """The noise ceiling's values for one task; empty where the truth has no variance (maps)."""
    values: dict[str, float] = {}
    if task.truth_image is not None and task.truth_variance is not None:
        values |= noise_ceiling(task.quantity, task.truth_image, task.truth_variance, task.mask, premultiplied=True)
    maps = task.truth_maps
    if maps is not None and maps.diffuse is not None:
        values |= noise_ceiling(
            "diffuse", maps.diffuse, suite.diffuse_variance(task.scene), task.mask, premultiplied=False
        )
    if maps is not None and maps.specular is not None:
        variance = suite.specular_variance(task.scene, suite.spec.base[1])
        values |= noise_ceiling("specular", maps.specular, variance, task.mask, premultiplied=False)
    return values


def ceiling_jobs(suite: Suite, scene: Scene, key_of: Callable[[str, MethodInfo], str]) -> Iterator[Job]:
    """The noise ceiling's records of one scene; `key_of` gives the content key of a question."""
    for table, protocol in PROTOCOLS:
        for task in tasks(suite, table, protocol, [scene]):
            if task.truth_variance is not None:
                key = key_of(task.identity, CEILING)
                yield Job(key, CEILING.label, partial(_ceiling_record, suite, task, key))


def _ceiling_record(suite: Suite, task: Task, key: str) -> Record:
    return record_of(task, CEILING, ceiling_values(suite, task), key)


def reference_images(check: TruthCheck) -> dict[str, np.ndarray]:
    """The re-rendered members by name, as the truth check stores them."""
    return {c.name: c.mean for c in check.checks}


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
    if task.truth_maps is None or specular is None or diffuse is None:
        return image, None
    inside = task.mask > 0
    maps = Intrinsics(
        specular=np.where(inside, specular, 0),
        diffuse=np.where(inside, diffuse, 0),
        mask=task.mask,
        camera=suite.spec.camera,
    )
    return image, maps
