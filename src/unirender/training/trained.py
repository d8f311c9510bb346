"""Which weights a run trains: all of them, or those of one direction alone.

    all       the whole network
    encoder   the picture encoder, against what its heads should say; no pass through the streams
    inverse   the picture encoder, the attribute stream's decoder, and what comes into it from the image stream
    renderer  the image stream's decoder, and what comes into it from the attribute stream

No weight of `encoder` and `inverse` takes part in rendering, and none of `renderer` in inverse rendering: the other
direction is the same to the bit before and after. Neither stream's encoder is among them, nor is the way of ImageNet's
features into a network.
"""

from torch import nn

from unirender.models.dual_stream import DualStreamModel
from unirender.models.picture_encoder import PictureEncoder

DECODER = ("up_blocks", "conv_norm_out", "conv_out")
DIRECTIONS = {"inverse": ("attribute_unet", "image_to_attributes"), "renderer": ("image_unet", "attributes_to_image")}


def train_only(model: DualStreamModel, trains: str) -> None:
    """Freezes all weights but those that `TrainConfig.trains` names."""
    if trains == "all":
        return
    nn.Module.requires_grad_(model, requires_grad=False)
    for part in model.modules():
        if isinstance(part, PictureEncoder) and trains != "renderer":
            part.requires_grad_()
        if trains in DIRECTIONS and isinstance(part, DualStreamModel):
            unet, bridge = (getattr(part, name) for name in DIRECTIONS[trains])
            bridge.requires_grad_()
            for name in DECODER:
                layers = getattr(unet, name, None)  # a network of the other direction has none
                if layers is not None:
                    layers.requires_grad_()


def encoder_of(model: nn.Module) -> PictureEncoder | None:
    """The picture encoder of a network; None where it has none."""
    return next((part for part in model.modules() if isinstance(part, PictureEncoder)), None)
