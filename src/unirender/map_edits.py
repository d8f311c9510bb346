"""What was edited in the pictures of a result folder since it was written.

A pixel of a picture counts where it shows another value than the stored map; all others keep what a picture of 8 bits
cannot hold: precision, and radiance above display white. Pictures beside an `intrinsics.exr` that unirender did not
write may be anything, and are not looked at.
"""

import logging
from collections.abc import Collection
from pathlib import Path

import numpy as np

from unirender.errors import UnirenderError
from unirender.exr import CAMERA_ATTRIBUTE, LIGHT_ATTRIBUTE, light_sha256, stated
from unirender.intrinsics import IMAGE_MAPS, RADIANCE_MAPS, Intrinsics
from unirender.map_files import MapFile, check_size, map_files, read_map_file, report_unread
from unirender.pictures import mask_values, read_mask

INTRINSICS = "intrinsics.exr"

logger = logging.getLogger(__name__)


def with_edits(stored: Intrinsics, folder: Path, names: Collection[str] = IMAGE_MAPS) -> Intrinsics:
    """The maps as the pictures beside `intrinsics.exr` show them; how much was edited is logged.

    s and d of a light that was edited are forgotten: they follow from it. Those of an edited normal or roughness are
    left as they are (`unirender.pipelines.edited_light`).

    Args:
        stored: what `intrinsics.exr` and `environment.exr` hold.
        folder: where they are.
        names: the image-aligned maps whose pictures count; the others' are not looked at.

    Raises:
        UnirenderError: a picture is broken, of another size, or no such map.
    """
    if stated(folder / INTRINSICS, CAMERA_ATTRIBUTE) is None:
        return stored
    report_unread(folder)
    files = {name: path for name, path in map_files(folder).items() if name in names}
    size = (stored.height, stored.width)
    changes: dict[str, np.ndarray] = {}
    said: list[str] = []
    if (light := _painted_light(stored, folder)) is not None:
        stored = stored.replace(specular=None, diffuse=None, environment=light)
        said.append("environment.png: specular and diffuse follow from it")
    if stored.environment is not None:
        of_light = [name for name in files if name in RADIANCE_MAPS and getattr(stored, name) is None]
        if of_light:
            unread = ", ".join(files.pop(name).name for name in of_light)
            logger.warning("%s: not looked at: %s, since the light says what they show", folder, unread)
    mask = np.ones((*size, 1), np.float32) if stored.mask is None else stored.mask
    if "mask" in files:
        shown = mask_values(path := files.pop("mask"))
        check_size(path, shown, size, INTRINSICS)
        if (changed := MapFile(shown, shown).differs("mask", mask)).any():
            changes["mask"] = mask = read_mask(path, size)
            said.append(f"{path.name} ({100 * changed.mean():.3g}% of the frame)")
    inside = mask[..., 0] > 0
    for name, path in files.items():
        known = getattr(stored, name)
        found = read_map_file(path, name)
        check_size(path, found.value, size, INTRINSICS)
        changed = inside if known is None else inside & found.differs(name, known)
        if changed.any():
            changes[name] = np.where(changed[..., None], found.value, 0 if known is None else known)
            said.append(f"{path.name} ({100 * changed.sum() / inside.sum():.3g}% of the object)")
    if said:
        logger.warning("edited in %s: %s", folder, ", ".join(said))
    try:
        return stored.replace(**changes)
    except UnirenderError as error:
        raise UnirenderError(f"{folder}: {error}") from error


def _painted_light(stored: Intrinsics, folder: Path) -> np.ndarray | None:
    """The light where its picture was edited; None where it was not, or where the light is another one than was written
    with the maps, and the picture that of the old one."""
    picture, light = folder / "environment.png", stored.environment
    if light is None or not picture.is_file() or stated(folder / INTRINSICS, LIGHT_ATTRIBUTE) != light_sha256(light):
        return None
    found = read_map_file(picture, "environment")
    check_size(picture, found.value, light.shape[:2], "environment.exr")
    changed = found.differs("environment", light)
    return np.where(changed[..., None], found.value, light) if changed.any() else None
