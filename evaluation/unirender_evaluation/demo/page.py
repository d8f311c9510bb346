"""The page: which job each control asks for. What stands where is in `widgets`; the state of a session is in
`gr.State`, so that visitors share the worker and nothing else.
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
from unirender_evaluation.demo.uploads import Limits, Upload
from unirender_evaluation.demo.widgets import INTRODUCTION, NOTHING, OWN, PREDICTED, Edited, Found, Given
from unirender_evaluation.demo.worker import Worker
from unirender_evaluation.report.gallery import data_uri
from unirender_reference.lights import bundled_light

DECIMALS = 2  # of the sliders
STATE_SECONDS = 3600  # for which a session that does nothing is remembered
FILE_SECONDS = (60, 600)  # how often stray uploads are looked for, and from which age they are deleted
QUEUE = 32  # requests that may wait
# One worker: one queue for all that is asked of it.
EVENT: dict[str, Any] = {"concurrency_id": "worker", "concurrency_limit": 1, "api_visibility": "private"}
Handler = Callable[..., Any]


@dataclass(frozen=True)
class Session:
    """What is remembered of a visitor."""

    picture: Upload | Picture | None = None  # the upload, or an example
    mask: Upload | None = None  # the uploaded mask
    subject: Subject | None = None  # the picture taken apart
    light: Environment | None = None  # the uploaded light


class Page:
    """The handlers of the page's events."""

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
                    given = Given.place(self.examples, self.limits)
                with gr.Column(scale=2, min_width=320):
                    edited = Edited.place()
            gr.HTML("<h2>Maps</h2>", elem_classes="heading")
            self._answer_events(session, given, edited, Found.place())
        page.queue(max_size=QUEUE, default_concurrency_limit=1)
        return page

    def _answer_events(self, session: gr.State, given: Given, edited: Edited, found: Found) -> None:
        """Which handler each event has, what it reads and what it changes."""
        view, controls = edited.view, edited.controls
        seen = [view, edited.checked, found.downloads]  # what is there follows from the controls
        as_predicted = [*controls[:-1], *seen]
        opened = [session, given.picture, given.mask, found.maps, found.spread, *as_predicted]
        with_controls = [session, *controls]

        def on(trigger: Any, handler: Handler, inputs: Any, outputs: Any, **options: Any) -> None:
            gr.on(trigger, refusing(handler), inputs, outputs, **EVENT, **options)

        on(given.picture.upload, self.open_file, [given.picture, given.side, session], opened, show_progress_on=view)
        on(given.mask.upload, self.open_mask, [given.mask, given.side, session], opened, show_progress_on=view)
        on(given.side.input, self.reopen, [given.side, session], opened, show_progress_on=view)
        for button in given.examples:
            on(button.click, self.open_example, [button, given.side, session], opened, show_progress_on=view)
        on(edited.predicted.click, self.reset, session, as_predicted, show_progress_on=view)
        lit = [session, edited.light, *seen]
        on(edited.own.upload, self.open_light, [edited.own, *with_controls], lit, show_progress_on=view)
        moved = [control.input for control in controls]
        on(moved, self.show, with_controls, seen, trigger_mode="always_last", show_progress="hidden")
        on(edited.mitsuba.click, self.check, with_controls, edited.checked)
        on(found.uncertain.click, self.spread, session, found.spread)
        on(found.files.click, self.pack, with_controls, found.downloads)


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
    """The picture that is open."""
    if session.subject is None:
        raise UnirenderError(NOTHING)
    return session.subject


def read_controls(
    session: Session, metallic: float, roughness: float, light: str, turn_deg: float, anchored: bool
) -> Controls:
    """What the controls say; a slider at the predicted value changes nothing."""
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


def example_styles(examples: Mapping[str, Picture]) -> str:
    """CSS that shows each example on its button."""
    return "\n".join(
        f'#example-{k} {{ background-image: url("{data_uri(picture.image_srgb, picture.mask)}"); }}'
        for k, picture in enumerate(examples.values())
    )
