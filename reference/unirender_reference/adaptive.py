"""`render_sample` with as many samples as a noise floor takes (see `noise`)."""

import numpy as np

from unirender_reference import exposure
from unirender_reference.noise import FLOOR_BATCHES, MAX_SPP, floor_provenance, render_to_floor
from unirender_reference.passes import Estimate, derive_seed
from unirender_reference.render import Renderer, Sample, SceneSpec, assemble_sample, renderer_of

MASK_SPP = 1024  # of the coverage, which weights the pixels


def render_sample_to_floor(
    spec: SceneSpec, floor_db: float, seed: int = 0, renderer: Renderer | None = None, max_spp: int = MAX_SPP
) -> Sample:
    """`render_sample` with as many samples as each of image, s and d takes to reach a noise floor.

    The provenance says what was asked and, for each of the three, the floor reached (expected and sure, see
    `FloorEstimate`) and the samples per pixel; `floor_reached` is "no" where `max_spp` ended the sampling of one.

    Args:
        spec: object, light, material, camera.
        floor_db: masked sRGB PSNR that a noise-free prediction is to score against image, s and d.
        seed: another seed gives an independent sample of the same scene, under the same exposure.
        renderer: reuse this one (of the same object, camera and resolution) instead of loading the scene.
        max_spp: about where sampling ends.
    """
    renderer = renderer_of(spec, renderer)
    factor = exposure.scene_exposure(renderer, spec.light.environment, spec.exposure_seed, f"light {spec.light.name}")
    environment = (spec.light.environment * factor).astype(np.float32)
    geometry = renderer.geometry(MASK_SPP, seed, (spec.roughness, spec.metallic))
    mask = geometry.require("mask")["mask"]

    def image(spp: int, seed: int) -> Estimate:
        return renderer.image(environment, spec.roughness, spec.metallic, spp, seed, batches=FLOOR_BATCHES)

    def diffuse(spp: int, seed: int) -> Estimate:
        return renderer.diffuse(environment, spp, seed, FLOOR_BATCHES)

    def specular(spp: int, seed: int) -> Estimate:
        return renderer.specular(environment, spec.roughness, spp, seed, FLOOR_BATCHES)

    own = derive_seed(seed, "floor")
    found = {
        name: render_to_floor(render, mask, floor_db, premultiplied=name == "image", max_spp=max_spp, seed=own)
        for name, render in (("image", image), ("diffuse", diffuse), ("specular", specular))
    }
    return assemble_sample(
        spec,
        renderer,
        factor,
        geometry,
        image=found["image"].estimate,
        diffuse=found["diffuse"].estimate,
        specular=found["specular"].estimate,
        provenance={
            "spp": str(found["image"].spp),
            "seed": str(seed),
            "batches": str(FLOOR_BATCHES),
            **floor_provenance(found),
        },
    )
