"""Several looks at one picture, and their mean: test-time augmentation.

A mirrored picture is a picture of the mirrored object, and one whose colour channels are exchanged is of an object of
other colours (`light.symmetries`). A network that learned from a few thousand objects agrees with itself on this
only nearly, and the mean of what it says is better than what it says once. No look is resampled: no detail is lost.

Which colours an object may have is something a network knows, and exchanged channels take that away: colours, normals
and light are the mean over looks with the channels in their order, roughness and metallic over all.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch

from unirender.camera import Camera
from unirender.diffusion.steps import is_whole
from unirender.errors import UnirenderError
from unirender.light.symmetries import Maps, mirror, permute_channels
from unirender.models.packing import Packing

MATERIAL = ("roughness", "metallic")
AS_IT_IS = (0, 1, 2)


@dataclass(frozen=True)
class Look:
    """One way to look at a picture.

    Attributes:
        mirrored: left and right change places.
        order: channel c of what is seen is channel `order[c]` of the picture.
    """

    mirrored: bool
    order: tuple[int, int, int]

    def of(self, maps: Maps) -> Maps:
        """What is seen of a picture and its mask."""
        return permute_channels(mirror(maps) if self.mirrored else maps, self.order)

    def undo(self, maps: Maps) -> Maps:
        """The maps of what was seen, as those of the picture."""
        first, second, third = (self.order.index(channel) for channel in range(3))
        found = permute_channels(maps, (first, second, third))
        return mirror(found) if self.mirrored else found

    def camera(self, camera: Camera) -> Camera:
        """The camera of what is seen."""
        x, y = camera.principal
        return replace(camera, principal=(1 - x, y)) if self.mirrored else camera


LOOKS = tuple(
    Look(mirrored, order)
    for order in (AS_IT_IS, (1, 2, 0), (2, 0, 1), (0, 2, 1), (2, 1, 0), (1, 0, 2))
    for mirrored in (False, True)
)


def check_looks(looks: Any, mode: str) -> int:
    """How many of `LOOKS` a picture gets.

    Raises:
        UnirenderError: it is no such number, or samples are drawn, whose spread a mean would hide.
    """
    if not is_whole(looks) or not 1 <= looks <= len(LOOKS):
        raise UnirenderError(f"looks: got {looks!r}, expected a whole number from 1 to {len(LOOKS)}")
    if looks > 1 and mode != "mean":
        raise UnirenderError(
            f"looks: got {looks} in mode {mode}, expected 1, since a mean would hide the spread of samples; use mode "
            "'mean', which one step and one sample are"
        )
    return int(looks)


def mean_of_looks(found: Sequence[Maps], packing: Packing) -> Maps:
    """The maps of one picture from those of the first of `LOOKS`, one each, [s s c].

    The mean is that of the pictures which the network predicts (`unirender.models.packing`): of display values and tone
    curves, not of radiance.
    """
    looks = LOOKS[: len(found)]
    own = [look.undo(maps) for look, maps in zip(looks, found, strict=True)]
    names = sorted(own[0])
    stacked = {name: torch.from_numpy(np.stack([np.moveaxis(maps[name], -1, 0) for maps in own])) for name in names}
    pictures = packing.pack(stacked)
    in_order = torch.tensor([look.order == AS_IT_IS for look in looks])
    mean = packing.unpack(pictures[in_order].mean(dim=0, keepdim=True))
    material = packing.unpack(pictures.mean(dim=0, keepdim=True))
    mean |= {name: material[name] for name in MATERIAL}
    return {name: np.moveaxis(mean[name][0].numpy(), 0, -1) for name in found[0]}
