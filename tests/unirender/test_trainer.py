"""The trainer: exact resume, averaged weights, overfitting one sample, and a run on shards."""

import contextlib
import dataclasses
import functools
import io
import json
import math
import os
import platform
import re
import shutil
import threading
import time
from pathlib import Path
from typing import Any, Literal

import diffusers
import numpy as np
import pytest
import torch
from rich.console import Console
from synthetic_shards import group_members, maps_members, write_dataset, write_shard
from tiny_models import TRAIN, make_batch, make_pipeline
from torch import Tensor, nn

from unirender.diffusion.inference import infer_attributes, infer_image
from unirender.errors import UnirenderError
from unirender.models import precision
from unirender.models.precision import resolve_device, resolve_dtype
from unirender.pipelines.unirender_pipeline import UniRenderPipeline
from unirender.score import Score
from unirender.training.augmentations.augment import NO_AUGMENTATION
from unirender.training.command import Train
from unirender.training.config import LossConfig, OptimizerConfig, RunConfig, TrainConfig
from unirender.training.data import dataset as data_module
from unirender.training.data import reader
from unirender.training.data.reader import BatchReader
from unirender.training.data.source import ShardSource
from unirender.training.logs.live import live_report, never_at_peak, progress_line, standing
from unirender.training.logs.run_log import read_lines
from unirender.training.loop.checkpoint import (
    STATE_FILE,
    differences,
    load_state,
    replace_folder,
    restore_folder,
    save_state,
)
from unirender.training.loop.export import export_pipeline, read_history
from unirender.training.loop.facts import training_facts
from unirender.training.loop.trainer import Trainer, learning_rate
from unirender.training.loop.validation import Validate, Validation
from unirender.training.optim.passes import side_by_side
from unirender.training.presets import PRESETS, get_preset
from unirender.training.run import train
from unirender.training.start.weights import begin_with_network, read_start

CPU = torch.device("cpu")
OVERFIT_STEPS = 150


class SyntheticSource:
    """Batch k is a function of k: a source whose place is one number."""

    def __init__(self, fixed: bool = False) -> None:
        self.place, self.idle, self.fixed = 0, 0, fixed

    def next(self) -> dict[str, Tensor]:
        self.place += 1
        return make_batch(TRAIN.batch_size, seed=0 if self.fixed else self.place)

    def read_ahead(self) -> None:
        self.idle += 1

    def state_dict(self) -> dict[str, Any]:
        return {"place": self.place}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.place = state["place"]

    def refresh(self) -> str | None:
        return None


def run_for(
    folder: Path, steps: int, of: int = 3, config: TrainConfig = TRAIN, parallel: int = 1
) -> list[dict[str, Any]]:
    """Trains up to `steps` of a run of `of` steps, as if killed there after a save; the logged lines."""
    trainer = Trainer(config, RunConfig(folder, steps=of, log_every=1, parallel=parallel), CPU, torch.float32)
    source, lines = SyntheticSource(), []
    trainer.resume(source)
    while trainer.step < steps:
        lines.append(trainer.train_step(source.next()))
    trainer.save(source)
    return lines


@pytest.mark.parametrize(("parallel", "kind"), [(1, "adamw"), (2, "muon")])
def test_resume_is_exact(tmp_path: Path, parallel: int, kind: Literal["adamw", "muon"]) -> None:
    train = dataclasses.replace(TRAIN, optimizer=dataclasses.replace(TRAIN.optimizer, kind=kind))
    run = functools.partial(run_for, config=train, parallel=parallel)
    whole = run(tmp_path / "a", 3)
    parts = run(tmp_path / "b", 1) + run(tmp_path / "b", 3)
    assert parts == whole
    a, b = (load_state(tmp_path / name) for name in "ab")
    assert a is not None
    assert b is not None
    for group in ("model", "ema"):
        first, second = (x[group].get("average", x[group]) for x in (a, b))
        assert all(torch.equal(first[name], second[name]) for name in first), group
    other = run(tmp_path / "c", 1, config=dataclasses.replace(train, seed=1))
    assert other != whole[:1]  # the twin that must differ


def test_the_moments_of_a_state_get_the_layout_of_the_weights(tmp_path: Path) -> None:
    """The fused optimiser would give each weight another's moments, without a word."""
    run_for(tmp_path, 1)
    state = load_state(tmp_path)
    assert state is not None
    turned = 0
    for moments in state["optimizer"]["state"].values():
        for name, value in moments.items():
            moments[name] = value.contiguous()
            turned += moments[name].stride() != value.stride()
    assert turned
    save_state(tmp_path, state)
    again = Trainer(TRAIN, RunConfig(tmp_path, steps=2), CPU, torch.float32)
    again.resume(SyntheticSource())
    for before, (p, after) in zip(state["optimizer"]["state"].values(), again.optimizer.state.items(), strict=True):
        assert torch.equal(after["exp_avg"], before["exp_avg"])
        assert after["exp_avg"].stride() == after["exp_avg_sq"].stride() == p.stride()


def test_idle_cores_are_made_use_of_once_the_passes_are_over(tmp_path: Path) -> None:
    trainer = Trainer(TRAIN, RunConfig(tmp_path, steps=2), CPU, torch.float32)
    weight = trainer.model.attribute_unet.conv_out.weight
    before, seen = weight.detach().clone(), []
    trainer.train_step(make_batch(), lambda: seen.append(weight.grad is not None and torch.equal(weight, before)))
    assert seen == [True]
    assert not torch.equal(weight, before)
    source = SyntheticSource()
    trainer.fit(source)
    assert (trainer.step, source.idle) == (2, 1)


def test_state_of_another_config_is_refused(tmp_path: Path) -> None:
    run_for(tmp_path, 1)
    with pytest.raises(UnirenderError, match="holds a run with batch_size 4 instead of 2; repeat the options"):
        run_for(tmp_path, 2, config=dataclasses.replace(TRAIN, batch_size=2))


def test_broken_state_is_refused(tmp_path: Path) -> None:
    for broken in (b"no state", b""):
        (tmp_path / STATE_FILE).write_bytes(broken)
        with pytest.raises(UnirenderError, match=r"cannot be read as a training state \(\w"):
            load_state(tmp_path)
    assert load_state(tmp_path / "empty") is None


@pytest.mark.parametrize("other", [{"step": 1, "net": {}}, [1]])
def test_a_state_of_something_else_is_refused(other: Any, tmp_path: Path) -> None:
    torch.save(other, tmp_path / STATE_FILE)
    with pytest.raises(UnirenderError, match="has no entry config, expected the state of a run of this command"):
        run_for(tmp_path, 1)


def test_save_replaces_at_once(tmp_path: Path) -> None:
    save_state(tmp_path, {"step": 1})
    save_state(tmp_path, {"step": 2, "t": torch.ones(2)})
    assert [p.name for p in tmp_path.iterdir()] == [STATE_FILE]
    state = load_state(tmp_path)
    assert state is not None
    assert state["step"] == 2


def test_training_needs_a_length(tmp_path: Path) -> None:
    with pytest.raises(UnirenderError, match="steps or minutes"):
        Trainer(TRAIN, RunConfig(tmp_path), CPU, torch.float32)


def test_learning_rate_warms_up_and_decays() -> None:
    config = OptimizerConfig(learning_rate=1.0, warmup_steps=9, final_lr=0.1)
    assert learning_rate(config, 0, 0.0) == pytest.approx(0.1)
    assert learning_rate(config, 9, 0.0) == pytest.approx(1.0)
    assert learning_rate(config, 500, 0.5) == pytest.approx(0.55)
    assert learning_rate(config, 999, 1.0) == pytest.approx(0.1)
    assert learning_rate(config, 999, 7.0) == pytest.approx(0.1)


def test_averaged_weights_are_in_place_only_inside_the_block(tmp_path: Path) -> None:
    trainer = Trainer(TRAIN, RunConfig(tmp_path, steps=3), CPU, torch.float32)
    trainer.train_step(make_batch())
    before = [p.detach().clone() for p in trainer.model.parameters()]
    with trainer.averaged():
        name, p = next(iter(trainer.model.named_parameters()))
        assert torch.equal(p, trainer.ema.average[name])
    assert all(torch.equal(p, q) for p, q in zip(trainer.model.parameters(), before, strict=True))
    assert trainer.model.training


def masked_psnr(a: Tensor, b: Tensor, mask: Tensor) -> float:
    return -10 * math.log10(float(((a - b).square() * mask).sum() / (3 * mask.sum())))


@pytest.mark.long
def test_plain_model_overfits_one_sample(tmp_path: Path) -> None:
    """Both directions, without the prior, in a few seconds on one core."""
    config = dataclasses.replace(
        TRAIN,
        model=dataclasses.replace(TRAIN.model, physics_prior="none"),
        loss=dataclasses.replace(TRAIN.loss, cycle=0.0),
        optimizer=OptimizerConfig(learning_rate=5e-3, warmup_steps=10, ema_decay=0.9),
        batch_size=2,
        p_t=0.0,
        map_dropout=0.0,
    )
    trainer = Trainer(config, RunConfig(tmp_path, steps=OVERFIT_STEPS), CPU, torch.float32)
    one = {name: value.repeat(2, 1, 1, 1) for name, value in make_batch(1).items()}
    while trainer.step < OVERFIT_STEPS:
        trainer.train_step(one)
    parts = (trainer.loss.model, trainer.loss.conditioning, trainer.loss.scheduler)
    with trainer.averaged():
        maps = infer_attributes(*parts, one["image"], one["mask"], generator=torch.Generator().manual_seed(1))
        given = torch.ones(2, 6, dtype=torch.bool)
        image = infer_image(*parts, one, given, generator=torch.Generator().manual_seed(1))
    assert masked_psnr(maps["albedo"], one["albedo"], one["mask"]) > 20
    assert masked_psnr(image, one["image"].clamp(0, 1), one["mask"]) > 20


def test_run_on_shards_writes_what_it_says(tmp_path: Path) -> None:
    data = write_dataset(tmp_path / "data", size=32)
    lines: list[dict[str, Any]] = []
    for steps in (2, 3):  # the second call resumes
        run = RunConfig(tmp_path / "run", steps=steps, log_every=1, picture_minutes=0.0, refresh_minutes=0.0)
        trainer = Trainer(TRAIN, run, CPU, torch.float32)
        source = ShardSource(data, TRAIN.batch_size, TRAIN.seed)
        trainer.fit(source, lines.append)
        source.close()
    assert [line["step"] for line in lines] == [1, 2, 3]
    logged = [json.loads(line) for line in (tmp_path / "run" / "log.jsonl").read_text().splitlines()]
    assert [line["step"] for line in logged] == [1, 2, 3]
    assert json.loads((tmp_path / "run" / "config.json").read_text())["train"]["batch_size"] == TRAIN.batch_size
    assert (tmp_path / "run" / "pictures" / "step_000003.png").is_file()
    folder = export_pipeline(trainer, tmp_path / "run" / "pipeline")
    assert json.loads((folder / "training.json").read_text())["samples"] == 3 * TRAIN.batch_size
    pipeline = UniRenderPipeline.from_pretrained(folder)
    assert pipeline.dtype == torch.float32
    weight = trainer.ema.average["image_unet.conv_in.weight"].half().float()
    assert torch.equal(pipeline.dual_stream.image_unet.conv_in.weight, weight)


def test_a_pipeline_answers_with_maps_if_it_was_trained_on_maps(tmp_path: Path) -> None:
    """Their mean over the object would be wrong everywhere; maps beside objects of one value make no difference."""
    for name, groups in {
        "scalar": {"a_g0": group_members("independent", 32, 1, (40,), (50,), 0)},
        "mixed": {"a_g0": group_members("independent", 32, 1, (40,), (50,), 0), "b_g0": maps_members(32, 1, 1)},
    }.items():
        (tmp_path / name).mkdir()
        write_shard(tmp_path / name / "shard-000000.tar", groups)
        trainer = Trainer(TRAIN, RunConfig(tmp_path / f"run-{name}", steps=1), CPU, torch.float32)
        trainer.source = ShardSource(tmp_path / name, TRAIN.batch_size, TRAIN.seed)
        found = UniRenderPipeline.from_pretrained(export_pipeline(trainer, tmp_path / f"run-{name}" / "pipeline"))
        assert found.config["material"] == {"scalar": "scalar", "mixed": "map"}[name]


def scores_in_turn(values: list[float], higher_is_better: bool) -> tuple[Validate, list[UniRenderPipeline]]:
    """A validation that answers with the next value, and the pipelines that it was shown."""
    shown: list[UniRenderPipeline] = []

    def validate(pipeline: UniRenderPipeline) -> dict[str, Score]:
        shown.append(pipeline)
        return {"error": Score(values[len(shown) - 1], higher_is_better), "other": Score(0.0, True)}

    return validate, shown


def fit(
    folder: Path, steps: int, validate: Validate | None = None, parallel: int = 1, keep_best: str | None = None
) -> list[dict[str, Any]]:
    """Runs, or resumes, with a log line at every step and a look (picture, validation) after every step."""
    run = RunConfig(folder, steps=steps, log_every=1, picture_minutes=0.0, parallel=parallel, keep_best=keep_best)
    lines: list[dict[str, Any]] = []
    Trainer(TRAIN, run, CPU, torch.float32).fit(SyntheticSource(), lines.append, validate)
    return lines


def test_validation_sees_the_averaged_weights(tmp_path: Path) -> None:
    validate, shown = scores_in_turn([3.0, 1.0], higher_is_better=False)
    trainer = Trainer(TRAIN, RunConfig(tmp_path, steps=1, picture_minutes=0.0), CPU, torch.float32)
    lines: list[dict[str, Any]] = []
    trainer.fit(SyntheticSource(), lines.append, validate)
    told = [line for line in lines if "validation" in line]
    assert [line["validation"]["error"] for line in told] == [3.0, 1.0]
    assert all(0 <= line["validation_s"] < 60 for line in told)
    weight = shown[-1].dual_stream.image_unet.conv_in.weight
    assert torch.equal(weight, trainer.ema.average["image_unet.conv_in.weight"])
    assert not torch.equal(weight, trainer.model.image_unet.conv_in.weight)  # the twin: not the trained ones
    image, mask = np.full((32, 32, 3), 0.5, np.float32), np.ones((32, 32, 1), np.float32)
    assert np.isfinite(shown[0].decompose(image, mask).intrinsics.require("albedo")["albedo"]).all()
    assert not (tmp_path / "best").exists()


def test_the_best_pipeline_is_kept_by_the_scores_own_direction(tmp_path: Path) -> None:
    """Of an error here; `test_train_writes_a_pipeline_that_decompose_loads` has a score of which more is better."""
    validate, _ = scores_in_turn([2.0, 1.0, 3.0], higher_is_better=False)  # at steps 0, 1, 2
    fit(tmp_path, 2, validate, keep_best="error")
    best = json.loads((tmp_path / "best" / "validation.json").read_text())
    assert best["step"] == 1
    assert json.loads((tmp_path / "best" / "training.json").read_text())["steps"] == 1
    resumed, _ = scores_in_turn([2.9, float("nan")], higher_is_better=False)  # neither is better
    fit(tmp_path, 4, resumed, keep_best="error")
    assert json.loads((tmp_path / "best" / "validation.json").read_text()) == best
    assert UniRenderPipeline.from_pretrained(tmp_path / "best").size == 32
    assert not (tmp_path / "best.partial").exists()


def test_the_best_of_another_run_is_not_taken_for_its_own(tmp_path: Path) -> None:
    validate, _ = scores_in_turn([2.0, 3.0, 2.5], higher_is_better=True)
    fit(tmp_path, 1, validate, keep_best="error")
    (tmp_path / STATE_FILE).unlink()
    log, best = ((tmp_path / name).read_text() for name in ("log.jsonl", "best/validation.json"))
    other = Trainer(dataclasses.replace(TRAIN, seed=1), RunConfig(tmp_path, 1, keep_best="error"), CPU, torch.float32)
    with pytest.raises(UnirenderError, match=r"best: is the best of another run, with seed 0 instead of 1, .* move it"):
        other.fit(SyntheticSource(), validate=scores_in_turn([1.0], higher_is_better=True)[0])
    assert [(tmp_path / name).read_text() for name in ("log.jsonl", "best/validation.json")] == [log, best]
    again, _ = scores_in_turn([2.0, 1.0, 1.0], higher_is_better=True)
    fit(tmp_path, 1, again, keep_best="error")  # its own: it was killed before its first save
    assert (tmp_path / "best" / "validation.json").read_text() == best
    (tmp_path / STATE_FILE).unlink()
    for broken in ("{}", '{"train":', "[]"):
        (tmp_path / "best" / "training.json").write_text(broken)
        with pytest.raises(UnirenderError, match=r"training\.json: cannot be read as the record of a training"):
            other.fit(SyntheticSource(), validate=scores_in_turn([1.0], higher_is_better=True)[0])


def test_the_best_on_other_scenes_is_not_compared(tmp_path: Path) -> None:
    """The best of an easy suite would stay for ever; and a run that goes on may be scored on others (`--validate`)."""
    timed = Trainer(TRAIN, RunConfig(tmp_path, minutes=30.0), CPU, torch.float32)  # its length is no difference
    facts: dict[str, Any] = training_facts(timed) | {"scored_on": "4 scenes of the suite tiny"}
    (tmp_path / "best").mkdir()
    (tmp_path / "best" / "training.json").write_text(json.dumps(facts))
    (tmp_path / STATE_FILE).touch()  # of a run that goes on; nobody reads it before

    def trainer(scored_on: str | None) -> Trainer:
        run = RunConfig(tmp_path, 1, keep_best="error", scored_on=scored_on)
        return Trainer(TRAIN, run, CPU, torch.float32)

    validate, _ = scores_in_turn([], higher_is_better=True)
    for same in (facts["scored_on"], None):
        Validation(validate, "error").begin(trainer(same))
    with pytest.raises(UnirenderError, match=r"best on 4 .* expected 8 .*: scores on other scenes cannot be compared"):
        trainer("8 scenes of the suite tiny").fit(SyntheticSource(), validate=validate)


def test_a_kill_at_the_end_costs_no_picture_and_no_score(tmp_path: Path) -> None:
    """After the last save come the last picture, its scores, `best/` and a line about them."""
    scores = {"error": Score(1.0, True)}
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    fit(whole, 2, lambda pipeline: scores, keep_best="error")
    shutil.copytree(whole, killed)
    *kept, last = (killed / "log.jsonl").read_text().splitlines(keepends=True)
    assert '"validation"' in last
    (killed / "log.jsonl").write_text("".join(kept))
    (killed / "pictures" / "step_000002.png").unlink()
    (killed / "pictures" / ".step_000002.png.part").touch()
    (killed / "best").rename(killed / "best.old")
    (killed / "best.partial").mkdir()
    for _ in range(2):  # again, when all is there
        fit(killed, 2, lambda pipeline: scores, keep_best="error")
        files = [{path.relative_to(run) for path in run.rglob("*")} for run in (killed, whole)]
        assert files[0] == files[1]
        assert scored(killed) == scored(whole) == [(0, True), (1, False), (2, False)]
        picture = Path("pictures", "step_000002.png")
        assert (killed / picture).read_bytes() == (whole / picture).read_bytes()
    (killed / "log.jsonl").unlink()
    (killed / STATE_FILE).unlink()
    fit(killed, 1, lambda pipeline: scores, keep_best="error")
    assert scored(killed)[0] == (0, True)  # killed between `best/` and its line, it is the best all the same


def scored(folder: Path) -> list[tuple[int, bool]]:
    """The steps that a log has scores of, and whether these were the best."""
    return [(line["step"], line["best"]) for line in read_lines(folder / "log.jsonl") if "validation" in line]


def test_a_run_that_is_over_is_scored_once(tmp_path: Path) -> None:
    over = Trainer(TRAIN, RunConfig(tmp_path, steps=1), CPU, torch.float32)
    over.step = 1
    over.save(SyntheticSource())
    validate, shown = scores_in_turn([1.0, 2.0], higher_is_better=True)
    fit(tmp_path, 1, validate)
    assert len(shown) == 1


def test_the_best_of_an_unknown_score_is_refused_before_training(tmp_path: Path) -> None:
    validate, _ = scores_in_turn([1.0], higher_is_better=True)
    with pytest.raises(UnirenderError, match="expected one of: error, other"):
        fit(tmp_path, 2, validate, keep_best="errors")
    assert load_state(tmp_path) is None


def test_scores_know_their_direction() -> None:
    assert Score(2, True).better_than(Score(1, True))
    assert Score(1, False).better_than(Score(2, False))
    assert not Score(1, True).better_than(Score(1, True))
    nan = float("nan")
    assert Score(1, False).better_than(Score(nan, False))
    assert not Score(nan, True).better_than(Score(1, True))
    with pytest.raises(ValueError, match="different directions"):
        Score(1, True).better_than(Score(1, False))


def test_a_resume_says_where_another_number_of_passes_changes_it(tmp_path: Path) -> None:
    fit(tmp_path, 1, parallel=2)
    state = load_state(tmp_path)
    assert state is not None
    assert state["parts"] == 2
    assert json.loads((tmp_path / "config.json").read_text())["run"]["parallel"] == 2
    assert not [line for line in fit(tmp_path, 2, parallel=2) if "parts" in line]
    (line,) = (line for line in fit(tmp_path, 3) if "parts" in line)
    assert line["parts"].startswith("2 -> 1")
    assert line in [json.loads(text) for text in (tmp_path / "log.jsonl").read_text().splitlines()]


def test_a_state_of_an_older_version_resumes_with_defaults_for_what_it_did_not_know(tmp_path: Path) -> None:
    run_for(tmp_path, 1)
    state = load_state(tmp_path)
    assert state is not None
    config = state["config"]
    assert config["map_dropout"] != TrainConfig().map_dropout
    assert TRAIN.loss.composite == LossConfig().composite
    del config["loss"]["composite"], config["timestep_rule"]
    save_state(tmp_path, state)
    assert run_for(tmp_path, 2)
    assert differences(config | {"trains": "all"}, TRAIN) == ["trains 'all' instead of None"]  # which is gone
    config["steps"] += 1  # a run may be prolonged
    assert differences(config, TRAIN) == []
    del config["map_dropout"]  # the twin: here the default is not what the run has now
    assert differences(config, TRAIN) == ["map_dropout 0.0 instead of 0.1"]
    config["loss"]["invention"] = 1.0  # of a later version: it trained on something that this one does not know
    save_state(tmp_path, state)
    with pytest.raises(UnirenderError, match=r"loss\.invention 1\.0 instead of None, map_dropout 0\.0 instead of 0\.1"):
        run_for(tmp_path, 2)


def test_radiance_above_the_curves_is_trained_on_and_counted(tmp_path: Path) -> None:
    trainer = Trainer(TRAIN, RunConfig(tmp_path, steps=1, log_every=1), CPU, torch.float32)
    batch = make_batch()
    assert set(trainer.overflow(batch).values()) == {0.0}
    batch["specular"][:, :, 10, 10:12] = 30.0
    expected = pytest.approx(6 / batch["specular"][0].numel())
    assert trainer.overflow(batch) == {
        "above_x_max_specular": expected,
        "above_x_max_diffuse": 0.0,
        "above_x_max_environment": 0.0,
    }
    source, lines = SyntheticSource(), list[dict[str, Any]]()
    source.next = lambda: batch
    trainer.fit(source, lines.append)
    assert [name for name in lines[0] if name.startswith("above")] == ["above_x_max_specular"]
    plain = Trainer(TRAIN, RunConfig(tmp_path / "plain", steps=1), CPU, torch.float32)
    clipped = plain.train_step(batch | {"specular": batch["specular"].clamp(max=20.0)})
    assert clipped["grad_norm"] != lines[0]["grad_norm"]  # kept, not clipped


def show(lines: list[dict[str, Any]], terminal: bool) -> str:
    console = Console(file=io.StringIO(), force_terminal=terminal, width=100)
    with live_report(100, 10.0, console) as report:
        for line in lines:
            report(line)
    assert isinstance(console.file, io.StringIO)
    return console.file.getvalue()


def test_a_terminal_sees_one_live_line_and_a_file_all_of_them() -> None:
    losses = [{"step": k, "minutes": 0.5 * k, "samples_per_s": 90.0, "albedo": 0.25 / k} for k in (1, 2)]
    lines = [losses[0], {"step": 1, "validation": {"albedo.psnr": 20.0}}, losses[1]]
    plain = show(lines, terminal=False).splitlines()
    assert plain == [
        "step 1  minutes 0.5  samples_per_s 90  albedo 0.25",
        "step 1  validation: albedo.psnr 20",
        "step 2  minutes 1  samples_per_s 90  albedo 0.125",
    ]
    live = show(lines, terminal=True)
    assert "step 2 of 100" in live
    assert "1.0 of 10 min" in live
    assert "90.0 samples/s" in live
    assert "validation: albedo.psnr 20" in live
    assert "\x1b[" in live  # redrawn in place


@pytest.mark.parametrize(("step", "minutes", "share"), [(2, 1.0, 0.1), (50, 1.0, 0.5), (2, 20.0, 1.0)])
def test_the_bar_of_a_run_shows_the_larger_share_of_its_length(step: int, minutes: float, share: float) -> None:
    console = Console(file=io.StringIO(), no_color=True, width=100)  # draws no rest of a bar
    console.print(progress_line({"step": step, "minutes": minutes, "samples_per_s": 90.0}, 100, 10.0))
    assert isinstance(console.file, io.StringIO)
    assert console.file.getvalue().count("━") == 30 * share


def test_a_run_that_is_taken_up_again_says_where_it_stands(tmp_path: Path) -> None:
    said: list[str] = []
    for steps in (1, 2, 2):
        trainer = Trainer(TRAIN, RunConfig(tmp_path, steps=steps), CPU, torch.float32)
        trainer.fit(SyntheticSource(), say=said.append)
    assert said == [  # and nothing of the new run
        "resumed at step 1 of 2",
        "finished at step 2 of 2: nothing to train; pass --steps (more than 2) to go on from there",
    ]
    state = load_state(tmp_path)
    assert state is not None
    save_state(tmp_path, state | {"seconds": 330.0})
    Trainer(TRAIN, RunConfig(tmp_path, minutes=5.0), CPU, torch.float32).fit(SyntheticSource(), say=said.append)
    assert said[-1].startswith("finished at step 2, after 5.5 of 5 minutes: nothing to train")
    assert standing(7, 1.25, None, 5.0) == "resumed at step 7, after 1.2 of 5 minutes"
    both = standing(8, 5.5, 8, 5.0)
    assert both.startswith("finished at step 8 of 8, after 5.5 of 5 minutes: nothing to train")
    assert "pass --steps (more than 8) and --minutes (more than 5.5)" in both
    assert "pass --steps (more than 3)" in standing(3, 1.0, 2, None), "past the length that is asked for"
    assert "--steps" not in standing(7, 5.5, 8, 5.0)


def test_a_run_that_ends_in_its_warm_up_is_told() -> None:
    """Two minutes of a slow machine are: the loss hardly moves, and nothing said why."""
    config = OptimizerConfig(learning_rate=5e-4, warmup_steps=100)
    assert "ended at step 100, and the learning rate rises for 100 steps" in str(never_at_peak(100, config))
    assert learning_rate(config, 99, 0.0) < 5e-4
    assert never_at_peak(101, config) is None
    assert learning_rate(config, 100, 0.0) == 5e-4


def test_a_batch_that_cannot_be_made_is_asked_for_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    data = write_dataset(tmp_path, size=32)
    whole = ShardSource(data, 2, 0, workers=0)
    batches = [whole.next()["image"] for _ in range(2)]
    make = data_module.make_batch
    for workers in (0, 1):
        source, made = ShardSource(data, 2, 0, workers=workers), list[int]()

        def only_the_first(*arguments: Any, made: list[int] = made) -> Any:
            made.append(1)  # a thread reads ahead at once
            return make(*arguments) if len(made) == 1 else 1 / 0

        with monkeypatch.context() as broken:
            broken.setattr(reader, "make_batch", only_the_first)
            assert torch.equal(source.next()["image"], batches[0])
            for _ in range(2):
                with pytest.raises(ZeroDivisionError):
                    source.next()
        assert source.consumed == 2
        if not workers:  # what a thread failed at it has failed at for good
            assert torch.equal(source.next()["image"], batches[1])
        source.close()


def test_a_run_that_fails_ends_its_threads(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    data, scored, before = write_dataset(tmp_path / "data", size=32), list[int](), set(threading.enumerate())

    def fail_at_the_end(pipeline: UniRenderPipeline) -> dict[str, Score]:
        scored.append(1)
        if len(scored) == 2:
            raise RuntimeError
        return {"error": Score(1.0, higher_is_better=False)}

    options = Train(data=data, steps=1, parallel=1, device="cpu", batch_size=2, seed=7)
    with pytest.raises(RuntimeError) as stopped:
        train(options, TRAIN, tmp_path / "run", fail_at_the_end)
    written = json.loads((tmp_path / "run" / "config.json").read_text())
    assert (written["train"]["batch_size"], written["train"]["seed"]) == (2, 7)  # of the options, as in the command
    assert written["run"]["preset"] is None  # the configuration is not that of the row `tiny`
    assert stopped.tb  # keeps the reader, whose threads end with it
    assert not {thread.name for thread in set(threading.enumerate()) - before}
    assert ", one pass at a time\n" in capsys.readouterr().out


def test_growing_folder(tmp_path: Path) -> None:
    """New shards are taken in at a refresh; a resumed run keeps the shards that it had."""
    data = write_dataset(tmp_path, shards=1)
    source = ShardSource(data, 2, 0)
    source.next()
    assert source.refresh() is None
    state = source.state_dict()
    write_dataset(tmp_path, shards=3)
    assert source.refresh() == "data: 1 -> 3 shards at sample 2"
    grown = source.next()
    resumed = ShardSource(data, 2, 0)
    resumed.load_state_dict(state)
    old = resumed.next()
    assert resumed.state_dict()["shards"] == state["shards"]
    assert not torch.equal(grown["image"], old["image"])
    with pytest.raises(UnirenderError, match=r"2 of the 3 shards .* \(first: shard-000001\.tar\), .*; put them back"):
        ShardSource(write_dataset(tmp_path / "other", shards=1), 2, 0).load_state_dict(source.state_dict())
    source.close()
    resumed.close()


def test_a_new_shard_that_cannot_be_used_does_not_end_the_run(tmp_path: Path) -> None:
    data, lines = write_dataset(tmp_path / "data", size=32), list[dict[str, Any]]()

    def report(line: dict[str, Any]) -> None:
        lines.append(line)
        (data / "shard-000009.tar").write_bytes(b"no tar")

    run = RunConfig(tmp_path / "run", steps=3, log_every=1, refresh_minutes=0.0)
    with contextlib.closing(ShardSource(data, TRAIN.batch_size, TRAIN.seed)) as source:
        Trainer(TRAIN, run, CPU, torch.float32).fit(source, report)
        assert (source.state_dict()["shards"], source.consumed) == (["shard-000000.tar", "shard-000001.tar"], 12)
    assert [line["step"] for line in lines if "lr" in line] == [1, 2, 3]
    assert re.search("no new shards: .*shard-000009.tar: not a readable tar", lines[1]["data"])


def test_presets_are_rows() -> None:
    assert get_preset("paper").optimizer == dataclasses.replace(PRESETS["sd15"].optimizer)
    assert (get_preset("paper").optimizer.beta1, get_preset("paper").batch_size) == (0.8, 4)
    assert get_preset("tiny_without_cycle").loss.cycle == 0
    with pytest.raises(UnirenderError, match="expected one of tiny"):
        get_preset("huge")


def test_device_and_dtype_names() -> None:
    assert resolve_device("auto").type in ("cuda", "mps", "cpu")
    assert resolve_dtype("float16", CPU) == torch.float16
    with pytest.raises(UnirenderError, match="expected one of: auto"):
        resolve_dtype("int8", CPU)
    with pytest.raises(UnirenderError, match="not available here"):
        resolve_device("tpu")


@pytest.mark.parametrize(
    ("flags", "expected"),
    [("avx512_bf16", torch.bfloat16), ("amx_bf16 amx_tile", torch.bfloat16), ("avx512f", torch.float32)],
)
def test_auto_is_bf16_where_the_cpu_multiplies_it(
    flags: str, expected: torch.dtype, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "cpuinfo").write_text(f"processor : 0\nflags : fpu {flags} sse2\nprocessor : 1\n")
    monkeypatch.setattr(platform, "machine", lambda: "x86_64")
    monkeypatch.setattr(precision, "Path", lambda path: tmp_path / Path(path).name)
    assert resolve_dtype("auto", CPU) == expected


def test_a_run_starts_from_other_weights(tmp_path: Path) -> None:
    first = Trainer(TRAIN, RunConfig(tmp_path / "a", steps=2), CPU, torch.float32)
    second = Trainer(dataclasses.replace(TRAIN, seed=1), RunConfig(tmp_path / "b", steps=2), CPU, torch.float32)
    name = "attribute_unet.conv_in.weight"
    assert not torch.equal(first.model.state_dict()[name], second.model.state_dict()[name])
    begin_with_network(second, first.model)
    for key, value in first.model.state_dict().items():
        assert torch.equal(value, second.model.state_dict()[key])
    assert torch.equal(second.ema.average[name], first.model.state_dict()[name])


def test_a_pipeline_tells_the_runs_that_it_continues(tmp_path: Path) -> None:
    folders: list[Path] = []
    for name in ("a", "b", "c"):
        trainer = Trainer(TRAIN, RunConfig(tmp_path / name, steps=1), CPU, torch.float32)
        if folders:
            pipeline = UniRenderPipeline.from_pretrained(folders[-1])
            begin_with_network(trainer, pipeline.dual_stream, read_history(folders[-1]))
        trainer.fit(SyntheticSource())
        again = Trainer(TRAIN, RunConfig(tmp_path / name, steps=1), CPU, torch.float32)
        again.resume(SyntheticSource())
        folders.append(export_pipeline(again, tmp_path / name / "pipeline"))
    assert [len(read_history(folder)) for folder in folders] == [1, 2, 3]
    assert all("continues" not in run and run["steps"] == 1 for run in read_history(folders[-1]))
    (folders[-1] / "training.json").write_text("[")
    with pytest.raises(UnirenderError, match="cannot be read as the record of a training"):
        read_history(folders[-1])


def test_a_resume_with_another_beginning_is_refused(tmp_path: Path) -> None:
    """What the state holds goes before all weights: another --init would be read and do nothing."""
    for seed in (0, 1):
        make_pipeline(seed).save_pretrained(tmp_path / f"{seed}")

    def resumed(name: str, init: Path | None) -> Trainer:
        trainer = Trainer(TRAIN, RunConfig(tmp_path / name, steps=2), CPU, torch.float32)
        read_start(TRAIN.model, init).apply(trainer)
        trainer.resume(SyntheticSource())
        return trainer

    for name, init in (("chance", None), ("first", tmp_path / "0")):
        resumed(name, init).save(SyntheticSource())
        again = resumed(name, init)  # the same command line
        assert again.begun_with == resumed(name, None).begun_with  # who asks for nothing
        again.save(SyntheticSource())
    (tmp_path / "elsewhere").mkdir()
    shutil.copytree(tmp_path / "0", tmp_path / "elsewhere" / "moved")
    resumed("first", tmp_path / "elsewhere" / "moved")  # the same weights
    for name, before, to_do in (
        ("chance", "random weights", "leave --init out"),
        ("first", f"--init {tmp_path / '0'}", f"repeat --init {tmp_path / '0'}"),
    ):
        said = f"begun with {before}, not with --init {tmp_path / '1'}; {to_do} to go on with it, or pass another --out"
        with pytest.raises(UnirenderError, match=re.escape(said)):
            resumed(name, tmp_path / "1")
    shutil.rmtree(tmp_path / "0")
    shutil.copytree(tmp_path / "1", tmp_path / "0")
    resumed("first", tmp_path / "0")  # the same command line, whatever has become of the folder


def test_loading_what_a_run_begins_with_shows_no_bars(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """And a call of `train` leaves torch's threads as they were: a second one would train in other parts."""
    diffusers.utils.logging.enable_progress_bar()
    data = write_dataset(tmp_path / "data", size=64)
    make_pipeline(0).save_pretrained(tmp_path / "other")
    options = Train(data, out=tmp_path / "run", init=tmp_path / "other", steps=1)
    with side_by_side(CPU, 1):
        torch.set_num_threads(3)
        with pytest.raises(UnirenderError, match="expected the same network"):
            train(options, options.check(), tmp_path / "run")
        assert torch.get_num_threads() == 3
    assert "Loading" not in capsys.readouterr().err


def test_another_prior_begins_with_its_own_picture(tmp_path: Path) -> None:
    other = dataclasses.replace(TRAIN, model=dataclasses.replace(TRAIN.model, physics_prior="composite"))
    first = Trainer(other, RunConfig(tmp_path / "a", steps=2), CPU, torch.float32)
    torch.nn.init.ones_(first.model.image_unet.conv_out.weight)
    second = Trainer(TRAIN, RunConfig(tmp_path / "b", steps=2), CPU, torch.float32)
    begin_with_network(second, first.model)
    assert not second.model.image_unet.conv_out.weight.any()
    assert not second.ema.average["image_unet.conv_out.weight"].any()
    assert torch.equal(first.model.image_unet.conv_in.weight, second.model.image_unet.conv_in.weight)


def test_weights_of_another_network_are_refused(tmp_path: Path) -> None:
    wider = dataclasses.replace(
        TRAIN, model=dataclasses.replace(TRAIN.model, cross_attention_dim=2 * TRAIN.model.cross_attention_dim)
    )
    trainer = Trainer(TRAIN, RunConfig(tmp_path / "a", steps=2), CPU, torch.float32)
    other = Trainer(wider, RunConfig(tmp_path / "b", steps=2), CPU, torch.float32)
    with pytest.raises(UnirenderError, match="expected the same network"):
        begin_with_network(trainer, other.model)


@pytest.mark.parametrize("unified", [True, False])
def test_a_pipeline_of_the_other_kind_of_network_is_refused(unified: bool, tmp_path: Path) -> None:
    """The names of the weights differ as well, but say nothing of the reason."""
    split = dataclasses.replace(TRAIN, model=dataclasses.replace(TRAIN.model, unified=False))
    given, wanted = (TRAIN, split) if unified else (split, TRAIN)
    trainer = Trainer(given, RunConfig(tmp_path, steps=1), CPU, torch.float32)
    folder = export_pipeline(trainer, tmp_path / "pipeline")
    kinds = ["one network for both directions", "a network for each direction"]
    got, expected = kinds if unified else kinds[::-1]
    with pytest.raises(
        UnirenderError, match=f"pipeline: its weights are those of {got}.*, expected {expected}.*--init"
    ):
        read_start(wanted.model, init=folder)
    assert read_start(given.model, init=folder).pipeline is not None  # the twin


def test_the_config_of_a_run_survives_a_kill_while_it_is_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    Trainer(TRAIN, RunConfig(tmp_path, steps=1), CPU, torch.float32).fit(SyntheticSource())
    before = json.loads((tmp_path / "config.json").read_text())

    synced, sync = [], os.fsync

    def killed(handle: int) -> None:
        synced.append(handle)
        if len(synced) == 2:  # the first is that of the log
            raise KeyboardInterrupt
        sync(handle)

    monkeypatch.setattr(os, "fsync", killed)
    with pytest.raises(KeyboardInterrupt):
        Trainer(TRAIN, RunConfig(tmp_path, steps=2), CPU, torch.float32).fit(SyntheticSource())
    assert json.loads((tmp_path / "config.json").read_text()) == before


def test_the_augmentation_of_a_config_reaches_the_batches(tmp_path: Path) -> None:
    data = write_dataset(tmp_path / "data", size=32)
    batches = [ShardSource(data, 2, 0, workers=0, augmentation=a).next() for a in (NO_AUGMENTATION, TRAIN.augmentation)]
    stored = next(BatchReader(data, 2, 0, workers=0, augmentation=NO_AUGMENTATION))
    assert torch.equal(batches[0]["image"], stored["image"])
    assert not torch.equal(batches[1]["image"], stored["image"])


def test_a_process_reads_its_own_rows(tmp_path: Path) -> None:
    data = write_dataset(tmp_path / "data", size=32)
    whole = ShardSource(data, 5, 0, workers=0)
    parts = [ShardSource(data, 5, 0, workers=0, rows=slice(rank, None, 2)) for rank in range(2)]
    for _ in range(3):  # across the end of an epoch
        batch = whole.next()
        for rank, part in enumerate(parts):
            assert torch.equal(part.next()["image"], batch["image"][rank::2])
    assert whole.state_dict() == parts[0].state_dict() == parts[1].state_dict()


def test_data_of_another_size_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("UNIRENDER_CACHE", str(tmp_path / "cache"))
    data = write_dataset(tmp_path / "data", size=32)
    ShardSource(data, 2, 0, size=32).open()
    derived = dataclasses.replace(NO_AUGMENTATION, derived=1.0)
    with pytest.raises(UnirenderError, match="got pictures of 32 x 32, expected 64 x 64"):
        ShardSource(data, 2, 0, size=64, augmentation=derived).open()
    assert not (tmp_path / "cache/derived").exists()  # which takes seconds a group


def test_only_steps_count_as_training(tmp_path: Path) -> None:
    naps: list[float] = []

    def slow(pipeline: UniRenderPipeline) -> dict[str, Score]:
        time.sleep(0.5)
        naps.append(0.5)
        return {"error": Score(1.0, higher_is_better=False)}

    before = time.monotonic()
    lines = [line for line in fit(tmp_path, 2, slow) if "lr" in line]
    elapsed = time.monotonic() - before
    state = load_state(tmp_path)
    assert state is not None
    assert len(naps) >= 3
    assert 0 < state["seconds"] < elapsed - sum(naps)
    spent = 60 * (lines[1]["minutes"] - lines[0]["minutes"])
    assert lines[1]["samples_per_s"] == pytest.approx(TRAIN.batch_size / spent)


def test_a_resume_forgets_what_the_log_says_of_later_steps(tmp_path: Path) -> None:
    run_for(tmp_path, 2)
    log = tmp_path / "log.jsonl"
    known = '{"step": 1, "image": 2.0}\n{"step": 2, "image": 1.5}\n'
    log.write_text(known + json.dumps({"step": 3, "image": 1.0}) + '\n{"step": 4, "ima')  # killed while writing
    Trainer(TRAIN, RunConfig(tmp_path, steps=4), CPU, torch.float32).resume(SyntheticSource())
    assert log.read_text() == known


def test_a_run_that_was_killed_before_its_first_save_leaves_no_log(tmp_path: Path) -> None:
    (tmp_path / "log.jsonl").write_text('{"step": 0, "validation": {}}\n{"step": 1, "image": 2.0}\n{"step": 2, "im')
    Trainer(TRAIN, RunConfig(tmp_path, steps=1, log_every=1), CPU, torch.float32).fit(SyntheticSource())
    (line,) = [json.loads(line) for line in (tmp_path / "log.jsonl").read_text().splitlines()]
    assert line["step"] == 1
    assert "samples_per_s" in line


class Poisoned(SyntheticSource):
    """A source of batches with a value that is none."""

    def next(self) -> dict[str, Tensor]:
        batch = super().next()
        batch["albedo"][1, 0, 3, 3] = math.nan
        return batch

    def last_keys(self) -> list[str]:
        return [f"object-{row}" for row in range(TRAIN.batch_size)]


def test_a_gradient_that_is_none_says_why(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    trainer = Trainer(TRAIN, RunConfig(tmp_path, steps=2), CPU, torch.float32)
    with pytest.raises(UnirenderError, match=r"the gradient at step 0 is nan; .* not finite \(albedo of object-1\)"):
        trainer.fit(Poisoned())
    monkeypatch.setattr(nn.utils, "clip_grad_norm_", lambda weights, norm: torch.tensor(math.inf))
    with pytest.raises(UnirenderError, match=r"is inf; lower the learning rate \(--learning-rate\)"):
        Trainer(TRAIN, RunConfig(tmp_path, steps=2), CPU, torch.float32).fit(SyntheticSource())
    trainer.save(SyntheticSource())
    with pytest.raises(UnirenderError, match="is inf; begin anew with a lower --learning-rate and another --out"):
        Trainer(TRAIN, RunConfig(tmp_path, steps=2), CPU, torch.float32).fit(SyntheticSource())


def test_a_source_knows_the_groups_of_its_last_batch(tmp_path: Path) -> None:
    write_dataset(tmp_path / "data", vary="independent", shards=1, groups=3)
    plain = NO_AUGMENTATION
    source = ShardSource(tmp_path / "data", 4, seed=2, workers=0, augmentation=plain, rows=slice(1, None, 2))
    for _ in range(2):
        batch, keys, dataset = source.next(), source.last_keys(), source.open()
        assert len(keys) == len(batch["albedo"]) == 2
        for albedo, key in zip(batch["albedo"], keys, strict=True):
            number = dataset.keys.index(key)
            own = dataset.stored(number, dataset.pairs(number)[0])[1].require("albedo")["albedo"]
            np.testing.assert_array_equal(albedo.permute(1, 2, 0).numpy(), own)


def test_a_folder_is_there_before_and_after_its_replacement(tmp_path: Path) -> None:
    def finished(text: str) -> Path:
        (tmp_path / "new").mkdir()
        (tmp_path / "new" / "file").write_text(text)
        return tmp_path / "new"

    best = tmp_path / "best"
    for text in ("one", "two"):
        replace_folder(best, finished(text))
        assert (best / "file").read_text() == text
    best.rename(tmp_path / "best.old")  # killed between the two moves
    restore_folder(best)
    assert (best / "file").read_text() == "two"
    replace_folder(best, finished("three"))
    assert [path.name for path in tmp_path.iterdir()] == ["best"]
