"""What the page does, as plain functions: picture -> decomposition -> edit and light -> check by Mitsuba.

A picture is taken apart once; each movement of a slider then costs one rendering. The anchored picture carries over
what the decomposition could not explain (`unirender.pipelines.editing.anchor`), for which the rendering of the unedited
maps is needed: it is kept, too.

Notation: I the picture, R_0 and R_1 the renders of the maps before and after the edit.
"""

import math
import time
from collections.abc import Collection, Mapping
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float

from unirender.color import srgb_decode
from unirender.command_line.commands import MUCH_COARSE
from unirender.intrinsics import Intrinsics
from unirender.light.environment import rotate_environment
from unirender.pictures import Picture
from unirender.pipelines.carried_light import with_carried_light
from unirender.pipelines.editing import anchor, specular_for_roughness, too_coarse, under_light
from unirender.pipelines.inputs import as_environment, as_material
from unirender.pipelines.results import Decomposition
from unirender.pipelines.settings import Sampling, same_noise
from unirender.pipelines.unirender_pipeline import UniRenderPipeline
from unirender_evaluation.metrics import psnr
from unirender_evaluation.report.gallery import flip_map, image_picture
from unirender_reference.shade import shade

SPP = 256  # of Mitsuba's check
SAMPLES = 5  # of the spread

Environment = Float[np.ndarray, "eh ew 3"]


@dataclass(frozen=True)
class Subject:
    """A picture that was taken apart."""

    picture: Picture  # with a mask
    decomposition: Decomposition  # of it, mode `mean`
    rendered: Float[np.ndarray, "h w 3"]  # R_0, premultiplied linear

    @property
    def maps(self) -> Intrinsics:
        """The maps that were found, with the picture's mask."""
        return self.decomposition.intrinsics

    @property
    def mask(self) -> Float[np.ndarray, "h w 1"]:
        return self.maps.require("mask")["mask"]

    @property
    def image_linear(self) -> Float[np.ndarray, "h w 3"]:
        """I, premultiplied linear."""
        return srgb_decode(self.picture.image_srgb) * self.mask


@dataclass(frozen=True)
class Controls:
    """What a visitor has set."""

    metallic: float | None = None  # of the whole object, [0, 1]; None: as predicted
    roughness: float | None = None  # the same
    light: Environment | None = None  # lat-long, camera axes, any scale; None: the one found, which agrees with s and d
    turn_deg: float = 0.0  # by which the light is turned about +y, from +z towards +x
    anchored: bool = True  # whether the change is applied to the picture; else the plain render is shown


@dataclass(frozen=True)
class View:
    """What is seen under some controls."""

    image_linear: Float[np.ndarray, "h w 3"]  # premultiplied, linear, >= 0
    rendered: Float[np.ndarray, "h w 3"]  # R_1, the plain render
    intrinsics: Intrinsics  # the maps and the light as set
    remarks: tuple[str, ...] = ()  # what the picture does not show, and why


@dataclass(frozen=True)
class Check:
    """The same maps under the same light, by the model and by Mitsuba."""

    model: Float[np.ndarray, "h w 3"]  # premultiplied linear
    mitsuba: Float[np.ndarray, "h w 3"]  # the same
    flip: Float[np.ndarray, "h w 3"]  # FLIP error in colours
    flip_mean: float  # over the object
    psnr_db: float  # inside the mask, sRGB
    seconds: float  # that Mitsuba took, compilation included


def take_apart(pipeline: UniRenderPipeline, picture: Picture) -> Subject:
    """Inverse rendering, and the rendering of what was found."""
    decomposition = pipeline.decompose(picture.image_srgb, picture.mask)
    return Subject(picture, decomposition, render(pipeline, decomposition.with_network_light))


def view(pipeline: UniRenderPipeline, subject: Subject, controls: Controls) -> View:
    """The subject with another material, under another light.

    Under the predicted light as it stands, s follows the new roughness as in `UniRenderPipeline.edit`; under any other
    s and d are derived from the normals, as in `UniRenderPipeline.relight`.
    """
    before = subject.decomposition.with_network_light
    edited, remarks, derived = before, [], ()
    if controls.metallic is not None:
        edited = edited.replace(metallic=as_material("metallic", controls.metallic, subject.mask))
    if controls.roughness is not None:
        edited = edited.replace(roughness=as_material("roughness", controls.roughness, subject.mask))
    if controls.light is not None or controls.turn_deg % 360:
        own = subject.maps.require("environment")["environment"]
        light = turned(own if controls.light is None else as_environment(controls.light), controls.turn_deg)
        edited = under_light(edited, light, "keep" if controls.light is None else "auto", mirrors=False)
        derived = ("specular", "diffuse")
        edited = with_carried_light(before, edited, derived, subject.decomposition.own_agreeing_light)
        remarks.append("Under a light that was changed, nothing casts a new shadow.")
    elif controls.roughness is not None:
        target = edited.require("roughness")["roughness"]
        edited = edited.replace(specular=specular_for_roughness(before, target)[0])
        coarse = float(too_coarse(before, target)[subject.mask > 0].mean())
        if coarse > MUCH_COARSE:
            remarks.append(
                f"The predicted light is too coarse to show what roughness {controls.roughness:g} reflects on "
                f"{coarse:.0%} of the object: its highlights stay as wide as they were."
            )
    rendered = subject.rendered if edited is before else render(pipeline, edited, derived)
    image = anchor(subject.image_linear, subject.rendered, rendered) if controls.anchored else rendered
    if edited.environment is before.environment:
        edited = edited.replace(environment=subject.maps.environment)
    return View(image, rendered, edited, tuple(remarks))


def render(
    pipeline: UniRenderPipeline, intrinsics: Intrinsics, derived: Collection[str] = ()
) -> Float[np.ndarray, "h w 3"]:
    """The mean rendering, with the noise of `UniRenderPipeline.edit` and `relight`: what is seen here is theirs."""
    return pipeline.render(intrinsics, generator=same_noise(Sampling.of().draw_seed(), 1)[0], derived=derived)


def turned(environment: Environment, turn_deg: float) -> Environment:
    """A light turned about +y: what came from +z comes from +x after 90 degrees. Bilinear."""
    if not turn_deg % 360:
        return environment
    c, s = math.cos(math.radians(turn_deg)), math.sin(math.radians(turn_deg))
    return rotate_environment(environment, np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]], dtype=np.float32))


def check(seen: View, spp: int = SPP) -> Check:
    """Mitsuba shades the maps that the model rendered, under the light that is shown with them."""
    mask = seen.intrinsics.require("mask")["mask"]
    start = time.perf_counter()
    truth = shade(seen.intrinsics, spp=spp)
    seconds = time.perf_counter() - start
    ours, theirs = (image_picture(image, mask) for image in (seen.rendered, truth))
    flip, flip_mean = flip_map(ours, theirs, mask)
    return Check(seen.rendered, truth, flip, flip_mean, psnr(ours, theirs, mask), seconds)


def spread(pipeline: UniRenderPipeline, subject: Subject, samples: int = SAMPLES) -> Mapping[str, np.ndarray]:
    """Standard deviation of every map over diffusion samples of the decomposition, by name of the map."""
    generator = torch.Generator().manual_seed(0)
    found = pipeline.decompose(
        subject.picture.image_srgb, subject.picture.mask, mode="sample", num_samples=samples, generator=generator
    )
    assert found.std is not None, "several samples have a spread"
    return found.std
