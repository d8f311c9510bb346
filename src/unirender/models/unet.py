"""The U-Net that each stream is, diffusers' `UNet2DConditionModel`: its config, and the shape of its features.

Notation: the *feature pyramid* is the tuple of skips in the order in which the encoder makes them; the mid feature is
the last.
"""

from collections.abc import Sequence

from diffusers.models.unets.unet_2d_condition import UNet2DConditionModel
from torch import nn


def unet_config(widths: Sequence[int], layers: int, attention: Sequence[int], head_dim: int | Sequence[int]) -> dict:
    """The part of a `UNet2DConditionModel` config that both streams share.

    The mid block is diffusers' default, which attends over all its pixels: the environment, which is not aligned with
    the picture's, reaches every one of them there, whichever levels have attention besides.

    Args:
        widths: channels of each level, the finest first.
        layers: of each level.
        attention: numbers of the levels that attend.
        head_dim: channels of an attention head; or for each level how many heads it has.

    Raises:
        ValueError: a level that attends, or the lowest, has a width that is no multiple of `head_dim`.
    """
    levels = range(len(widths))
    attending = {*attention, len(widths) - 1}  # the mid block has the lowest level's width and heads
    heads = [width // head_dim for width in widths] if isinstance(head_dim, int) else list(head_dim)
    if isinstance(head_dim, int) and any(width % head_dim for level, width in enumerate(widths) if level in attending):
        raise ValueError(
            f"block_out_channels {tuple(widths)}: levels with attention, and the lowest, whose width is the mid "
            f"block's, must be multiples of head size {head_dim}"
        )
    return {
        "block_out_channels": tuple(widths),
        "layers_per_block": layers,
        "down_block_types": tuple("CrossAttnDownBlock2D" if n in attention else "DownBlock2D" for n in levels),
        "up_block_types": tuple("CrossAttnUpBlock2D" if n in attention else "UpBlock2D" for n in reversed(levels)),
        # diffusers reads `attention_head_dim` as the number of heads (its own long-standing misnomer)
        "attention_head_dim": tuple(max(1, count) for count in heads),
    }


def pyramid_channels(unet: UNet2DConditionModel) -> list[int]:
    """Channels of each entry of the feature pyramid."""
    widths, layers = tuple(unet.config["block_out_channels"]), unet.config["layers_per_block"]
    channels = [widths[0]]
    for level, width in enumerate(widths):
        channels += [width] * (layers + (level < len(widths) - 1))
    return [*channels, widths[-1]]


def remove_decoder(unet: UNet2DConditionModel) -> None:
    """Takes the layers behind the mid block out of a U-Net."""
    unet.up_blocks = nn.ModuleList()
    unet.conv_norm_out, unet.conv_act = None, None
    del unet.conv_out
