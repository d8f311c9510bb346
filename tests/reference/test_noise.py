"""The noise floor: closed forms, rare events, and renders to a floor that a 64-fold render confirms."""

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from inline_executor import Inline
from reference_scenes import light, sphere

from unirender.color import display_slope, image_srgb
from unirender.errors import UnirenderError
from unirender_reference.measure import noise_floor
from unirender_reference.measure.noise_floor import FloorRow, NoiseFloor, summary
from unirender_reference.noise import (
    FLOOR_BATCHES,
    FloorEstimate,
    combined,
    floor_range,
    full_spp,
    measured_floor_db,
    noise_floor_db,
    render_to_floor,
)
from unirender_reference.passes import Estimate
from unirender_reference.render import Renderer
from unirender_reference.sample_counts import SAMPLES_PER_PASS, pass_count

SHAPE = (64, 64, 3)
WHOLE = np.ones((64, 64, 1), np.float32)


def decibels(a: np.ndarray, b: np.ndarray, mask: np.ndarray = WHOLE) -> float:
    error = np.square(image_srgb(a).astype(np.float64) - image_srgb(b))
    return float(-10 * np.log10((mask * error).sum() / (3 * mask.sum())))


@pytest.mark.parametrize("level", [0.001, 0.2, 0.9])
def test_constant_noise_has_the_closed_form(level: float) -> None:
    """-10 log10(D'(m)^2 v): 12.92^2 v on the toe, the derivative of the power above it; twin: the linear error."""
    mean, variance = np.full(SHAPE, level), np.full(SHAPE, 1e-10)
    slope = 12.92 if level < 0.0031308 else 1.055 / 2.4 * level ** (1 / 2.4 - 1)
    exact = -10 * math.log10(slope**2 * 1e-10)
    assert noise_floor_db(mean, variance, WHOLE, premultiplied=False) == pytest.approx(exact, abs=1e-6)
    assert abs(exact - 100) > 1, "linear light has another floor"
    larger = floor_range(mean, variance * 1e4, WHOLE, premultiplied=False)[0]
    assert larger == pytest.approx(exact - 40, abs=0.05), "little noise: curve and tangent agree"


def test_a_mask_of_half_floats_is_one_of_coverage() -> None:
    """Sums of more than 65,504 pixels, and squares of an edge's coverage, are beyond half floats."""
    mask = np.full((300, 300, 1), 0.5, np.float16)
    mask[0] = 1e-4
    mean, variance = np.full((300, 300, 3), 0.2, np.float32) * mask, np.full((300, 300, 3), 1e-8, np.float32) * mask
    for measure in (noise_floor_db, lambda *given: floor_range(*given)[0]):
        exact = measure(mean, variance, mask.astype(np.float32), True)
        assert 60 < exact < 80
        assert measure(mean, variance, mask, True) == exact


def test_coverage_divides_and_weights() -> None:
    """A premultiplied pixel of coverage a: m / a, s / a, weight a; pixels outside count nothing."""
    mask = np.zeros((2, 2, 1), np.float32)
    mask[0, 0], mask[0, 1] = 1, 0.25
    mean, variance = 0.4 * mask * np.ones(3), np.array([[1e-6, 4e-6], [1.0, 1.0]])[..., None] * np.ones(3)
    slope = float(display_slope(np.array(0.4)))
    error = slope**2 * (1 * 1e-6 + 0.25 * 4e-6 / 0.25**2) / 1.25
    found = noise_floor_db(mean, variance, mask, premultiplied=True)
    assert found == pytest.approx(-10 * math.log10(error), abs=1e-5)
    assert floor_range(mean, variance, mask, premultiplied=True)[0] == pytest.approx(found, abs=0.05)
    assert noise_floor_db(mean, variance, mask, premultiplied=False) != pytest.approx(found, abs=1)


def test_the_floor_is_the_score_of_a_noise_free_prediction() -> None:
    """Monte Carlo against both formulas; the twin is the score of another noisy render, 3 dB worse."""
    rng = np.random.default_rng(0)
    clean = rng.uniform(0.05, 0.9, SHAPE).astype(np.float32)
    sigma = 0.01 * clean
    noisy, again = (clean + sigma * rng.standard_normal(SHAPE, np.float32) for _ in range(2))
    predicted = noise_floor_db(noisy, sigma**2, WHOLE, premultiplied=True)
    assert floor_range(noisy, sigma**2, WHOLE, premultiplied=True)[0] == pytest.approx(predicted, abs=0.02)
    assert decibels(clean, noisy) == pytest.approx(predicted, abs=0.15)
    assert decibels(again, noisy) == pytest.approx(predicted - 3.01, abs=0.15)


@pytest.mark.parametrize("hits", [0.5, 1.0, 3.0, 10.0])
def test_rare_events_cost_what_the_curve_says(hits: float) -> None:
    """Pixels that a Poisson number of samples hits: the expected floor is the one measured, to 1.2 dB; the delta
    method, the twin, is 1.5 dB and more too good where samples are few."""
    rng = np.random.default_rng(1)
    batches = rng.poisson(hits / FLOOR_BATCHES, (FLOOR_BATCHES, 128, 128, 1)) * 0.3 * FLOOR_BATCHES / hits
    batches = batches * np.ones(3)
    mean, variance = batches.mean(axis=0), batches.var(axis=0, ddof=1) / FLOOR_BATCHES
    mask = np.ones((128, 128, 1), np.float32)
    measured = decibels(np.full_like(mean, 0.3), mean, mask)
    assert floor_range(mean, variance, mask, premultiplied=True)[0] == pytest.approx(measured, abs=1.2)
    if hits < 5:
        assert noise_floor_db(mean, variance, mask, premultiplied=True) > measured + 1.5


def test_a_floor_is_surer_the_more_pixels_carry_the_noise() -> None:
    """Even noise leaves `sure` a fraction of a decibel below; one pixel with nearly all of it, 4.8 dB: 1 + 2."""
    mean, even = np.full(SHAPE, 0.5), np.full(SHAPE, 1e-6)
    single = np.full(SHAPE, 1e-14)
    single[3, 4] = 1e-6
    expected, sure = floor_range(mean, even, WHOLE, premultiplied=True)
    assert 10 * math.log10(1 + 2 / 64) == pytest.approx(expected - sure, abs=1e-3)
    expected, sure = floor_range(mean, single, WHOLE, premultiplied=True)
    assert expected - sure == pytest.approx(10 * math.log10(3), abs=0.01)


def test_combined_estimates_are_weighted_by_their_samples() -> None:
    """Against the estimate from all samples at once; the twin, the plain mean of the two, is another one."""
    rng = np.random.default_rng(1)
    samples = rng.random((24, 4, 4, 3))
    parts = [samples[:8], samples[8:]]
    a, b = (FloorEstimate(x.mean(0), x.var(0, ddof=1) / len(x), len(x), 0.0, 0.0, 40.0, 1) for x in parts)
    both = combined(a, b, lambda mean, variance: (float(mean.sum()), float(variance.sum())))
    np.testing.assert_allclose(both.mean, samples.mean(0), rtol=1e-12)
    assert (both.spp, both.nan_pixels, both.asked_db) == (24, 2, 40.0)
    within = sum((len(x) / 24) ** 2 * x.var(0, ddof=1) / len(x) for x in parts)
    np.testing.assert_allclose(both.variance, within, rtol=1e-12)
    assert (both.floor_db, both.sure_db) == (both.mean.sum(), both.variance.sum()), "measured anew"
    assert np.abs((a.mean + b.mean) / 2 - samples.mean(0)).max() > 0.01


@pytest.mark.parametrize("premultiplied", [True, False])
def test_the_measured_floor_is_the_error_less_what_the_long_render_has_left(premultiplied: bool) -> None:
    """Weighted by coverage; nothing is left where noise explains it all."""
    mask = np.where(np.arange(64)[:, None, None] < 32, 1, 0.25).astype(np.float32) * WHOLE
    scale = mask if premultiplied else WHOLE
    level = np.where(mask == 1, 0.41, 0.43) * np.ones(3)
    picture = Estimate((level * scale).astype(np.float32), None)
    converged = Estimate(
        (0.4 * scale * np.ones(3)).astype(np.float32), (1e-6 * scale**2 * np.ones(3)).astype(np.float32)
    )
    shown = image_srgb(np.array([0.4, 0.41, 0.43]))
    error = np.average(np.square(shown[1:] - shown[0]), weights=[1, 0.25])
    left = float(display_slope(np.array(0.4))) ** 2 * 1e-6
    found = measured_floor_db(picture, converged, mask, premultiplied)
    assert found == pytest.approx(-10 * math.log10(error - left), abs=2e-3)
    assert abs(-10 * math.log10(error) - found) > 0.01  # the twin: the long render taken for exact
    assert measured_floor_db(converged, converged, mask, premultiplied) == math.inf
    with pytest.raises(UnirenderError, match="without variance"):
        measured_floor_db(converged, picture, mask, premultiplied)


@pytest.mark.parametrize("wanted", [1, 9, 256, 1000, 20_000, 60_000])
@pytest.mark.parametrize("batches", [1, 8, 16])
def test_sample_counts_make_full_passes(wanted: int, batches: int) -> None:
    spp, most = full_spp(wanted, batches, 64 * 64), SAMPLES_PER_PASS // 64**2
    assert spp >= wanted
    assert spp <= max(1.25 * wanted, wanted + 2 * batches)
    passes = pass_count(spp, batches, most)
    assert spp // passes <= most
    assert batches <= passes <= batches * (spp // (batches * most) + 1)


def simulated(unit: np.ndarray, calls: list[tuple[int, int]]) -> Callable[[int, int], Estimate]:
    """A render whose samples have the variance `unit`."""

    def render(spp: int, seed: int) -> Estimate:
        calls.append((spp, seed))
        noise = np.random.default_rng(seed).standard_normal(unit.shape) * np.sqrt(unit / spp)
        return Estimate((0.5 + noise).astype(np.float32), (unit / spp).astype(np.float32), nan_pixels=2)

    return render


def test_sampling_goes_on_until_the_floor_is_reached() -> None:
    """The first render says how many samples are missing; all count; every one has its own seed."""
    unit, calls = np.random.default_rng(0).uniform(0.01, 0.07, SHAPE), []
    found = render_to_floor(simulated(unit, calls), WHOLE, 45, premultiplied=True, spp=64, seed=7)
    assert found.reached
    assert 45 <= found.sure_db <= found.floor_db < 45.7
    assert 1 < len(calls) <= 5
    assert [seed for _, seed in calls] == [7 + i for i in range(len(calls))]
    assert found.spp == sum(count for count, _ in calls)
    assert found.nan_pixels == 2 * len(calls)
    np.testing.assert_allclose(found.variance, unit / found.spp, rtol=1e-4)
    assert np.abs((found.mean - 0.5) / np.sqrt(unit / found.spp)).max() < 6


def test_a_floor_is_that_of_the_colours_or_what_it_is_measured_by() -> None:
    """Noise of the coverage does not count; a measure of one's own decides alone."""
    unit, calls = np.full((64, 64, 4), 0.01), []
    unit[..., 3] = 1e3
    assert render_to_floor(simulated(unit, calls), WHOLE, 30, premultiplied=True, spp=64).spp == 64
    calls.clear()
    found = render_to_floor(
        simulated(unit, calls), WHOLE, 80, premultiplied=True, spp=64, measure=lambda mean, variance: (90.0, 85.0)
    )
    assert (len(calls), found.floor_db, found.sure_db, found.reached) == (1, 90.0, 85.0, True)
    assert not replace(found, sure_db=79.0).reached, "it takes the floor that is sure"


def test_a_floor_that_is_not_reached_is_reported() -> None:
    unit, calls = np.full(SHAPE, 0.05), []
    found = render_to_floor(simulated(unit, calls), WHOLE, 60, premultiplied=True, max_spp=640)
    assert not found.reached
    assert 640 <= found.spp <= 800
    assert found.sure_db < found.asked_db == 60


def test_what_cannot_be_measured_is_refused() -> None:
    render = simulated(np.full(SHAPE, 0.05), [])
    with pytest.raises(UnirenderError, match="empty mask"):
        render_to_floor(render, 0 * WHOLE, 40, premultiplied=True)
    with pytest.raises(UnirenderError, match="got nan dB"):
        render_to_floor(render, WHOLE, float("nan"), premultiplied=True)
    with pytest.raises(UnirenderError, match="without variance"):
        render_to_floor(lambda spp, seed: Estimate(render(spp, seed).mean, None), WHOLE, 40, premultiplied=True)


@pytest.mark.long
def test_a_64_fold_render_confirms_the_floor() -> None:
    """A sphere under a light with peaks: measured no lower than asked, and within 0.7 dB of what was expected. The
    twin believes half the variance, and falls short."""
    renderer, environment = Renderer(sphere(subdivisions=4), resolution=32), light(3).environment
    mask = renderer.geometry(1024).require("mask")["mask"]

    def image(spp: int, seed: int) -> Estimate:
        return renderer.image(environment, 0.35, 0.6, spp, seed, batches=FLOOR_BATCHES)

    def trusting(spp: int, seed: int) -> Estimate:
        found = image(spp, seed)
        assert found.variance is not None
        return Estimate(found.mean, found.variance / 2, found.nan_pixels)

    asked = 38.0
    found = render_to_floor(image, mask, asked, premultiplied=True, spp=16, seed=1)
    wrong = render_to_floor(trusting, mask, asked, premultiplied=True, spp=16, seed=1)
    converged = image(full_spp(64 * found.spp, FLOOR_BATCHES, mask.size), 2)
    measured = measured_floor_db(found.estimate, converged, mask, premultiplied=True)
    assert found.reached
    assert measured > asked
    assert measured == pytest.approx(found.floor_db, abs=0.7)
    assert wrong.reached, "it believes so"
    twin = measured_floor_db(wrong.estimate, converged, mask, premultiplied=True)
    assert twin < asked
    assert twin < wrong.floor_db - 1.5


def measured_row(number: int, floor_db: float, measured_db: float | None) -> FloorRow:
    return FloorRow(number, 0.5, 0.5, 256, floor_db, floor_db - 0.3, measured_db, 1.0, 10.0)


@pytest.mark.parametrize(
    ("measured", "status", "said"),
    [
        ((45.8, 45.2, 46.1), 0, "floor reached"),
        ((45.8, 43.9, 46.9), 1, "floor MISSED"),
        ((44.6, 44.7, 44.5), 1, "estimate BIASED"),
    ],
)
def test_the_command_judges_what_it_measured(measured: tuple[float, ...], status: int, said: str) -> None:
    rows = [measured_row(i, 45.7, value) for i, value in enumerate(measured)]
    lines, found = summary(rows, 45)
    assert found == status
    assert said in lines[-1]
    assert f"min {min(measured):.2f} dB" in lines[0]


class Here(Inline):
    """A pool whose tasks run at once, in the process of the test."""

    def __enter__(self) -> "Here":
        return self

    def __exit__(self, *error: object) -> None:
        pass


@pytest.mark.parametrize("workers", [1, 10**12])
@pytest.mark.parametrize("reaching", [(0, 1, 2), (1, 5, 6), (12, 13, 14), (14,), ()])
def test_images_are_drawn_until_enough_are_measured_or_none_is_left(
    reaching: tuple[int, ...], workers: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of 15 candidates for 3 images those that reach the floor, the last of all included, and the ones before them."""

    def pool(count: int, start: Callable[[], None]) -> Here:
        assert count == min(workers, 3)  # no more than images
        return Here()

    monkeypatch.setattr("unirender.system.worker_pool.WorkerPool", pool)
    monkeypatch.setattr(
        noise_floor, "measure_floor", lambda job: measured_row(job.number, 45, 45 if job.number in reaching else None)
    )
    rows = list(NoiseFloor(images=3, workers=workers)._rows())
    assert [row.number for row in rows if row.measured_db is not None] == list(reaching)
    assert [row.number for row in rows] == list(range(reaching[-1] + 1 if len(reaching) == 3 else 15))


@pytest.mark.long
@pytest.mark.slow
def test_the_command_measures_images_and_lists_those_left_out(capsys: pytest.CaptureFixture[str]) -> None:
    """Two images at a floor that is easy to reach, and none at one that is not."""
    status = NoiseFloor(images=2, floor=25, factor=8, resolution=16, workers=1).run()
    said = " ".join(capsys.readouterr().out.split())
    assert status == ("MISSED" in said or "BIASED" in said)  # two images are too few for either verdict
    assert "0 of 2 images do not reach 25 dB within about 1024 samples" in said
    assert "2 of 2 at or above 25 dB" in said
    assert NoiseFloor(images=1, floor=60, factor=8, resolution=16, workers=1, limit=16).run() == 1
    assert "no image reaches 60 dB within about 16 samples" in " ".join(capsys.readouterr().out.split())


def test_the_command_refuses_a_size_before_it_begins(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(UnirenderError, match=r"--resolution 10000000: would take .* render fewer"):
        NoiseFloor(resolution=10_000_000).run()
    assert capsys.readouterr().err == ""
