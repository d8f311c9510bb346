"""Coverage of all views as a differentiable picture: the object as an area emitter of radiance 1.

Coverage has no gradient in `prb`, and none in the projective integrators either as long as the object is no emitter:
alpha is not differentiated. Seen as a lamp, the object's radiance is its coverage, and `direct_projective` samples the
outlines.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from unirender.errors import UnirenderError
from unirender_reference.backend import mitsuba
from unirender_reference.optimize.textured_scene import moving_sensor
from unirender_reference.optimize.views import View
from unirender_reference.passes import derive_seed
from unirender_reference.scene import OBJECT, parameter_name, sensor_at
from unirender_reference.shader import gradient
from unirender_reference.shapes import MeshObject

EMITTER = {"type": "area", "radiance": {"type": "rgb", "value": 1.0}}


class MaskScene:
    """Renders the coverage of a mesh from all views, and differentiates it with respect to the vertices.

    Args:
        obj: the mesh.
        views: cameras; all pictures have one size.
    """

    def __init__(self, obj: MeshObject, views: Sequence[View]) -> None:
        mi = mitsuba()
        self.height, self.width = views[0].image.shape[:2]
        mesh = emitting_mesh(obj)
        self._scene = mi.load_dict({"type": "scene", OBJECT: mesh})
        self._sensors = [moving_sensor(sensor_at(view.pose, view.camera, self.height, self.width)) for view in views]
        # No light but the lamp's own, no shadows: outlines are all that a vertex can move.
        self._integrator = mi.load_dict({"type": "direct_projective", "sppi": 0})
        self._parameters = mi.traverse(self._scene)
        self._key = parameter_name(self._parameters, "vertex_positions")

    def image(self, vertices: Float[np.ndarray, "v 3"], spp: int, seed: int) -> Float[np.ndarray, "n h w 1"]:
        """Coverage of each view."""
        import drjit as dr

        mi = mitsuba()
        self._show(vertices)
        found = []
        for index, sensor in enumerate(self._sensors):
            drawn = dr.opaque(mi.UInt32, derive_seed(seed, "mask", index))
            found.append(
                np.array(mi.render(self._scene, sensor=sensor, integrator=self._integrator, spp=spp, seed=drawn))
            )
        return np.stack(found)[..., :1]

    def gradients(
        self, vertices: Float[np.ndarray, "v 3"], mask_gradient: Float[np.ndarray, "n h w 1"], spp: int, seed: int
    ) -> Float[np.ndarray, "v 3"]:
        """Derivatives of sum(mask_gradient * image) with respect to the vertices.

        Raises:
            UnirenderError: the mask gradient has another size or is not finite.
        """
        import drjit as dr

        mi = mitsuba()
        expected = (len(self._sensors), self.height, self.width, 1)
        if mask_gradient.shape != expected or not np.isfinite(mask_gradient).all():
            raise UnirenderError(
                f"mask scene: got a mask gradient of shape {mask_gradient.shape}, expected finite {expected}"
            )
        attached = self._show(vertices, attach=True)
        for index, (sensor, wanted) in enumerate(zip(self._sensors, mask_gradient, strict=True)):
            grad = np.zeros((self.height, self.width, 4), np.float32)
            grad[..., :1] = wanted
            drawn = dr.opaque(mi.UInt32, derive_seed(seed, "mask gradient", index))
            self._integrator.render_backward(self._scene, None, mi.TensorXf(grad), sensor, drawn, spp)
        return gradient(attached).reshape(vertices.shape)

    def _show(self, vertices: Float[np.ndarray, "v 3"], attach: bool = False) -> Any:
        import drjit as dr

        made = mitsuba().Float(np.ascontiguousarray(vertices, np.float32).ravel())
        if attach:
            dr.enable_grad(made)
        self._parameters[self._key] = made
        self._parameters.update()
        return made


def emitting_mesh(obj: MeshObject) -> Any:
    """The object's faces as a lamp, without shading normals."""
    mi = mitsuba()
    properties = mi.Properties()
    properties["emitter"] = mi.load_dict(EMITTER)
    mesh = mi.Mesh(OBJECT, vertex_count=len(obj.vertices), face_count=len(obj.faces), props=properties)
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = np.ascontiguousarray(obj.vertices, np.float32).ravel()
    parameters["faces"] = np.ascontiguousarray(obj.faces, np.uint32).ravel()
    parameters.update()
    return mesh
