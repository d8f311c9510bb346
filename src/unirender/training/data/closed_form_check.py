"""Whether pictures are as bright as the closed form of their maps (`unirender.composite`), which is near every render.

Nothing else notices an exposure that is not folded into the light, display values in place of linear ones, or a d that
is irradiance and not a white surface's radiance: picture and maps are valid, but not of each other.
"""

import numpy as np

from unirender.color import luminance
from unirender.composite import composite_image
from unirender.light.exposure import MASK_THRESHOLD
from unirender.training.data.dataset import GroupDataset
from unirender.training.data.members import BLACK

PICTURES = 32  # that are looked at, spread over the data
FACTOR = 1.4  # either way; rendered data sets stay well within it


def brightness(data: GroupDataset) -> float:
    """The median over some pictures of how many times as bright a picture is as the closed form, itself a median over
    the object; NaN where all is black."""
    pairs = [(group, pair) for group in range(len(data.keys)) for pair in data.pairs(group)]
    chosen = np.unique(np.linspace(0, len(pairs) - 1, PICTURES).round().astype(int))
    found = []
    for group, pair in (pairs[number] for number in chosen):
        image, intrinsics = data.stored(group, pair)
        form = luminance(composite_image(intrinsics))
        seen = (intrinsics.require("mask")["mask"][..., 0] > MASK_THRESHOLD) & (form > BLACK)
        if seen.any():
            found.append(np.median(luminance(image)[seen] / form[seen]))
    return float(np.median(found)) if found else float("nan")


def doubt(data: GroupDataset) -> str | None:
    """In words, if the brightness is another than that of the maps; None: it is not, or all is black."""
    times = brightness(data)
    if not (times > FACTOR or times < 1 / FACTOR):
        return None
    return (
        f"{data.folder}: pictures are {times:.2g} times as bright as the closed form of their maps, expected about 1; "
        "are they linear, is the exposure folded into the light, s and d, and is d irradiance / pi?"
    )
