"""A `DualStreamModel` from the model part of a preset."""

from torch import nn

from unirender.models.codec import make_codec
from unirender.models.conditioning import Conditioning
from unirender.models.config import ENVIRONMENT_SIZE, ModelConfig
from unirender.models.dual_stream import DualStreamModel
from unirender.models.packing import HDR_CURVES
from unirender.models.split_streams import SplitDualStreamModel


def build_model(config: ModelConfig, vae: nn.Module | None = None) -> tuple[DualStreamModel, Conditioning]:
    """Returns a fresh network and the conditioning that belongs to it.

    With the physics prior the image stream's last convolution starts at zero: the first render is the prior.
    """
    codec = make_codec(config.codec, config.patch, vae)
    recorded = {
        "hdr_curves": HDR_CURVES,
        "environment_size": ENVIRONMENT_SIZE,
        "physics_prior": config.physics_prior,
        "derived_light": config.derived_light,
    }
    conditioning = Conditioning.of(recorded, codec)
    extra_attributes, extra_image = conditioning.extra_channels
    network = DualStreamModel if config.unified else SplitDualStreamModel
    model = network(
        sample_size=config.resolution // codec.factor,
        attribute_channels=conditioning.attribute_channels,
        image_channels=codec.channels,
        attribute_extra_channels=extra_attributes,
        image_extra_channels=extra_image,
        block_out_channels=config.block_out_channels,
        layers_per_block=config.layers_per_block,
        attention_levels=config.attention_levels,
        attention_head_dim=config.attention_head_dim,
        cross_attention_dim=config.cross_attention_dim,
        prompt_tokens=config.prompt_tokens,
        norm_num_groups=config.norm_num_groups,
        linear_projection=config.linear_projection,
        codec=config.codec,
        patch=config.patch,
        **recorded,
    )
    if config.physics_prior != "none":
        restart_from_prior(model)
    return model, conditioning


def restart_from_prior(model: DualStreamModel) -> None:
    """Sets the image stream's last convolution to zero: with a physics prior, renders are the prior again."""
    nn.init.zeros_(model.image_unet.conv_out.weight)
    assert model.image_unet.conv_out.bias is not None
    nn.init.zeros_(model.image_unet.conv_out.bias)
