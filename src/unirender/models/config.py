"""What a network is built from. Torch-free, so that the command line can show and change it quickly."""

from dataclasses import dataclass
from typing import Literal

# Options of earlier networks, which the shipped ones name, each with the value that means what a network is without.
GONE = {"light": "latent", "picture_features": "none"}
ENVIRONMENT_SIZE = (16, 32)  # rows, columns of the light that every model predicts; whole pixels make up a texel


@dataclass(frozen=True)
class ModelConfig:
    """The network: what `DualStreamModel` is built from; latent channels follow from codec and patch."""

    resolution: int = 64  # training image size, one way
    codec: Literal["pixel", "kl"] = "pixel"
    patch: int = 2  # pixel codec: image pixels per latent pixel, one way
    block_out_channels: tuple[int, ...] = (64, 64, 96, 128)  # widths from the finest level down
    layers_per_block: int = 1
    attention_levels: tuple[int, ...] = (3,)  # the mid block, below the lowest level, has attention always
    attention_head_dim: int | tuple[int, ...] = 32  # channels of a head; a tuple: number of heads by level
    cross_attention_dim: int = 16
    prompt_tokens: int = 1
    norm_num_groups: int = 16
    linear_projection: bool = False  # attention's projections are linear layers, not 1x1 convolutions
    # the closed-form image to which the image stream adds what it leaves out
    physics_prior: Literal["none", "composite", "split_sum"] = "split_sum"
    derived_light: bool = False  # the network is told which of s and d were derived from a light and lack shadows
    unified: bool = True  # False: a network for each direction, and the widths are those of each
