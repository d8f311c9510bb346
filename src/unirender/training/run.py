"""`unirender train`: its options, and the run that they describe. Torch is imported only when training begins."""

import contextlib
import dataclasses
import functools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from unirender.errors import UnirenderError, UsageError
from unirender.options import Device, DType, check_seed, notice, usage
from unirender.paths import cache_dir
from unirender.training.config_check import check_config
from unirender.training.presets import ENVIRONMENT_SIZE, TrainConfig, get_preset
from unirender.writing import check_out

if TYPE_CHECKING:
    import torch

    from unirender.training.data import GroupDataset
    from unirender.training.device_data import DeviceSource
    from unirender.training.memory import TrainingBytes
    from unirender.training.processes import Processes
    from unirender.training.source import ShardSource
    from unirender.training.trainer import Trainer
    from unirender.training.validation import Validate

Batches = Literal["auto", "cpu", "device"]
MakeValidation = Callable[[str, int], "Validate"]  # (suite, number of scenes) -> the function that scores a pipeline
ScoreNames = Callable[[], Sequence[str]]  # names of the scores that such a function gives
Alone = Callable[[Path], contextlib.AbstractContextManager[Any]]  # holds a run's folder against another process


@dataclass(frozen=True)
class Train:
    """Train a preset on shards; resumes by running the same command again."""

    data: Path
    """Folder that `unirender dataset` wrote."""
    preset: str = "tiny"
    """Row of `unirender.training.presets.PRESETS`: tiny, small, small_wide (what ships as small), medium, sd15, sd21,
    paper, and ablations of tiny by name."""
    init: Path | None = None
    """Begin with the weights of this pipeline folder, or of a shipped one by its name, instead of random ones; its
    network must be the preset's, or a narrower form of it."""
    init_from: Path | None = None
    """Begin with the weights of this Stable Diffusion folder (version 1 or 2, diffusers format) and work on the latents
    of its autoencoder; for the presets sd15, sd21 and paper."""
    resolution: int | None = None
    """Size of the training pictures, one way, instead of the preset's; the data must have it."""
    learning_rate: float | None = None
    """Peak learning rate, instead of the preset's."""
    out: Path | None = None
    """Run folder. None: `${UNIRENDER_CACHE}/runs/<preset>`."""
    minutes: float | None = None
    """Stop, with the learning rate decayed, after this many minutes of training over all resumes."""
    steps: int | None = None
    """Stop after this many steps instead of the preset's."""
    batch_size: int | None = None
    """Instead of the preset's."""
    device: Device = "auto"
    """auto: cuda, then mps, then cpu, whichever is there."""
    batches: Batches = "auto"
    """Where batches are mixed and augmented. device: on the GPU, in whose memory the packed data then lie. auto: there,
    where they take no more than a third of what is free; else on the CPU."""
    dtype: DType = "auto"
    """Of the autocast; weights stay float32. auto: bfloat16 only on hardware that computes in it."""
    seed: int = 0
    """Of the weights, the data order and the noise."""
    parallel: int | None = None
    """Parts of a batch that run side by side on a CPU, one thread each. None: PyTorch's thread count."""
    accumulate: int = 1
    """Pieces in which a batch is computed, one after the other: more of them need less memory."""
    gradient_checkpointing: bool = False
    """Compute activations again where they are needed for gradients: less memory, for about one more forward pass."""
    log_every: int = 20
    """Steps between two lines of losses."""
    save_minutes: float = 3.0
    """Minutes between two saves of the state from which the run resumes."""
    refresh_minutes: float | None = None
    """Look for new shards this often, in a data folder that is still being written. None: never."""
    validate: int = 0
    """Score this many scenes of a suite with every picture (every 5 minutes). 0: none. At 64 px a scene costs about
    half a second of one CPU core."""
    validate_suite: str = "tiny"
    """A bundled suite, or the path of a suite's TOML file."""
    keep_best: str | None = None
    """Keep in `best/` the pipeline that had the best of these scores, such as albedo.psnr. It was then chosen by scenes
    of that suite: its scores there flatter it."""
    track: tuple[str, ...] = ()
    """Send every line of the log to these experiment trackers, such as tensorboard or wandb: those of accelerate that
    are installed."""

    @property
    def folder(self) -> Path:
        """Of the run."""
        return self.out or cache_dir() / "runs" / self.preset

    @property
    def scored_on(self) -> str | None:
        """In words: what `validate` measures on."""
        return f"{self.validate} scenes of the suite {Path(self.validate_suite).stem}" if self.validate else None

    def check(self) -> TrainConfig:
        """Looks at the values; the resolved configuration.

        Raises:
            UsageError: an unknown preset, a value outside its range, or options that contradict each other.
        """
        positive = ("minutes", "steps", "batch_size", "learning_rate", "parallel", "accumulate", "log_every")
        for name in (*positive, "save_minutes", "refresh_minutes"):
            value = getattr(self, name)
            if value is not None and not 0 < value < math.inf:
                raise UsageError(f"--{name.replace('_', '-')} {value}: expected a number above 0")
        check_seed(self.seed)
        if self.validate < 0:
            raise UsageError(f"--validate {self.validate}: expected a number of scenes, or 0 for none")
        if self.keep_best is not None and not self.validate:
            raise UsageError(f"--keep-best {self.keep_best}: nothing is scored, expected --validate beside it")
        if self.track:
            from unirender.training.trackers import check_trackers

            check_trackers(self.track)
        with usage():
            config = dataclasses.replace(get_preset(self.preset), seed=self.seed)
        if self.batch_size is not None:
            config = dataclasses.replace(config, batch_size=self.batch_size)
        if self.learning_rate is not None:
            optimizer = dataclasses.replace(config.optimizer, learning_rate=self.learning_rate)
            config = dataclasses.replace(config, optimizer=optimizer)
        if self.resolution is not None:
            least = math.lcm(*ENVIRONMENT_SIZE, config.model.patch)
            if self.resolution < 1 or self.resolution % least:
                raise UsageError(
                    f"--resolution {self.resolution}: expected a multiple of {least}, so that the network's latents "
                    "and the light's texels cover whole pixels"
                )
            config = dataclasses.replace(config, model=dataclasses.replace(config.model, resolution=self.resolution))
        with usage():
            check_config(config)
        self._check_start(config)
        return config

    def _check_start(self, config: TrainConfig) -> None:
        if self.init is not None and self.init_from is not None:
            raise UsageError("--init and --init-from: both say what to begin with, expected one of them")
        if config.trains != "all" and self.init is None and not self._is_saved():
            raise UsageError(
                f"--preset {self.preset}: it trains a part of a network and leaves the others as they are, expected "
                "--init with a trained one (the name of a shipped checkpoint, or a pipeline folder)"
            )
        if config.trains == "encoder" and self.validate:
            raise UsageError(
                f"--validate {self.validate}: nothing that is scored changes while the picture encoder is trained by "
                f"itself (--preset {self.preset}), expected 0"
            )
        if config.model.codec == "pixel" and self.init_from is not None:
            raise UsageError(
                f"--preset {self.preset}: its network works on pixels and cannot begin with Stable Diffusion's "
                "weights; leave out --init-from, or choose sd15, sd21 or paper"
            )
        if config.model.codec == "kl" and self.init is None and self.init_from is None:
            raise UsageError(
                f"--preset {self.preset}: its network works on latents of Stable Diffusion's autoencoder, which it "
                "needs; pass --init-from with a Stable Diffusion folder (or --init with a pipeline of this preset)"
            )

    def _is_saved(self) -> bool:
        """Whether there is a run to go on with, which has all weights."""
        from unirender.training.checkpoint import STATE_FILE

        return (self.folder / STATE_FILE).is_file()

    def run(
        self, make_validation: MakeValidation, score_names: ScoreNames, alone: Alone = contextlib.nullcontext
    ) -> int:
        """Trains, or resumes; `pipeline/` in the run folder is what it leaves. Returns the exit status.

        Under torchrun this is one of several processes, of which the first one writes and speaks.
        """
        config = self.check()
        if self.keep_best is not None and self.keep_best not in (names := score_names()):
            raise UsageError(f"--keep-best {self.keep_best}: no such score, expected one of: {', '.join(names)}")
        if not self.data.is_dir():
            raise UnirenderError(
                f"{self.data}: no such data folder, expected one written by `unirender dataset`; pass --data"
            )
        check_out(self.folder)
        validate = make_validation(self.validate_suite, self.validate) if self.validate else None
        pipeline = train(self, config, self.folder, validate, alone)
        if pipeline is not None:
            print(f"{pipeline}: use it with --checkpoint {pipeline}")
        return 0


def train(
    options: Train,
    config: TrainConfig,
    out: Path,
    validate: "Validate | None" = None,
    alone: Alone = contextlib.nullcontext,
) -> Path | None:
    """Runs the training; returns the folder with the trained pipeline, or None in all processes but the first."""
    from unirender.models.precision import resolve_device
    from unirender.training.groups import list_shards
    from unirender.training.processes import join_processes

    processes, device = join_processes(resolve_device(options.device))
    if options.batches == "device" and device.type != "cuda":
        raise UsageError(f"--batches device: the training is on {device}, expected a CUDA device; leave it out")
    list_shards(options.data)  # says what is wrong with the data before anything is built or written
    with alone(out) if processes.is_main else contextlib.nullcontext():
        return _train(options, config, out, validate, processes, device)


def _train(
    options: Train,
    config: TrainConfig,
    out: Path,
    validate: "Validate | None",
    processes: "Processes",
    device: "torch.device",
) -> Path | None:
    """In a folder that no other run writes to."""
    import diffusers
    import torch
    from rich.console import Console

    from unirender.models.precision import resolve_dtype
    from unirender.training.checkpoint import STATE_FILE
    from unirender.training.export import export_pipeline
    from unirender.training.live import live_report
    from unirender.training.memory import training_bytes
    from unirender.training.start import read_start
    from unirender.training.trackers import make_trackers, tracking
    from unirender.training.trainer import RunConfig, Trainer

    dtype = resolve_dtype(options.dtype, device)
    parallel = options.parallel or (torch.get_num_threads() if device.type == "cpu" else 1)
    if parallel > 1:
        torch.set_num_threads(1)
    run = RunConfig(
        out,
        steps=config.steps if options.steps is None and options.minutes is None else options.steps,
        minutes=options.minutes,
        log_every=options.log_every,
        save_minutes=options.save_minutes,
        refresh_minutes=options.refresh_minutes,
        parallel=parallel,
        accumulate=options.accumulate,
        keep_best=options.keep_best,
        preset=options.preset,
        scored_on=options.scored_on,
    )
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
            say(f"{options.data}: {data.num_pairs} pictures, {len(data.keys)} groups, {len(data.shards)} shards")
    del data  # a folder that grew is opened anew: not both at once
    with contextlib.closing(source):
        with (
            live_report(run.steps, run.minutes, Console(quiet=not processes.is_main)) as show,
            tracking(trackers, config, resumed, show) as report,
        ):
            trainer.fit(source, report, validate, lambda sentence: say(f"{out}: {sentence}"))
        pipeline = export_pipeline(trainer, out / "pipeline") if processes.is_main else None
    processes.close()
    return pipeline


def make_source(
    options: Train, config: TrainConfig, trainer: "Trainer", memory: "TrainingBytes"
) -> "tuple[ShardSource | DeviceSource, GroupDataset]":
    """Where the batches come from, and the packed data that it opened: the CPU; or the training's device, where that is
    asked for or has the place.

    Args:
        options: data folder, and where batches are made.
        config: of the training.
        trainer: whose rows of each batch they are.
        memory: that the training needs beside the data.
    """
    from unirender.training.device_data import DeviceSource, fits
    from unirender.training.source import ShardSource

    source = ShardSource(
        options.data,
        config.batch_size,
        config.seed,
        augmentation=config.augmentation,
        size=config.model.resolution,
        rows=trainer.split.own,
        group_size=config.group_size,
    )
    packed = source.open()
    if options.batches == "device" or (options.batches == "auto" and fits(packed, trainer.device, memory)):
        return DeviceSource(source, trainer.device), packed
    return source, packed


def described(trainer: "Trainer", source: "ShardSource | DeviceSource") -> str:
    """What trains, and where, in a line."""
    from unirender.training.device_data import DeviceSource

    processes, at_once = trainer.processes, trainer.split.at_once
    place = f"process {processes.rank} of {processes.size}, " if processes.size > 1 else ""
    parameters = sum(p.numel() for p in trainer.model.parameters()) / 1e6
    passes = "one pass at a time" if at_once == 1 else f"{at_once} passes side by side"
    made = f", batches made on {trainer.device}" if isinstance(source, DeviceSource) else ""
    return f"{place}{parameters:.2f} M parameters, {trainer.device}, {trainer.dtype}, {passes}{made}"
