"""Coverage of the interval, clusters, pairing, and what has no interval."""

import math

import numpy as np
import pytest
import scipy.stats

from unirender.errors import UnirenderError
from unirender_evaluation.pages.coverage import bootstrap, coverage_of_draws, least_by_chance, of_few_lights
from unirender_evaluation.pages.coverage import coverage as coverage_of
from unirender_evaluation.statistics import (
    FEWEST,
    UNPRINTED,
    beats,
    crossed_estimate,
    holm,
    light_count,
    mean_estimate,
    paired_difference,
    paired_p_value,
    unprinted_note,
)


def coverage(clustered: bool, use_clusters: bool, trials: int = 300) -> float:
    """Share of 95 % intervals that hold the true mean 0; clustered data have 8 samples of each of 30 objects."""
    rng = np.random.default_rng(0)
    hits = 0
    for _ in range(trials):
        values = np.repeat(rng.normal(size=30), 8) + 0.2 * rng.normal(size=240) if clustered else rng.normal(size=240)
        labels = np.repeat(np.arange(30), 8).tolist() if use_clusters else None
        estimate = mean_estimate(values, labels)
        hits += estimate.low <= 0 <= estimate.high
    return hits / trials


def test_the_interval_holds_the_mean_as_often_as_it_says() -> None:
    assert 0.90 <= coverage(clustered=False, use_clusters=False) <= 0.985


def test_clusters_are_needed_where_samples_share_an_object() -> None:
    assert 0.88 <= coverage(clustered=True, use_clusters=True) <= 0.985
    assert coverage(clustered=True, use_clusters=False) < 0.70  # the twin: samples drawn as if independent


@pytest.mark.parametrize("count", [FEWEST, 4, 8, 19])
def test_of_few_objects_the_interval_holds_the_mean_as_often(count: int) -> None:
    rng = np.random.default_rng(0)
    of = np.repeat(np.arange(count), rng.integers(1, 9, size=count))
    hits = 0
    for _ in range(1000):
        values = rng.normal(size=count)[of] + 0.2 * rng.normal(size=len(of))
        estimate = mean_estimate(values, of.tolist())
        hits += estimate.low <= 0 <= estimate.high
    assert 0.90 <= hits / 1000 <= 0.98


def test_of_few_objects_with_a_sample_each_it_is_students() -> None:
    values = [1.0, 2.0, 4.0, 7.0]
    estimate = mean_estimate(values)
    low, high = scipy.stats.t.interval(0.95, 3, loc=np.mean(values), scale=scipy.stats.sem(values))
    assert (estimate.low, estimate.high) == pytest.approx((low, high))
    assert estimate.half_width == pytest.approx(scipy.stats.sem(values) * scipy.stats.t.ppf(0.975, 3))


@pytest.mark.parametrize("relit", [False, True])
def test_where_lights_are_shared_only_the_interval_over_both_holds_the_mean_as_often_as_it_says(relit: bool) -> None:
    """24 objects under 2 of 8 lights each, also relit by the other; lights differ twice as much as objects."""
    alone, both = coverage_of(of_few_lights(24, 8, relit), 1, 2, trials=100)
    assert both >= 0.9
    assert alone < 0.75  # the twin: lights that are in every draw
    assert coverage_of(of_few_lights(24, 8, relit), 1, 0, trials=40)[1] >= 0.9, "lights that make no difference"


def one_each(lights: str) -> list[tuple[str, ...]]:
    return [(light,) for light in lights]


def test_where_no_light_is_shared_the_interval_over_both_is_that_over_objects() -> None:
    values, objects = [1.0, 2.0, 4.0, 7.0, 3.0, 3.5], ["a", "a", "b", "b", "c", "c"]
    alone = mean_estimate(values, objects)
    found = crossed_estimate(values, objects, one_each("stuvwx"))
    assert (found.low, found.high) == pytest.approx((alone.low, alone.high))
    assert (found.mean, found.n, found.clusters) == (alone.mean, 6, 3)


def test_over_lights_alone_it_is_that_over_clusters_of_their_samples() -> None:
    """Each object under one light that others share, as many samples of each."""
    values, lights = [1.0, 1.5, 4.0, 4.5, 7.0, 6.0, 9.0, 9.5, 0.5, 1.0], "ssttuuvvww"
    found, alone = crossed_estimate(values, list("abcdefghij"), one_each(lights)), mean_estimate(values, list(lights))
    assert (found.low, found.high) == pytest.approx((alone.low, alone.high))


def test_what_few_lights_or_one_that_all_share_do_not_tell_has_no_interval() -> None:
    values, objects = [1.0, 2.0, 4.0, 7.0, 3.0, 3.5], list("aabbcc")
    for lights in (one_each("stuvst"), one_each("ssssss"), [("x", light) for light in "stuvwy"]):
        found = crossed_estimate(values, objects, lights)
        assert math.isnan(found.low)
        assert found.mean == pytest.approx(np.mean(values))
    assert math.isnan(crossed_estimate(values, ["a"] * 6, one_each("stuvwx")).high)
    assert math.isnan(crossed_estimate([*values[:-1], math.inf], objects, one_each("stuvwx")).high)
    assert light_count([("s", "x"), ("t", "x"), ("u", "y")]) == 2


@pytest.mark.parametrize("wrong", [[1.0], [1.0, 2.0, 4.0, 7.0, 3.0, math.nan]])
def test_values_without_their_objects_and_lights_are_refused(wrong: list[float]) -> None:
    with pytest.raises(UnirenderError, match="over objects and lights"):
        crossed_estimate(wrong, list("aabbcc"), one_each("stuvwx"))
    with pytest.raises(UnirenderError, match="got 0 values"):
        crossed_estimate([], [], [])


def test_a_bootstrap_of_few_objects_holds_the_mean_less_often() -> None:
    """Why intervals are Student's. The twin: of many objects the two are one."""
    rng = np.random.default_rng(0)
    objects = [20 + rng.normal() + 0.2 * rng.normal(size=2) for _ in range(100)]
    student, resampled = coverage_of_draws(objects, 4, draws=300)
    assert 0.70 <= resampled < student - 0.08
    assert 0.90 <= student <= 0.98
    sums, sizes = np.array([own.sum() for own in objects]), np.array([len(own) for own in objects])
    of_all = mean_estimate(np.concatenate(objects), np.repeat(np.arange(100), sizes).tolist())
    assert bootstrap(sums, sizes) == pytest.approx((of_all.low, of_all.high), rel=0.003)


def test_the_least_of_many_shares_is_below_what_each_says() -> None:
    drawn = np.random.default_rng(0).binomial(200, 0.95, size=(20_000, 43)).min(axis=1) / 200
    assert least_by_chance(43, 200) == pytest.approx(np.quantile(drawn, [0.025, 0.975]))
    assert least_by_chance(1, 200)[1] > 0.95 > least_by_chance(43, 200)[1]


def test_of_many_objects_it_is_as_wide_as_their_spread_says() -> None:
    """Away from 0, where an interval of a wrong scale would hold the mean as often; objects differ in their samples."""
    rng = np.random.default_rng(3)
    sizes = rng.integers(1, 9, size=300)
    of = np.repeat(np.arange(300), sizes)
    values = 20 + 3 * rng.normal(size=300)[of] + rng.normal(size=len(of))
    residuals = np.bincount(of, weights=values - values.mean())
    error = math.sqrt(300 / 299 * np.square(residuals).sum()) / len(of)
    estimate = mean_estimate(values, of.tolist())
    for end in (estimate.mean - estimate.low, estimate.high - estimate.mean):
        assert end == pytest.approx(scipy.stats.norm.ppf(0.975) * error, rel=0.06)


def test_the_estimate_is_the_mean_over_samples_not_over_objects() -> None:
    estimate = mean_estimate([1.0, 1.0, 1.0, 5.0], ["a", "a", "a", "b"])
    assert (estimate.mean, estimate.n, estimate.clusters) == (2.0, 4, 2)


@pytest.mark.parametrize(
    ("values", "labels"),
    [([1.0], None), ([1.0, 2.0], ["a", "a"]), ([1.0, 1.0], None), ([1.0] * 30 + [math.inf], None)],
)
def test_what_has_no_interval_says_so(values: list[float], labels: list[str] | None) -> None:
    estimate = mean_estimate(values, labels)
    assert math.isnan(estimate.low)
    assert math.isnan(estimate.half_width)
    assert estimate.mean == np.mean(values)


def test_two_objects_that_agree_decide_nothing() -> None:
    """Their differences happen to be equal: an interval of no width, if there were one. The twin has a third object."""
    a, b = ({name: value for name in "xyz"} for value in (21.0, 20.0))
    for names, decided in (("xy", False), ("xyz", True)):
        better = {name: a[name] for name in names}
        assert beats(better, b, higher_is_better=True, clusters={n: n for n in names}) is decided
        assert (paired_p_value(better, b, {n: n for n in names}) < 0.05) is decided
        lights = [(light,) for light in "stuvwx"[: 2 * len(names)]]
        crossed = crossed_estimate([1.0] * len(lights), [n for n in names for _ in range(2)], lights)
        assert math.isfinite(crossed.low) is decided


def test_a_note_says_why_few_objects_have_no_interval() -> None:
    two, three = mean_estimate([1.0, 1.2]), mean_estimate([1.0, 1.2, 4.0])
    assert unprinted_note([three, two, None]) == (UNPRINTED,)
    assert unprinted_note([three, mean_estimate([math.inf]), None]) == ()


@pytest.mark.parametrize("values", [[], [1.0, math.nan]])
def test_nothing_and_nan_are_refused(values: list[float]) -> None:
    with pytest.raises(UnirenderError, match="mean"):
        mean_estimate(values)


def paired(shift: float, seed: int = 0) -> tuple[dict[str, float], dict[str, float]]:
    """Two methods whose samples vary by 5 and whose difference varies by 0.5."""
    rng = np.random.default_rng(seed)
    base = 20 + 5 * rng.normal(size=60)
    names = [f"s{i}" for i in range(60)]
    return dict(zip(names, base + shift + 0.5 * rng.normal(size=60), strict=True)), dict(zip(names, base, strict=True))


def test_pairing_sees_a_difference_that_intervals_of_the_means_hide() -> None:
    a, b = paired(0.4)
    alone = [mean_estimate(list(values.values())) for values in (a, b)]
    assert alone[0].low < alone[1].high  # they overlap
    assert beats(a, b, higher_is_better=True)
    assert not beats(b, a, higher_is_better=True)
    assert beats(b, a, higher_is_better=False)
    assert not beats(a, b, higher_is_better=False)


def test_of_two_objects_many_samples_prove_nothing() -> None:
    """The difference is drawn by object in the paired test, too; the twin draws samples."""
    a, b = ({f"s{i}": value + i % 2 * shift for i in range(60)} for value, shift in ((21.0, 4.0), (20.0, 0.0)))
    objects = {f"s{i}": i % 2 for i in range(60)}
    difference = paired_difference(a, b, objects)
    assert (difference.mean, difference.n, difference.clusters) == (3.0, 60, 2)
    assert not beats(a, b, higher_is_better=True, clusters=objects)
    assert beats(a, b, higher_is_better=True)


def test_a_method_does_not_beat_itself_or_an_equal() -> None:
    a, b = paired(0.0)
    assert not beats(a, a, higher_is_better=True)
    wins = sum(beats(*paired(0.0, seed), higher_is_better=True) for seed in range(60))
    assert wins <= 6  # 2.5 % a side
    assert paired_difference(a, b).n == 60


def test_only_common_samples_count() -> None:
    a, b = paired(1.0)
    b = dict(list(b.items())[:10]) | {"other": 100.0}
    assert paired_difference(a, b).n == 10
    with pytest.raises(UnirenderError, match="share no sample"):
        paired_difference({"x": 1.0}, {"y": 1.0})


def test_identical_images_have_no_difference_in_db() -> None:
    with pytest.raises(UnirenderError, match=r"on 'y' \(and 0 more\) is not finite.*compare the MSE"):
        paired_difference({"x": 1.0, "y": math.inf}, {"x": 2.0, "y": math.inf})


def test_the_p_value_is_that_of_the_paired_t_test() -> None:
    a, b = paired(0.1)
    each = {name: name for name in a}
    known = scipy.stats.ttest_rel(list(a.values()), list(b.values())).pvalue
    assert paired_p_value(a, b, each) == pytest.approx(known)
    assert paired_p_value(b, a, each) == pytest.approx(known)
    assert paired_p_value(a, a, each) == 1
    assert paired_p_value(a, b, dict.fromkeys(a, "one object")) == 1
    assert (
        paired_p_value({"x": 1.0, "y": -1.0, "z": 0.0}, dict.fromkeys("xyz", 0.0), dict(zip("xyz", "xyz", strict=True)))
        == 1
    )
    assert (
        paired_p_value(
            {"x": 2.0, "y": 3.0, "z": 1.0}, {"x": 1.0, "y": 2.0, "z": 0.0}, dict(zip("xyz", "xyz", strict=True))
        )
        == 0
    )


def test_holm_asks_more_of_each_claim_the_more_there_are() -> None:
    assert holm([0.03, 0.01, 0.02]) == [True, True, True]
    assert holm([0.03, 0.018, 0.02]) == [False, False, False]  # the least is above 0.05 / 3
    assert holm([0.04, 0.001, 0.03]) == [False, True, False]  # 0.03 is above 0.05 / 2, and ends it
    assert holm([]) == []
