"""Stable Diffusion's weights as the beginning of a dual-stream network, from a local folder in diffusers format.

Both streams get the whole U-Net. The attribute stream sees six pictures of c = 4 latent channels where the original
saw one: its first convolution is the original's, repeated over the six and divided by six, its last one is repeated.
Fed six identical latents, each stream's first forward pass is then the original's, since the cross connections and the
extra inputs start at zero.

Stable Diffusion predicts noise (or v) and this project predicts x0: the weights are a beginning for the *features*.
What the last convolution makes of them is learned anew; the first pass is no useful prediction.
"""

import inspect
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from diffusers.models.autoencoders.autoencoder_kl import AutoencoderKL
from diffusers.models.unets.unet_2d_condition import UNet2DConditionModel
from jaxtyping import Float, Int
from torch import Tensor

from unirender.errors import UnirenderError
from unirender.models.build import restart_from_prior
from unirender.models.codec import KLCodec
from unirender.models.diffusers_folder import load_tokenizer, load_weights, read_config, silent
from unirender.models.dual_stream import DualStreamModel
from unirender.models.unet import unet_config
from unirender.training.presets import PRESETS

if TYPE_CHECKING:
    from transformers import CLIPTextModel

# Entries of a U-Net's config that change no weight and no result: a size that is only recorded, and a precision.
FREE = ("sample_size", "upcast_attention")
NUMBERS = ("in_channels", "out_channels", "layers_per_block", "cross_attention_dim", "norm_num_groups")
BY_LEVEL = ("block_out_channels", "attention_head_dim")


@dataclass(frozen=True)
class StableDiffusion:
    """The parts of a Stable Diffusion model that a dual-stream network begins with, in float32.

    Attributes:
        folder: where they were read.
        unet: the denoiser.
        vae: the autoencoder of its latents.
        prompt_embedding: what the text encoder makes of the empty prompt.
    """

    folder: Path
    unet: UNet2DConditionModel
    vae: AutoencoderKL
    prompt_embedding: Float[Tensor, "1 tokens width"]

    @property
    def shape(self) -> dict[str, Any]:
        """The fields of a `ModelConfig` that a network must have to take these weights."""
        codec = {"codec": "kl", "patch": KLCodec(self.vae).factor, "prompt_tokens": self.prompt_embedding.shape[1]}
        return _unet_shape(_with_defaults(self.unet.config)) | codec | {"unified": True}

    def check(self, network: Mapping[str, Any]) -> None:
        """Looks whether a network takes these weights.

        Args:
            network: the fields of a `ModelConfig`, or a `DualStreamModel`'s config.

        Raises:
            UnirenderError: it does not; the message says where they differ and which preset fits.
        """
        wanted = self.shape
        other = {name: value for name, value in wanted.items() if name in network and _plain(network[name]) != value}
        if not other:
            return
        fitting = [n for n, row in PRESETS.items() if all(getattr(row.model, k) == v for k, v in wanted.items())]
        held = ", ".join(f"{name} {value!r} instead of {_plain(network[name])!r}" for name, value in other.items())
        advice = (
            f"choose --preset {' or '.join(fitting)}" if fitting else "no preset has its shape: add a row to PRESETS"
        )
        raise UnirenderError(f"{self.folder}: needs a network with {held}; {advice}")

    @torch.no_grad()
    def initialise(self, model: DualStreamModel) -> None:
        """Writes the weights into both streams, and the prompt embedding; cross connections and extra inputs stay.

        With a physics prior the image stream's last convolution starts at zero all the same.

        Raises:
            UnirenderError: the model is of another shape.
        """
        self.check(model.config)
        weights = self.unet.state_dict()
        model.image_unet.load_state_dict(weights)
        pictures = model.config["attribute_channels"] // model.config["image_channels"]
        tiled = {
            "conv_in.weight": weights["conv_in.weight"].repeat(1, pictures, 1, 1) / pictures,
            "conv_out.weight": weights["conv_out.weight"].repeat(pictures, 1, 1, 1),
            "conv_out.bias": weights["conv_out.bias"].repeat(pictures),
        }
        model.attribute_unet.load_state_dict(weights | tiled)
        model.prompt_embedding.copy_(self.prompt_embedding)
        if model.config["physics_prior"] != "none":
            restart_from_prior(model)


def load_stable_diffusion(folder: Path) -> StableDiffusion:
    """Reads Stable Diffusion 1 or 2: `unet/`, `vae/`, `text_encoder/` and `tokenizer/`, weights as safetensors.

    Raises:
        UnirenderError: a part is missing, broken or of another architecture, or transformers is not installed.
    """
    if not folder.is_dir():
        raise UnirenderError(f"{folder}: no such folder, expected Stable Diffusion 1 or 2 in diffusers format")
    unet = _with_defaults(read_config(folder / "unet", "_class_name", "UNet2DConditionModel"))
    vae = {"latent_channels": 4, "scaling_factor": 0.18215} | read_config(
        folder / "vae", "_class_name", "AutoencoderKL"
    )
    _check_unet(folder / "unet", unet)
    if not isinstance(vae["scaling_factor"], int | float):
        raise UnirenderError(
            f"{folder / 'vae'}: got scaling_factor {vae['scaling_factor']!r}, expected that of its latents"
        )
    if unet["in_channels"] != vae["latent_channels"]:
        raise UnirenderError(
            f"{folder}: the autoencoder has {vae['latent_channels']} latent channels, expected the U-Net's "
            f"{unet['in_channels']}; use the parts of one model"
        )
    prompt = _empty_prompt(folder)  # before the large files
    if prompt.shape[-1] != unet["cross_attention_dim"]:
        raise UnirenderError(
            f"{folder}: the text encoder gives {prompt.shape[-1]} channels, expected the U-Net's "
            f"{unet['cross_attention_dim']}; use the parts of one model"
        )
    return StableDiffusion(
        folder, load_weights(UNet2DConditionModel, folder / "unet"), load_weights(AutoencoderKL, folder / "vae"), prompt
    )


def _with_defaults(config: Mapping[str, Any]) -> dict[str, Any]:
    """A U-Net's config with every entry that diffusers knows; sequences as tuples, heads as a number per level."""
    parameters = inspect.signature(UNet2DConditionModel.__init__).parameters
    whole = {k: _plain(config.get(k, p.default)) for k, p in parameters.items() if k != "self"}
    heads, widths = whole["attention_head_dim"], whole["block_out_channels"]
    if isinstance(heads, int) and isinstance(widths, tuple):
        whole["attention_head_dim"] = (heads,) * len(widths)
    return whole


def _unet_shape(unet: Mapping[str, Any]) -> dict[str, Any]:
    """The fields of a `ModelConfig` that describe a U-Net."""
    attending = [level for level, kind in enumerate(unet["down_block_types"]) if kind == "CrossAttnDownBlock2D"]
    return {
        "block_out_channels": unet["block_out_channels"],
        "layers_per_block": unet["layers_per_block"],
        "attention_levels": tuple(attending),
        "attention_head_dim": unet["attention_head_dim"],
        "cross_attention_dim": unet["cross_attention_dim"],
        "norm_num_groups": unet["norm_num_groups"],
        "linear_projection": unet["use_linear_projection"],
    }


def _check_unet(folder: Path, unet: Mapping[str, Any]) -> None:
    """Raises where our network of the same shape would be another one in any entry."""
    numbers = {k: [unet[k]] for k in NUMBERS} | {k: unet[k] for k in BY_LEVEL}
    for name, values in numbers.items():
        if not isinstance(values, list | tuple) or not all(isinstance(v, int) and v > 0 for v in values):
            kind = "a positive number" if name in NUMBERS else "positive numbers, one for each level"
            raise UnirenderError(f"{folder}: got {name} {unet[name]!r}, expected {kind}; copy the folder again")
    if unet["in_channels"] != unet["out_channels"]:
        kind = " (an inpainting model)" if unet["in_channels"] == 9 else ""
        raise UnirenderError(
            f"{folder}: got {unet['in_channels']} input channels{kind}, expected as many as output channels "
            f"({unet['out_channels']}); use the model that generates images from text alone"
        )
    s = _unet_shape(unet)
    ours = unet_config(s["block_out_channels"], s["layers_per_block"], s["attention_levels"], s["attention_head_dim"])
    same = ("in_channels", "out_channels", "cross_attention_dim", "norm_num_groups", "use_linear_projection", *FREE)
    expected = _with_defaults(ours | {name: unet[name] for name in same})
    held = [f"{k} {unet[k]!r} instead of {expected[k]!r}" for k in expected if unet[k] != expected[k]]
    if held:
        raise UnirenderError(
            f"{folder}: is no U-Net of Stable Diffusion 1 or 2: it has {', '.join(held)}; others, such as SDXL's, "
            "are not supported"
        )


def _empty_prompt(folder: Path) -> Float[Tensor, "1 tokens width"]:
    """What the text encoder makes of the empty prompt, padded to its full length as Stable Diffusion pads it."""
    try:
        from transformers import CLIPTextModel, CLIPTokenizer
    except ImportError as error:
        raise UnirenderError(
            "Stable Diffusion's text encoder needs the package transformers, which is not installed; "
            "pip install 'unirender[sd]'"
        ) from error
    read_config(folder / "text_encoder", "architectures", "CLIPTextModel")
    tokenizer = load_tokenizer(CLIPTokenizer, folder / "tokenizer")
    with silent():
        encoder = load_weights(CLIPTextModel, folder / "text_encoder")
    length = encoder.config.max_position_embeddings
    tokenized = tokenizer("", padding="max_length", max_length=length, truncation=True, return_tensors="pt")
    return _encode(encoder, tokenized.input_ids, folder / "tokenizer")


@torch.no_grad()
def _encode(encoder: "CLIPTextModel", ids: Int[Tensor, "1 tokens"], tokens: Path) -> Float[Tensor, "1 tokens width"]:
    words = encoder.config.vocab_size
    if int(ids.max()) >= words:
        raise UnirenderError(
            f"{tokens}: gives word {int(ids.max())}, expected less than the text encoder's {words}; use the parts of "
            "one model"
        )
    return encoder(ids)[0].clone()


def _plain(value: Any) -> Any:
    """Lists, as JSON has them, as tuples."""
    return tuple(_plain(item) for item in value) if isinstance(value, list | tuple) else value
