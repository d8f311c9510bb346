"""What the optimiser finds: an object with its textures, and the light."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from unirender.errors import UnirenderError
from unirender.shown import short_repr
from unirender_reference.envmap import envmap_data
from unirender_reference.shapes import MeshObject


@dataclass(frozen=True)
class Solution:
    """An object and its light.

    Attributes:
        obj: the mesh with `albedo` (h, w, 3), `roughness` (h, w) and `metallic` (h, w) textures.
        environment: (eh, ew, 3) linear radiance in world axes, display units, on the grid of Mitsuba's `envmap`.
    """

    obj: MeshObject
    environment: Float[np.ndarray, "eh ew 3"]

    __repr__ = short_repr

    def __post_init__(self) -> None:
        missing = [name for name in ("roughness", "metallic") if getattr(self.obj, name) is None]
        if self.obj.albedo.ndim != 3 or missing:
            raise UnirenderError(
                f"solution: {self.obj.name} lacks textures ({', '.join(missing) or 'albedo is one colour'}); expected "
                "albedo, roughness and metallic textures"
            )
        envmap_data(self.environment)  # checks
