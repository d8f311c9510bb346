"""Inverse rendering of one picture by optimisation, as a benchmark method: NvDiffRec's kind, and ours refined by it.

The optimiser (`unirender_reference.optimize.single.run`) finds albedo, roughness, metallic and the light; Mitsuba
renders the edited and the relit surface (`unirender_reference.shade`).
"""

from collections.abc import Mapping
from dataclasses import asdict
from functools import partial
from typing import Any

import numpy as np
from jaxtyping import Float

from unirender.camera import Camera
from unirender.composite import split_sum_image
from unirender.intrinsics import Intrinsics
from unirender_evaluation.methods.decompositions import Decompositions
from unirender_evaluation.methods.method import Image, Mask
from unirender_reference.shapes import MeshObject

SHADE_SPP = 256
OPTIMISER = "NvDiffRec (Mitsuba)"
REFINED = "Ours + Mitsuba refinement"


class OptimizedMethod:
    """Optimisation of one picture.

    Without a mesh the normals are those of the prediction it starts from, or what the silhouette suggests. Given one (a
    row that is told the true shape), its normals and shadows are used.

    Args:
        name: of the row.
        base: a method whose decomposition is the start; None: a start from nothing.
        config: `SingleConfig` of the optimiser; None: its default.
    """

    def __init__(self, name: str, base: Any = None, config: Any = None) -> None:
        from unirender_reference.optimize.single.config import SingleConfig

        self.name, self.base = name, base
        self.settings = SingleConfig() if config is None else config
        self._found = Decompositions[Intrinsics]()

    @property
    def config(self) -> Mapping[str, Any]:
        start = {} if self.base is None else {"start": dict(self.base.config)}
        return {"optimize_image": asdict(self.settings), "shade": SHADE_SPP, **start}

    def decompose(
        self, image_srgb: Image, mask: Mask, camera: Camera, geometry: MeshObject | None = None
    ) -> Intrinsics:
        """The maps and the light of a picture; found once, since edits and relighting ask again."""
        mesh = b"" if geometry is None else geometry.vertices.tobytes() + geometry.faces.tobytes()
        make = partial(self._optimize, image_srgb, mask, camera, geometry)
        return self._found.of(image_srgb, mask, camera, make, told=mesh)[0]

    def _optimize(self, image_srgb: Image, mask: Mask, camera: Camera, geometry: MeshObject | None) -> Intrinsics:
        from unirender_reference.optimize.single.run import optimize_image

        init = None if self.base is None else self.base.decompose(image_srgb, mask, camera)
        return optimize_image(image_srgb, mask, camera, self.settings, geometry=geometry, init=init)

    def edit(
        self,
        image_srgb: Image,
        mask: Mask,
        camera: Camera,
        roughness: float | None = None,
        metallic: float | None = None,
        geometry: MeshObject | None = None,
    ) -> Image:
        found = self.decompose(image_srgb, mask, camera, geometry)
        inside = (mask > 0).astype(np.float32)
        material = {"roughness": roughness, "metallic": metallic}
        changes = {name: inside * np.float32(value) for name, value in material.items() if value is not None}
        return _rendered(found.replace(**changes), geometry)

    def relight(
        self,
        image_srgb: Image,
        mask: Mask,
        camera: Camera,
        environment: Float[np.ndarray, "eh ew 3"] | None = None,
        specular: Image | None = None,
        diffuse: Image | None = None,
        geometry: MeshObject | None = None,
    ) -> Image:
        """Under an environment Mitsuba renders; s and d given, the picture follows in closed form (split-sum)."""
        found = self.decompose(image_srgb, mask, camera, geometry)
        if environment is not None:
            return _rendered(found.replace(environment=environment), geometry)
        return split_sum_image(found.replace(specular=specular, diffuse=diffuse, environment=None))


def _rendered(maps: Intrinsics, geometry: MeshObject | None) -> Image:
    from unirender_reference.shade import shade

    return shade(maps, spp=SHADE_SPP, geometry=geometry)
