"""The light of a result folder: that which its maps were written with, an edit of it, or one from elsewhere."""

import logging
from pathlib import Path

import numpy as np
from jaxtyping import Float

from unirender.errors import UnirenderError
from unirender.exr import channels_rgb, light_sha256, on_pole_grid, read_exr
from unirender.intrinsics import Intrinsics
from unirender.picture_files.display_files import open_picture

logger = logging.getLogger(__name__)


def with_stored_light(maps: Intrinsics, file: Path, sha256: str | None) -> Intrinsics:
    """The maps with the environment of their folder; without s and d where it was edited since they were written.

    Args:
        maps: of the folder.
        file: its environment.
        sha256: of the environment that was written with them, where they state it.

    Raises:
        UnirenderError: it is broken, a map from elsewhere, whose rows lie otherwise, or one of ours that s and d do not
            belong to.
    """
    channels, attributes = read_exr(file)
    try:
        environment = channels_rgb(channels)
        lit = maps.replace(environment=environment)
    except UnirenderError as error:
        raise UnirenderError(f"{file}: {error}") from error
    ours = on_pole_grid(attributes)
    if not ours and not (sha256 and _is_size_of(file.with_suffix(".png"), environment)):
        raise UnirenderError(
            f"{file}: is no environment that unirender wrote, and a lat-long map from elsewhere has to be resampled; "
            "take it out of the folder and pass it as --environment (with --exposure 0 as bright as it is), in Python "
            "load_light(path, normalise=False).environment of unirender_reference.lights"
        )
    if not sha256 or sha256 == light_sha256(environment):
        return lit
    if not ours:
        logger.warning("%s: edited, so that specular and diffuse follow from it", file)
        return lit.replace(specular=None, diffuse=None)
    if maps.specular is not None or maps.diffuse is not None:
        raise UnirenderError(
            f"{file.parent}: {file.name} is another light than that of the specular and diffuse beside it, which are "
            "rendered as they are; put it back, and pass the other light as --environment (with --exposure 0 as bright "
            "as it is), in Python read_result(path, light=False).replace(environment=other, specular=None, "
            "diffuse=None): they are then derived from it"
        )
    return lit


def _is_size_of(picture: Path, environment: Float[np.ndarray, "eh ew 3"]) -> bool:
    """Whether the picture of a light that we wrote has the size of a light that no longer says so, and was edited."""
    return picture.is_file() and open_picture(picture).size == environment.shape[1::-1]
