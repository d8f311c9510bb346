"""The page: what stands where, and which job each control asks for. The state of a session is in `gr.State`, so that
visitors share the worker and nothing else.
"""

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

    def ask(self, job: Callable[..., Any], *arguments: Any) -> Any:
        """The worker's answer.

        Raises:
            gr.Error: with the reason why there is none, which the page shows until it is closed.
        """
        try:
            return self.worker.run(job, *arguments)
        except UnirenderError as error:
            raise refusal(error) from error

    def open_file(self, path: str, side: int, session: Session) -> list[Any]:
        """A picture was dropped in; the mask of the last one is not for it."""
        return self.opened(replace(session, picture=taken(path), mask=None), side)

    def open_mask(self, path: str, side: int, session: Session) -> list[Any]:
        """A mask was dropped in."""
        mask = taken(path)
        if not isinstance(session.picture, Upload):
            raise gr.Error("A mask belongs to a picture of your own: drop that in first.", print_exception=False)
        return self.opened(replace(session, mask=mask), side)

    def open_example(self, name: str, side: int, session: Session) -> list[Any]:
        """An example was chosen."""
        return self.opened(replace(session, picture=self.examples[name], mask=None), side)

    def reopen(self, side: int, session: Session) -> list[Any]:
        """Another resolution was chosen."""
        return [gr.skip()] * OPENED if session.picture is None else self.opened(session, side)

    def opened(self, session: Session, side: int) -> list[Any]:
        """Values of the outputs when a picture is opened: all controls as predicted."""
        if isinstance(session.picture, Upload):
            found: jobs.Opened = self.ask(jobs.open_upload, session.picture, session.mask, side)
        else:
            found = self.ask(jobs.open_picture, session.picture, side)
        return [replace(session, subject=found.subject), found.maps, *self.as_predicted(found.subject, found.view)]

    def as_predicted(self, subject: Subject, view: str) -> list[Any]:
        """Values of the controls at which nothing is changed, and of what depends on them."""
        found = subject.decomposition
        return [round(found.metallic, DECIMALS), round(found.roughness, DECIMALS), PREDICTED, 0, view, "", "", ""]

    def reset(self, session: Session) -> list[Any]:
        """Everything as predicted."""
        subject = opened_subject(session)
        return self.as_predicted(subject, self.ask(jobs.show, subject, Controls()))[:-1]

    def open_light(self, path: str, session: Session, *controls: Any) -> list[Any]:
        """A light was dropped in."""
        session = replace(session, light=self.ask(jobs.open_light, taken(path)))
        metallic, roughness, _, *others = controls
        shown = [gr.skip()] * 3 if session.subject is None else self.show(session, metallic, roughness, OWN, *others)
        return [session, OWN, *shown]

    def show(self, session: Session, *controls: Any) -> list[Any]:
        """A control was moved; what was checked and packed before is not of this view."""
        return [self.ask(jobs.show, opened_subject(session), read_controls(session, *controls)), "", ""]

    def check(self, session: Session, *controls: Any) -> str:
        """Mitsuba is asked."""
        return self.ask(jobs.check, opened_subject(session), read_controls(session, *controls))

    def spread(self, session: Session) -> str:
        """The spread is asked for."""
        return self.ask(jobs.spread, opened_subject(session))

    def pack(self, session: Session, *controls: Any) -> str:
        """The files are asked for."""
        return self.ask(jobs.pack, opened_subject(session), read_controls(session, *controls))

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
            sliders_on = [*controls[:-1], view, checked, downloads, spread]
            all_opened = [session, maps, *sliders_on]
            assert len(all_opened) == OPENED, "reopen skips them all"
            for trigger, handler, source in (
                (picture.upload, self.open_file, picture),
                (mask.upload, self.open_mask, mask),
            ):
                trigger(handler, [source, side, session], all_opened, show_progress_on=view, **EVENT)
            side.input(self.reopen, [side, session], all_opened, show_progress_on=view, **EVENT)
            for button in examples:
                button.click(self.open_example, [button, side, session], all_opened, show_progress_on=view, **EVENT)
            predicted.click(self.reset, session, sliders_on[:-1], show_progress_on=view, **EVENT)
            own.upload(
                self.open_light, [own, session, *controls], [session, light, view, checked, downloads],
                show_progress_on=view, **EVENT,
            )  # fmt: skip
            gr.on(
                [control.input for control in controls],
                self.show,
                [session, *controls],
                [view, checked, downloads],
                trigger_mode="always_last",
                show_progress="hidden",
                **EVENT,
            )
            mitsuba.click(self.check, [session, *controls], checked, **EVENT)
            uncertain.click(self.spread, session, spread, **EVENT)
            files.click(self.pack, [session, *controls], downloads, **EVENT)
        page.queue(max_size=QUEUE, default_concurrency_limit=1)
        return page


# One worker: one queue for all that is asked of it.
EVENT: dict[str, Any] = {"concurrency_id": "worker", "concurrency_limit": 1, "api_visibility": "private"}
OPENED = 10  # outputs that are set when a picture is opened


def refusal(error: UnirenderError) -> gr.Error:
    """The reason as the page shows it, until it is closed."""
    return gr.Error(html.escape(str(error), quote=False), duration=None, print_exception=False)


def taken(path: str) -> Upload:
    """A file that the web server received.

    Raises:
        gr.Error: it is not there.
    """
    try:
        return Upload.take(path)
    except UnirenderError as error:
        raise refusal(error) from error


def opened_subject(session: Session) -> Subject:
    """The picture that is open.

    Raises:
        gr.Error: there is none.
    """
    if session.subject is None:
        raise gr.Error(NOTHING, duration=None, print_exception=False)
    return session.subject


def read_controls(
    session: Session, metallic: float, roughness: float, light: str, turn_deg: float, anchored: bool
) -> Controls:
    """What the controls say; a slider at the predicted value changes nothing.

    Raises:
        gr.Error: an own light is chosen, and there is none.
    """
    found = opened_subject(session).decomposition
    if light == OWN and session.light is None:
        raise gr.Error("Drop in a light of your own first.", duration=None, print_exception=False)
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
