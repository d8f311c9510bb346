"""Schedule, timesteps and samplers, against closed forms."""

import math

import numpy as np
import pytest
import torch

from unirender.diffusion.samplers import make_sampler
from unirender.diffusion.sampling import draw_noise, set_timesteps
from unirender.diffusion.schedule import add_noise, last_timestep, make_scheduler, zero_terminal_betas
from unirender.diffusion.steps import MOST_STEPS, steps_of
from unirender.diffusion.timesteps import algorithm1_timesteps, conditional_timesteps, draw_timesteps
from unirender.errors import UnirenderError

# --- schedule


@pytest.mark.parametrize("timesteps", [1000, 50])
def test_both_ends_are_exact(timesteps: int) -> None:
    scheduler = make_scheduler(timesteps)
    alpha_bar = scheduler.alphas_cumprod
    assert last_timestep(scheduler) == len(alpha_bar) - 1 == timesteps - 1
    assert alpha_bar[0] == 1.0
    assert alpha_bar[-1] == 0.0
    assert (alpha_bar.diff() < 0).all()


def test_noising_is_clean_at_0_and_pure_noise_at_the_last_index() -> None:
    scheduler = make_scheduler()
    clean, noise = torch.randn(3, 2, 4, 4), torch.randn(3, 2, 4, 4)
    noised = add_noise(scheduler, clean, noise, torch.tensor([0, last_timestep(scheduler), 500]))
    assert torch.equal(noised[0], clean[0])
    assert torch.equal(noised[1], noise[1])
    alpha_bar = scheduler.alphas_cumprod[500]
    torch.testing.assert_close(noised[2], alpha_bar.sqrt() * clean[2] + (1 - alpha_bar).sqrt() * noise[2])


def test_schedule_is_the_rescaled_scaled_linear_one() -> None:
    """Lin et al. 2024, algorithm 1: sqrt(alpha_bar) is an affine function of the original one."""
    root = torch.cumprod(1 - torch.linspace(0.00085**0.5, 0.012**0.5, 1000, dtype=torch.float64) ** 2, 0).sqrt()
    ours = torch.cumprod(1 - torch.tensor(zero_terminal_betas(), dtype=torch.float64), 0).sqrt()
    slope = (ours[0] - ours[-1]) / (root[0] - root[-1])
    torch.testing.assert_close(ours, slope * (root - root[-1]), rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("name", ["ddim", "unipc"])
def test_sampling_starts_at_the_last_index(name: str) -> None:
    scheduler = make_sampler(name, make_scheduler())
    for steps in range(1, MOST_STEPS + 1):
        set_timesteps(scheduler, steps, torch.device("cpu"))
        assert scheduler.timesteps[0] == last_timestep(scheduler)
        assert scheduler.timesteps[-1] > 0
        assert len(scheduler.timesteps) == steps == scheduler.num_inference_steps


# --- timesteps


def test_section_3_2_one_stream_is_always_clean() -> None:
    generator = torch.Generator().manual_seed(0)
    n, last, p_render, p_t = 20000, 999, 0.35, 0.3
    t = conditional_timesteps(n, last, p_render, p_t, generator)
    rendering = t.attributes == 0
    assert ((t.attributes == 0) != (t.image == 0)).all()
    assert abs(rendering.double().mean().item() - p_render) <= 1 / n
    assert rendering.int().diff().max() <= 0  # rendering samples first
    noisy = torch.where(rendering, t.image, t.attributes)
    partial = noisy[noisy < last]
    # binomial share within 5 standard deviations; uniform t by its mean and extremes
    assert abs(len(partial) / n - p_t) < 5 * math.sqrt(p_t * (1 - p_t) / n)
    assert abs(partial.double().mean().item() - 499.5) < 5 * 998 / math.sqrt(12 * len(partial))
    assert partial.min() >= 1
    assert partial.max() <= last - 1


def test_section_3_2_draws_every_timestep_alike() -> None:
    """Chi-square of t on 1 .. T - 1; a draw that favours the low ones a little must fail."""
    n, last = 30000, 31
    t = conditional_timesteps(n, last, 0.5, 1.0, torch.Generator().manual_seed(0))
    noisy = torch.maximum(t.attributes, t.image).numpy()

    def chi_square(values: np.ndarray) -> float:
        counts = np.bincount(values, minlength=last + 1)[1:last]
        return float(((counts - n / 30) ** 2 / (n / 30)).sum())

    assert chi_square(noisy) < 66  # 29 degrees of freedom: p < 1e-4
    rng = np.random.default_rng(0)
    skewed = np.minimum(noisy, np.where(rng.random(n) < 0.1, rng.integers(1, last, n), last))
    assert chi_square(skewed) > 66


def test_small_batches_round_at_random_to_the_right_share() -> None:
    generator = torch.Generator().manual_seed(0)
    counts = [int((conditional_timesteps(3, 999, 0.5, 0.3, generator).attributes == 0).sum()) for _ in range(2000)]
    assert set(counts) == {1, 2}
    assert abs(np.mean(counts) - 1.5) < 5 * 0.5 / math.sqrt(2000)


def algorithm1_literal(num_timesteps: int, bs: int, rng: np.random.Generator, len_t: int = 2) -> np.ndarray:
    """The supplement's pseudo-code, line by line; it returns the array that it fills."""
    all_t = np.zeros((len_t, bs), dtype=np.int64)
    idx = rng.integers(0, len_t)
    all_t[idx] = rng.integers(0, num_timesteps, bs)  # 0 .. num_timesteps - 1
    for i in range(len_t):
        if i != idx:
            for j in range(bs):
                all_t[i][j] = rng.choice([0, num_timesteps - 1])
    return all_t


def test_algorithm_1_has_the_distribution_of_the_pseudo_code() -> None:
    """Few timesteps, so that the joint distribution of a pair can be compared cell by cell (chi-square).

    One row at a time: rows of a batch share the stream that is uniform, and would not be independent.
    """
    last, bs, draws = 4, 1, 6000
    rng, generator = np.random.default_rng(0), torch.Generator().manual_seed(1)
    literal, ours = np.zeros((last + 1, last + 1)), np.zeros((last + 1, last + 1))
    for _ in range(draws):
        a, i = algorithm1_literal(last + 1, bs, rng)
        np.add.at(literal, (a, i), 1)
        t = draw_timesteps("algorithm1", bs, last, 0.5, 0.5, generator)
        np.add.at(ours, (t.attributes.numpy(), t.image.numpy()), 1)
    seen = literal + ours > 0
    assert seen.sum() == 16  # each stream uniform on 0 .. 4, the other 0 or 4, the corners shared
    chi_square = ((literal - ours)[seen] ** 2 / (literal + ours)[seen]).sum()
    assert chi_square < 45  # 15 degrees of freedom: p < 1e-4
    shifted = np.roll(ours, 1, axis=0)
    assert ((literal - shifted)[seen] ** 2 / (literal + shifted)[seen]).sum() > 1000  # the twin that must fail


def test_algorithm_1_picks_one_stream_for_the_whole_batch() -> None:
    """As the pseudo-code does; each stream as often as the other."""
    generator, rng = torch.Generator().manual_seed(0), np.random.default_rng(0)
    draws, first = 400, {"ours": 0, "literal": 0}
    for _ in range(draws):
        t = algorithm1_timesteps(16, 999, generator)
        for name, (a, i) in {"ours": (t.attributes, t.image), "literal": algorithm1_literal(1000, 16, rng)}.items():
            ends = [bool(np.isin(np.asarray(x), [0, 999]).all()) for x in (a, i)]
            assert sorted(ends) == [False, True]
            first[name] += ends[0]
    for seed in range(9):  # all of it follows the seed
        a, b = (algorithm1_timesteps(16, 999, torch.Generator().manual_seed(seed)) for _ in range(2))
        assert torch.equal(a.attributes, b.attributes)
        assert torch.equal(a.image, b.image)
    for count in first.values():
        assert abs(count / draws - 0.5) < 5 * 0.5 / math.sqrt(draws)


def test_unknown_rule() -> None:
    with pytest.raises(UnirenderError, match="'conditional' or 'algorithm1'"):
        draw_timesteps("both", 4, 999, 0.5, 0.5, torch.Generator())


# --- sampling


def test_noise_of_a_seed_does_not_depend_on_the_default_dtype() -> None:
    """torch draws other numbers in float64; with them mode `mean` answered other maps."""
    like = torch.zeros(1)
    usual = draw_noise((2, 3, 4, 4), like, torch.Generator().manual_seed(5))
    torch.set_default_dtype(torch.float64)
    try:
        assert torch.equal(draw_noise((2, 3, 4, 4), like, torch.Generator().manual_seed(5)), usual)
    finally:
        torch.set_default_dtype(torch.float32)


def test_modes() -> None:
    assert (steps_of("mean", None), steps_of("sample", None), steps_of("sample", 4)) == (1, 20, 4)
    assert (steps_of("mean", 1), steps_of("sample", 500)) == (1, 500)
    for mode, steps, words in (
        ("mode", None, "'sample'"),
        ("mean", 2, "takes 1 step"),
        ("sample", 0, "expected 1 to 500"),
        ("sample", 501, "expected 1 to 500"),
        ("sample", True, "expected 1 to 500"),
    ):
        with pytest.raises(UnirenderError, match=words):
            steps_of(mode, steps)
