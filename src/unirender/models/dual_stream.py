"""The dual-stream network: two U-Nets that see each other (paper Sec. 3.2 and supplement, "Dual Stream Diffusion").

One stream denoises the intrinsic attributes, the other the RGB image. Every skip feature and the mid feature of each
encoder is added, through a zero-initialised 1x1 convolution, to the other stream's decoder; both ways, and exchanged
before either is fused. Each stream has its own timestep, so that one of them can be the clean condition of the other.

    x_0^a, x_0^i = f(x_t^a, x_t^i, t_a, t_i),    h_l^a <- h_l^a + Z_l h_l^i,    h_l^i <- h_l^i + Z'_l h_l^a

Notation: a attribute stream, i image stream; h_l entry l of the *feature pyramid* (`unirender.models.unet`), which goes
into the stream's decoder; Z, Z' zero convolutions.
The path of this module is recorded by saved checkpoints: it never moves.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from diffusers.configuration_utils import ConfigMixin, register_to_config
from diffusers.models.modeling_utils import ModelMixin
from diffusers.models.unets.unet_2d_condition import UNet2DConditionModel
from diffusers.utils.outputs import BaseOutput
from jaxtyping import Float, Int
from torch import Tensor, nn

from unirender.models.config import GONE
from unirender.models.unet import pyramid_channels, unet_config

ALL_ROWS = slice(None)


@dataclass
class Encoded:
    """What an encoder hands to the decoders.

    Attributes:
        features: the feature pyramid of this encoder: skips, then mid.
        time: time embedding of this stream.
    """

    features: tuple[Tensor, ...]
    time: Tensor

    def __getitem__(self, rows: slice) -> "Encoded":
        """The same for some samples of the batch."""
        if rows == ALL_ROWS:
            return self
        return Encoded(tuple(f[rows] for f in self.features), self.time[rows])


@dataclass
class DualStreamOutput(BaseOutput):
    """What was predicted for the rows that were asked for, and from what; None where no row was.

    Attributes:
        attributes: clean latents (x0).
        image: clean latents (x0).
        encoded_attributes: the attribute stream as the image's decoder saw it. Another call takes it in place of the
            same latents at the same timestep.
        encoded_image: the image stream as the attributes' decoder saw it.
    """

    attributes: Tensor | None = None
    image: Tensor | None = None
    encoded_attributes: Encoded | None = None
    encoded_image: Encoded | None = None


def zero_conv(in_channels: int, out_channels: int, kernel: int = 1) -> nn.Conv2d:
    """A convolution that starts as the zero map, so that it does not change what the network does already."""
    conv = nn.Conv2d(in_channels, out_channels, kernel, padding=kernel // 2)
    nn.init.zeros_(conv.weight)
    assert conv.bias is not None
    nn.init.zeros_(conv.bias)
    return conv


class DualStreamModel(ModelMixin, ConfigMixin):
    """Two `UNet2DConditionModel`s with zero-convolution cross connections.

    Everything a checkpoint needs to be understood is in its config: also the codec, the packing and the physics prior,
    which `unirender.models.conditioning` reads from here.
    """

    _supports_gradient_checkpointing = True
    _no_split_modules: ClassVar[list[str]] = ["BasicTransformerBlock", "ResnetBlock2D"]
    _repeated_blocks: ClassVar[list[str]] = ["BasicTransformerBlock"]
    _skip_layerwise_casting_patterns: ClassVar[list[str]] = ["norm"]

    @register_to_config
    def __init__(
        self,
        sample_size: int = 32,  # latent pixels of the training; the streams take any size
        attribute_channels: int = 72,  # latent channels of the six attribute triplets
        image_channels: int = 12,  # latent channels of the image
        attribute_extra_channels: int = 0,  # presence flags, mask, rays: enter by a zero-initialised convolution
        image_extra_channels: int = 0,  # mask, rays, composite
        block_out_channels: Sequence[int] = (64, 96, 128),  # widths from the finest level down
        layers_per_block: int = 1,  # residual blocks per level of each encoder
        attention_levels: Sequence[int] = (2,),  # levels with attention; the mid block has it always
        attention_head_dim: int | Sequence[int] = 32,  # channels of a head; a sequence: number of heads by level
        cross_attention_dim: int = 16,  # width of the prompt embedding
        prompt_tokens: int = 1,  # length of the stored empty-prompt embedding
        norm_num_groups: int = 16,
        linear_projection: bool = False,  # attention's projections are linear layers, not 1x1 convolutions
        codec: str = "pixel",  # "pixel" (space to depth) or "kl" (an AutoencoderKL beside the network)
        patch: int = 2,  # image pixels per latent pixel, one way
        environment_size: Sequence[int] = (16, 32),  # rows, columns of the light the model predicts
        hdr_curves: dict[str, Sequence[float]] | None = None,  # map -> (k, x_max); None: packing.HDR_CURVES
        physics_prior: str = "none",  # the closed-form image that the image stream sees and corrects
        derived_light: bool = False,  # s and d that were derived from a light, without shadows, have their own flag
    ):
        super().__init__()
        if not set(attention_levels) <= set(range(len(block_out_channels))):
            raise ValueError(
                f"attention_levels {tuple(attention_levels)}: expected levels from 0, the finest, to "
                f"{len(block_out_channels) - 1}, the lowest"
            )
        common = unet_config(block_out_channels, layers_per_block, attention_levels, attention_head_dim)
        common |= {"cross_attention_dim": cross_attention_dim, "norm_num_groups": norm_num_groups}
        common |= {"use_linear_projection": linear_projection}
        self.attribute_unet = UNet2DConditionModel(
            sample_size=sample_size, in_channels=attribute_channels, out_channels=attribute_channels, **common
        )
        self.image_unet = UNet2DConditionModel(
            sample_size=sample_size, in_channels=image_channels, out_channels=image_channels, **common
        )
        channels = pyramid_channels(self.attribute_unet)
        self.attributes_to_image = nn.ModuleList(zero_conv(c, c) for c in channels)
        self.image_to_attributes = nn.ModuleList(zero_conv(c, c) for c in channels)
        width = block_out_channels[0]
        self.attribute_extra = zero_conv(attribute_extra_channels, width, 3) if attribute_extra_channels else None
        self.image_extra = zero_conv(image_extra_channels, width, 3) if image_extra_channels else None
        self.register_buffer("prompt_embedding", torch.ones(1, prompt_tokens, cross_attention_dim))
        self.prompt_embedding: Tensor

    def forward(
        self,
        attributes: Float[Tensor, "b ca h w"] | Encoded,
        image: Float[Tensor, "b ci h w"] | Encoded,
        attributes_timestep: Int[Tensor, " b"],
        image_timestep: Int[Tensor, " b"],
        attribute_extra: Float[Tensor, "b ea h w"] | None = None,
        image_extra: Float[Tensor, "b ei h w"] | None = None,
        image_prior: Float[Tensor, "b ci h w"] | None = None,
        attribute_rows: slice | None = ALL_ROWS,
        image_rows: slice | None = ALL_ROWS,
    ) -> DualStreamOutput:
        """Predicts clean latents. The clean stream's decoder is not needed in a conditional pass: only those rows of a
        batch are decoded in a stream that are asked for there.

        Args:
            attributes: Noised attribute latents at `attributes_timestep`; or what an earlier call made of these
                latents, this timestep and these extra inputs, all of which are then ignored.
            image: The same for the image.
            attributes_timestep: 0 (clean) .. T (pure noise), per sample.
            image_timestep: The same for the image.
            attribute_extra: Additional inputs of the attribute stream.
            image_extra: Additional inputs of the image stream.
            image_prior: Latents to which the image stream's output is added (the physics prior).
            attribute_rows: Rows whose attributes are predicted; None: none.
            image_rows: Rows whose image is predicted; None: none.
        """
        a, i = attributes, image
        if isinstance(a, Tensor):
            a = self.encode(self.attribute_unet, a, attributes_timestep, attribute_extra, self.attribute_extra)
        if isinstance(i, Tensor):
            i = self.encode(self.image_unet, i, image_timestep, image_extra, self.image_extra)
        predicted = rendered = seen_attributes = seen_image = None
        if attribute_rows is not None:
            seen_image = i[attribute_rows]
            predicted = self.decode(self.attribute_unet, a[attribute_rows], seen_image, self.image_to_attributes)
        if image_rows is not None:
            seen_attributes = a[image_rows]
            rendered = self.decode(self.image_unet, i[image_rows], seen_attributes, self.attributes_to_image)
            if image_prior is not None:
                rendered = rendered + image_prior[image_rows]
        return DualStreamOutput(predicted, rendered, seen_attributes, seen_image)

    @classmethod
    def extract_init_dict(cls, config_dict: dict[str, Any], **kwargs: Any) -> tuple[dict, dict, dict]:
        """As in diffusers, of a configuration that may name what is `GONE`."""
        kept = {name: value for name, value in config_dict.items() if name not in GONE or value != GONE[name]}
        return super().extract_init_dict(kept, **kwargs)

    def context(self, like: Float[Tensor, "b c h w"]) -> Float[Tensor, "b tokens width"]:
        """What the cross-attention of both streams sees: the stored prompt."""
        return self.prompt_embedding.to(like.dtype).expand(len(like), -1, -1)

    def encode(
        self,
        unet: UNet2DConditionModel,
        sample: Tensor,
        timestep: Tensor,
        extra: Tensor | None,
        adapter: nn.Module | None,
    ) -> Encoded:
        """Runs one encoder and the mid block: (b, c, h, w) -> feature pyramid.

        Raises:
            ValueError: extra inputs are given to a model without them, or are missing.
        """
        if (extra is None) != (adapter is None):
            raise ValueError(
                f"extra inputs {'missing' if extra is None else 'given'}, but the model was built otherwise"
            )
        time = unet.time_embedding(unet.get_time_embed(sample=sample, timestep=timestep))
        hidden = unet.conv_in(sample)
        if adapter is not None:
            hidden = hidden + adapter(extra)
        context, features = self.context(hidden), (hidden,)
        for block in unet.down_blocks:
            seen = {"encoder_hidden_states": context} if getattr(block, "has_cross_attention", False) else {}
            hidden, skips = block(hidden_states=hidden, temb=time, **seen)
            features += tuple(skips)
        assert unet.mid_block is not None
        hidden = unet.mid_block(hidden, time, encoder_hidden_states=context)
        return Encoded((*features, hidden), time)

    def decode(self, unet: UNet2DConditionModel, own: Encoded, other: Encoded, bridge: nn.ModuleList) -> Tensor:
        """Runs one decoder on its own features plus the other stream's, brought over by zero convolutions."""
        fused = [mine + conv(theirs) for mine, theirs, conv in zip(own.features, other.features, bridge, strict=True)]
        hidden, skips = fused[-1], fused[:-1]
        context = self.context(hidden)
        for block in unet.up_blocks:
            resnets = block.resnets
            assert isinstance(resnets, nn.ModuleList)
            count = len(resnets)
            skips, taken = skips[:-count], tuple(skips[-count:])
            seen = {"encoder_hidden_states": context} if getattr(block, "has_cross_attention", False) else {}
            size = skips[-1].shape[-2:] if skips else None
            hidden = block(
                hidden_states=hidden, temb=own.time, res_hidden_states_tuple=taken, upsample_size=size, **seen
            )
        if unet.conv_norm_out is not None and unet.conv_act is not None:
            hidden = unet.conv_act(unet.conv_norm_out(hidden))
        return unet.conv_out(hidden)
