"""What a light from the image must beat: rows that look at no more than the picture's brightness, or at nothing."""

from typing import Any

import numpy as np

from unirender.camera import Camera
from unirender.intrinsics import Intrinsics
from unirender_evaluation.light_metrics import SHAPE
from unirender_evaluation.methods.method import Image, Mask, seen_linear
from unirender_evaluation.training_statistics import light_statistics
from unirender_reference.optimize.single.config import COLD


class UniformLight:
    """White light from everywhere, as bright as the picture: its mean radiance over the training objects' mean albedo,
    which is the one that optimisation begins with."""

    name = "uniform light"

    @property
    def config(self) -> dict[str, Any]:
        return {"trivial": "uniform-light", "albedo": COLD["albedo"]}

    def decompose(self, image_srgb: Image, mask: Mask, camera: Camera) -> Intrinsics:
        mean = seen_linear(image_srgb, mask).sum(dtype=np.float64) / (3 * mask.sum(dtype=np.float64))
        # In uniform light L a surface sends out nearly albedo x L.
        light = np.full((*SHAPE, 3), mean / COLD["albedo"], np.float32)
        return Intrinsics(environment=light, mask=mask, camera=camera)


class MeanLight:
    """The training lights' mean at each height above the horizon, the mean taken of ln(radiance + 0.01), as bright as
    they are: what one knows of the light without the picture."""

    name = "mean light"

    @property
    def config(self) -> dict[str, Any]:
        return {"trivial": "mean-light", "rows": light_statistics()["rows"]}

    def decompose(self, image_srgb: Image, mask: Mask, camera: Camera) -> Intrinsics:
        rows = np.array(light_statistics()["rows"], np.float32)
        light = np.repeat(rows[:, None], SHAPE[1], axis=1)
        return Intrinsics(environment=light, mask=mask, camera=camera)
