"""Pictures whose file states another colour space by an ICC profile, or by EXIF alone: brought to sRGB."""

import io

import numpy as np
from PIL import Image, ImageCms

from unirender.errors import UnirenderError
from unirender.picture_files.exif_colors import ADOBE_RGB, adobe_rgb_in_srgb, exif_color_space

SAME_PROFILE = 2  # of 255: profiles of sRGB differ by this much among one another
PROBE = 9  # steps along each axis of the cube that two profiles are compared on


def in_srgb(image: Image.Image, name: str) -> Image.Image:
    """A picture whose ICC profile is not sRGB's, converted: relative colorimetric, 8 bits a channel, RGB or RGBA; and
    one without a profile that is Adobe RGB by its EXIF (`unirender.picture_files.exif_colors`).

    Others come back as they are: those of which nothing is stated, those of sRGB, to the bit, and 16-bit grey, whose
    profile is not looked at.

    Args:
        image: the picture; colours, not data.
        name: what to call it in messages.

    Raises:
        UnirenderError: the profile is damaged, or of another kind of picture.
    """
    data = image.info.get("icc_profile")
    if not data:
        return adobe_rgb_in_srgb(image) if exif_color_space(image) == ADOBE_RGB else image
    if image.mode.startswith(("I", "F")):
        return image
    if image.mode in ("RGBa", "La"):  # premultiplied
        image = image.convert("RGBA" if image.mode == "RGBa" else "LA")
    alpha = image.convert("RGBA").getchannel("A") if image.has_transparency_data else None
    colors = image if image.mode in ("RGB", "L", "CMYK") else image.convert(_opaque_mode(image))
    space = ""
    try:
        profile = ImageCms.ImageCmsProfile(io.BytesIO(data))
        space = profile.profile.xcolor_space.strip()  # pyright: ignore[reportAttributeAccessIssue] - typed as a file
        if colors.mode == "L" and space == "RGB":  # grey was made of colours
            colors = colors.convert("RGB")
        if colors.mode == "RGB" and _is_srgb(profile):
            return image
        srgb, intent = ImageCms.createProfile("sRGB"), ImageCms.Intent.RELATIVE_COLORIMETRIC
        flags = ImageCms.Flags.NOOPTIMIZE if colors.mode == "L" else ImageCms.Flags.NONE  # dark grey was up to 10 off
        converted = ImageCms.profileToProfile(
            colors, profile, srgb, renderingIntent=intent, outputMode="RGB", flags=flags
        )
    except (ImageCms.PyCMSError, OSError, ValueError) as error:
        reason = f"for {space} and the picture is {colors.mode}" if space else str(error)
        raise UnirenderError(
            f"{name}: its ICC profile cannot be used ({reason}); convert it to sRGB, or save it without profile"
        ) from error
    assert converted is not None, "it was not converted in place"
    if alpha is not None:
        converted.putalpha(alpha)
    return converted


def states_other_colors(image: Image.Image, name: str) -> bool:
    """Whether a picture's colours are others under its ICC profile than they are in sRGB.

    Raises:
        UnirenderError: as `in_srgb`.
    """
    converted = in_srgb(image, name)
    if converted is image:
        return False
    seen, stored = (np.asarray(each.convert("RGB"), np.int16) for each in (converted, image))
    return bool(np.abs(seen - stored).max() > SAME_PROFILE)


def _opaque_mode(image: Image.Image) -> str:
    """Grey stays grey: its profile has one channel."""
    return "L" if image.mode in ("LA", "1") else "RGB"


def _is_srgb(profile: ImageCms.ImageCmsProfile) -> bool:
    steps = np.linspace(0, 255, PROBE).round().astype(np.uint8)
    cube = np.stack(np.meshgrid(steps, steps, steps), axis=-1).reshape(PROBE, PROBE * PROBE, 3)
    probe, srgb = Image.fromarray(cube), ImageCms.createProfile("sRGB")
    intent = ImageCms.Intent.RELATIVE_COLORIMETRIC
    seen = ImageCms.profileToProfile(probe, profile, srgb, renderingIntent=intent, outputMode="RGB")
    return bool(np.abs(np.asarray(seen, np.int16) - cube).max() <= SAME_PROFILE)
