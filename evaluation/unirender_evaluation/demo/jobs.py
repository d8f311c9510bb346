"""One function for each thing that the page asks for; they run in the worker process (`worker`).

Each takes the context first and gives back what the page shows, as HTML, and what the session must remember. They keep
nothing: a session's state travels with each request.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from unirender.command_line.options import Device, ModelOptions
from unirender.pictures import Picture
from unirender.pipelines.unirender_pipeline import UniRenderPipeline
from unirender_evaluation.demo import panels, session
from unirender_evaluation.demo.downloads import archives
from unirender_evaluation.demo.session import Controls, Environment, Subject
from unirender_evaluation.demo.uploads import Limits, Upload, read_light, read_upload, square

ARCHIVES = {
    "maps.zip": "OpenEXR and PNG, as unirender decompose writes them",
    "gltf.zip": "a card with the maps as glTF materials",
    "mitsuba.zip": "the same card and its light as a Mitsuba 3 scene",
}


@dataclass(frozen=True)
class Context:
    """What all jobs share."""

    pipeline: UniRenderPipeline  # the model
    limits: Limits  # of uploads
    meta: Mapping[str, Any] = field(default_factory=dict)  # which model it is, for downloads


@dataclass(frozen=True)
class Opened:
    """A picture that was taken apart."""

    subject: Subject  # to be remembered
    view: str  # HTML of picture, result and light
    maps: str  # HTML of the maps


def start(checkpoint: Path | None, device: Device, limits: Limits) -> Context:
    """Loads the model."""
    options = ModelOptions(checkpoint, device, progress=False)
    pipeline = options.load()
    return Context(pipeline, limits, options.provenance(pipeline))


def open_upload(context: Context, picture: Upload, mask: Upload | None, side: int) -> Opened:
    """Takes a visitor's picture apart."""
    found, remarks = read_upload(picture, mask, context.limits)
    return open_picture(context, found, side, remarks)


def open_picture(context: Context, picture: Picture, side: int, remarks: tuple[str, ...] = ()) -> Opened:
    """Takes a picture with a mask apart."""
    subject = session.take_apart(context.pipeline, square(picture, side))
    seen = session.view(context.pipeline, subject, Controls())
    noted = session.View(seen.image_linear, seen.rendered, seen.intrinsics, remarks)
    return Opened(subject, panels.view_panel(subject, noted), panels.maps_panel(subject))


def open_light(context: Context, light: Upload) -> Environment:
    """Reads a visitor's light."""
    return read_light(light, context.limits)


def show(context: Context, subject: Subject, controls: Controls) -> str:
    """HTML of the picture under some controls."""
    return panels.view_panel(subject, session.view(context.pipeline, subject, controls))


def check(context: Context, subject: Subject, controls: Controls) -> str:
    """HTML of Mitsuba's check of what is seen."""
    seen = session.view(context.pipeline, subject, controls)
    return panels.check_panel(session.check(seen), seen.intrinsics)


def spread(context: Context, subject: Subject) -> str:
    """HTML of the spread of every map."""
    return panels.spread_panel(session.spread(context.pipeline, subject), subject.mask, session.SAMPLES)


def pack(context: Context, subject: Subject, controls: Controls) -> str:
    """HTML with links to the archives of what is seen."""
    seen = session.view(context.pipeline, subject, controls)
    settings = {"metallic": controls.metallic, "roughness": controls.roughness, "turn_deg": controls.turn_deg}
    facts = {"command": "demo", "input": subject.picture.name, "edited": settings, "anchored": controls.anchored}
    return panels.downloads_panel(archives(seen, {**context.meta, **facts}), ARCHIVES)
