"""The shadows that a picture's own surfaces cast, against those that Mitsuba traces."""

import numpy as np
import pytest

from unirender.color import image_srgb
from unirender.composite import split_sum_image
from unirender.intrinsics import Intrinsics
from unirender.pipelines import bounced_light
from unirender.pipelines.derived_light import derived_light
from unirender.pipelines.rendered_maps import ready_to_render
from unirender.pipelines.shadowed_light import visible_shares
from unirender_reference.lights import make_light
from unirender_reference.render import Sample, SceneSpec, render_sample
from unirender_reference.shapes import make_object

LIGHT = ("specular", "diffuse")
CONCAVE = (0, 6, 11)  # seeds of training objects that shadow themselves
LEAST_GAIN = 0.7  # dB in the mean
LEAST_REFLECTED = 0.05


def masked_psnr(found: np.ndarray, truth: np.ndarray, mask: np.ndarray) -> float:
    error = (mask * np.square(image_srgb(np.clip(found, 0, 1)) - image_srgb(np.clip(truth, 0, 1)))).mean() / mask.mean()
    return float(-10 * np.log10(error))


@pytest.fixture(scope="module")
def samples() -> list[Sample]:
    specs = [SceneSpec(make_object(i, "train"), make_light(i, "train"), 0.5, 0.0, resolution=64) for i in CONCAVE]
    return [render_sample(spec, spp=32) for spec in specs]


@pytest.fixture(scope="module")
def scenes(samples: list[Sample]) -> list[Intrinsics]:
    return [sample.intrinsics for sample in samples]


def shares(scene: Intrinsics) -> dict[str, np.ndarray]:
    """What the seen shadows leave of s and d."""
    return visible_shares(scene, scene.require("environment")["environment"])


def gain(scene: Intrinsics, left: dict[str, np.ndarray]) -> list[float]:
    """What shadows gain over none, in dB of s and d."""
    maps = scene.require("environment", "mask", *LIGHT)
    plain = derived_light(scene, maps["environment"], LIGHT, shadows=False)
    scores = [
        [masked_psnr(s[name], maps[name], maps["mask"]) for name in LIGHT]
        for s in ({name: plain[name] * left[name] for name in LIGHT}, plain)
    ]
    return np.subtract(scores[0], scores[1]).tolist()


@pytest.mark.long
def test_s_and_d_are_nearer_to_what_mitsuba_renders(scenes: list[Intrinsics]) -> None:
    found = np.array([gain(scene, shares(scene)) for scene in scenes])
    assert found.mean(axis=0).min() > LEAST_GAIN, found
    assert found.min() > 0, found
    none = {name: np.ones_like(scenes[0].require("normal")["normal"]) for name in LIGHT}
    assert gain(scenes[0], none) == [0, 0]
    # the twin: as much shadow, elsewhere; less light alone is nearer, too
    upside_down = [{name: share[::-1] for name, share in shares(scene).items()} for scene in scenes]
    wrong = np.array([gain(scene, left) for scene, left in zip(scenes, upside_down, strict=True)])
    assert (found - wrong).mean(axis=0).min() > LEAST_GAIN, (found, wrong)


@pytest.mark.long
def test_pictures_are_nearer_with_what_the_object_reflects(
    samples: list[Sample], monkeypatch: pytest.MonkeyPatch
) -> None:
    def gains(reflected: float) -> np.ndarray:
        """In dB over hidden directions that are black, of the closed form under the light alone."""
        found = []
        for c in (reflected, 0.0):
            monkeypatch.setattr(bounced_light, "REFLECTED", c)
            for sample in samples:
                mask = sample.intrinsics.require("mask")["mask"]
                ready = ready_to_render(sample.intrinsics.replace(specular=None, diffuse=None))
                found.append(masked_psnr(split_sum_image(ready), sample.image_linear, mask))
        return np.subtract(*np.split(np.array(found), 2))

    chosen = bounced_light.REFLECTED
    found = gains(chosen)
    assert found.mean() > LEAST_REFLECTED, found
    assert gains(10 * chosen).mean() < 0  # the twin: more light is not better by itself
