"""The dual-stream network: two U-Nets that see each other (paper Sec. 3.2 and supplement, "Dual Stream Diffusion").

One stream denoises the intrinsic attributes, the other the RGB image. Every skip feature and the mid feature of each
encoder is added, through a zero-initialised 1x1 convolution, to the other stream's decoder; both ways, and exchanged
before either is fused. Each stream has its own timestep, so that one of them can be the clean condition of the other.

    x_0^a, x_0^i = f(x_t^a, x_t^i, t_a, t_i),    h_l^a <- h_l^a + Z_l h_l^i,    h_l^i <- h_l^i + Z'_l h_l^a

Notation: a attribute stream, i image stream; h_l entry l of the *feature pyramid* (`unirender.models.unet`), which goes
into the stream's decoder; Z, Z' zero convolutions.
The path of this module is recorded by saved checkpoints: it never moves.
"""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import torch
import torch.nn.functional as F
from diffusers.configuration_utils import ConfigMixin, register_to_config
from diffusers.models.modeling_utils import ModelMixin
from diffusers.models.unets.unet_2d_condition import UNet2DConditionModel
from diffusers.utils.outputs import BaseOutput
from jaxtyping import Float, Int
from torch import Tensor, nn

from unirender.models.added import Added, Answers
from unirender.models.conditioning import coverage_of
from unirender.models.light_encoder import LightEncoder
from unirender.models.picture_encoder import PictureEncoder
from unirender.models.picture_features import PictureFeatures
from unirender.models.unet import pyramid_channels, pyramid_strides, unet_config

ALL_ROWS = slice(None)
FEATURES = ("none", "vgg16", "encoder")  # what a clean image enters through besides the image stream's own encoder


@dataclass
class Encoded:
    """What an encoder hands to the decoders.

    Attributes:
        features: the feature pyramid of this encoder: skips, then mid.
        time: time embedding of this stream.
        context: what the cross-attention saw: the prompt, and the tokens of a light that has an encoder of its own.
        summary: what a clean image's features add to the time embedding of the other stream's decoder; None: nothing.
        skips: what they add to each entry of the pyramid in that decoder; () or None: nothing.
    """

    features: tuple[Tensor, ...]
    time: Tensor
    context: Tensor
    summary: Tensor | None = None
    skips: tuple[Tensor | None, ...] = ()

    def __getitem__(self, rows: slice) -> "Encoded":
        """The same for some samples of the batch."""
        if rows == ALL_ROWS:
            return self
        summary = None if self.summary is None else self.summary[rows]
        skips = tuple(None if x is None else x[rows] for x in self.skips)
        return Encoded(tuple(f[rows] for f in self.features), self.time[rows], self.context[rows], summary, skips)


@dataclass
class DualStreamOutput(BaseOutput):
    """What was predicted for the rows that were asked for, and from what; None where no row was.

    Attributes:
        attributes: clean latents (x0).
        image: clean latents (x0).
        encoded_attributes: the attribute stream as the image's decoder saw it. Another call takes it in place of the
            same latents at the same timestep.
        encoded_image: the image stream as the attributes' decoder saw it.
        answers: of the picture encoder, for the rows whose attributes are predicted; zeros where the image is not
            clean. None without such an encoder, and where the image was already encoded.
    """

    attributes: Tensor | None = None
    image: Tensor | None = None
    encoded_attributes: Encoded | None = None
    encoded_image: Encoded | None = None
    answers: Answers | None = None


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
        sample_size: int = 32,  # latent pixels; the streams take any size, the picture encoder is made for this one
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
        light: str = "latent",  # a given light is the sixth attribute picture, or tokens of an "encoder" of its own
        derived_light: bool = False,  # s and d that were derived from a light, without shadows, have their own flag
        # a clean image also enters through frozen features of ImageNet ("vgg16"), or an "encoder" of its own
        picture_features: str = "none",
    ):
        super().__init__()
        if not set(attention_levels) <= set(range(len(block_out_channels))):
            raise ValueError(
                f"attention_levels {tuple(attention_levels)}: expected levels from 0, the finest, to "
                f"{len(block_out_channels) - 1}, the lowest"
            )
        if picture_features not in FEATURES or (picture_features != "none" and codec != "pixel"):
            raise ValueError(
                f"picture_features {picture_features!r} with codec {codec!r}: expected one of {', '.join(FEATURES)}, "
                "and 'none' where the streams see an autoencoder's latents"
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
        rows, columns = environment_size
        self.light_encoder = LightEncoder((rows, columns), cross_attention_dim) if light == "encoder" else None
        self.patch = patch
        entering = (width, *block_out_channels[:-1])  # channels that come into each level of the encoder
        time_width = self.attribute_unet.time_embedding.linear_2.out_features
        self.vgg = PictureFeatures(entering, patch, time_width) if picture_features == "vgg16" else None
        strides = pyramid_strides(self.attribute_unet, patch)
        shape = (channels, strides, sample_size * patch, time_width, (rows, columns))
        self.encoder = PictureEncoder(*shape) if picture_features == "encoder" else None
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
        light: Float[Tensor, "b 4 eh ew"] | None = None,
        attribute_rows: slice | None = ALL_ROWS,
        image_rows: slice | None = ALL_ROWS,
    ) -> DualStreamOutput:
        """Predicts clean latents. The clean stream's decoder is not needed in a conditional pass: only those rows of a
        batch are decoded in a stream that are asked for there.

        Args:
            attributes: Noised attribute latents at `attributes_timestep`; or what an earlier call made of these
                latents, this timestep, these extra inputs and this light, all of which are then ignored.
            image: The same for the image.
            attributes_timestep: 0 (clean) .. T (pure noise), per sample.
            image_timestep: The same for the image.
            attribute_extra: Additional inputs of the attribute stream.
            image_extra: Additional inputs of the image stream.
            image_prior: Latents to which the image stream's output is added (the physics prior).
            light: Input of the light's own encoder, for a network that has one.
            attribute_rows: Rows whose attributes are predicted; None: none.
            image_rows: Rows whose image is predicted; None: none.
        """
        context = self.context(attributes, image, light)
        a, i, added = attributes, image, None
        if isinstance(a, Tensor):
            a = self.encode(self.attribute_unet, a, attributes_timestep, context, attribute_extra, self.attribute_extra)
        if isinstance(i, Tensor):
            added = self.features_of(i, image_timestep, image_extra)
            i = self.encode(self.image_unet, i, image_timestep, context, image_extra, self.image_extra, added)
        predicted = rendered = seen_attributes = seen_image = answers = None
        if attribute_rows is not None:
            seen_image = i[attribute_rows]
            predicted = self.decode(self.attribute_unet, a[attribute_rows], seen_image, self.image_to_attributes)
            if added and added.answers:
                answers = added.answers.each(lambda x: x[attribute_rows])
        if image_rows is not None:
            seen_attributes = a[image_rows]
            rendered = self.decode(self.image_unet, i[image_rows], seen_attributes, self.attributes_to_image)
            if image_prior is not None:
                rendered = rendered + image_prior[image_rows]
        return DualStreamOutput(predicted, rendered, seen_attributes, seen_image, answers)

    def context(
        self, attributes: Tensor | Encoded, image: Tensor | Encoded, light: Float[Tensor, "b 4 eh ew"] | None
    ) -> Float[Tensor, "b tokens width"]:
        """What the cross-attention of both streams sees: the stored prompt, and the light through its own encoder.

        Raises:
            ValueError: a light is given to a model without such an encoder, or is missing.
        """
        if isinstance(attributes, Encoded):
            return attributes.context
        if isinstance(image, Encoded):
            return image.context
        if (light is None) != (self.light_encoder is None):
            raise ValueError(f"light {'missing' if light is None else 'given'}, but the model was built otherwise")
        prompt = self.prompt_embedding.to(image.dtype).expand(len(image), -1, -1)
        return prompt if self.light_encoder is None else torch.cat([prompt, self.light_encoder(light)], dim=1)

    def features_of(
        self, image: Float[Tensor, "b ci h w"], timestep: Int[Tensor, " b"], extra: Tensor | None
    ) -> Added | None:
        """What the features of clean images add; None for a network without any, and where no image is clean."""
        clean = timestep == 0
        if (self.vgg is None and self.encoder is None) or not clean.any():
            return None
        picture = F.pixel_shuffle(image, self.patch)
        if self.vgg is not None:
            return self.vgg(picture, clean)
        assert self.encoder is not None
        assert extra is not None, "they hold the mask"
        return self.encoder(picture, coverage_of(extra, self.patch), clean)

    def encode(
        self,
        unet: UNet2DConditionModel,
        sample: Tensor,
        timestep: Tensor,
        context: Float[Tensor, "b tokens width"],
        extra: Tensor | None,
        adapter: nn.Module | None,
        added: Added | None = None,
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
        entering = dict(enumerate(added.levels)) if added else {}
        hidden = hidden + entering.get(0, 0)
        features = (hidden,)
        for level, block in enumerate(unet.down_blocks):
            hidden = hidden + entering.get(level, 0) if level else hidden
            seen = {"encoder_hidden_states": context} if getattr(block, "has_cross_attention", False) else {}
            hidden, skips = block(hidden_states=hidden, temb=time, **seen)
            features += tuple(skips)
        assert unet.mid_block is not None
        hidden = unet.mid_block(hidden, time, encoder_hidden_states=context)
        encoded = Encoded((*features, hidden), time, context)
        return dataclasses.replace(encoded, summary=added.summary, skips=tuple(added.skips)) if added else encoded

    def decode(self, unet: UNet2DConditionModel, own: Encoded, other: Encoded, bridge: nn.ModuleList) -> Tensor:
        """Runs one decoder on its own features plus the other stream's, brought over by zero convolutions."""
        fused = [mine + conv(theirs) for mine, theirs, conv in zip(own.features, other.features, bridge, strict=True)]
        for n, skip in enumerate(other.skips):
            fused[n] = fused[n] if skip is None else fused[n] + skip
        hidden, skips = fused[-1], fused[:-1]
        time = own.time if other.summary is None else own.time + other.summary
        for block in unet.up_blocks:
            resnets = block.resnets
            assert isinstance(resnets, nn.ModuleList)
            count = len(resnets)
            skips, taken = skips[:-count], tuple(skips[-count:])
            seen = {"encoder_hidden_states": own.context} if getattr(block, "has_cross_attention", False) else {}
            size = skips[-1].shape[-2:] if skips else None
            hidden = block(hidden_states=hidden, temb=time, res_hidden_states_tuple=taken, upsample_size=size, **seen)
        if unet.conv_norm_out is not None and unet.conv_act is not None:
            hidden = unet.conv_act(unet.conv_norm_out(hidden))
        return unet.conv_out(hidden)
