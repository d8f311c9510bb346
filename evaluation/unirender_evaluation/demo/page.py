"""The page: what stands where, and which job each control asks for. The state of a session is in `gr.State`, so that
visitors share the worker and nothing else.
"""

import functools
import html
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import gradio as gr

from unirender.errors import UnirenderError
from unirender.pictures import Picture
from unirender_evaluation.demo import jobs
from unirender_evaluation.demo.session import Controls, Environment, Subject
from unirender_evaluation.demo.uploads import SIDES, Limits, Upload
from unirender_evaluation.demo.worker import Worker
from unirender_evaluation.gallery import data_uri
from unirender_reference.lights import bundled_light, catalogue

PICTURES = [".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff", ".bmp", ".exr"]
LIGHTS = [".hdr", ".exr", ".pfm", ".png", ".jpg", ".jpeg"]
PREDICTED, OWN = "predicted", "own file"
DECIMALS = 2  # of the sliders
STATE_SECONDS = 3600  # for which a session that does nothing is remembered
FILE_SECONDS = (60, 600)  # how often stray uploads are looked for, and from which age they are deleted
QUEUE = 32  # requests that may wait
NOTHING = "Drop in a picture or choose an example first."
# One worker: one queue for all that is asked of it.
EVENT: dict[str, Any] = {"concurrency_id": "worker", "concurrency_limit": 1, "api_visibility": "private"}
Handler = Callable[..., Any]
INTRODUCTION = """
<h1>unirender</h1>
<p>A picture of one object in, and out come its material, shape and light. Change them, and let a physical renderer
check the result. Nothing leaves the machine that serves this page.</p>
"""


@dataclass(frozen=True)
class Session:
    """What is remembered of a visitor.

    Attributes:
        picture: the upload, or an example.
        mask: the uploaded mask.
        subject: the picture taken apart.
        light: the uploaded light.
    """

    picture: Upload | Picture | None = None
    mask: Upload | None = None
    subject: Subject | None = None
    light: Environment | None = None


class Page:
    """The handlers of the page's events.

    Args:
        worker: does the work.
        limits: that the page names.
        examples: pictures with masks, by their names.
    """

    def __init__(self, worker: Worker, limits: Limits, examples: Mapping[str, Picture]) -> None:
        self.worker, self.limits, self.examples = worker, limits, examples

    def open_file(self, path: str, side: int, session: Session) -> list[Any]:
        """A picture was dropped in; the mask of the last one is not for it."""
        return self.opened(replace(session, picture=Upload.take(path), mask=None), side, gr.skip(), None)

    def open_mask(self, path: str, side: int, session: Session) -> list[Any]:
        """A mask was dropped in."""
        mask = Upload.take(path)
        if not isinstance(session.picture, Upload):
            raise UnirenderError("A mask belongs to a picture of your own: drop that in first.")
        return self.opened(replace(session, mask=mask), side, gr.skip(), gr.skip())

    def open_example(self, name: str, side: int, session: Session) -> list[Any]:
        """An example was chosen."""
        return self.opened(replace(session, picture=self.examples[name], mask=None), side, None, None)

    def reopen(self, side: int, session: Session) -> Any:
        """Another resolution was chosen."""
        return gr.skip() if session.picture is None else self.opened(session, side, gr.skip(), gr.skip())

    def opened(self, session: Session, side: int, *files: Any) -> list[Any]:
        """Values of the outputs when a picture is opened: session, names of files, maps, spread, then the controls."""
        if isinstance(session.picture, Upload):
            found: jobs.Opened = self.worker.run(jobs.open_upload, session.picture, session.mask, side)
        else:
            found = self.worker.run(jobs.open_picture, session.picture, side)
        values = self.as_predicted(found.subject, found.view)
        return [replace(session, subject=found.subject), *files, found.maps, "", *values]

    def as_predicted(self, subject: Subject, view: str) -> list[Any]:
        """Values of the controls at which nothing is changed, and of what depends on them."""
        found = subject.decomposition
        return [round(found.metallic, DECIMALS), round(found.roughness, DECIMALS), PREDICTED, 0, view, "", ""]

    def reset(self, session: Session) -> list[Any]:
        """Everything as predicted."""
        subject = opened_subject(session)
        return self.as_predicted(subject, self.worker.run(jobs.show, subject, Controls()))

    def open_light(self, path: str, session: Session, *controls: Any) -> list[Any]:
        """A light was dropped in."""
        session = replace(session, light=self.worker.run(jobs.open_light, Upload.take(path)))
        metallic, roughness, _, *others = controls
        shown = [gr.skip()] * 3 if session.subject is None else self.show(session, metallic, roughness, OWN, *others)
        return [session, OWN, *shown]

    def show(self, session: Session, *controls: Any) -> list[Any]:
        """A control was moved; what was checked and packed before is not of this view."""
        return [self.worker.run(jobs.show, opened_subject(session), read_controls(session, *controls)), "", ""]

    def check(self, session: Session, *controls: Any) -> str:
        """Mitsuba is asked."""
        return self.worker.run(jobs.check, opened_subject(session), read_controls(session, *controls))

    def spread(self, session: Session) -> str:
        """The spread is asked for."""
        return self.worker.run(jobs.spread, opened_subject(session))

    def pack(self, session: Session, *controls: Any) -> str:
        """The files are asked for."""
        return self.worker.run(jobs.pack, opened_subject(session), read_controls(session, *controls))

    def build(self) -> gr.Blocks:
        """The page."""
        with gr.Blocks(title="unirender", analytics_enabled=False, delete_cache=FILE_SECONDS) as page:
            session = gr.State(Session(), time_to_live=STATE_SECONDS)
            gr.HTML(INTRODUCTION, elem_id="introduction")
            with gr.Row():
                with gr.Column(scale=1, min_width=280):
                    picture = gr.File(label="Picture", file_types=PICTURES, height=150, elem_id="picture")
                    with gr.Row(elem_id="examples"):
                        examples = [
                            gr.Button(name, elem_id=f"example-{k}", size="sm", min_width=64)
                            for k, name in enumerate(self.examples)
                        ]
                    side = gr.Radio([(f"{s} px", s) for s in SIDES], value=SIDES[0], label="Resolution", elem_id="side")
                    with gr.Accordion("Mask", open=False, elem_id="mask-section"):
                        gr.HTML("<p>White where the object is. Without one, the picture's alpha channel.</p>")
                        mask = gr.File(label="Mask", file_types=PICTURES, height=120, elem_id="mask")
                    gr.HTML(limits_text(self.limits), elem_id="limits")
                with gr.Column(scale=2, min_width=320):
                    view = gr.HTML(f'<p class="remark">{NOTHING}</p>', elem_id="view")
                    with gr.Row():
                        metallic = gr.Slider(
                            0, 1, 0, step=0.01, label="Metallic", elem_id="metallic", min_width=240, buttons=[]
                        )
                        roughness = gr.Slider(
                            0, 1, 0.5, step=0.01, label="Roughness", elem_id="roughness", min_width=240, buttons=[]
                        )
                    with gr.Row():
                        light = gr.Dropdown(
                            light_choices(), value=PREDICTED, label="Light", elem_id="light", min_width=240
                        )
                        turn = gr.Slider(
                            -180,
                            180,
                            0,
                            step=5,
                            label="Light turned, degrees",
                            elem_id="turn",
                            min_width=240,
                            buttons=[],
                        )
                    anchored = gr.Checkbox(True, label="Keep the picture's own detail", elem_id="anchored")
                    with gr.Accordion("A light of your own", open=False, elem_id="light-section"):
                        gr.HTML("<p>A lat-long HDR, EXR or PFM, or a photograph (PNG, JPG).</p>")
                        own = gr.File(label="Light", file_types=LIGHTS, height=120, elem_id="own-light")
                    with gr.Row():
                        predicted = gr.Button("As predicted", elem_id="reset", size="md", min_width=120)
                        mitsuba = gr.Button(
                            "Check with Mitsuba", elem_id="check", variant="primary", size="md", min_width=160
                        )
                    checked = gr.HTML(elem_id="checked")
            gr.HTML("<h2>Maps</h2>", elem_classes="heading")
            maps = gr.HTML(elem_id="maps")
            with gr.Row():
                uncertain = gr.Button("How sure is the model?", elem_id="spread-button", size="md", min_width=160)
                files = gr.Button("Files to take along", elem_id="pack", size="md", min_width=160)
            spread = gr.HTML(elem_id="spread")
            downloads = gr.HTML(elem_id="downloads")

            controls = [metallic, roughness, light, turn, anchored]
            seen = [view, checked, downloads]  # what is there follows from the controls
            as_predicted = [*controls[:-1], *seen]
            opened = [session, picture, mask, maps, spread, *as_predicted]
            with_controls = [session, *controls]

            def on(trigger: Any, handler: Handler, inputs: Any, outputs: Any, **options: Any) -> None:
                gr.on(trigger, refusing(handler), inputs, outputs, **EVENT, **options)

            on(picture.upload, self.open_file, [picture, side, session], opened, show_progress_on=view)
            on(mask.upload, self.open_mask, [mask, side, session], opened, show_progress_on=view)
            on(side.input, self.reopen, [side, session], opened, show_progress_on=view)
            for button in examples:
                on(button.click, self.open_example, [button, side, session], opened, show_progress_on=view)
            on(predicted.click, self.reset, session, as_predicted, show_progress_on=view)
            on(own.upload, self.open_light, [own, *with_controls], [session, light, *seen], show_progress_on=view)
            moved = [control.input for control in controls]
            on(moved, self.show, with_controls, seen, trigger_mode="always_last", show_progress="hidden")
            on(mitsuba.click, self.check, with_controls, checked)
            on(uncertain.click, self.spread, session, spread)
            on(files.click, self.pack, with_controls, downloads)
        page.queue(max_size=QUEUE, default_concurrency_limit=1)
        return page


def refusing(handler: Handler) -> Handler:
    """A handler whose errors become a sentence on the page, until it is closed; what is shown stays as it is."""

    @functools.wraps(handler)
    def handle(*arguments: Any) -> Any:
        try:
            return handler(*arguments)
        except UnirenderError as error:
            gr.Warning(html.escape(str(error), quote=False), duration=None, title="Not done")
            return gr.skip()

    return handle


def opened_subject(session: Session) -> Subject:
    """The picture that is open.

    Raises:
        UnirenderError: there is none.
    """
    if session.subject is None:
        raise UnirenderError(NOTHING)
    return session.subject


def read_controls(
    session: Session, metallic: float, roughness: float, light: str, turn_deg: float, anchored: bool
) -> Controls:
    """What the controls say; a slider at the predicted value changes nothing.

    Raises:
        UnirenderError: an own light is chosen, and there is none.
    """
    found = opened_subject(session).decomposition
    if light == OWN and session.light is None:
        raise UnirenderError("Drop in a light of your own first.")
    return Controls(
        metallic=None if metallic == round(found.metallic, DECIMALS) else metallic,
        roughness=None if roughness == round(found.roughness, DECIMALS) else roughness,
        light=None if light == PREDICTED else session.light if light == OWN else bundled_light(light).environment,
        turn_deg=turn_deg,
        anchored=anchored,
    )


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


def example_styles(examples: Mapping[str, Picture]) -> str:
    """CSS that shows each example on its button."""
    return "\n".join(
        f'#example-{k} {{ background-image: url("{data_uri(picture.image_srgb, picture.mask)}"); }}'
        for k, picture in enumerate(examples.values())
    )
