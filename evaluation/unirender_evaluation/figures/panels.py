"""Material strips, a relighting grid and a comparison sheet: any methods beside the truth.

A subject is a method with a name. It is asked as in the benchmark: it sees the 8-bit picture, the mask and the camera.
Strips and relighting ask for materials and lights that a suite does not store, so that their truth is rendered when
the figure is made (`MitsubaTruth`); the comparison's is the suite's own. PSNR is masked sRGB, as in the tables.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal

import numpy as np
from jaxtyping import Float

from unirender.color import image_srgb, srgb_encode
from unirender.errors import UnirenderError
from unirender.light.resampling import resample_environment
from unirender.visualization import map_picture
from unirender_evaluation.engine import answer, answered, ask
from unirender_evaluation.figures.grid import Grid, Line, Tile
from unirender_evaluation.figures.grid import over_white as map_over_white
from unirender_evaluation.methods.method import Image, Mask, capabilities
from unirender_evaluation.methods.mitsuba import MitsubaScene
from unirender_evaluation.metrics import metric_key
from unirender_evaluation.rows import Row, evenly
from unirender_evaluation.scoring import over_white, score_image, score_maps
from unirender_evaluation.suites.suite import MetallicRoughness, Scene, Suite
from unirender_evaluation.task import Task
from unirender_evaluation.tasks import picture, tasks
from unirender_evaluation.truth.render import good_spp, item_seed

Truth = Callable[[Scene, MetallicRoughness, Float[np.ndarray, "eh ew 3"]], Image]
LIGHT_ROWS = 32  # of a light's picture
COMPARED_MAPS = ("albedo", "normal")  # as the paper compares them


@dataclass(frozen=True)
class Subject:
    """A method as figures name it; `row` is what the benchmark asks."""

    label: str
    row: Row

    def can(self, capability: str) -> bool:
        """Whether it has `edit`, `relight` or `decompose`."""
        return capability in capabilities(self.row.method)

    def ask(self, capability: str, **inputs: Any) -> Any:
        """Its answer, by the rules of the benchmark (`engine.ask`); None where it has none."""
        return answered(partial(ask, self.row, capability, "figures", **inputs)) if self.can(capability) else None


class MitsubaTruth:
    """Renders a suite's object under any material and light, with samples rounded up to whole passes."""

    def __init__(self, suite: Suite, spp: int) -> None:
        self.suite, self.spp = suite, good_spp(spp, suite.spec)
        self._objects: dict[str, MitsubaScene] = {}

    def __call__(self, scene: Scene, material: MetallicRoughness, environment: Float[np.ndarray, "eh ew 3"]) -> Image:
        """Linear image, premultiplied."""
        seed = item_seed("figures", scene.key, material)
        metallic, roughness = material
        found = self._object(scene).renderer.image(environment, roughness, metallic, self.spp, seed)
        return np.asarray(found.mean[..., :3], np.float32)

    def _object(self, scene: Scene) -> MitsubaScene:
        if scene.object not in self._objects:
            made = MitsubaScene(self.suite, scene)
            if not made.geometry_test.passed:
                raise UnirenderError(
                    f"figures, {scene.object}: got another object from its generator than suite {self.suite.spec.name} "
                    f"was rendered from ({made.geometry_test}), expected the same; make its truth on this machine with "
                    "`unirender bench truth`"
                )
            self._objects[scene.object] = made
        return self._objects[scene.object]


def material_strip(
    subjects: Sequence[Subject],
    suite: Suite,
    scenes: Sequence[Scene],
    what: Literal["metallic", "roughness"],
    values: Sequence[float],
    truth: Truth,
) -> Grid:
    """The input edited over values of one material parameter, a row for each subject, the truth below."""
    taking_part, base = able(subjects, "edit", f"{what} strip"), suite.spec.base
    lines = []
    for scene in scenes:
        seen, mask = picture(suite, scene, base), suite.mask(scene)
        materials = [(v, base[1]) if what == "metallic" else (base[0], v) for v in values]
        images = [truth(scene, material, suite.environment(scene)) for material in materials]
        for number, subject in enumerate(taking_part):
            made = [subject.ask("edit", **seen, **{what: value}) for value in values]
            tiles = [_compared(image, true, mask) for image, true in zip(made, images, strict=True)]
            lines.append(Line(subject.label, (input_tile(seen, number), *tiles), starts=number == 0))
        lines.append(Line("Mitsuba", (None, *(Tile(picture_over_white(image, mask)) for image in images))))
    columns = ("input", *(f"{what} {value:g}" for value in values))
    other = f"roughness {base[1]:g}" if what == "metallic" else f"metallic {base[0]:g}"
    given = f"The input has metallic {base[0]:g} and roughness {base[1]:g}; edits keep {other}."
    return Grid(columns, tuple(lines), f"{given} PSNR inside the mask, sRGB, against Mitsuba.")


def relighting_grid(
    subjects: Sequence[Subject], suite: Suite, scenes: Sequence[Scene], lights: int, truth: Truth
) -> Grid:
    """Every scene's input under other lights of the suite, given as HDRIs, the truth below."""
    taking_part, base = able(subjects, "relight", "relighting grid"), suite.spec.base
    chosen = other_lights(suite, scenes, lights)
    environments = [suite.environment(scene) for scene in chosen]
    lines = [Line("light", (None, *(Tile(_light(environment)) for environment in environments)))]
    for scene in scenes:
        seen, mask = picture(suite, scene, base), suite.mask(scene)
        images = [truth(scene, base, environment) for environment in environments]
        for number, subject in enumerate(taking_part):
            made = [subject.ask("relight", **seen, environment=environment) for environment in environments]
            tiles = [_compared(image, true, mask) for image, true in zip(made, images, strict=True)]
            lines.append(Line(subject.label, (input_tile(seen, number), *tiles), starts=number == 0))
        lines.append(Line("Mitsuba", (None, *(Tile(picture_over_white(image, mask)) for image in images))))
    names = tuple(scene.light for scene in chosen)
    return Grid(
        ("input", *names), tuple(lines), "Relit by the HDRI above. PSNR inside the mask, sRGB, against Mitsuba."
    )


def other_lights(suite: Suite, scenes: Sequence[Scene], count: int) -> list[Scene]:
    """Scenes whose lights are not those of `scenes`: each light once, evenly spaced over the suite."""
    own = {scene.light for scene in scenes}
    found = {scene.light: scene for scene in reversed(suite.scenes) if scene.light not in own}
    if not found:
        raise UnirenderError(
            f"relighting grid: all {len(own)} lights of suite {suite.spec.name} light the inputs; name fewer --scenes"
        )
    return evenly(list(reversed(found.values())), count)


def comparison_sheet(subjects: Sequence[Subject], suite: Suite, scenes: Sequence[Scene]) -> Grid:
    """What every subject answers to the benchmark's questions, a column each, between the input and the truth."""
    lines = []
    for scene in scenes:
        for number, (label, task, name) in enumerate(_questions(suite, scene)):
            seen = task.inputs[task.asks[0]]["image_srgb"]
            mask = task.mask
            cells = [_answered(subject, task, name) for subject in subjects]
            if any(cell is not None for cell in cells):
                true = Tile(_shown(_true(task, name), mask, name))
                lines.append(Line(label, (_over(seen, mask), *cells, true), starts=number == 0))
    columns = ("input", *(subject.label for subject in subjects), "Mitsuba")
    caption = "PSNR (of normals the mean cosine) inside the mask, sRGB, against the suite's truth by Mitsuba."
    return Grid(columns, tuple(lines), caption)


def _questions(suite: Suite, scene: Scene) -> list[tuple[str, Task, str]]:
    """(label, task, "image" or map): the suite's edits, the relighting, albedo and normals of the first picture."""
    found = []
    for task in tasks(suite, "rendering", "from-image", [scene]):
        change = {name: task.inputs["edit"].get(name) for name in ("metallic", "roughness")}
        label = ", ".join(f"{name} {value:g}" for name, value in change.items() if value is not None)
        found.append((label, task, "image"))
    found += [("relit", task, "image") for task in tasks(suite, "relighting", "from-image-hdri", [scene])]
    first = next(tasks(suite, "inverse", "single-image", [scene]))
    return [*found, *((name, first, name) for name in COMPARED_MAPS)]


def _answered(subject: Subject, task: Task, name: str) -> Tile | None:
    """A subject's answer with its PSNR, of normals the cosine; None where it has none."""
    prediction = answer(subject.row, task)
    if name == "image":
        if prediction.image is None:
            return None
        values = score_image(prediction.image, _true(task, name), task.mask, quantity=task.quantity)
        return Tile(_shown(prediction.image, task.mask, name), f"{values[metric_key(task.quantity, 'psnr')]:.1f} dB")
    made = None if prediction.maps is None else getattr(prediction.maps, name)
    if made is None or prediction.maps is None or task.truth_maps is None:
        return None
    values = score_maps(prediction.maps.replace(mask=None), task.truth_maps)
    psnr, cosine = (values.get(metric_key(name, metric)) for metric in ("psnr", "cosine"))
    score = f"cos {cosine:.2f}" if name == "normal" else f"{psnr:.1f} dB"
    return Tile(_shown(made, task.mask, name), score)


def _true(task: Task, name: str) -> Image:
    found = task.truth_image if name == "image" else getattr(task.truth_maps, name)
    assert found is not None, f"{task.identity} has a true {name}"
    return found


def _shown(values: Image, mask: Mask, name: str) -> Image:
    if name == "normal":
        return map_over_white(map_picture(name, values), mask)
    return picture_over_white(values, mask) if name == "image" else _display(over_white(values, mask))


def able(subjects: Sequence[Subject], capability: str, what: str) -> list[Subject]:
    """The subjects that have a capability; raises UnirenderError, with the figure's name `what`, where none has."""
    found = [subject for subject in subjects if subject.can(capability)]
    if not found:
        names = ", ".join(subject.label for subject in subjects) or "none"
        raise UnirenderError(f"{what}: got {names}, of which none can {capability}; leave it out with --kinds")
    return found


def _compared(image: Image | None, true: Image, mask: Mask) -> Tile | None:
    if image is None:
        return None
    psnr = score_image(image, true, mask, quantity="relit")[metric_key("relit", "psnr")]
    return Tile(picture_over_white(image, mask), f"{psnr:.1f} dB")


def input_tile(seen: dict[str, Any], number: int) -> Tile | None:
    """The input beside a scene's first row."""
    return _over(seen["image_srgb"], seen["mask"]) if number == 0 else None


def _over(image: Image, mask: Mask) -> Tile:
    """A picture with alpha over white, mixed as display values, as a browser shows it."""
    return Tile((image * mask + 1 - mask).astype(np.float32))


def picture_over_white(image_linear: Image, mask: Mask) -> Image:
    """A premultiplied linear image over white."""
    return _display(image_linear + (1 - mask))


def _display(linear: Image) -> Image:
    return srgb_encode(np.clip(linear, 0, 1)).astype(np.float32)


def _light(environment: Float[np.ndarray, "eh ew 3"]) -> Image:
    return image_srgb(resample_environment(environment, (LIGHT_ROWS, 2 * LIGHT_ROWS))).astype(np.float32)
