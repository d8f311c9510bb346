"""All views of a solution as one differentiable Mitsuba scene: numpy in, numpy out.

One launch renders every camera (Mitsuba's `batch` sensor: the pictures lie side by side on one film), and one launch
differentiates them by path replay (`prb`). Image and gradient are separate calls, with a seed each:

    image = scene.image(maps, spp, seed=2 * step)
    gradients = scene.gradients(maps, loss_gradient(image), spp, seed=2 * step + 1)

A loss that is not linear in the image has a biased gradient if both use the same samples.

`prb` differentiates everything that does not move visibility: albedo, roughness, metallic, light.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from unirender.errors import UnirenderError
from unirender_reference.backend import mitsuba
from unirender_reference.optimize.refine.parameters import NAMES
from unirender_reference.optimize.solution import Solution
from unirender_reference.optimize.solution_scene import solution_scene
from unirender_reference.optimize.views import View
from unirender_reference.passes import NAN_ATTEMPTS, Counters, derive_seed, finite_pass
from unirender_reference.scene import LIGHT, parameter_name
from unirender_reference.sensors import sensor_at
from unirender_reference.shader import MOST_METALLIC, gradient, tensors, wrapped

Maps = Mapping[str, Float[np.ndarray, "..."]]
PLUGIN_MAPS = {"albedo": "base_color", "roughness": "roughness", "metallic": "metallic"}


def maps_of(solution: Solution) -> dict[str, Float[np.ndarray, "..."]]:
    """Textures and light of a solution, by name; copies."""
    obj = solution.obj
    assert obj.roughness is not None
    assert obj.metallic is not None
    return {
        "albedo": obj.albedo.copy(),
        "roughness": obj.roughness.copy(),
        "metallic": obj.metallic.copy(),
        "environment": np.array(solution.environment, np.float32),
    }


class TexturedScene:
    """Renders an object with textures from all views at once, and differentiates what it rendered.

    Images are stacks (n, h, w, 4) of premultiplied linear RGBA, one picture for each view. Maps are those of `maps_of`;
    their sizes stay as they were, one that is left out keeps its last value. A metallic of 1 counts as `MOST_METALLIC`.

    Args:
        solution: mesh, first maps and light.
        views: cameras; all pictures have one size.
        depth: 2 is direct light, 4 three bounces.
    """

    def __init__(self, solution: Solution, views: Sequence[View], depth: int = 4) -> None:
        mi = mitsuba()
        self.count, (self.height, self.width) = len(views), views[0].image.shape[:2]
        self._scene = solution_scene(solution)
        sensors = [sensor_at(view.pose, view.camera, self.height, self.width) for view in views]
        self._batch = mi.load_dict(batch_dict(sensors))
        hidden = {"max_depth": depth, "hide_emitters": True}
        self._path = mi.load_dict({"type": "path", **hidden})
        self._replay = mi.load_dict({"type": "prb", **hidden})
        parameters = mi.traverse(self._scene)
        self._parameters = parameters
        suffixes = {name: f"{plugin}.data" for name, plugin in (*PLUGIN_MAPS.items(), ("environment", LIGHT))}
        self._keys = {name: parameter_name(parameters, suffix) for name, suffix in suffixes.items()}

    def image(self, maps: Maps, spp: int, seed: int) -> Float[np.ndarray, "n h w 4"]:
        """The pictures; equal seeds draw equal samples. Pixels that come out NaN or infinite are drawn again."""
        import drjit as dr

        mi = mitsuba()
        self._show(maps, ())

        def draw(attempt: int) -> Float[np.ndarray, "n h w 4"]:
            drawn = dr.opaque(mi.UInt32, pass_seed(seed, attempt))
            return self._stack(
                np.array(mi.render(self._scene, sensor=self._batch, integrator=self._path, spp=spp, seed=drawn))
            )

        return finite_pass(draw, Counters(), "textured scene")

    def gradients(
        self, maps: Maps, image_gradient: Float[np.ndarray, "n h w 3"], spp: int, seed: int
    ) -> dict[str, Float[np.ndarray, "..."]]:
        """Derivatives of sum(image_gradient * image) with respect to maps, each of its map's shape.

        Args:
            maps: the point at which to differentiate.
            image_gradient: derivative of a loss with respect to the radiance (premultiplied) of `image`.
            spp: samples per pixel.
            seed: equal seeds draw equal samples.

        Raises:
            UnirenderError: the image gradient has another size or is not finite, or derivatives stay NaN.
        """
        expected = (self.count, self.height, self.width, 3)
        if image_gradient.shape != expected or not np.isfinite(image_gradient).all():
            raise UnirenderError(
                f"textured scene: got an image gradient of shape {image_gradient.shape}, expected finite {expected}"
            )
        for attempt in range(NAN_ATTEMPTS + 1):
            attached = self._show(maps, NAMES)
            self._backward(np.concatenate(list(image_gradient), axis=1), spp, pass_seed(seed, attempt))
            found = {name: gradient(tensor) for name, tensor in attached.items()}
            if all(np.isfinite(values).all() for values in found.values()):
                return {name: values.reshape(maps[name].shape) for name, values in found.items()}
        raise UnirenderError(
            f"textured scene: derivatives stay NaN after {NAN_ATTEMPTS} seeds, expected finite values; check the "
            "normals and the light"
        )

    def _show(self, maps: Maps, attached: Sequence[str]) -> dict[str, Any]:
        """Puts maps into the scene; returns the tensors that are differentiated."""
        import drjit as dr

        mi = mitsuba()
        made = tensors(maps, attached)
        for name, tensor in made.items():
            if self._keys.get(name) is None:
                raise UnirenderError(f"textured scene: got a map {name!r}, expected some of {', '.join(self._keys)}")
            if name == "environment":
                value = wrapped(tensor)
            else:
                height, width, *rest = tensor.shape
                most = MOST_METALLIC if name == "metallic" else 1
                clipped = dr.replace_grad(dr.clip(tensor.array, 0, most), tensor.array)
                value = mi.TensorXf(clipped, shape=(height, width, *(rest or [1])))
            self._parameters[self._keys[name]] = value
        self._parameters.update()
        return {name: made[name] for name in attached}

    def _backward(self, wanted: Float[np.ndarray, "h nw 3"], spp: int, seed: int) -> None:
        import drjit as dr

        mi = mitsuba()
        alpha = np.zeros((*wanted.shape[:2], 1), np.float32)
        grad = mi.TensorXf(np.ascontiguousarray(np.concatenate([wanted, alpha], axis=-1), np.float32))
        self._replay.render_backward(self._scene, None, grad, self._batch, dr.opaque(mi.UInt32, seed), spp)

    def _stack(self, film: Float[np.ndarray, "h nw 4"]) -> Float[np.ndarray, "n h w 4"]:
        return np.stack(np.split(film, self.count, axis=1))


def batch_dict(sensors: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """One sensor of many, of equal films: their pictures lie side by side."""
    film = {**sensors[0]["film"], "width": sensors[0]["film"]["width"] * len(sensors)}
    named = {f"view{index:05d}": sensor for index, sensor in enumerate(sensors)}
    return {"type": "batch", "film": film, "sampler": {"type": "multijitter"}, **named}


def pass_seed(seed: int, attempt: int) -> int:
    """Of a picture and of its derivative alike: with one seed both draw the same samples."""
    return derive_seed(seed, "textured scene", attempt)
