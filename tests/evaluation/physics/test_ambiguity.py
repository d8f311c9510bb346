"""The ambiguity test: the region is exact for any posterior, and Mitsuba finds the materials that explain a picture."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from unirender.color import image_srgb, unpremultiply
from unirender.errors import UnirenderError
from unirender_evaluation.methods.method import quantise
from unirender_evaluation.physics import ambiguity
from unirender_evaluation.physics.ambiguity import EXPLANATIONS, POSTERIOR, SIGMAS, Points, material_point
from unirender_evaluation.physics.region import RESOLUTION, inside, perfect_share, volume
from unirender_evaluation.physics.stage import Stage
from unirender_evaluation.physics.tests import TESTS
from unirender_evaluation.suites.suite import load_suite
from unirender_reference.render import Renderer

SCENE = "test-000015_l1"  # its truth took the fewest samples


def curved(rng: np.random.Generator, count: int) -> Points:
    """Points of a bent sheet: no normal distribution."""
    u, v = rng.random((2, count))
    return np.stack([u, (u - 0.5) ** 2 * 3, 0.2 + 0.1 * v], axis=-1)


def mean_share(shrink: float, samples: int = POSTERIOR, trials: int = 400) -> float:
    """Share of fresh draws inside the region of samples that are shrunk about their mean."""
    rng = np.random.default_rng(0)
    shares = []
    for _ in range(trials):
        z = curved(rng, samples)
        z = z.mean(axis=0) + shrink * (z - z.mean(axis=0))
        shares.append(inside(z, curved(rng, EXPLANATIONS)).mean())
    return float(np.mean(shares))


@pytest.mark.parametrize("samples", [9, 19, 33])
def test_the_region_holds_what_it_says_whatever_the_posterior(samples: int) -> None:
    """Within four standard errors; samples that are too sure do not, and too broad ones hold more."""
    assert mean_share(1.0, samples) == pytest.approx(perfect_share(samples), abs=0.035)
    assert mean_share(0.5, samples) < perfect_share(samples) - 0.15
    assert mean_share(2.0, samples) > perfect_share(samples) + 0.04


def test_the_expected_share() -> None:
    assert perfect_share(POSTERIOR) == pytest.approx(0.9)
    assert TESTS["ambiguity_share"].expected == perfect_share(POSTERIOR)


def test_volume() -> None:
    """It grows with the cube of the spread, is next to nothing without one, and nearly all for any material at all."""
    rng = np.random.default_rng(1)
    z = rng.normal(size=(POSTERIOR, 3))
    small, large = (volume(0.5 + spread * z) for spread in (0.03, 0.06))
    assert large / small == pytest.approx(8, rel=0.1)
    assert volume(np.full((POSTERIOR, 3), 0.5)) < 20 * RESOLUTION**3 + 1e-5
    assert volume(rng.random((POSTERIOR, 3))) > 0.6


def test_samples_that_are_all_the_same_hold_themselves() -> None:
    z = np.full((POSTERIOR, 3), 0.5)
    assert inside(z, np.array([[0.5, 0.5, 0.5], [0.5, 0.5, 0.53]])).tolist() == [True, False]


def test_too_few_samples_have_no_region() -> None:
    with pytest.raises(UnirenderError, match="got 8 samples, expected at least 9"):
        inside(np.zeros((8, 3)), np.zeros((1, 3)))


@pytest.mark.long
def test_what_mitsuba_finds_explains_the_picture(monkeypatch: pytest.MonkeyPatch) -> None:
    """The true material does, and so do materials found, rendered again with many samples; others do not. A perfect
    posterior passes both tests, and their twins fail."""
    monkeypatch.setattr(ambiguity, "LEVELS", (0.0, 0.25, 0.5, 0.75, 1.0))
    suite = load_suite("tiny")
    stage = Stage(suite, suite.scene(SCENE))
    found, (m, r) = stage.explanations, stage.own_material
    truth = material_point(stage.true_maps((m, r)), stage.mask)
    assert truth == pytest.approx([m, r, found.true_luminance], abs=1e-6)
    limit = SIGMAS * found.sigma
    for point in (truth, *found.materials[:2]):
        assert display_distance(stage, point) < 1.3 * limit  # the levels are far apart here
    smooth = np.array([m, 0.1, found.true_luminance])
    assert display_distance(stage, smooth) > 1.3 * limit, "twin: another roughness"
    assert not (found.posterior[:, 1] < 0.2).any()
    share, size = TESTS["ambiguity_share"], TESTS["ambiguity_volume"]

    def perfect(stage: Stage, *_: object) -> Points:
        return stage.explanations.posterior

    assert share.run(perfect, stage) > 0.6
    assert share.fails(share.run(share.twin, stage), share.run(perfect, stage))
    assert size.fails(size.run(size.twin, stage), size.run(perfect, stage))
    assert 0.1 * found.volume < size.run(perfect, stage) < 10 * found.volume


def display_distance(stage: Stage, point: np.ndarray) -> float:
    """RMS of display values between the input and Mitsuba's picture of a material, over the object."""
    own = stage.mitsuba.renderer
    factor = np.float32(point[2] / stage.explanations.true_luminance)
    renderer = Renderer(replace(own.obj, albedo=own.obj.albedo * factor), own.camera, own.resolution)
    light = stage.suite.environment(stage.scene)
    made = renderer.image(light, float(point[1]), float(point[0]), 1024, seed=1).mean[..., :3]
    shown = quantise(stage.image(stage.own_material), stage.mask)
    error = np.square(image_srgb(unpremultiply(made, stage.mask)) - shown)
    return float(np.sqrt((error * stage.mask).sum() / (3 * stage.mask.sum())))


def test_the_example_of_the_documentation_prints_what_it_says(capsys: pytest.CaptureFixture[str]) -> None:
    page = (Path(__file__).resolve().parents[3] / "docs" / "physics.md").read_text(encoding="utf-8")
    code = page.partition("```python\n")[2].partition("```")[0]
    exec(code, {})
    assert capsys.readouterr().out.split() == code.rpartition("#")[2].split()
