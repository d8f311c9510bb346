"""Mitsuba's sensors: the contract's camera at its framing distance, or at a pose."""

from typing import Any

import numpy as np
from jaxtyping import Float

from unirender.camera import Camera
from unirender.errors import UnirenderError
from unirender.intrinsics import as_numbers
from unirender_reference.backend import mitsuba

NEAR_CLIP, FAR_CLIP = 0.01, 1e4  # the second is Mitsuba's own
ROTATION_TOLERANCE = 1e-3  # of a pose


def sensor_dict(camera: Camera, height: int, width: int) -> dict[str, Any]:
    """The pinhole camera at its framing distance, RGBA film, box filter (renders are bit-identical for equal seeds)."""
    mi = mitsuba()
    to_world = mi.ScalarTransform4f().look_at(origin=[0, 0, camera.distance()], target=[0, 0, 0], up=[0, 1, 0])
    return {
        "type": "perspective",
        "fov": camera.fov_deg,
        "fov_axis": "y",
        **clips(camera.distance()),
        "principal_point_offset_x": 0.5 - camera.principal[0],
        "principal_point_offset_y": 0.5 - camera.principal[1],
        "to_world": to_world,
        "film": {
            "type": "hdrfilm",
            "width": width,
            "height": height,
            "pixel_format": "rgba",
            "component_format": "float32",
            "rfilter": {"type": "box"},
        },
        "sampler": {"type": "multijitter"},
    }


def check_pose(pose: Any, name: str = "pose") -> None:
    """Looks at a pose that somebody handed in.

    Raises:
        UnirenderError: it is no (4, 4) matrix of a rotation and a position.
    """
    matrix = as_numbers(name, pose).astype(np.float64)
    matrix = matrix if matrix.shape == (4, 4) and np.isfinite(matrix).all() else np.zeros((4, 4))
    turn, off = matrix[:3, :3], np.abs(matrix[3] - [0, 0, 0, 1]).max()
    if max(off, np.abs(turn.T @ turn - np.eye(3)).max()) >= ROTATION_TOLERANCE or np.linalg.det(turn) < 0:
        raise UnirenderError(
            f"{name}: the pose is no rotation and position; expected a (4, 4) camera-to-world matrix without scale or "
            "mirroring, and the position in its last column"
        )


def sensor_at(pose: Float[np.ndarray, "4 4"], camera: Camera, height: int, width: int) -> dict[str, Any]:
    """The contract's sensor, moved to a pose: (4, 4) camera to world.

    Raises:
        UnirenderError: as `check_pose`.
    """
    check_pose(pose)
    mi = mitsuba()
    turned = np.array(pose, np.float64)
    turned[:3, [0, 2]] *= -1  # Mitsuba's camera looks along its +z, with +x to the left
    sensor = sensor_dict(camera, height, width)
    sensor.pop("far_clip", None)
    return {**sensor, **clips(float(np.linalg.norm(turned[:3, 3]))), "to_world": mi.ScalarTransform4f(turned)}


def clips(distance: float) -> dict[str, float]:
    """The depths between which a camera at this distance sees the unit sphere.

    Mitsuba's rays begin at the near one. Cameras that these depths suit keep `NEAR_CLIP` and Mitsuba's own far one,
    so that their pictures stay the same to the bit; inside the sphere there is no better one.
    """
    gap = distance - 1
    found = {"near_clip": gap / 2 if 0 < gap <= NEAR_CLIP else NEAR_CLIP}
    return found if distance + 1 < FAR_CLIP else {**found, "far_clip": 2 * distance}
