"""Mitsuba renders of one object with every buffer of the contract.

s and d are ratios: coverage-weighted sum over coverage, from the same samples. How passes make an estimate and its
variance: `passes`. What belongs to the surface (base colour, normal, ...): `geometry`.

    image   path tracing at `depth` (4: three bounces), premultiplied RGBA, the environment hidden behind the object
    s, d    direct light only (depth 2) on the mirror-tinted and on the white Lambertian surface

All are estimates of the rendering equation (paper Eq. 1), of whose bounces `depth` keeps the first ones.
"""

import functools
from collections.abc import Mapping, Sequence
from numbers import Integral
from typing import Any

import numpy as np
from jaxtyping import Float

from unirender.arguments import as_instance
from unirender.camera import Camera
from unirender.errors import UnirenderError
from unirender.intrinsics import Intrinsics
from unirender.light.environment import as_light
from unirender.system.machine import memory_excess
from unirender_reference import exposure
from unirender_reference.backend import mitsuba
from unirender_reference.editable_scene import EditableScene
from unirender_reference.geometry import geometry_buffers
from unirender_reference.materials import Surface
from unirender_reference.passes import (
    TRUTH_BATCHES,
    Counters,
    Estimate,
    derive_seed,
    mean_estimate,
    ratio_estimate,
    render_passes,
)
from unirender_reference.sample_counts import SAMPLES_PER_PASS, pass_count
from unirender_reference.scene_spec import Sample, SceneSpec, object_hash, scene_hash, scene_hashes, shared_scene_hash
from unirender_reference.sensors import sensor_at
from unirender_reference.shapes import MeshObject

__all__ = [
    "DIRECT_DEPTH",
    "IMAGE_DEPTH",
    "Renderer",
    "Sample",
    "SceneSpec",
    "geometry_spp",
    "material_text",
    "render_sample",
    "renderer_of",
    "renderer_provenance",
    "scene_hash",
    "scene_hashes",
    "shared_scene_hash",
]

IMAGE_DEPTH = 4
DIRECT_DEPTH = 2
UNLIMITED = -1  # as Mitsuba counts bounces
MOST_DEPTH = 2**31 - 1  # that it counts to
GEOMETRY_SPP = 256
LARGE = 128  # pixels along a side; above, edges are a small part of the picture
LARGE_GEOMETRY_SPP = 25  # one jittered 5 x 5 grid: coverage to about 1/25
BYTES_A_PIXEL = 250  # of memory: what a pass of one sample a pixel takes


class Renderer:
    """Renders one object under any light and material; its scene loads once, then surface and light change in place.

    Args:
        obj: the object.
        camera: the contract's camera.
        resolution: height and width in pixels.
    """

    def __init__(self, obj: MeshObject, camera: Camera | None = None, resolution: int = 64) -> None:
        if not isinstance(resolution, Integral) or resolution < 1:
            raise UnirenderError(
                f"resolution: got {resolution!r:.60}, expected a whole number of pixels, at least 1; "
                "pictures are square"
            )
        if excess := memory_excess(BYTES_A_PIXEL * int(resolution) ** 2):
            raise UnirenderError(f"resolution: got {resolution} pixels a side, which {excess}; render fewer")
        self.obj = as_instance(obj, MeshObject, "renderer")
        self.camera = Camera() if camera is None else as_instance(camera, Camera, "renderer")
        self.resolution = resolution
        self.counters = Counters()
        self.scene = EditableScene(obj, self.camera, resolution)

    def __repr__(self) -> str:
        return f"Renderer({self.obj.name}, {self.camera}, resolution={self.resolution})"

    def geometry(
        self, spp: int = GEOMETRY_SPP, seed: int = 0, material: tuple[float | None, float | None] | None = None
    ) -> Intrinsics:
        """Albedo, normal (camera axes) and mask; with a `material` also roughness and metallic.

        Args:
            spp: least number of camera rays per pixel: the next that makes full multi-jittered grids is taken.
            seed: of the rays' positions within the pixels.
            material: (roughness, metallic) of the scene, each a value or None for the object's own map.
        """
        return geometry_buffers(self.scene, self.camera, self.resolution, spp, seed, material)

    @functools.cached_property
    def _exposure_mask(self) -> Float[np.ndarray, "h w 1"]:
        mask = self.geometry(exposure.PASS_SPP, exposure.PASS_SEED).mask
        assert mask is not None
        return mask

    def exposure_mask(self) -> Float[np.ndarray, "h w 1"]:
        """The coverage that the gauge uses: always the same samples, traced once."""
        return self._exposure_mask

    def lit(self, surface: Surface, values: Mapping[str, float | None], environment: Float[np.ndarray, "h w 3"]) -> Any:
        """The Mitsuba scene with a surface and its material under a light; arguments as `EditableScene.show`."""
        return self.scene.show(surface, values, as_light(environment))

    def image(
        self,
        environment: Float[np.ndarray, "h w 3"],
        roughness: float | None,
        metallic: float | None,
        spp: int,
        seed: int = 0,
        depth: int = IMAGE_DEPTH,
        batches: int = TRUTH_BATCHES,
        pose: Float[np.ndarray, "4 4"] | None = None,
    ) -> Estimate:
        """The image: premultiplied linear RGBA.

        Args:
            environment: linear radiance in world axes: the object's, and those of the contract's camera.
            roughness, metallic: None: the object's own map.
            spp: samples per pixel.
            seed: equal seeds give equal images.
            depth: 2 is direct light, 4 three bounces; -1: as many as there are, as in Mitsuba.
            batches: passes that the variance is taken from.
            pose: camera to world (`multiview`); None: the contract's camera.

        Raises:
            UnirenderError: an argument is of another type or out of range, or a pixel stays NaN.
        """
        if not isinstance(depth, Integral) or not (DIRECT_DEPTH <= depth <= MOST_DEPTH or depth == UNLIMITED):
            raise UnirenderError(
                f"depth: got {depth!r:.40}, expected {DIRECT_DEPTH} (one bounce) to {MOST_DEPTH}, {UNLIMITED}: no end"
            )
        scene = self.lit("principled", {"roughness": roughness, "metallic": metallic}, environment)
        sensor = None if pose is None else sensor_at(pose, self.camera, self.resolution, self.resolution)
        own = derive_seed(seed, "image")
        return mean_estimate(*render_passes(scene, depth, spp, own, batches, self.counters, sensor), batches)

    def images(
        self,
        poses: Sequence[Float[np.ndarray, "4 4"]],
        environment: Float[np.ndarray, "h w 3"],
        roughness: float | None,
        metallic: float | None,
        spp: int,
        seed: int = 0,
    ) -> list[Estimate]:
        """One image for each camera pose, each with its own seed; arguments as `image`."""
        return [
            self.image(environment, roughness, metallic, spp, derive_seed(seed, "view", index), pose=pose)
            for index, pose in enumerate(poses)
        ]

    def diffuse(
        self, environment: Float[np.ndarray, "h w 3"], spp: int, seed: int = 0, batches: int = TRUTH_BATCHES
    ) -> Estimate:
        """d: the white Lambertian surface, direct light, divided by coverage."""
        scene = self.lit("white", {}, environment)
        passes = render_passes(scene, DIRECT_DEPTH, spp, derive_seed(seed, "diffuse"), batches, self.counters)
        return ratio_estimate(*passes, batches)

    def specular(
        self,
        environment: Float[np.ndarray, "h w 3"],
        roughness: float | None,
        spp: int,
        seed: int = 0,
        batches: int = TRUTH_BATCHES,
    ) -> Estimate:
        """s: the mirror-tinted reflector of the same roughness (None: map), direct light, divided by coverage."""
        scene = self.lit("mirror", {"roughness": roughness}, environment)
        passes = render_passes(scene, DIRECT_DEPTH, spp, derive_seed(seed, "specular"), batches, self.counters)
        return ratio_estimate(*passes, batches)


def render_sample(spec: SceneSpec, spp: int, seed: int = 0, renderer: Renderer | None = None) -> Sample:
    """The image of a scene and its complete intrinsics, exposure folded into the light, with per-pixel variance.

    Args:
        spec: object, light, material, camera.
        spp: samples per pixel of the image, of s and of d, in `TRUTH_BATCHES` passes.
        seed: another seed gives an independent estimate of the same scene, under the same exposure.
        renderer: reuse this one (of the same object, camera and resolution) instead of loading the scene.

    Raises:
        UnirenderError: an argument is of another type or out of range, the renderer is another scene's, the light does
            not reach the object, or a pixel stays NaN.
    """
    renderer = renderer_of(spec, renderer)
    pass_count(spp, TRUTH_BATCHES, SAMPLES_PER_PASS // renderer.resolution**2)  # refuses before anything is rendered
    factor = exposure.scene_exposure(renderer, spec.light.environment, spec.exposure_seed, f"light {spec.light.name}")
    environment = (spec.light.environment * factor).astype(np.float32)
    geometry = renderer.geometry(geometry_spp(spec.resolution, spp), seed, (spec.roughness, spec.metallic))
    estimates = {
        "image": renderer.image(environment, spec.roughness, spec.metallic, spp, seed),
        "diffuse": renderer.diffuse(environment, spp, seed),
        "specular": renderer.specular(environment, spec.roughness, spp, seed),
    }
    covered = geometry.require("mask")["mask"] > 0
    intrinsics = geometry.replace(
        diffuse=np.where(covered, estimates["diffuse"].mean, 0),
        specular=np.where(covered, estimates["specular"].mean, 0),
        environment=environment,
    )
    header = {
        **renderer_provenance(renderer),
        "spp": str(spp),
        "seed": str(seed),
        "batches": str(TRUTH_BATCHES),
        "depth": str(IMAGE_DEPTH),
        "light": spec.light.name,
        "roughness": material_text(spec.roughness),
        "metallic": material_text(spec.metallic),
        "exposure_seed": str(spec.exposure_seed),
        "exposure_factor": repr(factor),
        "nan_pixels": str(sum(estimate.nan_pixels for estimate in estimates.values())),
        "scene": scene_hash(spec),
    }
    variance = {
        name: estimate.variance[..., :3] for name, estimate in estimates.items() if estimate.variance is not None
    }
    return Sample(estimates["image"].mean[..., :3], intrinsics, variance, header)


def renderer_of(spec: SceneSpec, renderer: Renderer | None = None) -> Renderer:
    """A renderer for the scene: the one given, or a new one.

    Raises:
        UnirenderError: the one given has another object (by its arrays, not by its name), camera or resolution.
    """
    as_instance(spec, SceneSpec, "scene")
    if renderer is None:
        return Renderer(spec.obj, spec.camera, spec.resolution)
    same = renderer.obj is spec.obj or (
        renderer.obj.name == spec.obj.name and object_hash(renderer.obj) == object_hash(spec.obj)
    )
    differs = [
        name
        for name, equal in (
            ("object", same),
            ("camera", renderer.camera == spec.camera),
            ("resolution", renderer.resolution == spec.resolution),
        )
        if not equal
    ]
    if differs:
        raise UnirenderError(
            f"renderer: got one for {renderer.obj.name} at {renderer.resolution} px, expected {spec.obj.name} at "
            f"{spec.resolution} px as the spec has it (another: {', '.join(differs)}); leave `renderer` out"
        )
    return renderer


def geometry_spp(resolution: int, spp: int) -> int:
    """Camera rays per pixel for the geometry of a sample whose image takes `spp`.

    Up to `LARGE` pixels at least `GEOMETRY_SPP`; above, so many that they take about 3 % of the time of renders of 64
    samples.
    """
    if resolution <= LARGE:
        return max(GEOMETRY_SPP, spp)
    return GEOMETRY_SPP if spp >= 2 * GEOMETRY_SPP else LARGE_GEOMETRY_SPP


def material_text(value: float | None) -> str:
    """A roughness or metallic in header attributes; None: the object's own map."""
    return "map" if value is None else f"{value:g}"


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
