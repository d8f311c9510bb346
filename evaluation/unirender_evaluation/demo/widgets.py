"""What stands where on the page: what a visitor hands in, the view with its controls, and what was found."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import gradio as gr

from unirender_evaluation.demo.uploads import SIDES, Limits
from unirender_reference.lights import catalogue

PICTURES = [".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff", ".bmp", ".exr"]
LIGHTS = [".hdr", ".exr", ".pfm", ".png", ".jpg", ".jpeg"]
PREDICTED, OWN = "predicted", "own file"
NOTHING = "Drop in a picture or choose an example first."
INTRODUCTION = """
<h1>unirender</h1>
<p>A picture of one object in, and out come its material, shape and light. Change them, and let a physical renderer
check the result. Nothing leaves the machine that serves this page.</p>
"""


@dataclass(frozen=True)
class Given:
    """What a visitor hands in: the left column."""

    picture: gr.File
    examples: list[gr.Button]
    side: gr.Radio
    mask: gr.File

    @classmethod
    def place(cls, examples: Iterable[str], limits: Limits) -> "Given":
        picture = gr.File(label="Picture", file_types=PICTURES, height=150, elem_id="picture")
        with gr.Row(elem_id="examples"):
            buttons = [
                gr.Button(name, elem_id=f"example-{k}", size="sm", min_width=64) for k, name in enumerate(examples)
            ]
        side = gr.Radio([(f"{s} px", s) for s in SIDES], value=SIDES[0], label="Resolution", elem_id="side")
        with gr.Accordion("Mask", open=False, elem_id="mask-section"):
            gr.HTML("<p>White where the object is. Without one, the picture's alpha channel.</p>")
            mask = gr.File(label="Mask", file_types=PICTURES, height=120, elem_id="mask")
        gr.HTML(limits_text(limits), elem_id="limits")
        return cls(picture, buttons, side, mask)


@dataclass(frozen=True)
class Edited:
    """The view and what changes it: the right column."""

    view: gr.HTML
    controls: list[Any]  # metallic, roughness, light, turn, anchored
    own: gr.File
    predicted: gr.Button
    mitsuba: gr.Button
    checked: gr.HTML

    @property
    def light(self) -> gr.Dropdown:
        return self.controls[2]

    @classmethod
    def place(cls) -> "Edited":
        view = gr.HTML(f'<p class="remark">{NOTHING}</p>', elem_id="view")
        with gr.Row():
            metallic = gr.Slider(0, 1, 0, step=0.01, label="Metallic", elem_id="metallic", min_width=240, buttons=[])
            roughness = gr.Slider(
                0, 1, 0.5, step=0.01, label="Roughness", elem_id="roughness", min_width=240, buttons=[]
            )
        with gr.Row():
            light = gr.Dropdown(light_choices(), value=PREDICTED, label="Light", elem_id="light", min_width=240)
            turned = "Light turned, degrees"
            turn = gr.Slider(-180, 180, 0, step=5, label=turned, elem_id="turn", min_width=240, buttons=[])
        anchored = gr.Checkbox(True, label="Keep the picture's own detail", elem_id="anchored")
        with gr.Accordion("A light of your own", open=False, elem_id="light-section"):
            gr.HTML("<p>A lat-long HDR, EXR or PFM, or a photograph (PNG, JPG).</p>")
            own = gr.File(label="Light", file_types=LIGHTS, height=120, elem_id="own-light")
        with gr.Row():
            predicted = gr.Button("As predicted", elem_id="reset", size="md", min_width=120)
            mitsuba = gr.Button("Check with Mitsuba", elem_id="check", variant="primary", size="md", min_width=160)
        checked = gr.HTML(elem_id="checked")
        return cls(view, [metallic, roughness, light, turn, anchored], own, predicted, mitsuba, checked)


@dataclass(frozen=True)
class Found:
    """The maps, how sure the model is of them, and the files: below."""

    maps: gr.HTML
    uncertain: gr.Button
    files: gr.Button
    spread: gr.HTML
    downloads: gr.HTML

    @classmethod
    def place(cls) -> "Found":
        maps = gr.HTML(elem_id="maps")
        with gr.Row():
            uncertain = gr.Button("How sure is the model?", elem_id="spread-button", size="md", min_width=160)
            files = gr.Button("Files to take along", elem_id="pack", size="md", min_width=160)
        return cls(maps, uncertain, files, gr.HTML(elem_id="spread"), gr.HTML(elem_id="downloads"))


def light_choices() -> list[str]:
    """Names of the lights: the predicted one, those that ship with the package, the visitor's."""
    return [PREDICTED, *sorted(catalogue()), OWN]


def limits_text(limits: Limits) -> str:
    """What is taken, as HTML."""
    return (
        f"<p>PNG or JPG, best with transparency around the object, or linear EXR. At most {limits.megabytes:g} MB and "
        f"{limits.pixels / 1e6:g} megapixels. The object is put into the middle of a square; the camera is taken to "
        "have a vertical field of view of 36 degrees.</p>"
    )
