"""A wider network that begins near a narrower one (after Chen et al. 2016, "Net2Net").

Each new channel repeats an old one of its own normalisation group, so that the group's mean and deviation stay about as
they were, and what leaves it is small: the old channels go on nearly alone. (Where a decoder puts a skip beside what
comes from below, the groups of the two together are others than before; that is what the beginning is off by.) A little
noise on both lets the new ones part from those that they repeat. Attention that the narrower network has not begins as
the identity.

The two networks agree in all but `block_out_channels` and `attention_levels` (and the size of pictures), and have the
size of heads as one number. The finest level keeps its width: what comes in, what goes out and the embedding of time
are those of the old network.
"""

import itertools
import json
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Bool, Int
from torch import Tensor, nn

from unirender.errors import UnirenderError
from unirender.models.build import build_model
from unirender.models.config import ModelConfig
from unirender.models.dual_stream import DualStreamModel

REPEATED_NOISE = 0.02  # of the deviation of a weight: on what a new channel repeats
LEAVING_NOISE = 0.1  # of the deviation of a weight: what leaves a new channel
Part = Any  # a part of diffusers' U-Net; torch knows no types of what modules hold
GROWS = frozenset(("block_out_channels", "attention_levels"))
MAY_DIFFER = GROWS | {"sample_size"}  # the streams take any size


@dataclass(frozen=True)
class Channels:
    """Channels of the wider network by those of the narrower one.

    Attributes:
        source: the old channel that each has, or repeats.
        old: whether it is the old one itself.
    """

    source: Int[Tensor, " n"]
    old: Bool[Tensor, " n"]

    @property
    def before(self) -> int:
        """Channels of the narrower network."""
        return int(self.source.max()) + 1

    def __add__(self, other: "Channels") -> "Channels":
        """Both, one after the other, as a decoder sees what comes from below and a skip."""
        return Channels(torch.cat([self.source, other.source + self.before]), torch.cat([self.old, other.old]))


def repeated(before: int, after: int, groups: int) -> Channels:
    """The channels of a level: every normalisation group grows alike, at its end."""
    own, grown = before // groups, after // groups
    places = torch.arange(grown)
    source = torch.where(places < own, places, places % own)
    starts = torch.arange(groups)[:, None] * own
    return Channels((starts + source).flatten(), (places < own).repeat(groups))


def appended(before: int, after: int) -> Channels:
    """Channels in no group (heads of attention, hidden units): the new ones come last."""
    places = torch.arange(after)
    return Channels(places % before, places < before)


def can_widen(network: DualStreamModel, other: DualStreamModel) -> bool:
    """Whether `network` is a wider form of `other`, or has attention at more levels, and nothing else."""
    if type(network) is not DualStreamModel or type(other) is not DualStreamModel:
        return False
    own, old = (_plain(each) for each in (network, other))
    if any(own[name] != old.get(name) for name in own.keys() - MAY_DIFFER):
        return False
    if all(own[name] == old[name] for name in GROWS):
        return False
    if not isinstance(own["attention_head_dim"], int) or not set(old["attention_levels"]) <= set(
        own["attention_levels"]
    ):
        return False
    return _levels_grow(old["block_out_channels"], own["block_out_channels"], own["norm_num_groups"])


def _levels_grow(narrow: list[int], wide: list[int], groups: int) -> bool:
    """Whether each level keeps its channels or gets more, in whole groups; the finest keeps them."""
    if len(wide) != len(narrow) or wide[0] != narrow[0]:
        return False
    if any(new < old or new % groups or old % groups for new, old in zip(wide, narrow, strict=True)):
        return False
    # Between levels of one width there is no shortcut: none that was trained may be left over.
    between = zip(itertools.pairwise(wide), itertools.pairwise(narrow), strict=True)
    return all(new[0] != new[1] or old[0] == old[1] for new, old in between)


def widened(config: ModelConfig, other: DualStreamModel, vae: nn.Module | None = None) -> DualStreamModel:
    """A network of `config` that begins near `other`, which stays as it is.

    Args:
        config: of the wider network.
        other: on the CPU.
        vae: the autoencoder on whose latents both work, if they do.

    Raises:
        UnirenderError: `can_widen` says no.
    """
    network, _ = build_model(config, vae)
    widen(network, other)
    return network


@torch.no_grad()
def widen(network: DualStreamModel, other: DualStreamModel) -> None:
    """Gives `network` the weights of a narrower one.

    Args:
        network: to be changed, on the CPU.
        other: on the CPU.

    Raises:
        UnirenderError: `can_widen` says no.
    """
    if not can_widen(network, other):
        raise UnirenderError(
            "initial weights: the preset's network is no wider form of theirs, expected one that differs from it in "
            "larger widths below the finest level, or more levels with attention, alone; choose the preset that the "
            "weights were trained with"
        )
    widths = zip(other.config["block_out_channels"], network.config["block_out_channels"], strict=True)
    levels = [repeated(old, new, network.config["norm_num_groups"]) for old, new in widths]
    growth = _Growth(levels, torch.Generator().manual_seed(0))
    pyramid = growth.unet(network.attribute_unet, other.attribute_unet)
    growth.unet(network.image_unet, other.image_unet)
    for name in ("attributes_to_image", "image_to_attributes"):
        for new, old, level in zip(getattr(network, name), getattr(other, name), pyramid, strict=True):
            growth.layer(new, old, levels[level], levels[level])
    for name in ("attribute_extra", "image_extra"):
        if getattr(other, name) is not None:
            getattr(network, name).load_state_dict(getattr(other, name).state_dict())
    network.prompt_embedding.copy_(other.prompt_embedding)


def _plain(network: DualStreamModel) -> dict[str, Any]:
    """A network's config with lists for tuples, as a file has it, without what diffusers notes."""
    config: dict[str, Any] = json.loads(json.dumps(dict(network.config)))
    return {name: value for name, value in config.items() if not name.startswith("_")}


@dataclass(frozen=True)
class _Growth:
    levels: list[Channels]
    generator: torch.Generator

    def unet(self, new: Part, old: Part) -> list[int]:
        """A stream; returns the level of each entry of its feature pyramid."""
        for name in ("conv_in", "time_embedding", "conv_norm_out", "conv_out"):
            getattr(new, name).load_state_dict(getattr(old, name).state_dict())
        pyramid = [0]
        for level, (mine, theirs) in enumerate(zip(new.down_blocks, old.down_blocks, strict=True)):
            for resnet, narrow in zip(mine.resnets, theirs.resnets, strict=True):
                self.resnet(resnet, narrow, self.levels[pyramid[-1]], self.levels[level])
                pyramid.append(level)
            self.attentions(mine, theirs, level)
            if mine.downsamplers is not None:
                self.layer(mine.downsamplers[0].conv, theirs.downsamplers[0].conv, *[self.levels[level]] * 2)
                pyramid.append(level)
        top = len(self.levels) - 1
        for resnet, narrow in zip(new.mid_block.resnets, old.mid_block.resnets, strict=True):
            self.resnet(resnet, narrow, self.levels[top], self.levels[top])
        self.attentions(new.mid_block, old.mid_block, top)
        skips, below = list(pyramid), top
        for up, (mine, theirs) in enumerate(zip(new.up_blocks, old.up_blocks, strict=True)):
            level = top - up
            for resnet, narrow in zip(mine.resnets, theirs.resnets, strict=True):
                entering = self.levels[below] + self.levels[skips.pop()]
                self.resnet(resnet, narrow, entering, self.levels[level])
                below = level
            self.attentions(mine, theirs, level)
            if mine.upsamplers is not None:
                self.layer(mine.upsamplers[0].conv, theirs.upsamplers[0].conv, *[self.levels[level]] * 2)
        return [*pyramid, top]

    def resnet(self, new: Part, old: Part, entering: Channels, leaving: Channels) -> None:
        self.layer(new.norm1, old.norm1, None, entering)
        self.layer(new.conv1, old.conv1, entering, leaving)
        self.layer(new.time_emb_proj, old.time_emb_proj, None, leaving)
        self.layer(new.norm2, old.norm2, None, leaving)
        self.layer(new.conv2, old.conv2, leaving, leaving)
        if new.conv_shortcut is None:
            return
        if old.conv_shortcut is not None:
            self.layer(new.conv_shortcut, old.conv_shortcut, entering, leaving)
            return
        passed = (leaving.source[:, None] == entering.source) & entering.old  # the identity, of a level that grew
        new.conv_shortcut.weight.copy_(passed[:, :, None, None])
        new.conv_shortcut.bias.zero_()

    def attentions(self, new: Part, old: Part, level: int) -> None:
        """Of a block, if it has any; where the old one has none, they begin as the identity."""
        wide, narrow = (getattr(block, "attentions", None) or () for block in (new, old))
        for i, attention in enumerate(wide):
            if narrow:
                self.transformer(attention, narrow[i], self.levels[level])
            else:
                nn.init.zeros_(attention.proj_out.weight)
                nn.init.zeros_(attention.proj_out.bias)

    def transformer(self, new: Part, old: Part, level: Channels) -> None:
        self.layer(new.norm, old.norm, None, level)
        self.layer(new.proj_in, old.proj_in, level, level)
        self.layer(new.proj_out, old.proj_out, level, level)
        heads = appended(level.before, len(level.source))
        for mine, theirs in zip(new.transformer_blocks, old.transformer_blocks, strict=True):
            for name in ("norm1", "norm2", "norm3"):
                self.layer(getattr(mine, name), getattr(theirs, name), None, level)
            for name, seen in (("attn1", level), ("attn2", None)):
                attention, narrow = getattr(mine, name), getattr(theirs, name)
                self.layer(attention.to_q, narrow.to_q, level, heads)
                self.layer(attention.to_k, narrow.to_k, seen, heads)
                self.layer(attention.to_v, narrow.to_v, seen, heads)
                self.layer(attention.to_out[0], narrow.to_out[0], heads, level)
            units = appended(theirs.ff.net[2].weight.shape[1], mine.ff.net[2].weight.shape[1])
            self.layer(mine.ff.net[0].proj, theirs.ff.net[0].proj, level, units + units)  # values and gates
            self.layer(mine.ff.net[2], theirs.ff.net[2], units, level)

    def layer(self, new: Part, old: Part, entering: Channels | None, leaving: Channels) -> None:
        """A convolution, a linear layer or a normalisation; `entering` None: what enters stays as it is."""
        weight = self.left(old.weight, leaving)
        if entering is not None:
            fresh = LEAVING_NOISE * weight.std() * self.noise(weight.shape[0], len(entering.source), *weight.shape[2:])
            old_ones = entering.old.reshape(1, -1, *[1] * (weight.dim() - 2))
            weight = torch.where(old_ones, weight[:, entering.source], fresh)
        new.weight.copy_(weight)
        if old.bias is not None:
            new.bias.copy_(old.bias[leaving.source])

    def left(self, weight: Tensor, leaving: Channels) -> Tensor:
        chosen = weight[leaving.source]
        if weight.dim() == 1:
            return chosen
        old_ones = leaving.old.reshape(-1, *[1] * (weight.dim() - 1))
        return torch.where(old_ones, chosen, chosen + REPEATED_NOISE * weight.std() * self.noise(*chosen.shape))

    def noise(self, *shape: int) -> Tensor:
        return torch.randn(shape, generator=self.generator)
