"""Pictures of an object from cameras around it, rendered like every ground truth: path traced, NaN repaired.

World axes are those of the object; the environment is given in them, so that all cameras see one light. For the camera
of the contract (`pose_towards` of azimuth 0, elevation 0) they are the camera's axes.
"""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from unirender.camera import Camera
from unirender_reference.passes import TRUTH_BATCHES, Counters, Estimate, derive_seed, mean_estimate, render_passes
from unirender_reference.render import IMAGE_DEPTH
from unirender_reference.scene import EditableScene, sensor_dict
from unirender_reference.shapes import MeshObject

ELEVATIONS_DEG = (0.0, 25.0, -15.0, 35.0, -25.0, 15.0, -35.0, 20.0)  # of an orbit, in turn


def pose_towards(azimuth_deg: float, elevation_deg: float, camera: Camera) -> Float[np.ndarray, "4 4"]:
    """A camera at its framing distance that looks at the origin: (4, 4) camera to world, +y up in the picture.

    Args:
        azimuth_deg: about +y, from +z (0) towards +x (90).
        elevation_deg: above the horizon, within (-90, 90).
    """
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
    """`count` cameras around the object, evenly in azimuth, with elevations in turn; the first looks from the front."""
    return [
        pose_towards(start_deg + 360.0 * k / count, ELEVATIONS_DEG[k % len(ELEVATIONS_DEG)], camera)
        for k in range(count)
    ]


def sensor_at(pose: Float[np.ndarray, "4 4"], camera: Camera, height: int, width: int) -> dict[str, Any]:
    """The contract's sensor, moved to a pose."""
    from unirender_reference.backend import mitsuba

    mi = mitsuba()
    turned = np.array(pose, np.float64)
    turned[:3, [0, 2]] *= -1  # Mitsuba's camera looks along its +z, with +x to the left
    return {**sensor_dict(camera, height, width), "to_world": mi.ScalarTransform4f(turned)}


class ViewRenderer:
    """Renders one object under any light, with any material, from any camera.

    Args:
        obj: the object.
        camera: field of view and principal point of all cameras.
        resolution: height and width in pixels.
    """

    def __init__(self, obj: MeshObject, camera: Camera | None = None, resolution: int = 64) -> None:
        self.camera = camera or Camera()
        self.resolution = resolution
        self.scene = EditableScene(obj, self.camera, resolution)
        self.counters = Counters()

    def image(
        self,
        pose: Float[np.ndarray, "4 4"],
        environment: Float[np.ndarray, "eh ew 3"],
        roughness: float | None,
        metallic: float | None,
        spp: int,
        seed: int = 0,
        depth: int = IMAGE_DEPTH,
        batches: int = TRUTH_BATCHES,
    ) -> Estimate:
        """Premultiplied linear RGBA; roughness or metallic None: the object's own map."""
        from unirender_reference.backend import mitsuba

        scene = self.scene.show("principled", {"roughness": roughness, "metallic": metallic}, environment)
        sensor = mitsuba().load_dict(sensor_at(pose, self.camera, self.resolution, self.resolution))
        own = derive_seed(seed, "image")
        return mean_estimate(*render_passes(scene, depth, spp, own, batches, self.counters, sensor), batches)

    def images(
        self,
        poses: Sequence[Float[np.ndarray, "4 4"]],
        environment: Float[np.ndarray, "eh ew 3"],
        roughness: float | None,
        metallic: float | None,
        spp: int,
        seed: int = 0,
    ) -> list[Estimate]:
        """One image for each pose, each with its own seed."""
        return [
            self.image(pose, environment, roughness, metallic, spp, derive_seed(seed, "view", index))
            for index, pose in enumerate(poses)
        ]
