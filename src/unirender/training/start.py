"""What the weights of a run begin with: chance, a trained pipeline, or Stable Diffusion; and the autoencoder, if any.

A state in the run's folder goes before all of them.
"""

import dataclasses
from dataclasses import dataclass
from pathlib import Path

from diffusers.models.autoencoders.autoencoder_kl import AutoencoderKL

from unirender.errors import UnirenderError
from unirender.models.stable_diffusion import StableDiffusion, load_stable_diffusion
from unirender.pipelines.unirender_pipeline import UniRenderPipeline
from unirender.training.export import read_history
from unirender.training.presets import ModelConfig
from unirender.training.trainer import Trainer


@dataclass(frozen=True)
class Start:
    """The beginning of a run; chance where there is neither of the two.

    Attributes:
        folder: of the pipeline.
        pipeline: trained before.
        diffusion: Stable Diffusion.
    """

    folder: Path | None = None
    pipeline: UniRenderPipeline | None = None
    diffusion: StableDiffusion | None = None

    @property
    def vae(self) -> AutoencoderKL | None:
        """The autoencoder on whose latents the network works; None: it works on pixels."""
        found = self.diffusion or self.pipeline
        return found.vae if found else None

    def apply(self, trainer: Trainer) -> None:
        """Gives a trainer the weights.

        Raises:
            UnirenderError: its network is another one.
        """
        if self.diffusion is not None:
            trainer.start_from_diffusion(self.diffusion)
        elif self.pipeline is not None and self.folder is not None:
            trainer.start_from(self.pipeline.dual_stream, read_history(self.folder))


def read_start(config: ModelConfig, init: Path | None = None, init_from: Path | None = None) -> Start:
    """Reads what a run begins with, and looks whether the network can begin with it.

    Args:
        config: the network.
        init: folder of a trained pipeline.
        init_from: Stable Diffusion folder.

    Raises:
        UnirenderError: a folder cannot be used, or belongs to another network.
    """
    if init_from is not None:
        diffusion = load_stable_diffusion(init_from)
        diffusion.check(dataclasses.asdict(config))
        return Start(diffusion=diffusion)
    if init is None:
        return Start()
    pipeline = UniRenderPipeline.from_pretrained(init)
    codec = pipeline.dual_stream.config["codec"]
    if codec != config.codec:
        raise UnirenderError(
            f"{init}: its network has the codec {codec}, expected {config.codec}; choose the preset that the weights "
            "were trained with"
        )
    return Start(init, pipeline)
