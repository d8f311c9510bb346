"""Cameras around an object, for `Renderer.image` and what else takes a pose (camera to world).

World axes are those of the object; the environment is given in them, so that all cameras see one light. For the camera
of the contract (`pose_towards` of azimuth 0, elevation 0) they are the camera's axes.
"""

import math
from numbers import Integral

import numpy as np
from jaxtyping import Float

from unirender.arguments import as_instance
from unirender.camera import Camera
from unirender.errors import UnirenderError

ELEVATIONS_DEG = (0.0, 25.0, -15.0, 35.0, -25.0, 15.0, -35.0, 20.0)  # of an orbit, in turn


def pose_towards(azimuth_deg: float, elevation_deg: float, camera: Camera) -> Float[np.ndarray, "4 4"]:
    """A camera at its framing distance that looks at the origin: (4, 4) camera to world, +y up in the picture.

    Args:
        azimuth_deg: about +y, from +z (0) towards +x (90).
        elevation_deg: above the horizon, within [-90, 90].
        camera: whose framing distance it is (`Camera.distance`).

    Raises:
        UnirenderError: an angle is not finite, the elevation is out of its range, or the camera is none.
    """
    as_instance(camera, Camera, "pose")
    if not (math.isfinite(azimuth_deg) and -90 <= elevation_deg <= 90):
        raise UnirenderError(
            f"pose: got azimuth {azimuth_deg:g} and elevation {elevation_deg:g} degrees, expected a finite azimuth and "
            "an elevation from -90 to 90"
        )
    azimuth, elevation = math.radians(azimuth_deg), math.radians(elevation_deg)
    back = np.array(
        [math.sin(azimuth) * math.cos(elevation), math.sin(elevation), math.cos(azimuth) * math.cos(elevation)]
    )
    right = np.array([math.cos(azimuth), 0.0, -math.sin(azimuth)])
    pose = np.eye(4, dtype=np.float32)
    pose[:3, :3] = np.stack([right, np.cross(back, right), back], axis=1)
    pose[:3, 3] = back * camera.distance()
    return pose


def orbit(count: int, camera: Camera, start_deg: float = 0.0) -> list[Float[np.ndarray, "4 4"]]:
    """`count` cameras around the object, evenly in azimuth, with elevations in turn; the first looks from the front.

    Raises:
        UnirenderError: the number of cameras is no whole one of at least 1, or as `pose_towards`.
    """
    if not isinstance(count, Integral) or count < 1:
        raise UnirenderError(f"orbit: got {count!r:.40} cameras, expected a whole number of at least 1")
    return [
        pose_towards(start_deg + 360.0 * k / count, ELEVATIONS_DEG[k % len(ELEVATIONS_DEG)], camera)
        for k in range(count)
    ]
