"""One picture with what is known of it, for single-view optimisation; and its record."""

import dataclasses
import json
import logging
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from unirender.camera import DEFAULT_FOV_DEG, Camera
from unirender.errors import UnirenderError
from unirender.files import read_result
from unirender.pictures import display_values, open_picture, read_mask
from unirender_reference.optimize.folder import read_picture_file, reduced
from unirender_reference.optimize.state import rounded
from unirender_reference.optimize.views import Step, View

_log = logging.getLogger("unirender.optimize")


@dataclass(frozen=True)
class PictureInput:
    """A picture as the optimiser takes it.

    Attributes:
        image: straight colour: display values in [0, 1], or linear radiance where `hdr`.
        mask: coverage.
        camera: field of view; the principal point is the picture's middle.
        normal: unit vectors in camera axes, 0 outside the mask, or None.
        hdr: whether the picture is linear.
    """

    image: Float[np.ndarray, "h w 3"]
    mask: Float[np.ndarray, "h w 1"]
    camera: Camera
    normal: Float[np.ndarray, "h w 3"] | None
    hdr: bool


def read_picture_input(
    path: Path,
    mask: Path | None = None,
    fov_deg: float | None = None,
    normal: Path | None = None,
    longest_side: int | None = None,
) -> PictureInput:
    """Reads a picture; what had to be assumed is logged.

    Args:
        path: PNG, JPG, ... (display values) or EXR (linear, premultiplied).
        mask: picture of the coverage; None: the alpha channel, else the whole frame.
        fov_deg: vertical; None: the contract's.
        normal: see `read_normals`.
        longest_side: a larger picture is reduced to this many pixels, before normals are looked at.

    Raises:
        UnirenderError: a file is unreadable or does not fit.
    """
    image, alpha, hdr = read_picture_file(path)
    if mask is not None:
        alpha = read_mask(mask, (image.shape[0], image.shape[1]))
    if alpha is None:
        _log.warning("no mask and no alpha channel: the whole frame is taken as the object (--mask)")
        alpha = np.ones((*image.shape[:2], 1), np.float32)
    if fov_deg is None:
        _log.warning("field of view not given: %g degrees assumed (--fov)", DEFAULT_FOV_DEG)
    view = View(image, alpha, Camera(DEFAULT_FOV_DEG if fov_deg is None else fov_deg), np.eye(4), path.name)
    if longest_side is not None:
        view = reduced(view, longest_side, hdr)
        view = dataclasses.replace(view, camera=dataclasses.replace(view.camera, principal=(0.5, 0.5)))
    normals = None if normal is None else read_normals(normal, view.mask)
    return PictureInput(view.image, view.mask, view.camera, normals, hdr)


def read_normals(path: Path, mask: Float[np.ndarray, "h w 1"]) -> Float[np.ndarray, "h w 3"]:
    """Unit normals in camera axes, 0 where the mask is.

    Args:
        path: a result folder or an EXR with normal.X/Y/Z, or a picture of (n + 1) / 2.
        mask: coverage of the picture that they belong to.

    Raises:
        UnirenderError: the file has no normals, or they are of another size, or some inside the mask have no length.
    """
    if path.is_dir() or path.suffix.lower() == ".exr":
        normal = read_result(path, fov_deg=DEFAULT_FOV_DEG, light=False).normal
        if normal is None:
            raise UnirenderError(f"{path}: has no normals, expected the channels normal.X, normal.Y, normal.Z")
    else:
        normal = 2 * display_values(open_picture(path), str(path))[..., :3] - 1
    if normal.shape[:2] != mask.shape[:2]:
        height, width = mask.shape[:2]
        raise UnirenderError(
            f"{path}: the normals are {normal.shape[1]} x {normal.shape[0]} pixels, expected {width} x {height} like "
            "the picture"
        )
    length = np.linalg.norm(normal, axis=-1, keepdims=True)
    missing = float(((length < 0.5) & (mask > 0.5)).sum() / max(int((mask > 0.5).sum()), 1))
    if missing > 0.01:
        raise UnirenderError(
            f"{path}: {missing:.0%} of the object's pixels have no normal, expected unit vectors (as a picture: "
            "(n + 1) / 2); does the mask fit?"
        )
    fallback = np.array([0, 0, 1], np.float32)
    unit = np.where(length < 0.5, fallback, normal / np.maximum(length, 1e-6))
    return np.where(mask > 0, unit, 0).astype(np.float32)


def history_text(steps: Sequence[Step]) -> str:
    """The record of an optimisation as lines of JSON."""
    lines = [{**dataclasses.asdict(step), "values": rounded(step.values)} for step in steps]
    return "".join(json.dumps(line) + "\n" for line in lines)
