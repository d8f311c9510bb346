"""The samplers of diffusers on our schedule: an exact Gaussian denoiser, orders of convergence, seeds in any batch."""

import math
from collections import Counter
from collections.abc import Iterable, Iterator
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
import torch
from diffusers.schedulers.scheduling_dpmsolver_multistep import DPMSolverMultistepScheduler
from diffusers.schedulers.scheduling_unipc_multistep import UniPCMultistepScheduler
from tiny_models import SIZE, counted_rows, make_batch, make_model, make_pipeline
from torch import Tensor

from unirender.camera import Camera
from unirender.diffusion import sampling
from unirender.diffusion.inference import extras_by_camera, infer_attributes, infer_image
from unirender.diffusion.samplers import check_scheduler, make_sampler
from unirender.diffusion.sampling import denoise, draw_noise
from unirender.diffusion.schedule import last_timestep, make_scheduler
from unirender.diffusion.steps import MOST_STEPS
from unirender.errors import UnirenderError
from unirender.models.conditioning import Conditioning
from unirender.models.dual_stream import DualStreamModel
from unirender.models.packing import TRIPLETS

SAMPLERS = ("ddim", "unipc")
MU, S = 0.7, 0.5  # x0 ~ N(MU, S^2): the posterior mean and the probability flow are known
ALPHA_BAR = make_scheduler().alphas_cumprod


def exact_denoiser(x_t: Tensor, t: Tensor) -> Tensor:
    alpha_bar = ALPHA_BAR[t][:, None, None, None]
    a = alpha_bar.sqrt()
    return MU + a * S**2 / (alpha_bar * S**2 + 1 - alpha_bar) * (x_t - a * MU)


def flow(noise: Tensor, t: int) -> Tensor:
    """Where the probability flow from `noise` at T is at t; MU + S * noise at 0."""
    alpha_bar = ALPHA_BAR[t]
    return alpha_bar.sqrt() * MU + (alpha_bar * S**2 + 1 - alpha_bar).sqrt() * noise


def path(name: str, steps: int, noise: Tensor) -> dict[int, Tensor]:
    """The states that a sampler passes, by timestep; -1: its result."""
    states = {}

    def watch(x_t: Tensor, t: Tensor) -> Tensor:
        states[int(t[0])] = x_t.clone()
        return exact_denoiser(x_t, t)

    states[-1] = denoise(watch, noise, make_sampler(name, make_scheduler()), steps)
    return states


def error_at(name: str, steps: int, t: int) -> float:
    noise = torch.linspace(-2, 2, 64).reshape(1, 1, 8, 8)
    return float((path(name, steps, noise)[t] - flow(noise, t)).abs().max())


def test_one_step_is_the_mean() -> None:
    x = denoise(exact_denoiser, torch.randn(4, 1, 8, 8), make_scheduler(), 1)
    torch.testing.assert_close(x, torch.full_like(x, MU))


@pytest.mark.parametrize("name", SAMPLERS)
def test_every_number_of_steps_starts_at_pure_noise_and_is_finite(name: str) -> None:
    noise = torch.linspace(-2, 2, 64).reshape(1, 1, 8, 8)
    for steps in (*range(2, 21), 30, 50, 61, MOST_STEPS):  # diffusers has 62 timesteps for 61: one too many, at -1
        states = path(name, steps, noise)
        assert max(states) == last_timestep(make_scheduler())
        assert len(states) == steps + 1
        assert min(t for t in states if t >= 0) > 0  # no step starts where all is clean
        assert torch.isfinite(states[-1]).all(), steps
        assert float((states[-1] - (MU + S * noise)).abs().max()) < 4 / (steps + 3), steps


@pytest.mark.parametrize("name", SAMPLERS)
def test_mean_and_variance_of_the_gaussian(name: str) -> None:
    noise = torch.randn(64, 1, 32, 32, generator=torch.Generator().manual_seed(0))
    x = denoise(exact_denoiser, noise, make_sampler(name, make_scheduler()), 50)
    # Five standard errors beside what the last jump loses of the spread: under 8 % of S at 50 steps.
    assert abs(float(x.mean()) - MU) < 5 * S / math.sqrt(noise.numel())
    assert 0.92 * S < float(x.std()) < S * (1 + 5 / math.sqrt(2 * noise.numel()))
    few = denoise(exact_denoiser, noise, make_sampler(name, make_scheduler()), 5)
    assert float(few.std()) < 0.92 * S  # the twin: few steps are over-confident


def test_steps_that_do_not_divide_the_timesteps_lose_as_little_as_those_that_do() -> None:
    """diffusers' DDIM strides by 1000 // 334 = 2 where the timesteps are 3 apart: the spread was 1.6 times too wide."""
    noise = torch.randn(16, 1, 32, 32, generator=torch.Generator().manual_seed(0))
    spread = {
        steps: float(denoise(exact_denoiser, noise, make_sampler("ddim", make_scheduler()), steps).std()) / S
        for steps in (7, 8, 30, 150, 250, 300, 334, 500)
    }
    assert list(spread.values()) == sorted(spread.values()), spread  # ever less is lost
    assert 0.97 < spread[334] < 1.01, spread


def test_our_step_of_ddim_is_that_of_diffusers_where_both_stride_alike() -> None:
    noise = torch.randn(2, 1, 8, 8, generator=torch.Generator().manual_seed(1))
    scheduler = make_sampler("ddim", make_scheduler())
    theirs = denoise(exact_denoiser, noise, scheduler, 20)
    ours, timesteps = noise, list(scheduler.timesteps)
    for t, following in zip(timesteps, [*timesteps[1:], None], strict=True):
        ours = sampling._ddim_step(scheduler, exact_denoiser(ours, t.expand(len(ours))), ours, t, following)
    torch.testing.assert_close(ours, theirs, rtol=0, atol=1e-5)


def test_order_of_convergence() -> None:
    """At t = 99, which 10, 20 and 40 steps all pass: before the last jump, whose error is of first order for any."""
    ddim, unipc = ([error_at(name, steps, 99) for steps in (10, 20, 40)] for name in SAMPLERS)
    orders = [math.log2(a / b) for a, b in pairwise(ddim)]
    assert all(0.9 < order < 1.1 for order in orders), f"orders {orders}, errors {ddim}"
    assert all(10 * ours < first for ours, first in zip(unipc, ddim, strict=True)), (unipc, ddim)
    # Second order at t = 499, where the errors still exceed what the start at a signal of 2^-12 costs.
    ddim, unipc = ([error_at(name, steps, 499) for steps in (4, 8, 20)] for name in SAMPLERS)
    orders = [math.log(a / b) / math.log(n) for a, b, n in zip(unipc, unipc[1:], (2, 2.5), strict=False)]
    assert all(order > 1.5 for order in orders), f"orders {orders}, errors {unipc}"
    slow = [math.log(a / b) / math.log(n) for a, b, n in zip(ddim, ddim[1:], (2, 2.5), strict=False)]
    assert all(order < 1.2 for order in slow), f"orders {slow}, errors {ddim}"  # the twin


def test_the_start_at_zero_signal_costs_unipc_at_most_its_stand_in() -> None:
    """diffusers puts alpha_bar = 2^-24 at T; the first step from there is DDIM's, which is exact, to 2^-12."""
    noise = torch.linspace(-2, 2, 64).reshape(1, 1, 8, 8)
    first = denoise_one_step("unipc", noise)
    torch.testing.assert_close(first, denoise_one_step("ddim", noise), rtol=0, atol=2**-12)
    assert float((first - denoise_one_step("ddim", 1.01 * noise)).abs().max()) > 2**-12  # the twin


def denoise_one_step(name: str, noise: Tensor) -> Tensor:
    states = path(name, 10, noise)
    return states[sorted(states)[-2]]


@pytest.mark.parametrize(
    ("kind", "settings", "order"),
    [
        (UniPCMultistepScheduler, {"lower_order_final": False}, {"solver_order": 1}),
        (DPMSolverMultistepScheduler, {"final_sigmas_type": "sigma_min"}, {"solver_order": 1}),
        (DPMSolverMultistepScheduler, {"final_sigmas_type": "sigma_min"}, {"euler_at_final": True}),
    ],
)
def test_a_last_step_of_first_order_divides_by_nothing_whatever_else_is_set(
    kind: Any, settings: dict[str, Any], order: dict[str, Any]
) -> None:
    noise, config = torch.linspace(-2, 2, 64).reshape(1, 1, 8, 8), make_scheduler().config
    usual, taken = (kind.from_config(config, **order, **own) for own in ({}, settings))
    check_scheduler(taken)
    assert torch.equal(*(denoise(exact_denoiser, noise, scheduler, 20) for scheduler in (usual, taken)))
    higher = kind.from_config(config, **settings)  # the twin: of second order
    assert not denoise(exact_denoiser, noise, higher, 20).isfinite().all()
    with pytest.raises(UnirenderError, match=next(iter(settings))):
        check_scheduler(higher)


def test_names() -> None:
    scheduler = make_scheduler()
    made = make_sampler("unipc", scheduler)
    assert isinstance(made, UniPCMultistepScheduler)
    assert (made.config["prediction_type"], made.config["timestep_spacing"]) == ("sample", "trailing")
    back = make_sampler("ddim", made)
    torch.testing.assert_close(back.alphas_cumprod, scheduler.alphas_cumprod, rtol=0, atol=1e-6)
    assert back.alphas_cumprod[-1] == 0
    with pytest.raises(UnirenderError, match="got 'euler', expected 'ddim' or 'unipc'"):
        make_sampler("euler", scheduler)


def test_noise_by_row_and_by_generator() -> None:
    like = torch.zeros(1)
    one, other = (draw_noise((2, 3, 4, 4), like, torch.Generator().manual_seed(seed)) for seed in (5, 6))
    generators = [torch.Generator().manual_seed(seed) for seed in (5, 6)]
    both = draw_noise((4, 3, 4, 4), like, generators)
    assert torch.equal(both, torch.cat([one, other]))
    with pytest.raises(ValueError, match="2 generators for 3 rows"):
        draw_noise((3, 3, 4, 4), like, generators)


@pytest.mark.parametrize("name", SAMPLERS)
def test_a_row_is_the_same_in_any_batch(name: str) -> None:
    model, conditioning = make_model()
    parts: tuple[Any, Any, Any] = (model, conditioning, make_sampler(name, make_scheduler()))
    batch = make_batch(3)
    missing = torch.tensor([[True, False, True, True, True, True]]).expand(3, -1)  # albedo is noise, too
    cameras = [Camera(fov_deg=30.0 + 10 * i) for i in range(3)]
    single = {name: value[:1] for name, value in batch.items()}

    def settings(rows: int) -> dict[str, Any]:
        return {"steps": 3, "generator": torch.Generator().manual_seed(1), "camera": cameras[:rows]}

    alone = infer_attributes(*parts, single["image"], single["mask"], **settings(1))
    among = infer_attributes(*parts, batch["image"], batch["mask"], **settings(3))
    torch.testing.assert_close(alone["albedo"], among["albedo"][:1], rtol=0, atol=1e-4)
    alone_image = infer_image(*parts, single, missing[:1], **settings(1))
    among_image = infer_image(*parts, batch, missing, **settings(3))
    torch.testing.assert_close(alone_image, among_image[:1], rtol=0, atol=1e-4)
    assert float((among_image[1:2] - alone_image).abs().max()) > 1e-2  # the twin


def test_both_directions_see_through_the_camera() -> None:
    """One for all rows is the same for each; another one gives another answer."""
    model, conditioning = make_model()
    parts: tuple[Any, Any, Any] = (model, conditioning, make_scheduler())
    batch, given = make_batch(2), torch.ones(2, 6, dtype=torch.bool)
    near = Camera(fov_deg=80.0, principal=(0.3, 0.6))

    def answers(camera: Any) -> tuple[Tensor, Tensor]:
        seeds = (torch.Generator().manual_seed(1) for _ in range(2))
        maps = infer_attributes(*parts, batch["image"], batch["mask"], generator=next(seeds), camera=camera)
        return maps["normal"], infer_image(*parts, batch, given, generator=next(seeds), camera=camera)

    default, one, each = answers(None), answers(near), answers([near] * 2)
    for by_default, found, again in zip(default, one, each, strict=True):
        assert torch.equal(found, again)
        assert float((found - by_default).abs().max()) > 1e-3


NETWORKS: dict[str, dict[str, Any]] = {
    "unified": {},
    "split": {"unified": False},
    "no prior": {"physics_prior": "none"},
}


@pytest.mark.parametrize(("kind", "steps"), [("unified", 1), *((kind, 4) for kind in NETWORKS)])
def test_the_clean_stream_is_encoded_once_and_nothing_changes(kind: str, steps: int) -> None:
    """Bit for bit what a plain loop gives that encodes both streams at every step."""
    model, conditioning = make_model(**NETWORKS[kind])
    batch, scheduler = make_batch(2), make_scheduler()
    runs = Counter[str]()
    for name, module in model.named_modules():
        if name.endswith("unet.conv_in"):  # the first layer of each encoder
            module.register_forward_pre_hook(lambda *_, name=name: runs.update([name.split(".")[-2]]))

    def seed() -> torch.Generator:
        return torch.Generator().manual_seed(3)

    maps = infer_attributes(
        model, conditioning, scheduler, batch["image"], batch["mask"], steps=steps, generator=seed()
    )
    assert runs == {"attribute_unet": steps, "image_unet": 1}
    given = torch.ones(2, 6, dtype=torch.bool)
    runs.clear()
    image = infer_image(model, conditioning, scheduler, batch, given, steps=steps, generator=seed())
    assert runs == {"attribute_unet": 1, "image_unet": steps}

    noise = draw_noise((2, 72, 16, 16), batch["image"], seed())
    looped = conditioning.decode_attributes(loop(model, conditioning, batch, ~given, noise, steps))
    assert all(torch.equal(looped[name], value) for name, value in maps.items())
    runs.clear()
    noise = draw_noise((2, 84, 16, 16), batch["image"], seed())
    looped = conditioning.decode_image(loop(model, conditioning, batch, given, noise, steps))
    assert torch.equal(looped, image)
    assert runs == {"attribute_unet": steps, "image_unet": steps}


@torch.no_grad()
def loop(
    model: DualStreamModel,
    conditioning: Conditioning,
    batch: dict[str, Tensor],
    given: Tensor,
    noise: Tensor,
    steps: int,
) -> Tensor:
    """x0 of the image where everything is given, of the attributes where nothing is, by one whole call a step."""
    rendering = bool(given.all())
    extras = conditioning.extras(batch["mask"], given, batch if rendering else None)
    clean = conditioning.encode_attributes(batch) if rendering else conditioning.encode_image(batch["image"])
    if rendering:
        unknown, noise = noise.split((72, 12), dim=1)
        clean = torch.where(conditioning.by_triplet(given), clean, unknown)
    zero = torch.zeros(len(clean), dtype=torch.long)

    def predict(x_t: Tensor, t: Tensor) -> Tensor:
        streams = (clean, x_t, zero, t) if rendering else (x_t, clean, t, zero)
        other: Any = {"attribute_rows" if rendering else "image_rows": None}
        output = model(*streams, extras.attributes, extras.image, extras.prior, **other)
        x_0 = output.image if rendering else output.attributes
        assert x_0 is not None
        return x_0

    return denoise(predict, noise, make_scheduler(), steps)


def test_extras_of_each_camera() -> None:
    _, conditioning = make_model(derived_light=True)
    batch, given = make_batch(2), torch.ones(2, 6, dtype=torch.bool)
    cameras = [Camera(), Camera(fov_deg=60.0, principal=(0.2, 0.9))]
    derived = torch.tensor([[False] * 6, [name == "diffuse" for name in TRIPLETS]])
    both = extras_by_camera(conditioning, batch["mask"], given, batch, cameras, derived)
    for i, camera in enumerate(cameras):
        row = {name: value[i : i + 1] for name, value in batch.items()}
        own = conditioning.extras(row["mask"], given[i : i + 1], row, camera, derived[i : i + 1])
        assert torch.equal(both.image[i : i + 1], own.image)
        assert own.prior is not None
        assert both.prior is not None
        assert torch.equal(both.prior[i : i + 1], own.prior)
    without = make_model(physics_prior="none")[1]
    assert extras_by_camera(without, batch["mask"], given, batch, cameras).prior is None
    with pytest.raises(ValueError, match="2 cameras for 1 rows"):
        extras_by_camera(conditioning, batch["mask"][:1], given[:1], None, cameras)


def test_the_sampler_by_name_and_by_component(monkeypatch: pytest.MonkeyPatch) -> None:
    pipeline = make_pipeline()
    image = np.random.default_rng(0).uniform(0, 1, (SIZE, SIZE, 3)).astype(np.float32)
    passes = counted_rows(monkeypatch)

    def albedo(**sampling: Any) -> np.ndarray:
        settings: dict[str, Any] = {"mode": "sample", "num_inference_steps": 4, "num_samples": 2} | sampling
        result = pipeline.decompose(image, closed=False, generator=torch.Generator().manual_seed(0), **settings)
        return result.intrinsics.require("albedo")["albedo"]

    default, ddim, named = albedo(), albedo(sampler="ddim"), albedo(sampler="unipc")
    assert passes == [2] * 12  # one pass a step, all samples in it
    pipeline.scheduler = make_sampler("unipc", pipeline.scheduler)
    np.testing.assert_allclose(albedo(), named, rtol=0, atol=1e-6)
    np.testing.assert_allclose(default, ddim, rtol=0, atol=1e-6)
    assert np.abs(named - ddim).max() > 1e-4
    with pytest.raises(UnirenderError, match="mode mean takes one step and no sampler"):
        pipeline.decompose(image, sampler="unipc")
    with pytest.raises(UnirenderError, match="'euler'"):
        albedo(sampler="euler")


@pytest.mark.parametrize("name", SAMPLERS)
def test_calls_at_the_same_time_do_not_share_their_steps(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    pipeline = make_pipeline()
    pipeline.scheduler = make_sampler(name, pipeline.scheduler)
    image = np.random.default_rng(0).uniform(0, 1, (SIZE, SIZE, 3)).astype(np.float32)

    def sampled(steps: int) -> np.ndarray:
        settings: dict[str, Any] = {"mode": "sample", "num_inference_steps": steps, "num_samples": 1, "closed": False}
        result = pipeline.decompose(image, generator=torch.Generator().manual_seed(0), **settings)
        return result.intrinsics.require("albedo")["albedo"]

    def interrupted(steps: Iterable[Any]) -> Iterator[Any]:
        first, *others = steps
        yield first
        monkeypatch.setattr(pipeline, "progress_bar", iter)
        sampled(2)
        yield from others

    alone = sampled(4)
    monkeypatch.setattr(pipeline, "progress_bar", interrupted)
    np.testing.assert_array_equal(sampled(4), alone)
