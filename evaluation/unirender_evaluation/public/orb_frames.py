"""Stanford-ORB's captures: their frames and poses as `transforms_*.json` say, and which photographs share a pose."""

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from jaxtyping import Float

from unirender.camera import Camera
from unirender.errors import UnirenderError
from unirender_evaluation.public.files import parsed_json

LDR, HDR, TRUTH = "blender_LDR", "blender_HDR", "ground_truth"
ROTATION_TOLERANCE = 1e-3
# `teapot_scene001`, and as the evaluation code names them `scene001_obj018_teapot`
NAMES = (re.compile(r"(?P<object>.+)_scene\d+"), re.compile(r"scene\d+_(?P<object>.+)"))


@dataclass(frozen=True)
class Photograph:
    """One photograph of a capture."""

    capture: str  # name of its folder
    split: str  # "test" or "train"
    id: str  # name of its files without suffix
    angle_x: float  # horizontal field of view, radians
    pose: tuple[tuple[float, ...], ...]  # camera to world, OpenGL axes (those of our contract); rows of a 4 x 4 matrix

    def photo(self, folder: Path, kind: str = LDR) -> Path:
        """Its file among the LDR or the HDR photographs."""
        return folder / kind / self.capture / self.split / f"{self.id}{'.png' if kind == LDR else '.exr'}"

    def mask(self, folder: Path) -> Path:
        """Its mask, of blender_LDR where that has the folder."""
        kind = LDR if (folder / LDR / self.capture / f"{self.split}_mask").is_dir() else HDR
        return folder / kind / self.capture / f"{self.split}_mask" / f"{self.id}.png"

    def truth(self, folder: Path, kind: str, suffix: str) -> Path:
        """Its file below ground_truth."""
        return folder / TRUTH / self.capture / kind / f"{self.id}{suffix}"

    def camera(self, height: int, width: int) -> Camera:
        """The contract's camera, with the vertical field of view."""
        return Camera(math.degrees(2 * math.atan(math.tan(self.angle_x / 2) * height / width)))

    @property
    def matrix(self) -> Float[np.ndarray, "4 4"]:
        return np.array(self.pose, np.float64)


@dataclass(frozen=True)
class Capture:
    """One object in one place."""

    name: str  # of its folder
    object: str  # the object, in every place
    test: tuple[Photograph, ...]  # photographs that maps are asked of
    train: tuple[Photograph, ...]  # the other photographs
    novel: tuple[Photograph, ...]  # photographs of the object elsewhere, posed in this capture's world
    files: tuple[Path, ...]  # the transforms_*.json that say so

    def nearest(self, novel: Photograph, tolerance_deg: float) -> Photograph | None:
        """The photograph of this capture from nearly the same camera as a novel frame's; None where there is none."""
        near = [(difference_deg(frame, novel), frame) for frame in (*self.test, *self.train)]
        best = min(near, key=lambda item: item[0], default=None)
        return best[1] if best is not None and best[0] <= tolerance_deg else None


def difference_deg(a: Photograph, b: Photograph) -> float:
    """How far two cameras of one world differ, degrees.

    The largest of the turn between them, the angle under which their distance is seen from a's distance to the origin
    (where the object is), and the difference of their fields of view.
    """
    p, q = a.matrix, b.matrix
    turn = math.acos(float(np.clip((np.trace(p[:3, :3].T @ q[:3, :3]) - 1) / 2, -1, 1)))
    shift = math.atan2(float(np.linalg.norm(p[:3, 3] - q[:3, 3])), float(np.linalg.norm(p[:3, 3])))
    return math.degrees(max(turn, shift, abs(a.angle_x - b.angle_x)))


def captures(folder: Path) -> tuple[list[Capture], list[str]]:
    """The captures below blender_LDR, and a line for each thing that is wrong with their transforms."""
    found, problems = [], []
    for path in sorted(p for p in (folder / LDR).iterdir() if p.is_dir()):
        split_frames: dict[str, tuple[Photograph, ...]] = {}
        files = [path / f"transforms_{split}.json" for split in ("test", "train", "novel")]
        for split, file in zip(("test", "train", "novel"), files, strict=True):
            try:
                split_frames[split] = read_frames(file, path.name) if file.is_file() or split == "test" else ()
            except UnirenderError as error:
                problems.append(str(error))
                split_frames[split] = ()
        there = tuple(file for file in files if file.is_file())
        found.append(Capture(path.name, object_of(path.name), **split_frames, files=there))
    return found, problems


def object_of(capture: str) -> str:
    """The object's name in a capture's; the whole name where it has another form."""
    matches = (pattern.fullmatch(capture) for pattern in NAMES)
    return next((match["object"] for match in matches if match), capture)


def read_frames(path: Path, capture: str) -> tuple[Photograph, ...]:
    """The frames of a transforms_*.json.

    Raises:
        UnirenderError: no readable file, another layout, or a pose that is no rotation and position.
    """

    def frames(content: Any) -> tuple[Photograph, ...]:
        return tuple(_frame(entry, content, capture) for entry in content["frames"])

    layout = "frames with file_path and a 4 x 4 transform_matrix, and camera_angle_x in radians"
    return parsed_json(path, frames, layout)


def _frame(entry: dict[str, Any], content: dict[str, Any], capture: str) -> Photograph:
    pose = np.asarray(entry["transform_matrix"], np.float64)
    angle = float(content["camera_angle_x"] if "camera_angle_x" in content else entry["camera_angle_x"])
    if pose.shape != (4, 4) or not np.isfinite(pose).all():
        raise ValueError(f"a transform_matrix of {pose.shape}")
    if not 0 < angle < math.pi:
        raise ValueError(f"camera_angle_x {angle:g}")
    file = PurePosixPath(entry["file_path"])
    turn, scale = pose[:3, :3], float(np.cbrt(np.linalg.det(pose[:3, :3])))
    if scale <= 0 or np.abs(turn.T @ turn / scale**2 - np.eye(3)).max() >= ROTATION_TOLERANCE:
        raise UnirenderError(
            f"frame {file}: the transform_matrix is no rotation, position and scale, expected camera to world without "
            "mirroring or shear"
        )
    pose[:3, :3] = turn / scale  # captures that are aligned with one another may be scaled
    rows = tuple(tuple(float(x) for x in row) for row in pose)
    return Photograph(str(entry.get("scene_name", capture)), file.parent.name, file.stem, angle, rows)


def relightings(all_captures: Sequence[Capture]) -> list[tuple[Capture, Photograph]]:
    """Every novel frame of every capture whose own capture is there."""
    names = {capture.name for capture in all_captures}
    return [(capture, frame) for capture in all_captures for frame in capture.novel if frame.capture in names]
