"""A picture file with a mask as a command takes them, and the remarks that are due on it. Light to import."""

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING

from unirender.errors import UnirenderError
from unirender.system.machine import memory_excess, needs_swap
from unirender.system.wording import counted

if TYPE_CHECKING:
    from unirender.pictures import Picture

DARK = 0.35  # display value that an object reaches at the exposures of the training data, unless it is dark itself
USUAL = 0.8  # that most reach there
FULL_COVERAGE = 0.95  # that a mask reaches on an object
FEW_PIXELS = 16  # that an object covers: of fewer a notice is due
MANY_CLIPPED = 0.05  # share of clipped pixels from which a notice is due
BYTES_A_PIXEL, BYTES_OF_NONE = 145, 5e8  # of memory: what it takes to take a picture apart, or to edit it
TILED_BYTES_A_PIXEL = 180  # the same with the detail of tiles
TILED_SAMPLE_BYTES_A_PIXEL = 24  # what each of several samples takes in tiles, beside `SAMPLE_BYTES_A_PIXEL`
RELIT_BYTES_A_PIXEL = 190  # what it takes to put it under another light
RENDERED_BYTES_A_PIXEL = 115  # what it takes to render maps
DERIVED_BYTES_A_PIXEL = 160  # where s and d are derived from a light
SAMPLE_BYTES_A_PIXEL = 64  # what each takes beside that, where there are several samples


def read_input(
    path: Path, mask: Path | None, option: str = " (--mask)", bytes_a_pixel: int = BYTES_A_PIXEL, samples: int = 1
) -> tuple["Picture", dict[str, str]]:
    """A picture with a mask, and remarks by kind: what was assumed, and what the picture cannot show.

    Args:
        path: of the picture.
        mask: of a picture of the coverage; None: the alpha channel, else the whole frame.
        option: what remarks on a mask that is not there add: how one is given.
        bytes_a_pixel: that the work on it takes, besides `BYTES_OF_NONE`.
        samples: that are made of it, each of which takes `SAMPLE_BYTES_A_PIXEL` where there are several.

    Raises:
        UnirenderError: an unreadable file, a mask that does not fit, or a picture that this machine is too small for.
    """
    import numpy as np

    from unirender.color import srgb_decode
    from unirender.picture_files.mask_rim import (
        BACKGROUND,
        MIXED,
        mixture_explains,
        outline_is_background,
        without_background,
    )
    from unirender.pictures import OPAQUE, header_pixels, read_mask_file, read_picture

    pixels = header_pixels(path)
    lack = memory_remarks(path, pixels, bytes_a_pixel, samples) if pixels else {}
    picture = read_picture(path)
    height, width = picture.image_srgb.shape[:2]
    remarks = dict(picture.remarks) | lack
    if mask is not None:
        coverage, lost = read_mask_file(mask, (height, width))
        remarks |= lost
        opaque = picture.mask is None or picture.mask.min() >= OPAQUE  # so that its colours may have a background
        if opaque and mixture_explains(picture.image_srgb, coverage) > MIXED:
            straight = without_background(picture.image_srgb, coverage)
            picture = dataclasses.replace(picture, image_srgb=straight)
            remarks["rim"] = (
                "the picture's background is mixed into the rim of the mask: the colours next to it, further inside, "
                "are taken there"
            )
        elif opaque and outline_is_background(picture.image_srgb, coverage) > BACKGROUND:
            remarks["outline"] = (
                "the outline of the mask shows the background, which goes into roughness and albedo: the mask is too "
                "large, unless the object mirrors the background there; shrink it by a pixel or more"
            )
        picture = dataclasses.replace(picture, mask=coverage)
        if coverage.min() >= OPAQUE:
            remarks["mask"] = "the mask covers the whole frame, which is taken as the object"
    elif picture.mask is None:
        remarks["mask"] = f"no mask and no alpha channel: the whole frame is taken as the object{option}"
        picture = dataclasses.replace(picture, mask=np.ones((height, width, 1), dtype=np.float32))
    elif picture.mask.min() >= OPAQUE:
        remarks["mask"] = f"the alpha channel covers the whole frame, which is taken as the object{option}"
    assert picture.mask is not None, "the whole frame at least"
    covered = picture.mask[..., 0] > 0.5
    if covered[[0, 0, -1, -1], [0, -1, 0, -1]].all() and not covered.all():
        remarks["inverted"] = (
            "the mask holds all four corners of the frame, expected white on the object: is it inverted?"
        )
    if (pixels := int(covered.sum())) < FEW_PIXELS:
        remarks["small"] = f"the object covers {counted(pixels, 'pixel')}: its maps mean little"
    if (most := picture.mask.max()) < FULL_COVERAGE:
        remarks["coverage"] = f"the mask is at most {most:.2f}, as of something transparent: expected 1 on the object"
    if (bright := float(np.percentile(picture.image_srgb[covered].max(axis=-1), 99))) < DARK:
        usual, reached = srgb_decode(np.array([USUAL, max(bright, 1 / 255)], np.float32))
        remarks["dark"] = (
            f"the object is dark, 99% of it below {bright:.2f} of display white: the network was taught exposures at "
            "which white is bright, and a darker one goes into the albedo; unless the object itself is dark, brighten "
            f"the picture first, by some {np.log2(usual / reached):.0f} stops"
        )
    if picture.negative:
        remarks["negative"] = f"{100 * picture.negative:.1g}% of the picture's radiance is negative and was set to 0"
    if picture.clipped > MANY_CLIPPED:
        remarks["clipped"] = (
            f"{picture.clipped:.0%} of the object's pixels are clipped at display white: radiance is lost there"
        )
    return picture, remarks


def memory_remarks(path: Path, pixels: int, bytes_a_pixel: int, samples: int = 1) -> dict[str, str]:
    """A remark, by kind, where only swap holds a picture or maps of so many pixels; arguments as of `read_input`.

    Raises:
        UnirenderError: it takes more memory than the machine has in all: one sentence before the work instead of an end
            without a word in it.
    """
    wanted = BYTES_OF_NONE + pixels * (bytes_a_pixel + (SAMPLE_BYTES_A_PIXEL * samples if samples > 1 else 0))
    if excess := memory_excess(wanted):
        fewer = ", or ask for fewer --samples" if samples > 1 else ""
        raise UnirenderError(
            f"{path}: a picture of {pixels / 1e6:,.3g} megapixels, which {excess}; scale it down first{fewer}"
        )
    if said := needs_swap(wanted):
        return {"memory": f"a picture of {pixels / 1e6:,.3g} megapixels {said}; scale it down"}
    return {}
