"""The loss of the network of shadows, on one object:

    mean_w BCE(P, V) + LIGHT_WEIGHT mean_L log(E_L + E_0),
    E_L = mean_p ((sum_ck L_k (H_pck - W_pck P_pck)) / mean_p(sum_ck L_k W_pck))^2

that is, how likely each direction is hidden, and the squared error of d under random lights L in decibels: what is
nearly right of a ball that hides nothing should not be paid for with what is gained on a chair. H and W are the
integrals of the cosine over the hidden and over all directions of class c and bin k, P the network's answer.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from unirender.models.visibility import BINS, CLASSES, VisibilityNet, at_pixels, net_input
from unirender.training.shadows.rays import VisibilityItem

LIGHT_WEIGHT = 0.1
LEAST_ERROR = 1e-4  # E_0
LIGHTS = 4  # of each kind for an object
SPREAD = 1.5  # standard deviation of the log of the bins' radiance in lights of the first kind
LAMP, LAMP_SHARE = 40.0, 0.04  # radiance of lamps beside a uniform 1, and the share of bins that have one: the second


def terms(net: VisibilityNet, item: VisibilityItem, rng: torch.Generator) -> tuple[Tensor, Tensor]:
    """The two terms of the loss of an object: BCE, and the mean log error under lights that are drawn."""
    weight = item.weight.astype(np.float32)
    hidden = torch.from_numpy(np.minimum(item.hidden, weight))
    x, window = net_input(item.normal, item.surface, item.depth, weight)
    y = net(torch.from_numpy(x)[None].contiguous(memory_format=torch.channels_last))[0]
    y = at_pixels(y, item.surface, window).reshape(-1, len(CLASSES), BINS)
    w = torch.from_numpy(weight)
    bce = -(hidden * F.logsigmoid(y) + (w - hidden) * F.logsigmoid(-y)).sum() / w.sum()
    skies = torch.exp(SPREAD * torch.randn(LIGHTS, BINS, generator=rng))
    lamps = 1 + LAMP * (torch.rand(LIGHTS, BINS, generator=rng) < LAMP_SHARE)
    light = torch.cat([skies, lamps]).T
    error = (hidden - w * y.sigmoid()).sum(dim=1) @ light / (w.sum(dim=1) @ light).mean(dim=0)
    return bce, torch.log(error.square().mean(dim=0) + LEAST_ERROR).mean()


def validate(net: VisibilityNet, items: Sequence[VisibilityItem], seed: int) -> dict[str, float]:
    """The two terms, means over held-out objects, under the same lights each time."""
    with torch.no_grad():
        found = [terms(net, item, torch.Generator().manual_seed(seed + i)) for i, item in enumerate(items)]
    bce, error = zip(*found, strict=True)
    return {"held_out_bce": mean(bce), "held_out_log_error": mean(error)}


def mean(values: Sequence[Any]) -> float:
    """Of numbers, or of tensors of one number."""
    return sum(float(value) for value in values) / len(values)
