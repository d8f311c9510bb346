"""A second look at a clean picture: a residual network that is asked for what the whole of it tells.

How metallic and rough an object is, how bright its paint and how bright its light are one question: they explain the
same picture together, and a pixel cannot decide it. This network sees the condition of inverse rendering at 64 pixels,
and its own answers (*heads*) are compared with the truth: mean over the object of every attribute picture, the same by
cells of 8 pixels, and the light. It sees four pictures in the time of a training pass of one through both streams of
`tiny`, so it is trained first, by itself (`trains="encoder"` in a preset).

Into the dual stream it comes through zero-initialised maps: its stages are added to what the attribute stream's decoder
receives at their size, its *summary* to that decoder's time embedding. The image's decoder receives nothing of it, and
a noisy image has none: rendering is the same with and without it.

    x_0 = conv(depth(picture, mask)),  x <- x + conv(relu(norm(conv(relu(norm(x)))))),
    x_{s+1} = conv_2(relu(norm(x_s)))
    z = relu(A [mean_object(x_s), deviation_object(x_s)]_{s = 2, 3}),    e <- e + V z,    f_l <- f_l + W_l x_s(l)

Notation: b batch, H W image size, s stage (of stride 2, 4, 8, 16 at 64 pixels), z hidden, e time embedding, f_l entry
l of the feature pyramid of `unirender.models.dual_stream`.
"""

import itertools
import math
from collections.abc import Sequence

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor, nn

from unirender.models.added import Added, Answers
from unirender.models.config import ENCODER_SIDE

WIDTHS, BLOCKS = (32, 64, 128, 256), (1, 2, 2, 2)  # channels and residual blocks of each stage, finest first
GROUP = 16  # channels of a group of the normalisation
HIDDEN = 384
EPSILON = 1e-3  # beside sums over an object, which may be empty
PICTURES = 15  # channels of the attribute pictures without the light: material, albedo, normal, s, d
# of each channel's squared error: metallic, roughness, mask; albedo; normal; s; d
CHANNEL_WEIGHTS = (1.0, 1.0, 0.0, *3 * (1.0,), *3 * (0.3,), *3 * (0.5,), *3 * (0.5,))
CELLS_WEIGHT, LIGHT_WEIGHT = 0.1, 0.5  # beside 1 of the whole


class Block(nn.Module):
    """x + conv(relu(norm(conv(relu(norm(x)))))); zero at first but for x."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.norm1, self.conv1 = nn.GroupNorm(width // GROUP, width), nn.Conv2d(width, width, 3, padding=1)
        self.norm2, self.conv2 = nn.GroupNorm(width // GROUP, width), nn.Conv2d(width, width, 3, padding=1)
        nn.init.zeros_(self.conv2.weight)

    def forward(self, x: Float[Tensor, "b c h w"]) -> Float[Tensor, "b c h w"]:
        hidden = self.conv1(F.relu(self.norm1(x)))
        return x + self.conv2(F.relu(self.norm2(hidden)))


class PictureEncoder(nn.Module):
    """The network, its heads, and its way into the attribute stream's decoder.

    Args:
        channels: of each entry of the feature pyramid.
        strides: of each entry, pixels of the network's picture.
        resolution: of that picture, one way, which is averaged down to 64 pixels; 64 times a power of two, or less.
        embedding_width: of the time embedding.
        environment_size: rows, columns of the light.
    """

    def __init__(
        self,
        channels: Sequence[int],
        strides: Sequence[int],
        resolution: int,
        embedding_width: int,
        environment_size: tuple[int, int],
    ) -> None:
        super().__init__()
        self.shrink, self.environment_size = shrink_of(resolution), environment_size
        self.stem = nn.Conv2d(4 * 4, WIDTHS[0], 3, padding=1)
        self.downs = nn.ModuleList(
            nn.Sequential(nn.GroupNorm(a // GROUP, a), nn.ReLU(), nn.Conv2d(a, b, 3, stride=2, padding=1))
            for a, b in itertools.pairwise(WIDTHS)
        )
        self.stages = nn.ModuleList(
            nn.Sequential(*(Block(width) for _ in range(count))) for width, count in zip(WIDTHS, BLOCKS, strict=True)
        )
        last = WIDTHS[-1] + WIDTHS[-2]
        self.hidden = nn.Linear(2 * last, HIDDEN)
        self.heads = nn.ModuleDict(
            {
                "whole": nn.Linear(HIDDEN, PICTURES),
                "cells": nn.Conv2d(last, PICTURES, 1),
                "light": nn.Linear(HIDDEN, 3 * math.prod(environment_size)),
            }
        )
        stage_of = {2 ** (s + 1) * self.shrink: s for s in range(len(WIDTHS))}
        self.stage_of = tuple(stage_of.get(stride) for stride in strides)
        self.adapters = nn.ModuleDict(
            {
                str(n): nn.Conv2d(WIDTHS[stage], width, 1)
                for n, (stage, width) in enumerate(zip(self.stage_of, channels, strict=True))
                if stage is not None
            }
        )
        self.summary = nn.Linear(HIDDEN, embedding_width, bias=False)
        for parameter in (*self.adapters.parameters(), *self.summary.parameters()):
            nn.init.zeros_(parameter)

    def forward(
        self, picture: Float[Tensor, "b 3 H W"], mask: Float[Tensor, "b 1 H W"], known: Bool[Tensor, " b"]
    ) -> Added:
        """What it adds, and what its heads say; zeros in rows that are not known.

        Args:
            picture: packed images, in [-1, 1]; those that are not known are not looked at.
            mask: coverage.
            known: which are clean.
        """
        rows = known.nonzero()[:, 0]

        def in_place(x: Tensor) -> Tensor:
            return x if len(rows) == len(known) else x.new_zeros(len(known), *x.shape[1:]).index_copy(0, rows, x)

        stages, hidden, answers = self.look(picture[rows], mask[rows])
        grown = shrink_of(picture.shape[-1]) / self.shrink
        if grown != 1:  # asked at another size than its own
            stages = [F.interpolate(x, scale_factor=grown, mode="nearest") for x in stages]
        skips = [
            None if stage is None else in_place(self.adapters[str(n)](stages[stage]))
            for n, stage in enumerate(self.stage_of)
        ]
        return Added((), in_place(self.summary(hidden)), skips, answers.each(in_place))

    def look(
        self, picture: Float[Tensor, "n 3 H W"], mask: Float[Tensor, "n 1 H W"]
    ) -> tuple[list[Tensor], Float[Tensor, "n z"], Answers]:
        """Stages, hidden and heads."""
        x = F.avg_pool2d(torch.cat([picture, 2 * mask.to(picture) - 1], dim=1), shrink_of(picture.shape[-1]))
        coverage = 0.5 * x[:, 3:].float() + 0.5
        x = self.stem(F.pixel_unshuffle(x, 2).contiguous(memory_format=torch.channels_last))
        stages: list[Tensor] = []
        for n, blocks in enumerate(self.stages):
            x = blocks(self.downs[n - 1](x) if n else x)
            stages.append(x)
        fine, coarse = stages[-2:]
        moments = torch.cat([over_object(fine, coverage), over_object(coarse, coverage)], dim=1)
        hidden = F.relu(self.hidden(moments.to(self.hidden.weight)))
        both = torch.cat([fine, F.interpolate(coarse, size=fine.shape[-2:], mode="nearest")], dim=1)
        light = self.heads["light"](hidden).unflatten(1, (3, *self.environment_size))
        return stages, hidden, Answers(self.heads["whole"](hidden), self.heads["cells"](both), light)


def shrink_of(resolution: int) -> int:
    """Pixels of a picture, one way, for each that the encoder sees."""
    return max(1, resolution // ENCODER_SIDE)


def over_object(x: Float[Tensor, "n c h w"], coverage: Float[Tensor, "n 1 H W"]) -> Float[Tensor, "n moments"]:
    """Mean and standard deviation of each channel over the object."""
    x = x.float()
    weight = F.adaptive_avg_pool2d(coverage, (x.shape[-2], x.shape[-1]))
    weight = weight / weight.sum(dim=(2, 3), keepdim=True).clamp_min(EPSILON)
    mean = (weight * x).sum(dim=(2, 3), keepdim=True)
    variance = (weight * (x - mean).square()).sum(dim=(2, 3))
    return torch.cat([mean.flatten(1), (variance + EPSILON**2).sqrt()], dim=1)


def answers_error(said: Answers, truth: Answers, covered: Float[Tensor, "b 1 h w"]) -> Float[Tensor, ""]:
    """Squared error of the heads, a mean over the rows.

    Args:
        said: by the heads.
        truth: of `truth_of`.
        covered: coverage of each cell.
    """
    channels = said.whole.new_tensor(CHANNEL_WEIGHTS, dtype=torch.float32)
    whole = (channels * (said.whole.float() - truth.whole).square()).sum(dim=1).mean()
    cells = (channels[:, None, None] * (said.cells.float() - truth.cells).square()).sum(dim=1, keepdim=True)
    cells = ((cells * covered).sum(dim=(1, 2, 3)) / covered.sum(dim=(1, 2, 3)).clamp_min(EPSILON)).mean()
    light = (said.light.float() - truth.light).square().mean()
    return whole + CELLS_WEIGHT * cells + LIGHT_WEIGHT * light


def truth_of(
    pictures: Float[Tensor, "b 18 H W"],
    mask: Float[Tensor, "b 1 H W"],
    light: Float[Tensor, "b 3 eh ew"],
    cells: tuple[int, int],
) -> tuple[Answers, Float[Tensor, "b 1 h w"]]:
    """What the heads should say of packed attribute pictures, and the coverage of each cell.

    Args:
        pictures: of `unirender.models.packing.Packing.pack`.
        mask: coverage.
        light: packed.
        cells: rows, columns of the cells.
    """
    covered = F.adaptive_avg_pool2d(mask, cells)
    summed = F.adaptive_avg_pool2d(pictures[:, :PICTURES] * mask, cells)
    whole = summed.sum(dim=(2, 3)) / covered.sum(dim=(2, 3)).clamp_min(EPSILON)
    return Answers(whole, summed / covered.clamp_min(EPSILON), light), covered
