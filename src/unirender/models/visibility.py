"""How much of the sky an object hides from its own surfaces, by a network that sees its normals and its depth.

Screen-space masks (`unirender.pipelines.self_shadow`) say of a direction that what is seen hides it, that it lies
behind what hides, or neither. Each of the three may be wrong: how thick surfaces are and what the picture does not show
no mask knows. The network gives for each pixel, each class c and each bin k of directions how likely one is hidden:

    P(hidden | c, k) = sigmoid(f(n, log z, share of each class in the bins)_ck)

It is a U-Net of a million weights, trained on traced rays (`unirender.training.shadows`) and on no light: whatever
the light, the integrals of d and s are taken over 1 - P.

Notation: n normals in camera axes, z depth along the view axis, k of `BINS` bins, c of `CLASSES`.
"""

import functools
import math
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int, Integer, Shaped
from safetensors.torch import load_file
from torch import Tensor, nn

BANDS, AZIMUTHS = 6, 8  # of the angle to the axis towards the viewer, and around it
BINS = BANDS * AZIMUTHS
CLASSES = ("hidden", "behind", "open")  # what the masks say of a direction
BEFORE = (0.75, 0.45, 0.06)  # how likely directions of each class are hidden, before anything was learned
WIDTHS = (24, 48, 96, 128)  # channels at full size, at half of it, ...
NORM_GROUPS = 8
DEPTH_SCALE = 4.0  # of log z, whose spread over an object in the contract's camera is about 0.25
MARGIN = 8  # pixels around the object that the network sees
_MULTIPLE = 1 << (len(WIDTHS) - 1)  # of which the window's sides are multiples

WEIGHTS = Path(__file__).parents[1] / "checkpoints" / "visibility.safetensors"


class VisibilityNet(nn.Module):
    """Normals, surface, depth, shares of the masks -> logits of what is hidden."""

    def __init__(self) -> None:
        super().__init__()
        widths = WIDTHS
        levels = range(len(widths))
        self.conv_in = nn.Conv2d(5 + 2 * BINS, widths[0], 1)
        self.down = nn.ModuleList([_Block(widths[max(level - 1, 0)], widths[level]) for level in levels])
        self.up = nn.ModuleList([_Block(widths[level + 1] + widths[level], widths[level]) for level in levels[:-1]])
        self.conv_out = nn.Conv2d(widths[0], len(CLASSES) * BINS, 1)
        nn.init.zeros_(self.conv_out.weight)
        before = torch.logit(torch.tensor(BEFORE)).repeat_interleave(BINS)
        self.conv_out.bias = nn.Parameter(before)

    def forward(self, x: Float[Tensor, "b i h w"]) -> Float[Tensor, "b o h w"]:
        """Logits, class by class, of what `net_input` gives; h and w are multiples of 8."""
        h, skips = self.conv_in(x), []
        for level, block in enumerate(self.down):
            h = block(F.avg_pool2d(h, 2) if level else h)
            skips.append(h)
        for level in reversed(range(len(self.up))):
            h = self.up[level](torch.cat([F.interpolate(h, scale_factor=2.0, mode="nearest"), skips[level]], dim=1))
        return self.conv_out(h)


class _Block(nn.Module):
    """Two 3x3 convolutions beside a way past them."""

    def __init__(self, channels_in: int, channels_out: int) -> None:
        super().__init__()
        self.conv_1 = nn.Conv2d(channels_in, channels_out, 3, padding=1)
        self.norm_1 = nn.GroupNorm(NORM_GROUPS, channels_out)
        self.conv_2 = nn.Conv2d(channels_out, channels_out, 3, padding=1)
        self.norm_2 = nn.GroupNorm(NORM_GROUPS, channels_out)
        same = channels_in == channels_out
        self.past = nn.Identity() if same else nn.Conv2d(channels_in, channels_out, 1)

    def forward(self, x: Float[Tensor, "b i h w"]) -> Float[Tensor, "b o h w"]:
        h = F.silu(self.norm_1(self.conv_1(x)))
        return F.silu(self.norm_2(self.conv_2(h)) + self.past(x))


def direction_bins(directions: Float[np.ndarray, "3 m"]) -> Int[np.ndarray, " m"]:
    """The bin of each direction: unit, camera axes."""
    polar = np.arccos(np.clip(directions[2], -1, 1))
    azimuth = np.arctan2(directions[1], directions[0]) % (2 * math.pi)
    band = np.minimum((polar * (BANDS / math.pi)).astype(np.int64), BANDS - 1)
    sector = np.minimum((azimuth * (AZIMUTHS / (2 * math.pi))).astype(np.int64), AZIMUTHS - 1)
    return band * AZIMUTHS + sector


def bin_weights(
    cosine: Float[np.ndarray, "q m"], classes: Integer[np.ndarray, "q m"], directions: Float[np.ndarray, "3 m"]
) -> Float[np.ndarray, "q c k"]:
    """The integral of `cosine` over the directions of each class and bin, in units of a mean texel.

    Args:
        cosine: of directions and normals, 0 below the surface.
        classes: of the directions, numbers in `CLASSES`.
        directions: of the texels of a lat-long map: camera axes.
    """
    bins = direction_bins(directions)
    in_bin = np.zeros((len(bins), BINS), np.float32)
    in_bin[np.arange(len(bins)), bins] = np.sqrt(1 - np.square(directions[1])) * (math.pi / 2)
    cosine = np.asarray(cosine, np.float32)
    weights = [(cosine * (classes == number)) @ in_bin for number in range(len(CLASSES))]
    return np.stack(weights, axis=1)


def net_input(
    normal: Float[np.ndarray, "h w 3"],
    surface: Bool[np.ndarray, "h w"],
    depth: Float[np.ndarray, "h w"],
    weight: Float[np.ndarray, "p c k"],
) -> tuple[Float[np.ndarray, "i y x"], tuple[slice, slice]]:
    """What the network sees: a window around the surface, and where that lies in the picture, or in one that is padded.

    Args:
        normal: camera axes, unit.
        surface: its p pixels, one at least.
        depth: along the view axis where there is a surface, up to a factor.
        weight: integral of the cosine over the directions of each class and bin, up to a factor.
    """
    window = _window(surface)
    z = np.log(np.where(surface, depth, 1))
    share = weight[:, :2] / (weight.sum(axis=1, keepdims=True) + 1e-6)
    size = [max(size, side.stop) for size, side in zip(surface.shape, window, strict=True)]
    x = np.zeros((5 + 2 * BINS, *size), np.float32)
    inside = x[:, : surface.shape[0], : surface.shape[1]]  # a picture's sides may be no multiples
    inside[:3] = np.moveaxis(normal * surface[..., None], -1, 0)
    inside[3] = surface
    inside[4] = np.where(surface, DEPTH_SCALE * (z - np.median(z[surface])), 0)
    inside[5:, surface] = share.reshape(len(share), -1).T
    return x[:, *window], window


def _window(surface: Bool[np.ndarray, "h w"]) -> tuple[slice, slice]:
    """Rows and columns around the surface, in numbers that the network can halve; beyond the frame if need be."""
    slices = []
    for axis in (1, 0):
        inside, size = np.flatnonzero(surface.any(axis=axis)), surface.shape[1 - axis]
        first, last = max(inside[0] - MARGIN, 0), min(inside[-1] + 1 + MARGIN, size)
        length = -(-(last - first) // _MULTIPLE) * _MULTIPLE
        first = max(min(first, size - length), 0)
        slices.append(slice(int(first), int(first + length)))
    return slices[0], slices[1]


@functools.cache
def load_visibility_net() -> VisibilityNet:
    """The network that ships, on the CPU."""
    net = VisibilityNet().eval().requires_grad_(False)
    net.load_state_dict({name: value.float() for name, value in load_file(WEIGHTS).items()})
    return net


@torch.no_grad()
def hidden_chance(
    normal: Float[np.ndarray, "h w 3"],
    surface: Bool[np.ndarray, "h w"],
    depth: Float[np.ndarray, "h w"],
    weight: Float[np.ndarray, "p c k"],
) -> Float[np.ndarray, "p c k"]:
    """How likely directions of each class and bin are hidden, for each pixel of a surface; arguments: `net_input`."""
    x, window = net_input(normal, surface, depth, weight)
    chance = load_visibility_net()(torch.from_numpy(x)[None])[0].sigmoid().numpy()
    return at_pixels(chance, surface, window).reshape(-1, len(CLASSES), BINS)


def at_pixels(
    values: Shaped[Any, "o y x"], surface: Bool[np.ndarray, "h w"], window: tuple[slice, slice]
) -> Shaped[Any, "p o"]:
    """What the network gave (array or tensor) at the pixels of the surface, in the order of the picture."""
    rows, columns = (index - side.start for index, side in zip(np.nonzero(surface), window, strict=True))
    return values[:, rows, columns].T
