"""Result folders on disk.

A *result folder* holds `intrinsics.exr` (all image-aligned maps), `environment.exr` (float32), one PNG a map for the
eye and `meta.json`; it appears complete or not at all. `read_result` takes it back, or one such EXR by itself: every
EXR says in its header attributes `unirender:*` where it comes from and through which camera it is seen.
"""

import dataclasses
import hashlib
import json
import logging
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from unirender.arguments import as_instance, as_path
from unirender.camera import DEFAULT_FOV_DEG, Camera
from unirender.color import image_srgb, unpremultiply
from unirender.errors import UnirenderError
from unirender.exr import (
    CAMERA_ATTRIBUTE,
    channels_rgb,
    header_camera,
    image_channels,
    intrinsics_channels,
    intrinsics_from_channels,
    on_pole_grid,
    radiance_fits_half,
    read_exr,
    write_environment,
    write_exr,
)
from unirender.intrinsics import IMAGE_MAPS, Intrinsics
from unirender.new_folders import META_FILE
from unirender.new_folders import new_folder as new_folder  # known by this name, too
from unirender.visualization import map_picture as map_picture  # likewise
from unirender.visualization import write_map_png, write_png

INTRINSICS_FILE, ENVIRONMENT_FILE, IMAGE_FILE = "intrinsics.exr", "environment.exr", "image.exr"

LIGHT_ATTRIBUTE = "light_sha256"  # of maps: of the environment beside them, to which their s and d belong

logger = logging.getLogger(__name__)


def write_result(
    folder: str | Path,
    intrinsics: Intrinsics | None,
    meta: Mapping[str, Any],
    image_linear: Float[np.ndarray, "h w 3"] | None = None,
) -> None:
    """Writes maps, pictures and `meta.json` into an existing (temporary) folder; see `new_folder`.

    EXR files have half precision, or float32 where radiance does not fit into half (`exr.radiance_fits_half`).

    Args:
        folder: where.
        intrinsics: maps to write, or None.
        meta: facts for `meta.json`: input, checkpoint, settings; text, numbers, paths, and dicts of them. The camera is
            added.
        image_linear: a rendered image, premultiplied; written as `image.exr` and `image.png` (with alpha if the mask is
            known).

    Raises:
        UnirenderError: the maps are no `Intrinsics`, or the folder is no path.
    """
    if intrinsics is not None:
        as_instance(intrinsics, Intrinsics, "result")
    folder = as_path(folder, "folder")
    attributes = header_attributes(meta, None if intrinsics is None else intrinsics.camera)
    if intrinsics is not None:
        if any(name in IMAGE_MAPS for name in intrinsics.present):
            of_maps = attributes
            if intrinsics.environment is not None and _is_lit(intrinsics):
                of_maps = attributes | {LIGHT_ATTRIBUTE: _light_sha256(intrinsics.environment)}
            channels = intrinsics_channels(intrinsics)
            half = radiance_fits_half(channels)
            write_exr(folder / INTRINSICS_FILE, channels, half=half, attributes=of_maps)
        if intrinsics.environment is not None:
            write_environment(folder / ENVIRONMENT_FILE, intrinsics.environment, attributes)
        for name, value in intrinsics.maps.items():
            write_map_png(folder / f"{name}.png", name, value)
    if image_linear is not None:
        mask = None if intrinsics is None else intrinsics.mask
        rgba = image_linear if mask is None else np.concatenate([image_linear, mask], axis=-1)
        channels = image_channels(rgba)
        write_exr(folder / IMAGE_FILE, channels, half=radiance_fits_half(channels), attributes=attributes)
        picture = image_srgb(image_linear if mask is None else unpremultiply(image_linear, mask))
        write_png(folder / "image.png", picture if mask is None else np.concatenate([picture, mask], axis=-1))
    write_meta(folder, meta, None if intrinsics is None else intrinsics.camera)


def write_meta(folder: Path, meta: Mapping[str, Any], camera: Camera | None) -> None:
    """Writes `meta.json`, with the camera if there is one."""
    record = dict(meta)
    if camera is not None:
        record |= {"fov_deg": camera.fov_deg, "principal": list(camera.principal)}
    (folder / META_FILE).write_text(json.dumps(record, indent=2, sort_keys=True, default=str) + "\n")


def header_attributes(meta: Mapping[str, Any], camera: Camera | None) -> dict[str, str]:
    """The text and numbers of `meta` as header attributes; of a path the name only, since files travel."""
    attributes = {key: str(value) for key, value in meta.items() if isinstance(value, str | int | float)}
    attributes |= {key: value.resolve().name for key, value in meta.items() if isinstance(value, Path)}
    return attributes if camera is None else attributes | {CAMERA_ATTRIBUTE: camera.describe()}


def read_result(path: str | Path, fov_deg: float | None = None, *, light: bool = True) -> Intrinsics:
    """The maps of a result folder, or those of one EXR file, which then come without the environment.

    The camera is that of the folder's `meta.json`, else that of the EXR header, else the contract's default, which is
    logged.

    Args:
        path: the folder or the EXR file.
        fov_deg: instead of the field of view that is stored.
        light: whether the folder's environment is wanted; else it is not looked at.

    Raises:
        UnirenderError: there is nothing of the kind, a file is broken, or the folder's environment is another one than
            s and d were written with.
    """
    path = as_path(path)
    file = path / INTRINSICS_FILE if path.is_dir() else path
    if path.is_dir() and not file.is_file():
        inside = sorted(found.parent.name for found in path.glob(f"*/{INTRINSICS_FILE}"))
        several = f": name one of the folders inside, like {path / inside[0]}" if inside else ""
        raise UnirenderError(
            f"{path}: has no {INTRINSICS_FILE}, expected the output folder of `unirender decompose`{several}"
        )
    if not file.is_file() or file.suffix.lower() != ".exr":
        raise UnirenderError(f"{path}: no folder and no EXR file, expected the output of `unirender decompose`")
    channels, attributes = read_exr(file)
    environment, camera = None, None
    if path.is_dir():
        camera = _camera_of_meta(path / META_FILE)
        if light and (path / ENVIRONMENT_FILE).is_file():
            environment = _read_environment(path / ENVIRONMENT_FILE)
    try:
        if camera is None and CAMERA_ATTRIBUTE in attributes:
            text = attributes[CAMERA_ATTRIBUTE]
            camera = _camera_of_header(text) if fov_deg is None else header_camera(attributes)
        if camera is None and fov_deg is None:
            logger.warning(
                "%s says nothing of its camera: a field of view of %g degrees is assumed (fov_deg, --fov)",
                path,
                DEFAULT_FOV_DEG,
            )
        camera = camera or Camera()
        if fov_deg is not None:
            camera = dataclasses.replace(camera, fov_deg=fov_deg)
        intrinsics = intrinsics_from_channels(channels, environment, camera)
    except UnirenderError as error:
        raise UnirenderError(f"{path}: {error}") from error
    stored = attributes.get(LIGHT_ATTRIBUTE)
    if environment is not None and stored and _is_lit(intrinsics) and stored != _light_sha256(environment):
        raise UnirenderError(
            f"{path}: {ENVIRONMENT_FILE} is another light than that of the specular and diffuse beside it, which are "
            "rendered as they are; put it back, and pass the other light as --environment (with --exposure 0 as bright "
            "as it is), in Python read_result(path, light=False).replace(environment=other, specular=None, "
            "diffuse=None): they are then derived from it"
        )
    if not intrinsics.present:
        raise UnirenderError(f"{path}: has the channels {', '.join(sorted(channels))}, expected maps like albedo.R")
    return intrinsics


def _camera_of_header(text: str) -> Camera:
    """The camera that a header states.

    Raises:
        UnirenderError: it is none.
    """
    try:
        return Camera.parse(text)
    except UnirenderError as error:
        raise UnirenderError(f"{error}; pass the field of view (fov_deg, --fov)") from error


def _is_lit(intrinsics: Intrinsics) -> bool:
    """Whether there is s or d."""
    return intrinsics.specular is not None or intrinsics.diffuse is not None


def _light_sha256(environment: Float[np.ndarray, "eh ew 3"]) -> str:
    return hashlib.sha256(repr(environment.shape).encode() + environment.tobytes()).hexdigest()


def _read_environment(file: Path) -> Float[np.ndarray, "eh ew 3"]:
    """The environment of a result folder.

    Raises:
        UnirenderError: it is broken, or a map from elsewhere, whose rows lie otherwise.
    """
    channels, attributes = read_exr(file)
    if not on_pole_grid(attributes):
        raise UnirenderError(
            f"{file}: is no environment that unirender wrote, and a lat-long map from elsewhere has to be resampled; "
            "take it out of the folder and pass it as --environment (with --exposure 0 as bright as it is), in Python "
            "load_light(path, normalise=False).environment of unirender_reference.lights"
        )
    try:
        return channels_rgb(channels)
    except UnirenderError as error:
        raise UnirenderError(f"{file}: {error}") from error


def _camera_of_meta(path: Path) -> Camera | None:
    """The camera of a `meta.json`; None where there is no file, or none in it.

    Raises:
        UnirenderError: the file is broken.
    """
    if not path.is_file():
        return None
    try:
        meta = json.loads(path.read_text())
        if not isinstance(meta, dict):
            raise TypeError(f"got {type(meta).__name__}, expected a JSON object")
        if "fov_deg" not in meta:
            return None
        x, y = meta.get("principal", Camera().principal)
        return Camera(fov_deg=float(meta["fov_deg"]), principal=(float(x), float(y)))
    except (ValueError, TypeError, AttributeError) as error:
        raise UnirenderError(f"{path}: not readable ({error}); delete it to use the camera of the EXR file") from error
