"""Passes of any integrator: the same samples as Mitsuba's own, further channels, repaired pixels, weighted means,
groups of passes."""

import weakref

import numpy as np
import occluders
import pytest
import reference_scenes as scenes

from unirender.errors import UnirenderError
from unirender_reference import passes as module
from unirender_reference import sample_counts
from unirender_reference.backend import mitsuba
from unirender_reference.integrators import path_integrator, python_integrator
from unirender_reference.passes import (
    NAN_ATTEMPTS,
    PIXELS_PER_BLOCK,
    Counters,
    derive_seed,
    finite_pass,
    group_means,
    integrator_passes,
    mean_estimate,
    ratio_estimate,
    render_passes,
    weighted_estimate,
)
from unirender_reference.render import Renderer
from unirender_reference.sample_counts import MOST_KEPT, MOST_SPLITS, kept_passes, next_spp, pass_count

SIZE = 24
SPP, BATCHES = 64, 4


@pytest.fixture(scope="module")
def scene():
    renderer = Renderer(occluders.torus(), resolution=SIZE)
    return renderer.scene.show("principled", {"roughness": 0.3, "metallic": 0.5}, scenes.environment())


def delegate(depth: int, extra: bool = False):
    """An integrator in Python that asks Mitsuba's path tracer."""
    path = path_integrator(depth)

    def radiance(scene, sampler, ray, active):
        light, hit, _ = path.sample(scene, sampler, ray, None, active)
        return light, hit, [light.y, mitsuba().Float(2)] if extra else []

    return python_integrator(radiance, ["green", "two"] if extra else [])


def test_passes_of_the_path_tracer_are_its_renders(scene) -> None:
    mi = mitsuba()
    counters = Counters()
    passes, nan_pixels = render_passes(scene, 4, SPP, 7, BATCHES, counters)
    integrator = mi.load_dict({"type": "path", "max_depth": 4, "hide_emitters": True})
    for index, picture in enumerate(passes):
        seed = derive_seed(7, "pass", index, 0)
        assert np.array_equal(picture, np.array(mi.render(scene, integrator=integrator, spp=SPP // BATCHES, seed=seed)))
    assert (len(passes), nan_pixels, counters.renders) == (BATCHES, 0, BATCHES)


def test_integrator_in_python_has_the_same_film_sampler_and_seeds(scene) -> None:
    """It repeats the native integrator bit by bit, and its further channels stand behind RGBA."""
    native, _ = integrator_passes(scene, path_integrator(3), SPP, 7, BATCHES, Counters())
    assert np.array_equal(native, integrator_passes(scene, delegate(3), SPP, 7, BATCHES, Counters())[0])
    passes, _ = integrator_passes(scene, delegate(3, extra=True), SPP, 7, BATCHES, Counters())
    more, native = np.stack(passes), np.stack(native)
    assert more.shape == (BATCHES, SIZE, SIZE, 6)
    assert np.array_equal(more[..., :4], native)
    np.testing.assert_allclose(more[..., 4], native[..., 1], rtol=1e-6)
    np.testing.assert_allclose(more[..., 5], 2, rtol=1e-6)
    assert not np.array_equal(native, integrator_passes(scene, delegate(3), SPP, 8, BATCHES, Counters())[0])
    assert not np.array_equal(native, integrator_passes(scene, delegate(2), SPP, 7, BATCHES, Counters())[0])


def broken(share: float):
    """An integrator that gives NaN in this share of its samples and 1 in the others.

    Not in all: Dr.Jit's `scatter_reduce` drops NaN where a packet of lanes has only NaN and 0 for a pixel.
    """

    def radiance(scene, sampler, ray, active):
        import drjit as dr

        mi = mitsuba()
        good = sampler.next_1d(active) >= share
        return mi.Color3f(dr.select(good, 1.0, dr.nan)), active, []

    return python_integrator(radiance)


def test_nan_of_any_integrator_is_rendered_again_and_counted(scene) -> None:
    counters = Counters()
    passes, nan_pixels = integrator_passes(scene, broken(0.01), SPP, 3, BATCHES, counters)
    np.testing.assert_allclose(passes, 1, rtol=1e-6)
    expected = (1 - 0.99 ** (SPP // BATCHES)) * np.size(passes) / 4
    assert abs(nan_pixels - expected) < 5 * np.sqrt(expected)
    assert counters.nan_pixels == nan_pixels
    with pytest.raises(UnirenderError, match="stay NaN"):
        integrator_passes(scene, broken(0.5), SPP, 3, BATCHES, counters)


def test_only_the_pixels_that_are_not_finite_are_taken_from_other_draws() -> None:
    """One broken channel breaks a pixel; the last of the attempts counts, too."""

    def drawn(attempt: int) -> np.ndarray:
        picture = np.full((2, 2, 3), float(attempt))
        picture[0, 0, 1] = np.nan if attempt < last else attempt
        picture[1, 1, 2] = np.inf if attempt == 0 else attempt
        return picture

    counters, last = Counters(nan_pixels=5), NAN_ATTEMPTS
    assert finite_pass(drawn, counters, "render").tolist() == [[[last] * 3, [0] * 3], [[0] * 3, [1] * 3]]
    assert counters.nan_pixels == 5 + 2
    last += 1
    with pytest.raises(UnirenderError, match="render: 1 pixels stay NaN after 8 seeds"):
        finite_pass(drawn, counters, "render")


def test_the_variance_of_two_passes_is_that_of_their_mean() -> None:
    tall = np.ones((PIXELS_PER_BLOCK + 3, 2, 3), np.float32)  # several blocks of rows
    estimate = mean_estimate([tall, 3 * tall], 4, 2)
    assert estimate.variance is not None
    assert (estimate.mean == 2).all()
    assert (estimate.variance == 1).all()
    assert estimate.nan_pixels == 4
    assert mean_estimate([tall], 0, 1).variance is None


def test_weighted_estimate_divides_by_the_weights_of_each_channel() -> None:
    """The variance is that of the ratio: light and weight vary together, and so their ratio varies less."""
    rng = np.random.default_rng(0)
    trials, n = 4000, 8
    weight = rng.uniform(0.2, 1, (n, trials, 1, 3))
    light = weight * np.array([1.0, 2.0, 3.0]) + rng.normal(0, 0.02, weight.shape)
    weight[:, 0] = light[:, 0] = 0
    estimate = weighted_estimate(list(light.astype(np.float32)), list(weight.astype(np.float32)), 5, n)
    assert estimate.variance is not None
    assert estimate.nan_pixels == 5
    assert not estimate.mean[0].any()
    assert not estimate.variance[0].any()
    assert np.abs(estimate.mean[1:].mean(axis=(0, 1)) - (1, 2, 3)).max() < 1e-3
    ratio = estimate.variance[1:].mean(axis=(0, 1)) / estimate.mean[1:].var(axis=(0, 1))
    assert np.abs(ratio - 1).max() < 0.15
    apart = (light.var(axis=0, ddof=1) / n / weight.mean(axis=0).clip(1e-9) ** 2)[1:].mean(axis=(0, 1))
    assert (apart > 5 * estimate.variance[1:].mean(axis=(0, 1))).all()  # light alone varies with its weight
    assert weighted_estimate(list(light.astype(np.float32)), list(weight.astype(np.float32)), 0, 1).variance is None


def test_coverage_is_one_weight_for_all_channels() -> None:
    passes = np.random.default_rng(1).random((8, 5, 6, 4)).astype(np.float32)
    coverage = np.repeat(passes[..., 3:], 3, axis=-1)
    one, three = ratio_estimate(list(passes), 0, 8), weighted_estimate(list(passes[..., :3]), list(coverage), 0, 8)
    assert np.array_equal(one.mean, three.mean)
    assert one.variance is not None
    assert three.variance is not None
    assert np.array_equal(one.variance, three.variance)


@pytest.mark.parametrize(
    ("count", "batches", "side", "kept"),
    [
        (8, 8, 64, 8),
        (32, 8, 64, 32),
        (64, 8, 64, 32),
        (512, 16, 1024, 32),
        (40, 40, 64, 40),
        (67, 1, 64, 1),
        (48, 8, 2048, 8),  # of large pictures as few as the batches allow
        (48, 16, 2048, 16),
        (36, 8, 2048, 9),
    ],
)
def test_few_passes_are_kept_of_many(count: int, batches: int, side: int, kept: int) -> None:
    assert kept_passes(count, batches, side**2) == kept


def test_passes_come_in_numbers_that_make_groups() -> None:
    """However many samples: at least `batches` equal groups, and not many more than are kept."""
    for batches in (2, 8, 16, 20):
        for most in (1, 8, 64):
            for wanted in (1, 67 * 64, 8 * 67, 5003, 40000):
                spp = next_spp(wanted, batches, most)
                count = pass_count(spp, batches, most)
                kept = kept_passes(count, batches, 64**2)
                assert batches <= kept <= max(MOST_KEPT, MOST_SPLITS * batches)
                assert count % kept == spp % count == 0


def test_samples_are_divided_into_the_fewest_full_grids() -> None:
    """40 in 4 batches: 10 are no grid, 8 are 2 x 4. A seed is the same in every process.

    67 samples would be 67 passes of one sample each, not stratified at all; small passes that the wavefront asks for
    are right.
    """
    asked = ((40, 4, 64), (100, 1, 64), (13, 8, 64), (32, 1, 1 << 20), (2048, 8, 1 << 20), (67, 1, 1))
    assert [pass_count(*of) for of in asked] == [5, 4, 13, 2, 8, 67]
    assert next_spp(3, 8, 64) == 8
    for spp, batches, said in (
        (67, 1, "use 64 or 70"),
        (8 * 67, 8, "use 531 or 539"),
        (5, 0, "5 in 0 batches"),
        (0, 0, "0 in 0 batches"),
        (7, 8, "at least one sample in each"),
    ):
        with pytest.raises(UnirenderError, match=said):
            pass_count(spp, batches, 1 << 20)
    for better in (64, 70):
        assert pass_count(better, 1, 1 << 20) <= MOST_SPLITS
    assert derive_seed(7, "pass", 0, 1) == 17919641


def test_more_passes_than_anybody_waits_for_are_refused_at_once() -> None:
    """Finding how to divide them would take as long."""
    with pytest.raises(UnirenderError, match=r"spp: got 1\d+, expected at most 64,000,000, "):
        pass_count(10**20, 1, 64)
    assert pass_count(64 * sample_counts.MOST_PASSES, 1, 64) == sample_counts.MOST_PASSES


def test_groups_are_means_of_successive_passes() -> None:
    passes = np.random.default_rng(0).random((6, 3, 4, 5)).astype(np.float32)
    assert np.array_equal(group_means(iter(passes), 6, 6), passes)
    pairs = (passes[::2].astype(np.float64) + passes[1::2]) / 2
    assert np.array_equal(group_means(iter(passes), 6, 3), pairs.astype(np.float32))


def test_variance_of_groups_is_that_of_passes() -> None:
    """The same mean, and the same expected variance of it, for means and for ratios."""
    rng = np.random.default_rng(1)
    n, groups, trials = 64, 16, 20000
    coverage = rng.uniform(0.2, 1, (n, trials, 1, 1))
    passes = np.concatenate([coverage * rng.normal(1, 0.1, (n, trials, 1, 3)), coverage], axis=-1).astype(np.float32)
    grouped = group_means(iter(passes), n, groups)
    for estimate in (mean_estimate, ratio_estimate):
        all_of_them, few = estimate(list(passes), 0, 8), estimate(grouped, 0, 8)
        np.testing.assert_allclose(few.mean, all_of_them.mean, rtol=1e-6)
        assert few.variance is not None
        assert all_of_them.variance is not None
        # Standard error of the mean of 20000 variances of 15 degrees of freedom: 0.26 %.
        ratio = few.variance.mean(axis=(0, 1)) / all_of_them.variance.mean(axis=(0, 1))
        assert np.abs(ratio - 1).max() < 0.015
        assert np.abs(ratio * groups / (groups - 1) - 1).min() > 0.015  # the twin: one degree of freedom wrong


def test_memory_does_not_grow_with_the_samples(scene, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of 128 passes, 32 pictures are the result, and one or two are alive besides."""
    monkeypatch.setattr(module, "SAMPLES_PER_PASS", SIZE**2)
    genuine, drawn, alive = module._render, [], []

    def render(*args):
        picture = genuine(*args)
        drawn.append(weakref.ref(picture))
        alive.append(sum(reference() is not None for reference in drawn))
        return picture

    monkeypatch.setattr(module, "_render", render)
    passes, _ = integrator_passes(scene, path_integrator(2), 128, 7, BATCHES, Counters())
    assert np.shape(passes) == (MOST_KEPT, SIZE, SIZE, 4)
    assert len(drawn) == 128
    assert max(alive) <= 2


def test_grouped_passes_are_those_of_the_same_seeds(scene, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "SAMPLES_PER_PASS", SIZE**2)
    grouped, _ = render_passes(scene, 2, 64, 7, BATCHES, Counters())
    monkeypatch.setattr(sample_counts, "MOST_KEPT", 64)
    single, _ = render_passes(scene, 2, 64, 7, BATCHES, Counters())
    assert (len(grouped), len(single)) == (MOST_KEPT, 64)
    pairs = np.stack(single).reshape(MOST_KEPT, 2, *single[0].shape)
    np.testing.assert_allclose(grouped, pairs.mean(axis=1), rtol=1e-6)
