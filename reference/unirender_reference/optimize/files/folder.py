"""Folders of posed pictures: `transforms.json` with PNG (display values) or EXR (linear radiance), to and from `Views`.

Held out are the frames that say `"held_out": true`; where none does, those of `transforms_val.json` or else of
`transforms_test.json` beside it (NeRF's synthetic scenes call the first file `transforms_train.json`); and every N-th
of the rest, if asked for.
"""

import hashlib
import json
import logging
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import get_args

import numpy as np
from jaxtyping import Float

from unirender.arguments import as_instance, as_path
from unirender.camera import Camera
from unirender.color import unpremultiply
from unirender.errors import UnirenderError
from unirender.exr import channels_rgb, header_camera, image_channels, read_exr, write_exr
from unirender.new_folders import new_folder
from unirender.picture_files.display_files import is_turned
from unirender.pictures import check_finite, check_mask, negative_share, read_mask, read_picture
from unirender.visualization import write_png
from unirender_reference.optimize.files.transforms import Y_UP, PosedPicture, Up, read_transforms
from unirender_reference.optimize.machine import require_memory_for_pictures
from unirender_reference.optimize.reduction import reduced
from unirender_reference.optimize.views import View, Views

SEEN_FILES = ("transforms.json", "transforms_train.json")
HELD_OUT_FILES = ("transforms_val.json", "transforms_test.json")
PIXEL_BYTES = 19.0  # of memory for a pixel of a view: colour, coverage, what is clipped
UNTURNED = "EXIF orientations of the pictures are not followed: poses count in the pixels as they are stored"

_log = logging.getLogger("unirender.optimize")


def read_views(
    folder: str | Path,
    *,
    up: Up = "y",
    hold_out: int = 0,
    most_views: int | None = None,
    longest_side: int | None = None,
) -> Views:
    """Reads a folder of posed pictures; poses stay in its units (`shape.placement.placed` moves them).

    A picture needs a mask: the file that its `mask_path` names (white: object), else its alpha channel. PNG is straight
    colour; EXR is linear and premultiplied by its own alpha channel. EXIF orientations are not followed: poses count in
    the pixels as they are stored.

    Args:
        folder: with `transforms.json` (or `transforms_train.json`).
        up: "z" turns a world with +z up (Blender, NeRF's synthetic scenes) so that +y is up.
        hold_out: every N-th picture that is not held out by the files is held out, too; 0: none.
        most_views: of more pictures that are seen, this many are taken, evenly spread in their order.
        longest_side: larger pictures are reduced to this many pixels, by means of area in linear light.

    Raises:
        UnirenderError: one sentence that names the file, or the argument, and what is wrong with it; or the pictures
            take more memory than the machine has.
    """
    _check_arguments(up, hold_out, most_views, longest_side)
    folder = as_path(folder, "views")
    main = next((folder / name for name in SEEN_FILES if (folder / name).is_file()), None)
    if main is None:
        there = "is no folder" if not folder.is_dir() else f"has no {' or '.join(SEEN_FILES)}"
        raise UnirenderError(f"{folder}: {there}; expected posed pictures (docs/optimization.md has the format)")
    seen, held_out = _split(main, hold_out)
    seen, held_out = _spread(seen, most_views), _spread(held_out, most_views)
    hdr = {frame.file.suffix.lower() == ".exr" for frame in (*seen, *held_out)}
    if len(hdr) > 1:
        raise UnirenderError(
            f"{folder}: has EXR beside other pictures, expected one kind: all linear, or all display; convert some"
        )
    linear = hdr.pop()
    notices: set[str] = set()
    pictures: list[View] = []
    for frame in (*seen, *held_out):
        pictures.append(_view(frame, folder, linear, up, longest_side, notices))
        if len(pictures) == 1:  # the others have its size
            height, width = pictures[0].mask.shape[:2]
            require_memory_for_pictures(len(seen) + len(held_out), height, width, PIXEL_BYTES)
    views = Views(tuple(pictures[: len(seen)]), tuple(pictures[len(seen) :]), linear)
    for notice in sorted(notices):
        _log.warning("%s: %s", main, notice)
    try:
        views.require_light()
    except UnirenderError as error:
        raise UnirenderError(f"{folder}: {error}") from error
    _warn(views, [*seen, *held_out])
    return views


def _split(main: Path, hold_out: int) -> tuple[list[PosedPicture], list[PosedPicture]]:
    """The frames that are seen, and those that are held out: by the files, and every N-th of the others."""
    frames = read_transforms(main)
    seen = [frame for frame in frames if not frame.held_out]
    held_out = [frame for frame in frames if frame.held_out]
    if not held_out:
        other = next((file for name in HELD_OUT_FILES if (file := main.with_name(name)).is_file()), None)
        held_out = [] if other is None else read_transforms(other)
    if hold_out:
        held_out = held_out + seen[hold_out - 1 :: hold_out]
        seen = [frame for index, frame in enumerate(seen) if (index + 1) % hold_out]
    if not seen:
        raise UnirenderError(
            f"{main}: all {len(frames)} pictures are held out, expected some to optimise against; hold fewer out"
        )
    both = {frame.file.resolve() for frame in seen} & {frame.file.resolve() for frame in held_out}
    if both:
        names = " and ".join(frame.name for frame in (*seen, *held_out) if frame.file.resolve() == min(both))
        raise UnirenderError(f"{names}: one picture is both seen and held out; expected each once")
    return seen, held_out


def _check_arguments(up: Up, hold_out: int, most_views: int | None, longest_side: int | None) -> None:
    if up not in get_args(Up):
        raise UnirenderError(f"up: got {up!r}, expected one of {', '.join(get_args(Up))}")
    if hold_out < 0 or hold_out == 1:
        raise UnirenderError(f"hold_out: got {hold_out}, expected 2 or more, or 0 (those that the folder holds out)")
    for name, value in (("most_views", most_views), ("longest_side", longest_side)):
        if value is not None and value < 1:
            raise UnirenderError(f"{name}: got {value}, expected 1 or more, or None (no limit)")


def _warn(views: Views, frames: Sequence[PosedPicture]) -> None:
    """Logs what is hardly meant: black pictures, one picture twice, and a lens in pixels of another size."""
    names: dict[bytes, str] = {}
    for view, frame in zip((*views.seen, *views.held_out), frames, strict=True):
        if view.mask.any() and views.black(view):
            _log.warning("%s: the picture is black wherever its mask covers it; leave it out", frame.name)
        digest = hashlib.sha256(view.image.tobytes() + view.mask.tobytes()).digest()
        if digest in names:
            other = names[digest].rpartition(": ")[2]
            _log.warning("%s: the same picture as %s; expected each once", frame.name, other)
        names.setdefault(digest, frame.name)


def _spread(frames: list[PosedPicture], most: int | None) -> list[PosedPicture]:
    if most is None or len(frames) <= most:
        return frames
    return [frames[index * len(frames) // most] for index in range(most)]


def _view(frame: PosedPicture, folder: Path, linear: bool, up: Up, longest_side: int | None, notices: set[str]) -> View:
    """Reads one picture with its mask; what is due on the set as a whole goes to `notices`."""
    picture = read_picture_file(frame.file, upright=False)
    image, mask = picture.image, picture.mask
    notices |= frame.other_size(*image.shape[:2])
    if not linear and is_turned(frame.file):
        notices.add(UNTURNED)
    if frame.mask is not None:
        mask = read_mask(frame.mask, image.shape[:2], upright=False)
    if mask is None:
        raise UnirenderError(
            f"{frame.file}: has no alpha channel, and its frame no mask_path; expected one of them (white: object)"
        )
    pose = Y_UP @ frame.pose if up == "z" else frame.pose
    camera = frame.camera(*image.shape[:2])
    try:
        view = View(image, mask, camera, pose, name=Path(frame.values["file_path"]).as_posix())
    except UnirenderError as error:
        raise UnirenderError(f"{folder}: {error}") from error
    return view if longest_side is None else reduced(view, longest_side, linear)


@dataclass(frozen=True)
class PictureFile:
    """A picture as its file has it.

    Attributes:
        image: straight colour: display values in [0, 1], or linear radiance where `linear`.
        mask: the alpha channel, or None.
        linear: whether it is an EXR.
        camera: that its header states (EXR files of ours do), or None.
    """

    image: Float[np.ndarray, "h w 3"]
    mask: Float[np.ndarray, "h w 1"] | None
    linear: bool
    camera: Camera | None


def read_picture_file(path: Path, *, upright: bool = True) -> PictureFile:
    """Reads a picture; what is lost in it is logged. `upright` as of `read_picture`.

    Raises:
        UnirenderError: the file is missing, broken, or no picture.
    """
    if path.suffix.lower() == ".exr":
        return _linear_picture(path)
    picture = read_picture(path, upright=upright)
    for remark in picture.remarks.values():
        _log.warning("%s: %s", path, remark)
    return PictureFile(picture.image_srgb, picture.mask, linear=False, camera=picture.camera)


def _linear_picture(path: Path) -> PictureFile:
    """An EXR's straight linear radiance; what `negative_share` lets pass is 0."""
    channels, attributes = read_exr(path)
    try:
        rgb = channels_rgb(channels)
    except UnirenderError as error:
        raise UnirenderError(f"{path}: {error}; expected a picture") from error
    name = "A" if "A" in channels else "mask.Y"
    alpha = channels.get(name)
    check_finite(rgb if alpha is None else np.dstack([rgb, alpha]), str(path))
    if negative := negative_share(rgb, str(path)):
        _log.warning("%s: %.1g%% of the radiance is negative and was set to 0", path, 100 * negative)
        rgb = np.maximum(rgb, 0)
    mask = None if alpha is None else check_mask(alpha[..., None], f"{path} ({name})")
    straight = rgb if mask is None else unpremultiply(rgb, mask)
    return PictureFile(straight, mask, linear=True, camera=header_camera(attributes))


def write_views(views: Views, folder: str | Path) -> None:
    """Writes views as `read_views` reads them: PNG with alpha (8 bits), or EXR (float32) where they are `hdr`.

    Raises:
        UnirenderError: the folder is there already.
    """
    as_instance(views, Views, "views")
    with new_folder(folder) as temporary:
        (temporary / "images").mkdir()
        frames = [_written(view, temporary, index, views.hdr) for index, view in enumerate(views.seen)]
        held_out = [
            {**_written(view, temporary, index, views.hdr), "held_out": True}
            for index, view in enumerate(views.held_out, len(frames))
        ]
        text = json.dumps({"w": views.width, "h": views.height, "frames": [*frames, *held_out]}, indent=1)
        (temporary / SEEN_FILES[0]).write_text(text + "\n", encoding="utf-8")


def _written(view: View, folder: Path, index: int, linear: bool) -> dict[str, object]:
    """Writes one picture; its frame."""
    height, width = view.mask.shape[:2]
    file = f"images/{index:04d}.{'exr' if linear else 'png'}"
    if linear:
        rgba = np.concatenate([view.image * view.mask, view.mask], axis=-1)
        write_exr(folder / file, image_channels(rgba), half=False)
    else:
        write_png(folder / file, np.concatenate([view.image, view.mask], axis=-1))
    focal = view.camera.focal(height)
    x, y = view.camera.principal
    return {
        "file_path": file,
        "fl_x": focal,
        "fl_y": focal,
        "cx": x * width,
        "cy": y * height,
        "transform_matrix": _matrix(view.pose),
    }


def _matrix(pose: Float[np.ndarray, "4 4"]) -> Sequence[Sequence[float]]:
    return [[float(value) for value in row] for row in pose]
