"""What the weights of a run begin with: chance, a trained pipeline, or Stable Diffusion; and the autoencoder, if any.

A state in the run's folder goes before all of them.
"""

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from diffusers.models.autoencoders.autoencoder_kl import AutoencoderKL

from unirender.errors import UnirenderError
from unirender.models.build import restart_from_prior
from unirender.models.config import ModelConfig
from unirender.models.dual_stream import DualStreamModel
from unirender.models.split_streams import SplitDualStreamModel
from unirender.pipelines.unirender_pipeline import UniRenderPipeline
from unirender.shipped import checkpoint_folder
from unirender.system.notices import notice
from unirender.training.loop.beginning import Beginning, beginning
from unirender.training.loop.export import read_history
from unirender.training.loop.trainer import Trainer
from unirender.training.start.stable_diffusion import StableDiffusion, load_stable_diffusion
from unirender.training.start.widening import can_widen, widened

_KINDS = {True: "one network for both directions (unified)", False: "a network for each direction (unified=False)"}


@dataclass(frozen=True)
class Start:
    """The beginning of a run; chance where there is neither of the two.

    Attributes:
        folder: of the pipeline.
        pipeline: trained before.
        diffusion: Stable Diffusion.
        named: how the run's state knows it again.
    """

    folder: Path | None = None
    pipeline: UniRenderPipeline | None = None
    diffusion: StableDiffusion | None = None
    named: Beginning = field(default_factory=dict)

    @property
    def vae(self) -> AutoencoderKL | None:
        """The autoencoder on whose latents the network works; None: it works on pixels."""
        found = self.diffusion or self.pipeline
        return found.vae if found else None

    def apply(self, trainer: Trainer, tell: Callable[[str], None] = notice) -> None:
        """Gives a trainer the weights.

        Args:
            trainer: that has not begun.
            tell: is told what of the beginning is not taken over.

        Raises:
            UnirenderError: its network is another one.
        """
        if self.diffusion is not None:
            begin_with_diffusion(trainer, self.diffusion)
        elif self.pipeline is not None and self.folder is not None:
            begin_with_network(trainer, self.pipeline.dual_stream, read_history(self.folder))
            if self.pipeline.config["calibration"]:
                own = "its calibration is that of its own weights"
                tell(f"{self.folder}: {own}; run `unirender calibrate` on the new ones")
        trainer.begun_with = self.named


def read_start(config: ModelConfig, init: Path | None = None, init_from: Path | None = None) -> Start:
    """Reads what a run begins with, and looks whether the network can begin with it.

    Args:
        config: the network.
        init: folder of a trained pipeline, or the name of a shipped one.
        init_from: Stable Diffusion folder.

    Raises:
        UnirenderError: a folder cannot be used, or belongs to another network.
    """
    if init_from is not None:
        diffusion = load_stable_diffusion(init_from)
        diffusion.check(dataclasses.asdict(config))
        return Start(diffusion=diffusion, named=beginning("--init-from", init_from, init_from, weights=False))
    if init is None:
        return Start()
    given, init = init, checkpoint_folder(init)
    pipeline = UniRenderPipeline.from_pretrained(init)
    codec = pipeline.dual_stream.config["codec"]
    if codec != config.codec:
        raise UnirenderError(
            f"{init}: its network has the codec {codec}, expected {config.codec}; choose the preset that the weights "
            "were trained with"
        )
    unified = not isinstance(pipeline.dual_stream, SplitDualStreamModel)
    if unified != config.unified:
        raise UnirenderError(
            f"{init}: its weights are those of {_KINDS[unified]}, expected {_KINDS[config.unified]}; choose the preset "
            "that the weights were trained with, or begin without --init"
        )
    return Start(init, pipeline, named=beginning("--init", given, init))


def begin_with_network(trainer: Trainer, network: DualStreamModel, history: Sequence[dict[str, Any]] = ()) -> None:
    """Gives a trainer, and its average, the weights of another network.

    A wider form of the network begins near it (`unirender.training.start.widening`).
    With another physics prior than the network's the image stream's last convolution starts at zero again.

    Args:
        trainer: that has not begun.
        network: of the same shape, or a narrower form of the trainer's.
        history: what `unirender.training.loop.export.read_history` says of it.

    Raises:
        UnirenderError: the networks differ.
    """
    model = trainer.model
    if can_widen(model, network):
        network = widened(trainer.config.model, network, trainer.vae)
    own, other = ({k: tuple(v.shape) for k, v in m.state_dict().items()} for m in (model, network))
    curves = [m.config["hdr_curves"] for m in (model, network)]
    if own != other or {k: tuple(v) for k, v in curves[0].items()} != {k: tuple(v) for k, v in curves[1].items()}:
        differing = sorted(k for k in own.keys() | other.keys() if own.get(k) != other.get(k)) or ["hdr_curves"]
        raise UnirenderError(
            f"initial weights: {len(differing)} entries differ from the preset's network (first: {differing[0]}), "
            f"expected the same network; choose the preset that the weights were trained with{_named(history)}"
        )
    model.load_state_dict(network.state_dict())
    if network.config["physics_prior"] != model.config["physics_prior"]:
        restart_from_prior(model)  # what it added to the other closed form is no correction of this one
    trainer.begin_anew(history)


def _named(history: Sequence[dict[str, Any]]) -> str:
    preset = history[-1].get("preset") if history else None
    return f" ({preset})" if preset else ""


def begin_with_diffusion(trainer: Trainer, weights: StableDiffusion) -> None:
    """Gives a trainer, and its average, Stable Diffusion's weights.

    Raises:
        UnirenderError: the trainer's network is of another shape.
    """
    weights.initialise(trainer.model)
    trainer.begin_anew([{"stable_diffusion": weights.folder.resolve().name}])
