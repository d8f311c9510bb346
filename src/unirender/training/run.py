"""`unirender train`: its options, and the run that they describe. Torch is imported only when training begins."""

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from unirender.errors import UnirenderError, UsageError
from unirender.options import Device, DType, usage
from unirender.paths import cache_dir
from unirender.training.presets import TrainConfig, get_preset

if TYPE_CHECKING:
    from unirender.training.validation import Validate

MakeValidation = Callable[[str, int], "Validate"]  # (suite, number of scenes) -> the function that scores a pipeline


@dataclass(frozen=True)
class Train:
    """Train a preset on shards; resumes by running the same command again."""

    data: Path
    """Folder that `unirender dataset` wrote."""
    preset: str = "tiny"
    """Row of `unirender.training.presets.PRESETS`."""
    init: Path | None = None
    """Begin with the weights of this pipeline folder instead of random ones; its network must be the preset's."""
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
    dtype: DType = "auto"
    """Of the autocast; weights stay float32. auto: bfloat16 only on hardware that computes in it."""
    seed: int = 0
    """Of the weights, the data order and the noise."""
    parallel: int | None = None
    """Parts of a batch that run side by side on a CPU, one thread each. None: PyTorch's thread count."""
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

    def check(self) -> TrainConfig:
        """Looks at the values; the resolved configuration.

        Raises:
            UsageError: an unknown preset, a value outside its range, or options that contradict each other.
        """
        for name in ("minutes", "steps", "batch_size", "learning_rate", "parallel", "refresh_minutes"):
            value = getattr(self, name)
            if value is not None and not value > 0:
                raise UsageError(f"--{name.replace('_', '-')} {value}: expected more than 0")
        if self.validate < 0:
            raise UsageError(f"--validate {self.validate}: expected a number of scenes, or 0 for none")
        if self.keep_best is not None and not self.validate:
            raise UsageError(f"--keep-best {self.keep_best}: nothing is scored, expected --validate beside it")
        with usage():
            config = dataclasses.replace(get_preset(self.preset), seed=self.seed)
        if self.batch_size is not None:
            config = dataclasses.replace(config, batch_size=self.batch_size)
        if self.learning_rate is not None:
            optimizer = dataclasses.replace(config.optimizer, learning_rate=self.learning_rate)
            config = dataclasses.replace(config, optimizer=optimizer)
        if config.model.codec == "kl":
            raise UsageError(
                f"--preset {self.preset}: its network works on latents of Stable Diffusion's autoencoder, which this "
                "command cannot load yet; choose a preset with the pixel codec, such as tiny or small"
            )
        return config

    def run(self, make_validation: MakeValidation) -> int:
        """Trains, or resumes; `pipeline/` in the run folder is what it leaves. Returns the exit status."""
        config = self.check()
        if not self.data.is_dir():
            raise UnirenderError(
                f"{self.data}: no such data folder, expected one written by `unirender dataset`; pass --data"
            )
        validate = make_validation(self.validate_suite, self.validate) if self.validate else None
        pipeline = train(self, config, self.out or cache_dir() / "runs" / self.preset, validate)
        print(f"{pipeline}: use it with --checkpoint {pipeline}")
        return 0


def train(options: Train, config: TrainConfig, out: Path, validate: "Validate | None" = None) -> Path:
    """Runs the training; returns the folder with the trained pipeline."""
    import torch
    from rich.console import Console

    from unirender.models.precision import resolve_device, resolve_dtype
    from unirender.training.export import export_pipeline, load_network, read_history
    from unirender.training.groups import list_shards
    from unirender.training.live import live_report
    from unirender.training.source import ShardSource
    from unirender.training.trainer import RunConfig, Trainer

    device = resolve_device(options.device)
    dtype = resolve_dtype(options.dtype, device)
    parallel = options.parallel or (torch.get_num_threads() if device.type == "cpu" else 1)
    if parallel > 1:
        torch.set_num_threads(1)
    run = RunConfig(
        out,
        steps=config.steps if options.steps is None and options.minutes is None else options.steps,
        minutes=options.minutes,
        refresh_minutes=options.refresh_minutes,
        parallel=parallel,
        keep_best=options.keep_best,
    )
    list_shards(options.data)  # says what is wrong with the data before anything is built or written
    trainer = Trainer(config, run, device, dtype)
    if options.init is not None:
        trainer.start_from(load_network(options.init), read_history(options.init))
    source = ShardSource(
        options.data, config.batch_size, config.seed, augmentation=config.augmentation, size=config.model.resolution
    )
    source.open()
    console = Console()
    parameters = sum(p.numel() for p in trainer.model.parameters()) / 1e6
    console.print(
        f"{out}: {parameters:.2f} M parameters, {device}, {dtype}, {parallel} passes side by side",
        soft_wrap=True,
        highlight=False,
        markup=False,
    )
    with live_report(run.steps, run.minutes, console) as report:
        trainer.fit(source, report, validate)
    source.close()
    return export_pipeline(trainer, out / "pipeline")
