"""Result folders on disk.

A *result folder* holds `intrinsics.exr` (all image-aligned maps), `environment.exr` (float32), one PNG a map for the
eye and for image editors, and `meta.json`; it appears complete or not at all. `read_result` takes it back with what was
edited in its PNGs, or a folder that has a file for each map (`unirender.map_files`), or one such EXR by itself: every
EXR says in its header attributes `unirender:*` where it comes from and through which camera it is seen.
"""

import dataclasses
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
    LIGHT_ATTRIBUTE,
    header_camera,
    image_channels,
    intrinsics_channels,
    intrinsics_from_channels,
    light_sha256,
    radiance_fits_half,
    read_exr,
    write_environment,
    write_exr,
)
from unirender.intrinsics import IMAGE_MAPS, Intrinsics
from unirender.map_edits import with_edits
from unirender.map_files import map_files, read_maps, report_unread
from unirender.new_folders import META_FILE
from unirender.new_folders import new_folder as new_folder  # known by this name, too
from unirender.stored_light import with_stored_light
from unirender.visualization import map_picture as map_picture  # likewise
from unirender.visualization import write_map_png, write_png

INTRINSICS_FILE, ENVIRONMENT_FILE, IMAGE_FILE = "intrinsics.exr", "environment.exr", "image.exr"

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
            if intrinsics.environment is not None:
                of_maps = attributes | {LIGHT_ATTRIBUTE: light_sha256(intrinsics.environment)}
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


def read_result(
    path: str | Path, fov_deg: float | None = None, *, light: bool = True, edits: bool = True
) -> Intrinsics:
    """The maps of a folder, or those of one EXR file, which then come without the environment.

    A result folder has them in `intrinsics.exr`; where a picture of a map beside it was edited, the picture counts
    (`unirender.map_edits`). Without that file they are files named like the maps (`unirender.map_files`). The camera is
    that of the folder's `meta.json`, else that of the EXR header, else the contract's default, which is logged.

    Args:
        path: the folder or the EXR file.
        fov_deg: instead of the field of view that is stored.
        light: whether the folder's environment is wanted; else it is not looked at.
        edits: whether edited pictures count; else they are not looked at.

    Raises:
        UnirenderError: there is nothing of the kind, a file is broken, or the folder's environment is another one than
            s and d were written with.
    """
    path = as_path(path)
    file = path / INTRINSICS_FILE if path.is_dir() else path
    attributes: dict[str, str] = {}
    if path.is_dir() and not file.is_file():
        maps = _single_maps(path)
    elif not file.is_file() or file.suffix.lower() != ".exr":
        raise UnirenderError(
            f"{path}: no folder and no EXR file, expected the output of `unirender decompose` or a folder with a file "
            "for each map"
        )
    else:
        maps, attributes = _maps_of_exr(file, path)
    maps = maps.replace(camera=_camera(path, attributes, fov_deg))
    if light and (path / ENVIRONMENT_FILE).is_file():
        maps = with_stored_light(maps, path / ENVIRONMENT_FILE, attributes.get(LIGHT_ATTRIBUTE))
    return with_edits(maps, path) if edits else maps


def _maps_of_exr(file: Path, path: Path) -> tuple[Intrinsics, dict[str, str]]:
    """The maps of an EXR file and its attributes; `path` is what messages name.

    Raises:
        UnirenderError: it is broken, or has no maps.
    """
    channels, attributes = read_exr(file)
    try:
        maps = intrinsics_from_channels(channels)
    except UnirenderError as error:
        raise UnirenderError(f"{path}: {error}") from error
    if not maps.present:
        raise UnirenderError(f"{path}: has the channels {', '.join(sorted(channels))}, expected maps like albedo.R")
    return maps, attributes


def _single_maps(folder: Path) -> Intrinsics:
    """The maps of a folder that has a file for each.

    Raises:
        UnirenderError: it has none, or one is broken.
    """
    files = map_files(folder)
    if not set(files) - {"mask"}:
        inside = sorted(found.parent.name for found in folder.glob(f"*/{INTRINSICS_FILE}"))
        several = f": name one of the folders inside, like {folder / inside[0]}" if inside else ""
        raise UnirenderError(
            f"{folder}: has no {INTRINSICS_FILE} and no maps like albedo.png, expected the output of "
            f"`unirender decompose` or a folder with a file for each map{several}"
        )
    report_unread(folder)
    if (picture := folder / "environment.png").is_file() and not (folder / ENVIRONMENT_FILE).is_file():
        logger.warning("%s: not read: its values end at display white, expected %s", picture, ENVIRONMENT_FILE)
    maps = read_maps(files)
    try:
        return Intrinsics().replace(**maps)
    except UnirenderError as error:
        raise UnirenderError(f"{folder}: {error}") from error


def _camera(path: Path, attributes: Mapping[str, str], fov_deg: float | None) -> Camera:
    """The camera of a folder or an EXR file; see `read_result`."""
    camera = _camera_of_meta(path / META_FILE) if path.is_dir() else None
    if camera is None and CAMERA_ATTRIBUTE in attributes:
        camera = header_camera(attributes) if fov_deg is not None else _camera_of_header(path, attributes)
    if camera is None and fov_deg is None:
        logger.warning(
            "%s says nothing of its camera: a field of view of %g degrees is assumed (fov_deg, --fov)",
            path,
            DEFAULT_FOV_DEG,
        )
    camera = camera or Camera()
    return camera if fov_deg is None else dataclasses.replace(camera, fov_deg=fov_deg)


def _camera_of_header(path: Path, attributes: Mapping[str, str]) -> Camera:
    """The camera that a header states.

    Raises:
        UnirenderError: it is none.
    """
    try:
        return Camera.parse(attributes[CAMERA_ATTRIBUTE])
    except UnirenderError as error:
        raise UnirenderError(f"{path}: {error}; pass the field of view (fov_deg, --fov)") from error


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
    except (ValueError, TypeError, OverflowError, RecursionError) as error:  # no JSON, or numbers that are none
        raise UnirenderError(f"{path}: not readable ({error}); delete it to use the camera of the EXR file") from error
