"""The differentiable shader: one surface point per pixel, one bounce of light.

The radiance that leaves pixel x towards the viewer along v, with normal n and the principled BSDF f of the pixel, is
the rendering equation (paper Eq. 1) under a distant light E:

    L(x) = integral of f(l, v) E(l) V(x, l) max(n . l, 0) dl

with V = 1 (no geometry), or the visibility of the light from the points of a known mesh that the pixel shows. A sample
draws two directions, one from the light and one from the BSDF; under the balance heuristic each of them counts

    f E V max(n . l, 0) / (p_light + p_bsdf).

Differentiation is *detached*: directions and densities are drawn with the present maps and light and then held fixed,
only f, n and E are differentiated. The domain (all directions) does not move with any map, V belongs to the mesh and
not to the normals, and f max(n . l, 0) is 0 on the horizon. The gradient is therefore unbiased, with no boundary terms.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from jaxtyping import Float

from unirender.camera import Camera
from unirender.errors import UnirenderError
from unirender_reference.arrays import aligned, components
from unirender_reference.backend import mitsuba
from unirender_reference.envmap import envmap_rows
from unirender_reference.samplers import stratified_sampler
from unirender_reference.scene import mesh_shape
from unirender_reference.sensors import sensor_dict
from unirender_reference.shapes import MeshObject

LEAST_FACING = 0.01  # cosine to which normals that face away from the viewer are bent
MOST_METALLIC = 1 - 1e-6  # at 1 Mitsuba leaves out the diffuse lobe, and its derivative with it
MATERIAL = {"albedo": ("base_color", 3), "roughness": ("roughness", 1), "metallic": ("metallic", 1)}
Parameter = Literal["albedo", "normal", "roughness", "metallic", "environment"]
PARAMETERS: tuple[Parameter, ...] = ("albedo", "normal", "roughness", "metallic", "environment")


@dataclass(frozen=True)
class Lanes:
    """The samples of one wavefront: `spp` consecutive ones belong to a pixel of the support.

    Attributes:
        pixel: flat index of each sample's pixel in the frame.
        point: surface interaction of each sample; its shading frame is attached to the normals.
        share: what a sample counts in its pixel's mean.
        traced: whether V is traced from `point` (False: nothing hides the light from it).
        spp: samples per pixel.
    """

    pixel: Any
    point: Any
    share: Any
    traced: Any
    spp: int


@dataclass(frozen=True)
class Directions:
    """Directions of the light for all samples, with 1 / (p_light + p_bsdf); constants of the differentiation."""

    towards: Any
    weight: Any


class Shader:
    """Shades the pixels of one picture; camera, support and geometry are fixed, maps and light are parameters.

    All tensors are Dr.Jit's `TensorXf`, image-aligned ones (h, w, c), the light (eh, ew, 3) in camera axes. Values of
    albedo, roughness and metallic outside [0, 1] count as the nearest end, a metallic of 1 as `MOST_METALLIC`; the
    derivative there is that of the end (an optimiser clips after its step). Normals need not have length 1; those that
    face away from the viewer are bent until they do not.

    Args:
        mask: coverage, [0, 1]; pixels with more than 0 are shaded, and the image is premultiplied by it.
        camera: the contract's camera.
        geometry: the object that the picture shows, for shadows; None: nothing is hidden.
    """

    def __init__(self, mask: Float[np.ndarray, "h w 1"], camera: Camera, geometry: MeshObject | None = None) -> None:
        mi = mitsuba()
        self.height, self.width = mask.shape[:2]
        inside = mask[..., 0] > 0
        if not inside.any():
            raise UnirenderError("shader: the mask is empty, expected at least one pixel to shade")
        self.points = int(inside.sum())
        self.coverage = mi.Float(aligned(mask[inside][:, 0]))
        self._pixel = mi.UInt32(aligned(np.flatnonzero(inside).astype(np.uint32)))
        self._view = mi.Vector3f(*components(camera.view_directions(self.height, self.width)[inside]))
        first = mi.Bitmap(np.ones((3, 4, 3), np.float32))
        scene: dict[str, Any] = {"type": "scene", "light": {"type": "envmap", "bitmap": first}}
        if geometry is not None:
            scene["sensor"] = sensor_dict(camera, self.height, self.width)
            scene["object"] = mesh_shape(geometry, {"type": "diffuse"})
        self._geometry = geometry is not None
        self._scene = mi.load_dict(scene)
        self._light = self._scene.environment()
        self._light_parameters = mi.traverse(self._light)
        maps = {plugin: self._blank_map(channels) for plugin, channels in MATERIAL.values()}
        self._bsdf = mi.load_dict({"type": "principled", **maps})
        self._bsdf_parameters = mi.traverse(self._bsdf)

    def image(self, maps: Mapping[str, Any], environment: Any, spp: int, seed: int) -> Any:
        """The image (h, w, 3), linear, premultiplied by the mask, attached to whatever is attached in the arguments.

        All samples are one wavefront: `shade_gradients` splits it and needs memory for a part only.

        Args:
            maps: `albedo`, `normal`, `roughness` and `metallic`.
            environment: radiance, not negative, some of it positive.
            spp: samples per pixel, a full multi-jittered grid (4, 6, 9, 16, 64, ...).
            seed: equal seeds draw equal samples.
        """
        import drjit as dr

        mi = mitsuba()
        radiance = self.radiance(maps, environment, spp, seed)
        dr.eval(radiance)  # block_sum would trace again for every channel
        image = dr.zeros(mi.Float, self.height * self.width * 3)
        for channel, values in enumerate(radiance):
            dr.scatter(image, dr.block_sum(values, spp) * self.coverage, self._pixel * 3 + channel)
        return mi.TensorXf(image, shape=(self.height, self.width, 3))

    def backward(self, maps: Mapping[str, Any], environment: Any, image_gradient: Any, spp: int, seed: int) -> None:
        """Adds the derivatives of sum(image_gradient * image) to the gradients of whatever is attached.

        Nothing of the image is kept: samples are drawn, reflected and differentiated in one kernel.

        Args:
            image_gradient: (h, w, 3), constant.
            maps, environment, spp, seed: as in `image`.
        """
        import drjit as dr

        mi = mitsuba()
        radiance = self.radiance(maps, environment, spp, seed)
        owner = dr.arange(mi.UInt32, self.points * spp) // spp
        weight = dr.gather(mi.Color3f, image_gradient.array, dr.gather(mi.UInt32, self._pixel, owner))
        dr.backward(dr.sum(radiance * weight * dr.gather(mi.Float, self.coverage, owner)))

    def radiance(self, maps: Mapping[str, Any], environment: Any, spp: int, seed: int) -> Any:
        """What each sample adds to its pixel's radiance: `spp` consecutive values for each pixel of the support."""
        self.set(maps, environment)
        sampler = stratified_sampler(spp, self.points * spp, seed)
        lanes = self.lanes(maps["normal"], sampler, spp)
        return sum(self.reflected(lanes, drawn) for drawn in self.directions(lanes, sampler))

    def set(self, maps: Mapping[str, Any], environment: Any) -> None:
        """Puts maps and light into the BSDF and the emitter; normals enter with `lanes`.

        Raises:
            UnirenderError: a map has another size.
        """
        import drjit as dr

        mi = mitsuba()
        for name, (plugin, channels) in MATERIAL.items():
            if maps[name].shape != (self.height, self.width, channels):
                size = (self.height, self.width, channels)
                raise UnirenderError(f"shader {name}: got shape {maps[name].shape}, expected {size}")
            values = maps[name].array
            most = MOST_METALLIC if name == "metallic" else 1
            clipped = dr.replace_grad(dr.clip(values, 0, most), values)
            self._bsdf_parameters[f"{plugin}.data"] = mi.TensorXf(clipped, shape=maps[name].shape)
        self._bsdf_parameters.update()
        self._light_parameters["data"] = wrapped(environment)
        self._light_parameters.update()

    def lanes(self, normal: Any, sampler: Any, spp: int) -> Lanes:
        """The samples' points: on the known geometry through random places of the pixel, or just anywhere."""
        import drjit as dr

        mi = mitsuba()
        index = dr.arange(mi.UInt32, self.points * spp) // spp
        pixel, view = dr.gather(mi.UInt32, self._pixel, index), dr.gather(mi.Vector3f, self._view, index)
        point = dr.zeros(mi.SurfaceInteraction3f, self.points * spp)
        share, traced = mi.Float(1 / spp), mi.Bool(False)
        row, column = pixel // self.width, pixel % self.width
        if self._geometry:
            corner = mi.Point2f(mi.Float(column), mi.Float(row))
            position = (corner + sampler.next_2d()) / mi.Point2f(self.width, self.height)
            ray, _ = self._scene.sensors()[0].sample_ray(0.0, 0.5, position, mi.Point2f(0.5))
            hit = self._scene.ray_intersect(ray, mi.RayFlags.Minimal, coherent=True)
            traced = hit.is_valid()
            found = dr.gather(mi.Float, dr.block_sum(mi.Float(traced), spp), index)
            share = dr.select(found > 0, dr.select(traced, dr.rcp(found), 0.0), share)
            point.p, point.n = hit.p, hit.n
        point.t = mi.Float(1.0)
        point.uv = mi.Point2f((mi.Float(column) + 0.5) / self.width, (mi.Float(row) + 0.5) / self.height)
        point.sh_frame = mi.Frame3f(facing(dr.gather(mi.Vector3f, normal.array, pixel), view))
        point.wi = point.to_local(view)
        return Lanes(pixel, point, share, traced, spp)

    def directions(self, lanes: Lanes, sampler: Any) -> tuple[Directions, Directions]:
        """One direction from the light and one from the BSDF for every sample, detached."""
        import drjit as dr

        mi = mitsuba()
        context, point = mi.BSDFContext(), lanes.point
        with dr.suspend_grad():
            lit, _ = self._light.sample_direction(point, sampler.next_2d())
            total = lit.pdf + self._bsdf.pdf(context, point, point.to_local(lit.d))
            from_light = Directions(lit.d, dr.select(lit.pdf > 0, dr.rcp(total), 0))
            drawn, _ = self._bsdf.sample(context, point, sampler.next_1d(), sampler.next_2d())
            reflected = dr.zeros(mi.DirectionSample3f, dr.width(lanes.pixel))
            reflected.d = point.to_world(drawn.wo)
            total = drawn.pdf + self._light.pdf_direction(point, reflected)
            from_bsdf = Directions(reflected.d, dr.select(drawn.pdf > 0, dr.rcp(total), 0))
        return from_light, from_bsdf

    def reflected(self, lanes: Lanes, directions: Directions) -> Any:
        """Light of the given directions that the points reflect to the viewer, times weight and share; attached."""
        import drjit as dr

        mi = mitsuba()
        point = lanes.point
        sky = dr.zeros(mi.SurfaceInteraction3f, dr.width(lanes.pixel))
        sky.wi = -directions.towards
        reflectance = self._bsdf.eval(mi.BSDFContext(), point, point.to_local(directions.towards))
        value = reflectance * self._light.eval(sky)
        counts = directions.weight > 0
        if self._geometry:
            asked = counts & lanes.traced & (dr.max(dr.detach(reflectance)) > 0)
            counts &= ~self._scene.ray_test(point.spawn_ray(directions.towards), asked)
        return dr.select(counts, value * directions.weight * lanes.share, 0)

    def _blank_map(self, channels: int) -> dict[str, Any]:
        bitmap = mitsuba().Bitmap(np.full((self.height, self.width, channels), 0.5, np.float32))
        return {"type": "bitmap", "bitmap": bitmap, "raw": True, "filter_type": "nearest", "wrap_mode": "clamp"}


def facing(normal: Any, view: Any) -> Any:
    """Unit normals; those that face away from the viewer (averaged or predicted ones may) are bent until they don't."""
    import drjit as dr

    normal = dr.normalize(normal)
    normal = normal + view * dr.maximum(LEAST_FACING - dr.dot(normal, view), 0)
    return dr.normalize(normal)


def wrapped(environment: Any) -> Any:
    """A light (eh, ew, 3) as Mitsuba's `envmap` stores it: a copy of the last column before it, of the first behind.

    The tensor stays attached: the gradient of both copies returns to the columns that they came from, and that of the
    rows between those of a light with bright poles to their neighbours (`envmap.envmap_rows`).
    """
    import drjit as dr

    mi = mitsuba()
    height, width, _ = environment.shape
    rows = len(envmap_rows(environment.numpy()))
    # Not from numpy, whose memory may be gone while the kernel that gathers still runs.
    place = dr.arange(mi.UInt32, rows * (width + 2) * 3)
    row, channel = place // (3 * (width + 2)), place % 3
    column = (place // 3 % (width + 2) + width - 1) % width

    def texels(row: Any) -> Any:
        return dr.gather(mi.Float, environment.array, (row * width + column) * 3 + channel)

    data = (texels(row // 2) + texels((row + 1) // 2)) / 2 if rows > height else texels(row)
    return mi.TensorXf(data, shape=(rows, width + 2, 3))


def tensors(values: Mapping[str, Float[np.ndarray, "..."]], attached: Sequence[str] = ()) -> dict[str, Any]:
    """Arrays as tensors; gradients of those named in `attached` are enabled."""
    import drjit as dr

    mi = mitsuba()
    made = {name: mi.TensorXf(aligned(np.asarray(array, np.float32))) for name, array in values.items()}
    for name in attached:
        dr.enable_grad(made[name])
    return made


def gradient(tensor: Any) -> Float[np.ndarray, "..."]:
    """What differentiation has added up for an attached tensor."""
    import drjit as dr

    return np.array(dr.grad(tensor))
