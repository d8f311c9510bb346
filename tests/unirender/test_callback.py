"""`callback_on_step_end`: what it is told, and what it may change."""

from typing import Any

import numpy as np
import pytest
import torch
from tiny_models import SIZE, make_pipeline

from unirender.errors import UnirenderError
from unirender.pipelines.settings import step_end_of
from unirender.pipelines.unirender_pipeline import UniRenderPipeline

IMAGE, MASK = np.full((SIZE, SIZE, 3), 0.5, np.float32), np.ones((SIZE, SIZE, 1), np.float32)


@pytest.fixture(scope="module")
def pipeline() -> UniRenderPipeline:
    return make_pipeline()


def sampled(pipeline: UniRenderPipeline, callback: Any, steps: int = 4, **settings: Any) -> np.ndarray:
    settings = {"mode": "sample", "num_inference_steps": steps, "num_samples": 2, "closed": False} | settings
    seed = torch.Generator().manual_seed(0)
    found = pipeline.decompose(IMAGE, MASK, generator=seed, callback_on_step_end=callback, **settings)
    return found.intrinsics.require("albedo")["albedo"]


@pytest.mark.parametrize(("steps", "sampler"), [(4, "ddim"), (3, "ddim"), (4, "unipc"), (1, "ddim")])
def test_it_is_told_of_every_step_and_changes_nothing(pipeline: UniRenderPipeline, steps: int, sampler: str) -> None:
    told: list[tuple[int, int, tuple[int, ...]]] = []

    def watch(own: Any, step: int, timestep: int, kwargs: dict[str, Any]) -> dict[str, Any] | None:
        assert own is pipeline
        told.append((step, timestep, tuple(kwargs["latents"].shape)))
        return kwargs if step % 2 else None

    watched = sampled(pipeline, watch, steps, sampler=sampler)
    assert np.array_equal(watched, sampled(pipeline, None, steps, sampler=sampler))
    assert [step for step, _, _ in told] == list(range(steps))
    timesteps = [timestep for _, timestep, _ in told]
    assert timesteps[0] == 999
    assert timesteps == sorted(set(timesteps), reverse=True)
    assert {shape for _, _, shape in told} == {(2, 72, SIZE // 2, SIZE // 2)}


def test_the_next_step_begins_with_what_it_returns(pipeline: UniRenderPipeline) -> None:
    end = torch.linspace(-1, 1, 72)[None, :, None, None]

    def replaced(own: Any, step: int, timestep: int, kwargs: dict[str, Any]) -> dict[str, Any]:
        return {"latents": end.double().expand(kwargs["latents"].shape)}  # back in the latents' own dtype

    two, four = (sampled(pipeline, replaced, steps) for steps in (2, 4))
    assert np.array_equal(two, four)  # the last word is the callback's
    assert not np.array_equal(two, sampled(pipeline, None))


def test_one_call_of_a_closed_decomposition_and_three_passes_of_an_edit(pipeline: UniRenderPipeline) -> None:
    channels: list[int] = []

    def watch(own: Any, step: int, timestep: int, kwargs: dict[str, Any]) -> None:
        channels.append(kwargs["latents"].shape[1])

    found = pipeline.decompose(IMAGE, MASK, callback_on_step_end=watch)
    assert channels == [72]  # not of closing's rendering
    pipeline.render(found.intrinsics, callback_on_step_end=watch)
    assert channels == [72, 12]
    channels.clear()
    pipeline.edit(IMAGE, MASK, metallic=1.0, callback_on_step_end=watch)
    assert channels == [72, 12, 12]  # with the edit and without, on which it is anchored


@pytest.mark.parametrize(
    ("callback", "words"),
    [
        (lambda *told: {"latent": 0}, r"returned \['latent'\], expected a dictionary of latents alone"),
        (lambda *told: torch.zeros(3), r"returned tensor\(.*expected a dictionary"),
        (lambda *told: {"latents": 0}, r"returned latents int, expected a tensor \[2, 72, "),
        (lambda *told: {"latents": torch.zeros(3)}, r"returned latents \[3\], expected a tensor \[2, 72, "),
    ],
)
def test_anything_else_is_refused(pipeline: UniRenderPipeline, callback: Any, words: str) -> None:
    with pytest.raises(UnirenderError, match=f"callback_on_step_end: {words}"):
        sampled(pipeline, callback)


def test_what_cannot_be_called_is_refused(pipeline: UniRenderPipeline) -> None:
    with pytest.raises(UnirenderError, match="callback_on_step_end: got 3, expected a function"):
        step_end_of(pipeline, 3)


def test_what_it_raises_ends_the_call(pipeline: UniRenderPipeline) -> None:
    def stop(own: Any, step: int, *told: Any) -> None:
        if step == 1:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        sampled(pipeline, stop)
