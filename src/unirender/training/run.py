"""One training run, as the options of `unirender train` describe it: its device, its data, and what it tells."""

import contextlib
import dataclasses
import functools
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from unirender.errors import UsageError
from unirender.system.notices import notice
from unirender.system.wording import counted
from unirender.training.command import Alone, Train
from unirender.training.config import RunConfig, TrainConfig
from unirender.training.presets import PRESETS

if TYPE_CHECKING:
    import torch

    from unirender.training.data.dataset import GroupDataset
    from unirender.training.data.device_data import DeviceSource
    from unirender.training.data.source import ShardSource
    from unirender.training.loop.trainer import Trainer
    from unirender.training.loop.validation import Validate
    from unirender.training.optim.memory import TrainingBytes
    from unirender.training.optim.processes import Processes


def train(
    options: Train,
    config: TrainConfig,
    out: Path,
    validate: "Validate | None" = None,
    alone: Alone = contextlib.nullcontext,
) -> Path | None:
    """Runs the training; returns the folder with the trained pipeline, or None in all processes but the first.

    Args:
        options: of the command; `preset` and `out` are not looked at, but for what the model card says.
        config: of the training, in which the values that the options give take the place of its own.
        out: run folder.
        validate: what `options.validate` asks for.
        alone: holds the folder against another process.

    Raises:
        UsageError: the options ask for scores and there is no `validate`, or contradict each other.
    """
    from unirender.models.precision import resolve_device
    from unirender.training.data.groups import list_shards
    from unirender.training.loop.checkpoint import check_leftover
    from unirender.training.optim.passes import side_by_side
    from unirender.training.optim.processes import join_processes

    config = options.resolved(config)
    options.check_start(config)
    if validate is None and (options.validate or options.keep_best is not None):
        raise UsageError(
            f"validate {options.validate}, keep_best {options.keep_best}: nothing scores, expected the argument "
            "`validate` of `train`, such as unirender_evaluation.validation.suite_validation('tiny', 4)"
        )
    processes, device = join_processes(resolve_device(options.device))
    if options.batches == "device" and device.type != "cuda":
        raise UsageError(f"--batches device: the training is on {device}, expected a CUDA device; leave it out")
    check_leftover(out, "pipeline")
    list_shards(options.data)  # says what is wrong with the data before anything is built or written
    with (
        alone(out) if processes.is_main else contextlib.nullcontext(),
        side_by_side(device, options.parallel) as parallel,
    ):
        run = run_config(options, config, out, parallel)
        return _train(options, config, run, validate, processes, device)


def _train(
    options: Train,
    config: TrainConfig,
    run: RunConfig,
    validate: "Validate | None",
    processes: "Processes",
    device: "torch.device",
) -> Path | None:
    """In a folder that no other run writes to."""
    import diffusers
    from rich.console import Console

    from unirender.models.precision import resolve_dtype
    from unirender.training.logs.live import live_report, never_at_peak
    from unirender.training.logs.trackers import make_trackers, tracking
    from unirender.training.loop.checkpoint import STATE_FILE
    from unirender.training.loop.export import export_pipeline
    from unirender.training.loop.trainer import Trainer
    from unirender.training.optim.memory import training_bytes
    from unirender.training.start.weights import read_start

    dtype = resolve_dtype(options.dtype, device)
    out = run.out
    trackers = make_trackers(options.track, out) if processes.is_main else ()
    tell = notice if processes.is_main else lambda text: None
    diffusers.utils.logging.disable_progress_bar()  # of loading: small files
    start = read_start(config.model, options.init, options.init_from)
    trainer = Trainer(config, run, device, dtype, processes, start.vae)
    resumed = (out / STATE_FILE).is_file()
    start.apply(trainer, (lambda text: None) if resumed else tell)  # what goes on takes the weights of its own state
    del start  # Stable Diffusion's U-Net is no longer needed
    if options.gradient_checkpointing:
        trainer.model.enable_gradient_checkpointing()
    memory = training_bytes(trainer.model, config.optimizer.kind)
    source, data = make_source(options, config, trainer, memory)
    say = functools.partial(Console().print, soft_wrap=True, highlight=False, markup=False)
    say(f"{out}: {described(trainer, source)}")
    if processes.is_main:
        say(f"memory: {memory}")
        if not resumed:  # which goes on with the shards that it has
            _tell_data(options.data, data, say)
    del data  # a folder that grew is opened anew: not both at once
    with contextlib.closing(source):
        with (
            live_report(run.steps, run.minutes, Console(quiet=not processes.is_main)) as show,
            tracking(trackers, config, resumed, show) as report,
        ):
            trainer.fit(source, report, validate, lambda sentence: say(f"{out}: {sentence}"))
        if short := never_at_peak(trainer.step, config.optimizer):
            tell(f"{out}: {short}")
        pipeline = export_pipeline(trainer, out / "pipeline") if processes.is_main else None
    processes.close()
    return pipeline


def _tell_data(folder: Path, data: "GroupDataset", say: Callable[[str], None]) -> None:
    """Says what is in a data folder, and what is doubtful about it."""
    from unirender.training.data.closed_form_check import doubt
    from unirender.training.data.groups import split_of, unread_shards

    groups, shards = counted(len(data.keys), "group"), counted(len(data.shards), "shard")
    say(f"{folder}: {counted(data.num_pairs, 'picture')}, {groups}, {shards}")
    if unread := unread_shards(folder):
        notice(unread)
    if doubtful := doubt(data):
        notice(doubtful)
    if split_of(folder) == "test":
        notice(f"{folder}: was rendered with --split test; what is trained on it cannot be tested on it")


def run_config(options: Train, config: TrainConfig, out: Path, parallel: int) -> RunConfig:
    """How long the run is and what it leaves behind; `parallel`: parts of a batch that run side by side."""
    return RunConfig(
        out,
        steps=config.steps if options.steps is None and options.minutes is None else options.steps,
        minutes=options.minutes,
        log_every=options.log_every,
        save_minutes=options.save_minutes,
        refresh_minutes=options.refresh_minutes,
        parallel=parallel,
        accumulate=options.accumulate,
        keep_best=options.keep_best,
        preset=_preset_of(options, config),
        scored_on=options.scored_on,
    )


def _preset_of(options: Train, config: TrainConfig) -> str | None:
    """The row that a configuration is of, by its name in the options; None: it is another than that row."""
    if options.preset not in PRESETS:
        return options.preset  # a name of one's own
    row = options.resolved(PRESETS[options.preset])
    return options.preset if dataclasses.replace(config, seed=row.seed, steps=row.steps) == row else None


def make_source(
    options: Train, config: TrainConfig, trainer: "Trainer", memory: "TrainingBytes"
) -> "tuple[ShardSource | DeviceSource, GroupDataset]":
    """Where the batches come from, and the packed data that it opened.

    Batches are made on the CPU, or on the training's device if that is asked for or has enough free memory.

    Args:
        options: data folder, and where batches are made.
        config: of the training.
        trainer: whose rows of each batch they are.
        memory: that the training needs beside the data.
    """
    from unirender.training.data.device_data import DeviceSource, fits
    from unirender.training.data.source import ShardSource

    source = ShardSource(
        options.data,
        config.batch_size,
        config.seed,
        augmentation=config.augmentation,
        size=config.model.resolution,
        rows=trainer.split.own,
        group_size=config.group_size,
    )
    with trainer.processes.one_first():  # shards are packed, and lights derived, on all cores
        packed = source.open()
    if options.batches == "device" or (options.batches == "auto" and fits(packed, trainer.device, memory)):
        return DeviceSource(source, trainer.device), packed
    return source, packed


def described(trainer: "Trainer", source: "ShardSource | DeviceSource") -> str:
    """What trains, and where, in a line."""
    from unirender.training.data.device_data import DeviceSource

    processes, at_once = trainer.processes, trainer.split.at_once
    place = f"process {processes.rank} of {processes.size}, " if processes.size > 1 else ""
    parameters = sum(p.numel() for p in trainer.model.parameters()) / 1e6
    passes = "one pass at a time" if at_once == 1 else f"{at_once} passes side by side"
    made = f", batches made on {trainer.device}" if isinstance(source, DeviceSource) else ""
    return f"{place}{parameters:.2f} M parameters, {trainer.device}, {trainer.dtype}, {passes}{made}"
