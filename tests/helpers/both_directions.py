"""A network asked in both directions with the noise of one seed."""

import torch
from torch import Tensor

from unirender.diffusion.inference import infer_attributes, infer_image
from unirender.diffusion.schedule import make_scheduler
from unirender.models.conditioning import Conditioning
from unirender.models.dual_stream import DualStreamModel
from unirender.models.packing import TRIPLETS


def decompose(parts: tuple[DualStreamModel, Conditioning], maps: dict[str, Tensor]) -> Tensor:
    """The albedo that is found in the image."""
    seed = torch.Generator().manual_seed(0)
    return infer_attributes(*parts, make_scheduler(), maps["image"], maps["mask"], generator=seed)["albedo"]


def render(parts: tuple[DualStreamModel, Conditioning], maps: dict[str, Tensor]) -> Tensor:
    """The image of all maps."""
    given = torch.ones(len(maps["mask"]), len(TRIPLETS), dtype=torch.bool)
    return infer_image(*parts, make_scheduler(), maps, given, generator=torch.Generator().manual_seed(0))
