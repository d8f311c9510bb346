"""`unirender train`: its options, and what it refuses of them. Torch is imported only when training begins."""

import contextlib
import dataclasses
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from unirender.command_line.option_checks import check_seed, usage
from unirender.command_line.options import Device, DType
from unirender.errors import UnirenderError, UsageError
from unirender.models.config import ENVIRONMENT_SIZE
from unirender.system.paths import cache_dir
from unirender.system.wording import one_of
from unirender.system.writing import check_out
from unirender.training.config import TrainConfig
from unirender.training.config_check import check_config
from unirender.training.presets import get_preset

if TYPE_CHECKING:
    from unirender.training.loop.validation import Validate

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
    """Precision of the autocast; weights stay float32. auto: bfloat16 only on hardware that computes in it."""
    seed: int = 0
    """Seed of the weights, the data order and the noise."""
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
            from unirender.training.logs.trackers import check_trackers

            check_trackers(self.track)
        with usage():
            config = get_preset(self.preset)
        config = self.resolved(config)
        with usage():
            check_config(config)
        self.check_start(config)
        return config

    def resolved(self, config: TrainConfig) -> TrainConfig:
        """A configuration with the values that the options give in place of its own (a seed of 0 gives none).

        Raises:
            UsageError: no network has pictures of that size.
        """
        config = dataclasses.replace(config, seed=self.seed or config.seed)
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
        return config

    def check_start(self, config: TrainConfig) -> None:
        """Looks whether a run of a configuration can begin.

        Raises:
            UsageError: it lacks weights to begin with, or has some that it cannot begin with.
        """
        if self.init is not None and self.init_from is not None:
            raise UsageError("--init and --init-from: both say what to begin with, expected one of them")
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

    def run(
        self, make_validation: MakeValidation, score_names: ScoreNames, alone: Alone = contextlib.nullcontext
    ) -> int:
        """Trains, or resumes; `pipeline/` in the run folder is what it leaves. Returns the exit status.

        Under torchrun this is one of several processes, of which the first one writes and speaks.
        """
        config = self.check()
        if self.keep_best is not None and self.keep_best not in (names := score_names()):
            raise UsageError(f"--keep-best {self.keep_best}: no such score, {one_of(self.keep_best, names)}")
        if not self.data.is_dir():
            raise UnirenderError(
                f"{self.data}: no such data folder, expected one written by `unirender dataset`; pass --data"
            )
        check_out(self.folder)
        validate = make_validation(self.validate_suite, self.validate) if self.validate else None
        from unirender.training.run import train

        pipeline = train(self, config, self.folder, validate, alone)
        if pipeline is not None:
            print(f"{pipeline}: use it with --checkpoint {pipeline}")
        return 0
