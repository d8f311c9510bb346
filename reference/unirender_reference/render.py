"""Mitsuba renders of one object with every buffer of the contract.

Buffers other than the image are ratios: coverage-weighted sum over coverage, from the same samples. How passes make an
estimate and its variance: `passes`.

    image   path tracing at `depth` (4: three bounces), premultiplied RGBA, the environment hidden behind the object
    s, d    direct light only (depth 2) on the mirror-tinted and on the white Lambertian surface
"""

import functools
import hashlib
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from unirender.camera import Camera
from unirender.errors import UnirenderError
from unirender.intrinsics import Intrinsics
from unirender_reference import exposure
from unirender_reference.backend import mitsuba
from unirender_reference.lights import Light
from unirender_reference.passes import (
    SAMPLES_PER_PASS,
    TRUTH_BATCHES,
    Counters,
    Estimate,
    derive_seed,
    mean_estimate,
    pass_count,
    ratio_estimate,
    render_passes,
)
from unirender_reference.scene import EditableScene
from unirender_reference.shapes import MeshObject

IMAGE_DEPTH = 4
DIRECT_DEPTH = 2
GEOMETRY_SPP = 256


@dataclass(frozen=True)
class SceneSpec:
    """One sample to render. `exposure_seed` draws the gauge's target; roughness is perceptual."""

    obj: MeshObject
    light: Light
    roughness: float
    metallic: float
    camera: Camera = field(default_factory=Camera)
    resolution: int = 64
    exposure_seed: int = 0


@dataclass(frozen=True)
class Sample:
    """A rendered scene: `image_linear` premultiplied (h, w, 3), complete `intrinsics`, the variance of the means."""

    image_linear: Float[np.ndarray, "h w 3"]
    intrinsics: Intrinsics
    variance: dict[str, Float[np.ndarray, "h w c"]]
    provenance: dict[str, str]


class Renderer:
    """Renders one object under any light and material; its scene loads once, then surface and light change in place.

    Args:
        obj: the object.
        camera: the contract's camera.
        resolution: height and width in pixels.
    """

    def __init__(self, obj: MeshObject, camera: Camera | None = None, resolution: int = 64) -> None:
        if resolution < 1:
            raise UnirenderError(f"resolution: got {resolution}, expected at least 1 pixel")
        self.obj = obj
        self.camera = camera or Camera()
        self.resolution = resolution
        self.counters = Counters()
        self._scene = EditableScene(obj, self.camera, resolution)

    def geometry(self, spp: int = GEOMETRY_SPP, seed: int = 0) -> Intrinsics:
        """Albedo, normal (camera axes) and mask; roughness and metallic are the caller's.

        Base colour is read with `eval_attribute`: Mitsuba's albedo AOV is view-dependent on metals.
        """
        sums = np.zeros((self.resolution, self.resolution, 7), np.float64)
        budget = max(1, SAMPLES_PER_PASS // self.resolution**2)
        count = pass_count(spp, 1, budget)
        for index in range(count):
            sums += self._trace_geometry(spp // count, derive_seed(seed, "geometry", index)) * (spp // count)
        mask = sums[..., :1] / spp
        maps = np.divide(sums[..., 1:], sums[..., :1], out=np.zeros_like(sums[..., 1:]), where=mask > 0)
        length = np.linalg.norm(maps[..., 3:], axis=-1, keepdims=True)
        normal = np.divide(maps[..., 3:], length, out=np.zeros_like(maps[..., 3:]), where=length > 0)
        return Intrinsics(
            albedo=np.clip(maps[..., :3], 0, 1).astype(np.float32),
            normal=normal.astype(np.float32),
            mask=np.clip(mask, 0, 1).astype(np.float32),
            camera=self.camera,
        )

    @functools.cached_property
    def _exposure_mask(self) -> Float[np.ndarray, "h w 1"]:
        mask = self.geometry(exposure.PASS_SPP, exposure.PASS_SEED).mask
        assert mask is not None
        return mask

    def exposure_mask(self) -> Float[np.ndarray, "h w 1"]:
        """The coverage that the gauge uses: always the same samples, traced once."""
        return self._exposure_mask

    def image(
        self,
        environment: Float[np.ndarray, "h w 3"],
        roughness: float,
        metallic: float,
        spp: int,
        seed: int = 0,
        depth: int = IMAGE_DEPTH,
        batches: int = TRUTH_BATCHES,
    ) -> Estimate:
        """The image: premultiplied linear RGBA."""
        scene = self._scene.show("principled", {"roughness": roughness, "metallic": metallic}, environment)
        passes = render_passes(scene, depth, spp, derive_seed(seed, "image"), batches, self.counters)
        return mean_estimate(*passes, batches)

    def diffuse(
        self, environment: Float[np.ndarray, "h w 3"], spp: int, seed: int = 0, batches: int = TRUTH_BATCHES
    ) -> Estimate:
        """d: the white Lambertian surface, direct light, divided by coverage."""
        scene = self._scene.show("white", {}, environment)
        passes = render_passes(scene, DIRECT_DEPTH, spp, derive_seed(seed, "diffuse"), batches, self.counters)
        return ratio_estimate(*passes, batches)

    def specular(
        self,
        environment: Float[np.ndarray, "h w 3"],
        roughness: float,
        spp: int,
        seed: int = 0,
        batches: int = TRUTH_BATCHES,
    ) -> Estimate:
        """s: the mirror-tinted reflector of the same roughness, direct light, divided by coverage."""
        scene = self._scene.show("mirror", {"roughness": roughness}, environment)
        passes = render_passes(scene, DIRECT_DEPTH, spp, derive_seed(seed, "specular"), batches, self.counters)
        return ratio_estimate(*passes, batches)

    def _trace_geometry(self, spp: int, seed: int) -> Float[np.ndarray, "h w 7"]:
        """Mean over `spp` camera rays of (hit, base colour, shading normal), per pixel."""
        mi = mitsuba()
        import drjit as dr

        scene = self._scene.show("principled")
        size, sensor = self.resolution, scene.sensors()[0]
        index = dr.arange(mi.UInt32, size * size * spp)
        pixel = index // spp
        sampler = mi.load_dict({"type": "multijitter", "sample_count": spp})
        sampler.set_samples_per_wavefront(spp)
        sampler.seed(dr.opaque(mi.UInt32, seed), size * size * spp)  # a literal seed would recompile the kernel
        corner = mi.Point2f(mi.Float(pixel % size), mi.Float(pixel // size))
        position = (corner + sampler.next_2d()) / size
        ray, _ = sensor.sample_ray_differential(0.0, 0.5, position, mi.Point2f(0.5))
        hit = scene.ray_intersect(ray)
        valid = hit.is_valid()
        base = hit.bsdf(ray).eval_attribute_3("base_color", hit, valid)
        normal = dr.select(dr.dot(hit.n, ray.d) > 0, -hit.sh_frame.n, hit.sh_frame.n)
        channels = [dr.select(valid, mi.Float(channel), 0.0) for channel in (valid, *base, *normal)]
        dr.eval(channels)  # one kernel; block_sum would trace again for every channel
        means = [dr.block_sum(channel, spp) / spp for channel in channels]
        return np.stack([np.array(mean).reshape(size, size) for mean in means], axis=-1)


def render_sample(spec: SceneSpec, spp: int, seed: int = 0, renderer: Renderer | None = None) -> Sample:
    """The image of a scene and its complete intrinsics, exposure folded into the light, with per-pixel variance.

    Args:
        spec: object, light, material, camera.
        spp: samples per pixel of the image, of s and of d, in `TRUTH_BATCHES` passes.
        seed: another seed gives an independent estimate of the same scene, under the same exposure.
        renderer: reuse this one (of the same object, camera and resolution) instead of loading the scene.
    """
    renderer = renderer or Renderer(spec.obj, spec.camera, spec.resolution)
    if (renderer.obj.name, renderer.camera, renderer.resolution) != (spec.obj.name, spec.camera, spec.resolution):
        raise UnirenderError(
            f"renderer: got one for {renderer.obj.name} at {renderer.resolution} px, expected {spec.obj.name} at "
            f"{spec.resolution} px with the spec's camera; leave `renderer` out"
        )
    factor = exposure.scene_exposure(renderer, spec.light.environment, spec.exposure_seed)
    environment = (spec.light.environment * factor).astype(np.float32)
    geometry = renderer.geometry(max(GEOMETRY_SPP, spp), seed)
    assert geometry.mask is not None
    image = renderer.image(environment, spec.roughness, spec.metallic, spp, seed)
    diffuse = renderer.diffuse(environment, spp, seed)
    specular = renderer.specular(environment, spec.roughness, spp, seed)
    covered = geometry.mask > 0
    intrinsics = geometry.replace(
        roughness=np.where(covered, spec.roughness, 0).astype(np.float32),
        metallic=np.where(covered, spec.metallic, 0).astype(np.float32),
        diffuse=np.where(covered, diffuse.mean, 0),
        specular=np.where(covered, specular.mean, 0),
        environment=environment,
    )
    variance = {
        name: estimate.variance
        for name, estimate in (("image", image), ("diffuse", diffuse), ("specular", specular))
        if estimate.variance is not None
    }
    variance["image"] = variance["image"][..., :3]
    nan_pixels = image.nan_pixels + diffuse.nan_pixels + specular.nan_pixels
    provenance = {
        **renderer_provenance(renderer),
        "spp": str(spp),
        "seed": str(seed),
        "batches": str(TRUTH_BATCHES),
        "depth": str(IMAGE_DEPTH),
        "light": spec.light.name,
        "roughness": f"{spec.roughness:g}",
        "metallic": f"{spec.metallic:g}",
        "exposure_seed": str(spec.exposure_seed),
        "exposure_factor": repr(factor),
        "nan_pixels": str(nan_pixels),
        "scene": scene_hash(spec),
    }
    return Sample(image.mean[..., :3], intrinsics, variance, provenance)


def renderer_provenance(renderer: Renderer) -> dict[str, str]:
    """What rendered, of what, through which camera: header attributes of every file made from it."""
    mi = mitsuba()
    return {
        "mitsuba": mi.__version__,
        "variant": mi.variant(),
        "object": renderer.obj.name,
        "camera": renderer.camera.describe(),
        "resolution": str(renderer.resolution),
    }


def scene_hash(spec: SceneSpec) -> str:
    """sha256 over everything that defines a scene's radiance."""
    return next(scene_hashes([spec]))


def scene_hashes(specs: Iterable[SceneSpec]) -> Iterator[str]:
    """`scene_hash` of each spec; the arrays of an object under a light are read once while they stay the same."""
    shared, obj, light = hashlib.sha256(), None, None
    for spec in specs:
        if spec.obj is not obj or spec.light is not light:
            shared, obj, light = hashlib.sha256(), spec.obj, spec.light
            for array in (obj.vertices, obj.faces, obj.normals, obj.uv, obj.albedo, light.environment):
                shared.update(b"none" if array is None else np.ascontiguousarray(array).tobytes())
        digest = shared.copy()
        values = (spec.roughness, spec.metallic, spec.camera, spec.resolution, spec.exposure_seed)
        digest.update(repr(values).encode())
        yield digest.hexdigest()


def shared_scene_hash(hashes: Iterable[str]) -> str:
    """The scene hash of a member that belongs to several scenes: sha256 over theirs, in order."""
    return hashlib.sha256(" ".join(hashes).encode()).hexdigest()
