"""The gradient of a batch does not depend on how the batch is cut. Noise does, and is switched off for that."""

import dataclasses
from typing import Any

import pytest
import torch
from tiny_models import TRAIN, make_batch, make_model
from torch import Tensor

from unirender.diffusion.schedule import make_scheduler
from unirender.diffusion.timesteps import Timesteps
from unirender.errors import UnirenderError
from unirender.models.packing import TRIPLETS
from unirender.training.config import LossConfig, TrainConfig
from unirender.training.losses import consistency
from unirender.training.losses import loss_function as losses
from unirender.training.losses.loss_function import LossFunction
from unirender.training.optim import passes
from unirender.training.optim.loss_scale import FIRST
from unirender.training.optim.passes import BatchGradient, Split, side_by_side
from unirender.training.optim.processes import Processes

BATCH = 8
CONFIG = dataclasses.replace(
    TRAIN,
    loss=LossConfig(cycle_share=0.5, cycle_warmup=0.0, composite=0.5),
    batch_size=BATCH,
    map_dropout=0.0,
    p_render=0.4,
)


@pytest.fixture
def batch() -> dict[str, Tensor]:
    """Objects of different coverage: a mean of means is no mean here."""
    maps = make_batch(BATCH)
    for i in range(BATCH):
        maps["mask"][i, :, : 3 * i] = 0
    return maps


@pytest.fixture
def without_noise(monkeypatch: pytest.MonkeyPatch) -> None:
    """Pure noise is zero: it is drawn for each part, and would differ with the parts."""
    for module in (losses, consistency):
        monkeypatch.setattr(module, "noise_like", lambda x, generator: torch.zeros_like(x))


def gradient_of(
    config: TrainConfig = CONFIG, parallel: int = 1, accumulate: int = 1, dtype: torch.dtype = torch.float32
) -> BatchGradient:
    model, conditioning = make_model(unified=config.model.unified)
    loss = LossFunction(model, conditioning, make_scheduler(), config.loss, config.map_dropout)
    split = Split(config.batch_size, parallel=parallel, accumulate=accumulate)
    return BatchGradient(loss, config, split, torch.Generator().manual_seed(4), dtype)


def run(gradient: BatchGradient, batch: dict[str, Tensor]) -> tuple[dict[str, float], Tensor]:
    terms = gradient(batch)
    return terms, torch.cat([p.grad.flatten() for p in gradient.loss.model.parameters() if p.grad is not None])


@pytest.mark.parametrize(("rule", "unified"), [("conditional", True), ("conditional", False), ("algorithm1", False)])
def test_the_gradient_is_that_of_the_whole_batch(
    rule: Any, unified: bool, batch: dict[str, Tensor], without_noise: None
) -> None:
    model = dataclasses.replace(CONFIG.model, unified=unified)
    floors = {"image_floor": 1e-3, "colour_floor": 1e-2} if unified else {}  # means over pictures, and over pixels
    loss = dataclasses.replace(CONFIG.loss, **floors)
    config = dataclasses.replace(CONFIG, timestep_rule=rule, model=model, loss=loss)
    terms, whole = run(gradient_of(config), batch)
    assert {"image", "albedo", "environment"} <= terms.keys()
    assert rule == "algorithm1" or {"composite", "cycle"} <= terms.keys()
    # How a batch is cut is the same for both rules: the second needs one cut, uneven, side by side and one by one.
    for parallel, accumulate in ((1, 3), (2, 4)) if rule == "conditional" else ((2, 3),):
        parted, pieces = run(gradient_of(config, parallel, accumulate), batch)
        assert parted == pytest.approx(terms, rel=1e-5)
        rounding = 1e-5 if unified else 1e-4  # of float32; a wrong mass is off by 1e-2
        torch.testing.assert_close(pieces, whole, rtol=0, atol=rounding * float(whole.abs().max()))


def test_a_mean_of_the_parts_means_is_another(batch: dict[str, Tensor], without_noise: None) -> None:
    """The failing twin: parts weighed by their number of rows."""
    terms, _ = run(gradient_of(), batch)
    gradient = gradient_of(parallel=2)
    parts = [gradient.terms(part, batch) for part in gradient.parts(batch)]
    for name in ("image", "albedo", "cycle"):
        plain = sum(float(part[name].detach()) for part in parts) / len(parts)
        assert plain != pytest.approx(terms[name], rel=1e-3), name


def test_pieces_one_after_the_other_are_pieces_side_by_side(batch: dict[str, Tensor]) -> None:
    side_by_side, first = run(gradient_of(parallel=2), batch)
    one_by_one, second = run(gradient_of(accumulate=2), batch)
    assert one_by_one == side_by_side
    assert torch.equal(first, second)
    other, _ = run(gradient_of(parallel=4), batch)
    assert other != side_by_side  # the twin: other parts, other noise


def test_gradients_lie_in_memory_as_their_parameters_do(
    batch: dict[str, Tensor], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A fused optimiser needs it, and does not look (the twin)."""
    _, whole = run(gradient_of(), batch)

    def other_layout(self: BatchGradient, parameters: list[Tensor], gradients: list[Tensor | None]) -> list:
        del self, parameters
        return [None if g is None else g.t().contiguous().t() if g.dim() == 2 else g for g in gradients]

    monkeypatch.setattr(BatchGradient, "_over_processes", other_layout)
    gradient = gradient_of()
    _, again = run(gradient, batch)
    assert torch.equal(again, whole)
    with_gradient = [p for p in gradient.loss.model.parameters() if p.grad is not None]
    assert all(p.grad is not None and p.grad.stride() == p.stride() for p in with_gradient)
    results = []
    for fused, layout in ((False, False), (True, False), (True, True)):
        weight = torch.nn.Parameter(torch.ones(2, 3))
        weight.grad = torch.tensor([[1.0, -1.0, 2.0], [-2.0, 3.0, 0.0]])
        weight.grad = weight.grad.t().contiguous().t() if layout else weight.grad
        torch.optim.AdamW([weight], 0.1, fused=fused).step()
        results.append(weight.detach())
    torch.testing.assert_close(results[1], results[0])
    assert not torch.allclose(results[2], results[0])


@pytest.mark.parametrize(("size", "parallel", "accumulate"), [(1, 1, 1), (2, 1, 1), (1, 3, 2), (2, 2, 1), (3, 1, 5)])
def test_parts_are_rows_of_the_batch_whoever_computes_them(size: int, parallel: int, accumulate: int) -> None:
    splits = [Split(11, Processes(rank, size), parallel, accumulate) for rank in range(size)]
    found = {s.processes.rank + size * j: range(11)[s.own][j :: s.parts] for s in splits for j in range(s.parts)}
    number = splits[0].all_parts
    assert found == {p: range(11)[p::number] for p in range(number)}
    assert all(found.values())
    assert 1 <= splits[0].at_once <= parallel


def test_the_cycle_has_its_share_of_the_batch_not_of_each_part(batch: dict[str, Tensor]) -> None:
    config = dataclasses.replace(CONFIG, loss=dataclasses.replace(CONFIG.loss, cycle_share=0.5), p_render=0.25)
    gradient = gradient_of(config, parallel=BATCH)
    parts = gradient.parts(batch)
    inverse = [part for part in parts if part.mass["environment"]]
    rendered_again = [part for part in parts if "cycle" in gradient.terms(part, batch)]
    assert (len(inverse), len(rendered_again)) == (6, 3)  # of a single row one half is none
    assert all(part.mass["cycle"] for part in rendered_again)


@pytest.mark.parametrize("size", [1, 4], ids=["one picture", "as in the paper"])
def test_the_cycle_has_its_share_of_a_small_batch_in_the_mean(size: int) -> None:
    """Of two inverse rows a quarter is half a row, which rounded is none: never rendered again."""
    batch = make_batch(size)
    gradient = gradient_of(dataclasses.replace(CONFIG, loss=LossConfig(), batch_size=size, p_render=0.5))
    drawn = [gradient.parts(batch)[0] for _ in range(1000)]
    inverse = sum(part.mass["environment"] for part in drawn)
    again = sum(part.cycle_share * part.mass["environment"] for part in drawn)
    assert again / inverse == pytest.approx(0.25, abs=0.05)


def test_a_part_of_which_nothing_is_noisy_has_no_share(
    batch: dict[str, Tensor], without_noise: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Algorithm 1 draws rows that are clean in both streams."""
    clean = Timesteps(torch.tensor([0, 999] * 4), torch.zeros(BATCH, dtype=torch.long))
    monkeypatch.setattr(passes, "draw_timesteps", lambda *arguments: clean)
    whole, gradient = run(gradient_of(), batch)
    halves, pieces = run(gradient_of(parallel=2), batch)  # the first half is the clean one
    assert halves == pytest.approx(whole, rel=1e-5)
    torch.testing.assert_close(pieces, gradient, rtol=0, atol=1e-5 * float(gradient.abs().max()))


def test_float16_keeps_small_gradients(batch: dict[str, Tensor]) -> None:
    """It has nothing below 6e-8: what a pixel of a large batch, or of a network that is nearly right, comes to."""
    weights = {name: 0.001 * getattr(CONFIG.loss, name) for name in (*TRIPLETS, "image", "cycle", "composite")}
    loss = dataclasses.replace(CONFIG.loss, cycle_into_renderer=False, **weights)
    config = dataclasses.replace(CONFIG, batch_size=3, loss=loss)
    rows = {name: maps[:3] for name, maps in batch.items()}
    _, exact = run(gradient_of(config), rows)

    def error(scale: float) -> float:
        half = gradient_of(config, dtype=torch.float16)
        half.loss.scale = scale
        _, found = run(half, rows)
        return float((found - exact).norm() / exact.norm())

    assert error(FIRST) < 0.01
    assert error(1.0) > 0.02  # the twin


def test_a_batch_too_small_for_the_processes_is_refused(batch: dict[str, Tensor]) -> None:
    with pytest.raises(UnirenderError, match="a batch of 2 for 3 processes, expected at least one sample"):
        Split(2, Processes(0, 3))
    with pytest.raises(UnirenderError, match="got 7 rows, expected 8"):
        gradient_of()({name: value[:7] for name, value in batch.items()})


def test_threads_are_given_back() -> None:
    cpu = torch.device("cpu")
    with side_by_side(cpu, 1):  # which gives back those of before
        torch.set_num_threads(3)
        for asked in (None, 2):
            with side_by_side(cpu, asked) as parallel:
                assert (parallel, torch.get_num_threads()) == (asked or 3, 1)
            assert torch.get_num_threads() == 3
        with pytest.raises(RuntimeError, match="stop"), side_by_side(cpu):
            raise RuntimeError("stop")
        assert torch.get_num_threads() == 3
