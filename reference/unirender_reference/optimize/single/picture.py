"""One picture with what is known of it, for single-view optimisation."""

import dataclasses
import logging
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float

from unirender.camera import DEFAULT_FOV_DEG, Camera
from unirender.errors import UnirenderError
from unirender.files import read_result
from unirender.map_edits import with_edits
from unirender.picture_files.display_files import stored_values
from unirender.pictures import checked_file, read_mask
from unirender_reference.optimize.files.folder import read_picture_file
from unirender_reference.optimize.reduction import reduced
from unirender_reference.optimize.views import View, Views

MOST_SATURATED = 0.99  # share of the object's display values
LEAST_LENGTH = 0.5  # of a stored normal
SHORTEST = 1e-6  # length of a mean that still has a direction
MOST_AWAY = 0.5  # share of the object whose normals look away from the camera
MATERIALS = ("albedo", "roughness", "metallic")
FLIPPED = -0.3  # agreement of an axis with the outline, from -1 to 1: true normals of 24 objects have 0.69 and more

_log = logging.getLogger("unirender.optimize")


@dataclass(frozen=True)
class PictureInput:
    """A picture as the optimiser takes it.

    Attributes:
        image: straight colour: display values in [0, 1], or linear radiance where `hdr`.
        mask: coverage.
        camera: field of view and principal point.
        normal: unit vectors in camera axes, 0 outside the mask, or None.
        hdr: whether the picture is linear.
        clipped: where a display value is only a lower bound, if the picture was reduced; None: where it is 1.
    """

    image: Float[np.ndarray, "h w 3"]
    mask: Float[np.ndarray, "h w 1"]
    camera: Camera
    normal: Float[np.ndarray, "h w 3"] | None
    hdr: bool
    clipped: Bool[np.ndarray, "h w 3"] | None = None


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
        fov_deg: vertical; None: that of the camera that the picture's header states, or else of the one that the
            normals were found with, or else the contract's.
        normal: a file for `read_normals`.
        longest_side: a larger picture is reduced to this many pixels, and normals of its size along with it; they may
            also have the reduced size.

    Raises:
        UnirenderError: a file is unreadable or does not fit, or the picture is black or saturated where the mask covers
            it.
    """
    picture = read_picture_file(path)
    image, alpha, hdr = picture.image, picture.mask, picture.linear
    if mask is not None:
        alpha = read_mask(mask, (image.shape[0], image.shape[1]))
    if alpha is None:
        _log.warning("no mask and no alpha channel: the whole frame is taken as the object (--mask)")
        alpha = np.ones((*image.shape[:2], 1), np.float32)
    full = View(image, alpha, _camera(picture.camera, fov_deg, normal), np.eye(4), path.name)
    _require_light(full, hdr, path)
    view = full
    if longest_side is not None:
        view = reduced(full, longest_side, hdr)
        if full.camera.principal == Camera().principal:  # the middle stays the middle, without rounding
            view = dataclasses.replace(view, camera=dataclasses.replace(view.camera, principal=full.camera.principal))
    normals = None
    if normal is not None:
        normals = _fitting_normals(normal, full, view, longest_side)
        check_axes(normals, view.mask, view.camera, normal)
    return PictureInput(view.image, view.mask, view.camera, normals, hdr, view.clipped)


def _camera(stated: Camera | None, fov_deg: float | None, normal: Path | None) -> Camera:
    """The picture's camera; what it was taken from is logged.

    Args:
        stated: by the picture's header, or None.
        fov_deg: instead of the field of view that is stated, or None.
        normal: where the normals come from, or None.
    """
    if fov_deg is not None:
        return dataclasses.replace(stated or Camera(), fov_deg=fov_deg)
    if stated is not None:
        _log.warning("field of view of %g degrees, as the picture's header says (--fov)", stated.fov_deg)
        return stated
    if normal is not None and _has_maps(normal):
        camera = read_result(normal, light=False, edits=False).camera
        _log.warning("field of view of %g degrees, the one that %s is read with (--fov)", camera.fov_deg, normal)
        return camera
    _log.warning("field of view not given: %g degrees assumed (--fov)", DEFAULT_FOV_DEG)
    return Camera()


def _has_maps(normal: Path) -> bool:
    """Whether normals are among the maps of a result folder or an EXR, which state a camera, or a picture."""
    return normal.is_dir() or normal.suffix.lower() == ".exr"


def _require_light(view: View, hdr: bool, path: Path) -> None:
    """Looks whether the picture shows anything where its mask covers it."""
    views = Views((view,), hdr=hdr)
    if views.black(view):
        raise UnirenderError(
            f"{path}: the picture is black wherever its mask covers it, expected an object under light; does the mask "
            "belong to the picture?"
        )
    saturated = float(views.saturated(view)[view.mask[..., 0] > 0].mean())
    if saturated >= MOST_SATURATED:
        raise UnirenderError(
            f"{path}: {saturated:.0%} of the object's values are saturated (white), expected a picture that shows its "
            "shading; take a darker exposure, or a linear EXR"
        )


def _fitting_normals(path: Path, full: View, view: View, longest_side: int | None) -> Float[np.ndarray, "h w 3"]:
    """Normals of the picture as it is optimised: those of its own size are averaged as it was."""
    stored = read_normals(path)
    if longest_side is None or stored.shape[:2] == view.mask.shape[:2]:
        return unit_normals(stored, view.mask, path)
    unit = unit_normals(stored, full.mask, path)
    above, below = (  # a picture has no negative values
        reduced(dataclasses.replace(full, image=np.maximum(part, 0)), longest_side, linear=True).image
        for part in (unit, -unit)
    )
    return _unit(above - below, view.mask, SHORTEST)


def check_axes(
    normal: Float[np.ndarray, "h w 3"], mask: Float[np.ndarray, "h w 1"], camera: Camera, path: Path
) -> None:
    """Looks whether normals have the axes of the camera: they face it, and at the outline they point out of it.

    An axis that the outline contradicts is logged.

    Args:
        normal: unit, 0 outside the mask.
        mask: coverage.
        camera: of the picture.
        path: the file, for messages.

    Raises:
        UnirenderError: most look away from the camera.
    """
    away = (normal * camera.view_directions(*mask.shape[:2])).sum(-1)[mask[..., 0] > 0] < 0
    if away.mean() > MOST_AWAY:
        raise UnirenderError(
            f"{path}: {away.mean():.0%} of the object's normals look away from the camera, expected camera axes (+x "
            "right, +y up, +z towards the viewer); negate z (OpenCV's axes: y and z)"
        )
    down, right = np.gradient(mask[..., 0])  # none along the frame's border, which is no outline
    for axis, outward in (("x", -right), ("y", down)):
        along = normal[..., "xyz".index(axis)] * outward
        if along.sum() < FLIPPED * np.abs(along).sum():
            _log.warning(
                "%s: at the outline the normals point inwards along %s; expected +x right, +y up: negate %s?",
                path,
                axis,
                axis,
            )


def read_normals(path: Path) -> Float[np.ndarray, "h w 3"]:
    """Normals in camera axes as they are stored; that other maps beside them are not used is logged.

    Args:
        path: a result folder or an EXR with normal.X/Y/Z, or a picture of (n + 1) / 2.

    Raises:
        UnirenderError: the file is unreadable or has no normals.
    """
    if _has_maps(path):
        stored = read_result(path, fov_deg=DEFAULT_FOV_DEG, light=False, edits=False)
        normal = with_edits(stored, path, ("normal", "mask")).normal
        if normal is None:
            raise UnirenderError(
                f"{path}: has no normals, expected the channels normal.X, normal.Y, normal.Z; "
                "leave --normal out, or give another file"
            )
        if unused := [name for name in MATERIALS if name in stored.present]:
            _log.warning("%s: only its normals are used, not its %s", path, ", ".join(unused))
        return normal
    return 2 * stored_values(checked_file(path))[..., :3] - 1


def unit_normals(
    normal: Float[np.ndarray, "h w 3"], mask: Float[np.ndarray, "h2 w2 1"], path: Path
) -> Float[np.ndarray, "h2 w2 3"]:
    """Vectors of length 1, 0 where the mask is.

    Args:
        normal: of any length; less than half is none, and becomes the direction towards the viewer.
        mask: coverage of the picture that they belong to.
        path: the file, for messages.

    Raises:
        UnirenderError: they are of another size, or some inside the mask have no length.
    """
    if normal.shape[:2] != mask.shape[:2]:
        height, width = mask.shape[:2]
        raise UnirenderError(
            f"{path}: the normals are {normal.shape[1]} x {normal.shape[0]} pixels, expected {width} x {height} like "
            "the picture; make them of this picture (`unirender decompose`)"
        )
    length = np.linalg.norm(normal, axis=-1, keepdims=True)
    missing = float(((length < LEAST_LENGTH) & (mask > 0.5)).sum() / max(int((mask > 0.5).sum()), 1))
    if missing > 0.01:
        raise UnirenderError(
            f"{path}: {missing:.0%} of the object's pixels have no normal, expected unit vectors (as a picture: "
            "(n + 1) / 2); does the mask fit?"
        )
    return _unit(normal, mask, LEAST_LENGTH)


def _unit(
    vectors: Float[np.ndarray, "h w 3"], mask: Float[np.ndarray, "h w 1"], least: float
) -> Float[np.ndarray, "h w 3"]:
    """Vectors of length 1, towards the viewer where they are shorter than `least`, 0 where the mask is."""
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    unit = np.where(length < least, np.array([0, 0, 1], np.float32), vectors / np.maximum(length, SHORTEST))
    return np.where(mask > 0, unit, 0).astype(np.float32)
