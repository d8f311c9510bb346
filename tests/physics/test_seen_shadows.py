"""The shadows that a picture's own surfaces cast, against those that Mitsuba traces."""

import numpy as np
import pytest

from unirender.color import image_srgb
from unirender.intrinsics import Intrinsics
from unirender.pipelines.derived_light import derived_light
from unirender_reference.lights import make_light
from unirender_reference.render import SceneSpec, render_sample
from unirender_reference.shapes import make_object

LIGHT = ("specular", "diffuse")
CONCAVE = (0, 6, 11)  # seeds of training objects that shadow themselves
LEAST_GAIN = 0.7  # dB in the mean; about 1.8 are found


def masked_psnr(found: np.ndarray, truth: np.ndarray, mask: np.ndarray) -> float:
    error = (mask * np.square(image_srgb(np.clip(found, 0, 1)) - image_srgb(np.clip(truth, 0, 1)))).mean() / mask.mean()
    return float(-10 * np.log10(error))


@pytest.fixture(scope="module")
def scenes() -> list[Intrinsics]:
    specs = [SceneSpec(make_object(i, "train"), make_light(i, "train"), 0.5, 0.0, resolution=64) for i in CONCAVE]
    return [render_sample(spec, spp=32).intrinsics for spec in specs]


def gains(scenes: list[Intrinsics], turned: bool = False) -> np.ndarray:
    """What shadows gain in dB, by scene and `LIGHT`; `turned`: those of the normals upside down."""
    found = []
    for scene in scenes:
        maps = scene.require("environment", "mask", *LIGHT)
        plain = derived_light(scene, maps["environment"], LIGHT, shadows=False)
        lit = derived_light(scene, maps["environment"], LIGHT)
        if turned:
            lit = {name: plain[name] * (lit[name] / np.maximum(plain[name], 1e-6))[::-1] for name in LIGHT}
        scores = [[masked_psnr(s[name], maps[name], maps["mask"]) for name in LIGHT] for s in (plain, lit)]
        found.append(np.subtract(scores[1], scores[0]))
    return np.array(found)


def test_s_and_d_are_nearer_to_what_mitsuba_renders(scenes: list[Intrinsics]) -> None:
    found = gains(scenes)
    assert found.mean(axis=0).min() > LEAST_GAIN, found
    assert found.min() > 0, found
    wrong = gains(scenes, turned=True)  # the twin: the shadows of another place
    assert wrong.mean(axis=0).max() < 0, wrong
