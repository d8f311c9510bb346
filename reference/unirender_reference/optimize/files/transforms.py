"""`transforms.json`, the file that NeRF's data sets, instant-ngp and nerfstudio describe posed pictures with.

    {"camera_angle_x": 0.69, "frames": [{"file_path": "./train/r_0", "transform_matrix": [[...], ...]}, ...]}

Poses are camera to world with +x right, +y up and +z towards the viewer, as everywhere here. The field of view is
`camera_angle_x` (radians, across the width) or the focal length `fl_x`, `fl_y` in pixels with `cx`, `cy`; each of them
stands at the top or, for one picture, in its frame: a frame with a focal length or an angle of its own takes none from
the top. Pixels count in a picture of `w` x `h`, where these are given.

A frame is held out where it says `"held_out": true`, and where the file has nerfstudio's lists of a split: those of
`val_filenames` and `test_filenames`, and with `train_filenames` all that these do not name.
"""

import json
import math
import os
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float

from unirender.camera import Camera
from unirender.errors import UnirenderError

Up = Literal["y", "z"]

Y_UP = np.array([[1, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]], np.float64)  # from a world with +z up
SUFFIXES = (".png", ".exr", ".jpg", ".jpeg", ".webp")  # tried where a path of a picture has none
PINHOLE = ("PINHOLE", "SIMPLE_PINHOLE", "OPENCV", "SIMPLE_RADIAL", "RADIAL")
SPLITS = ("train_filenames", "val_filenames", "test_filenames")
DISTORTION = ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2")
DISTORTIONS = "distortion_params"  # nerfstudio's list of the same
FOCAL = ("fl_x", "fl_y", "camera_angle_x", "camera_angle_y")  # each of them says how wide the lens is
LARGEST = sys.float_info.max  # JSON has whole numbers beyond it
ASPECT_TOLERANCE = 0.01  # of the proportions: whole pixels
ANGLE_TOLERANCE = 0.02  # of a focal length beside an angle, which may count a pixel more or less
FOCAL_TOLERANCE = 0.002  # of fl_x and fl_y: less than a pixel at the edge of 800


@dataclass(frozen=True)
class PosedPicture:
    """One picture of a `transforms.json`.

    Attributes:
        file: the picture.
        mask: a picture of the coverage, or None.
        pose: (4, 4) camera to world.
        held_out: whether the file says so.
        values: what it says of the lens: the frame's own keys over those of the whole file.
        name: as the file has it, for messages.
    """

    file: Path
    mask: Path | None
    pose: Float[np.ndarray, "4 4"]
    held_out: bool
    values: Mapping[str, Any]
    name: str

    def camera(self, height: int, width: int) -> Camera:
        """The camera of the picture, which has this size in pixels.

        Raises:
            UnirenderError: no field of view, one out of its range, a distorted lens, or pixels that are not square.
        """
        self._check_lens()
        stated = (self._number("h", height), self._number("w", width))
        scale = height / stated[0]
        if min(stated) <= 0 or abs(width / stated[1] / scale - 1) > ASPECT_TOLERANCE:
            raise UnirenderError(
                f"{self.name}: the picture is {width} x {height}, w and h say {stated[1]:g} x {stated[0]:g}; expected "
                "the same proportions"
            )
        focal = self._focal(stated[1], stated[0]) * scale
        center = (self._number("cx", stated[1] / 2) * scale, self._number("cy", stated[0] / 2) * scale)
        try:
            return Camera.from_focal(focal, height, width, center)
        except UnirenderError as error:
            raise UnirenderError(f"{self.name}: {error}") from error

    def other_size(self, height: int, width: int) -> set[str]:
        """A sentence, if focal length or centre count in pixels of another size than the picture has."""
        stated = self._number("w", width), self._number("h", height)
        if stated == (width, height) or not {"fl_x", "fl_y", "cx", "cy"} & self.values.keys():
            return set()
        return {
            f"pictures are {width} x {height}, w and h say {stated[0]:g} x {stated[1]:g}: focal lengths and cx, cy are "
            f"multiplied by {height / stated[1]:.4g}"
        }

    def _focal(self, width: float, height: float) -> float:
        """In pixels of the stated size."""
        sides = {"camera_angle_x": width, "camera_angle_y": height}
        found = {key: self._focal_of_angle(key, side) for key, side in sides.items() if key in self.values}
        if "fl_x" in self.values or "fl_y" in self.values:
            focal_y = self._number("fl_y", self._number("fl_x", 0.0))
            focal_x = self._number("fl_x", focal_y)
            if focal_y <= 0 or abs(focal_x / focal_y - 1) > FOCAL_TOLERANCE:
                raise UnirenderError(
                    f"{self.name}: fl_x {focal_x:g} and fl_y {focal_y:g}, expected one positive focal length (square "
                    "pixels); resample the picture"
                )
            for key, other in found.items():
                if abs(other / focal_y - 1) > ANGLE_TOLERANCE:
                    raise UnirenderError(
                        f"{self.name}: focal length {focal_y:g} (fl_x, fl_y) and {key}, which makes it {other:g} "
                        f"pixels in a picture of {width:g} x {height:g}, expected the same; leave the wrong one out "
                        "(w and h are the size that fl_x counts in)"
                    )
            return focal_y
        if not found:
            raise UnirenderError(
                f"{self.name}: no field of view, expected camera_angle_x or fl_x (and fl_y); "
                "write one of them into the file"
            )
        of_x, of_y = next(iter(found.values())), list(found.values())[-1]
        if abs(of_x / of_y - 1) > FOCAL_TOLERANCE:
            raise UnirenderError(
                f"{self.name}: camera_angle_x and camera_angle_y make focal lengths of {of_x:g} and {of_y:g} "
                f"pixels in a picture of {width:g} x {height:g}, expected one (square pixels); leave one of them out"
            )
        return of_x

    def _focal_of_angle(self, key: str, side: float) -> float:
        angle = self._number(key, 0.0)
        if not 0 < angle < math.pi:
            raise UnirenderError(f"{self.name}: {key} {angle:g}, expected radians between 0 and pi; is it in degrees?")
        return side / (2 * math.tan(angle / 2))

    def _check_lens(self) -> None:
        """Refuses a lens that is no pinhole."""
        model = self.values.get("camera_model", PINHOLE[0])
        if not isinstance(model, str) or model.upper() not in PINHOLE:
            raise UnirenderError(
                f"{self.name}: camera_model {model!r}, expected a pinhole ({', '.join(PINHOLE)}); undistort the "
                "pictures, and say PINHOLE"
            )
        fisheye = self.values.get("is_fisheye", False)
        if not isinstance(fisheye, bool):
            raise UnirenderError(f"{self.name}: is_fisheye is {fisheye!r}, expected true or false")
        if fisheye:
            raise UnirenderError(f"{self.name}: is_fisheye is true, expected a pinhole; undistort the pictures")
        bent = [key for key in DISTORTION if self._number(key, 0.0) != 0]
        listed = self.values.get(DISTORTIONS, [])
        if not isinstance(listed, list) or any(value != 0 for value in listed):
            bent.append(DISTORTIONS)
        if bent:
            raise UnirenderError(
                f"{self.name}: the lens is distorted ({', '.join(bent)} not 0), expected a pinhole camera; undistort "
                "the pictures (COLMAP: image_undistorter) and set these to 0"
            )

    def _number(self, key: str, default: float) -> float:
        value = self.values.get(key, default)
        if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) <= LARGEST:
            raise UnirenderError(f"{self.name}: {key} is {value!r:.60}, expected a finite number")
        return float(value)


def read_transforms(path: Path) -> list[PosedPicture]:
    """The frames of a `transforms.json`, in its order; no picture is opened.

    Raises:
        UnirenderError: the file is missing or no such JSON, has no frames, or one of them lacks something.
    """
    try:
        content = json.loads(path.read_text(encoding="utf-8-sig"))  # editors of Windows write a byte order mark
    except OSError as error:
        raise UnirenderError(
            f"{path}: cannot be read ({error.strerror}), expected a transforms.json; is the path right?"
        ) from error
    except (ValueError, RecursionError) as error:
        raise UnirenderError(f"{path}: not valid JSON ({error}), expected a transforms.json; write it again") from error
    frames = content.get("frames") if isinstance(content, dict) else None
    if not isinstance(frames, list) or not frames:
        raise UnirenderError(
            f"{path}: has no frames, expected a list of file_path and transform_matrix under 'frames'; "
            "docs/optimization.md has the format"
        )
    shared = {key: value for key, value in content.items() if key != "frames"}
    splits = {key: _split(path, key, content[key]) for key in SPLITS if key in content}
    return [_frame(path, index, entry, shared, splits) for index, entry in enumerate(frames)]


def _split(path: Path, key: str, names: Any) -> set[Path]:
    """The pictures that a split lists, as their frames name them."""
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise UnirenderError(f"{path}: {key} is {names!r:.60}, expected a list of file_path as the frames have them")
    return {Path(name) for name in names}


def _frame(
    path: Path, index: int, entry: Any, shared: Mapping[str, Any], splits: Mapping[str, set[Path]]
) -> PosedPicture:
    where = f"{path}: frames[{index}]"
    if not isinstance(entry, dict) or not isinstance(entry.get("file_path"), str):
        raise UnirenderError(f"{where} has no file_path, expected the path of a picture; write it into the frame")
    own = Path(entry["file_path"])
    unseen = any(own in splits.get(key, ()) for key in SPLITS[1:]) or own not in splits.get(SPLITS[0], {own})
    held_out = entry.get("held_out", unseen)
    if not isinstance(held_out, bool):
        raise UnirenderError(f"{where}: held_out is {held_out!r}, expected true or false")
    mask = entry.get("mask_path")
    if mask is not None and not isinstance(mask, str):
        raise UnirenderError(f"{where}: mask_path is {mask!r}, expected the path of a picture")
    return PosedPicture(
        file=_picture_file(path.parent, _written(entry["file_path"]), where),
        mask=None if mask is None else path.parent / _written(mask),
        pose=_pose(entry, where),
        held_out=held_out,
        values=_lens(shared, entry),
        name=f"{where} ({entry['file_path']})",
    )


def _lens(shared: Mapping[str, Any], own: Mapping[str, Any]) -> Mapping[str, Any]:
    """A frame's own keys over the shared ones; how wide the lens is, is said by one of both, never by half of each."""
    said = FOCAL if any(key in own for key in FOCAL) else ()
    return {**{key: value for key, value in shared.items() if key not in said}, **own}


def _written(name: str) -> str:
    """The path of a picture as this machine writes it: tools on Windows leave backslashes."""
    return name if os.sep == "\\" else name.replace("\\", "/")


def _picture_file(folder: Path, name: str, where: str) -> Path:
    """The picture, whose suffix may be left out."""
    if (folder / name).is_file():
        return folder / name
    found = [folder / (name + suffix) for suffix in SUFFIXES if (folder / (name + suffix)).is_file()]
    if len(found) > 1:
        names = " and ".join(file.name for file in found)
        raise UnirenderError(f"{where}: {name} may be {names}; write the suffix into file_path")
    if not found:
        raise UnirenderError(
            f"{where}: no picture {folder / name}, expected a file (or one with {', '.join(SUFFIXES)} behind it); "
            "copy it there, or correct file_path"
        )
    return found[0]


def _pose(entry: Mapping[str, Any], where: str) -> Float[np.ndarray, "4 4"]:
    try:
        pose = np.asarray(entry.get("transform_matrix"), np.float64)
    except (TypeError, ValueError, OverflowError):
        pose = np.zeros(0)
    if pose.shape == (3, 4):
        pose = np.concatenate([pose, [[0, 0, 0, 1]]])
    if pose.shape != (4, 4) or not np.isfinite(pose).all() or not np.allclose(pose[3], [0, 0, 0, 1], atol=1e-6):
        raise UnirenderError(
            f"{where}: transform_matrix is no 4 x 4 matrix of finite numbers with the last row 0 0 0 1, and no 3 x 4 "
            "matrix without that row; expected camera to world"
        )
    return pose
