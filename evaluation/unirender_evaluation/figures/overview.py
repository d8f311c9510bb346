"""The overview figure: everything that a method makes of one picture, beside the suite's truth.

From left to right the picture, the maps found in it, the suite's edits and a relighting. Every subject has a row for
each scene, the truth is the last; what a method cannot do stays empty.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from unirender.intrinsics import Intrinsics
from unirender.light.resampling import resample_environment
from unirender.visualization import map_picture
from unirender_evaluation.figures.grid import Grid, Line, Tile, over_white
from unirender_evaluation.figures.panels import Subject, able, input_tile, picture_over_white
from unirender_evaluation.methods.method import Mask
from unirender_evaluation.suites.suite import Scene, Suite
from unirender_evaluation.tasks import picture

MAPS = ("albedo", "normal", "roughness", "metallic", "specular", "diffuse", "environment")
ENVIRONMENT = (16, 32)  # rows and columns at which lights are shown: those that the model predicts


def overview(subjects: Sequence[Subject], suite: Suite, scenes: Sequence[Scene]) -> Grid:
    """What every subject makes of a scene's base picture, the truth below."""
    taking_part, base = able(subjects, "decompose", "overview"), suite.spec.base
    edits = [{"metallic": edit[0]} if edit[0] != base[0] else {"roughness": edit[1]} for edit in suite.spec.edits]
    lines = []
    for scene in scenes:
        seen, mask, other = picture(suite, scene, base), suite.mask(scene), suite.other_light(scene)
        environment = suite.environment(other)
        for number, subject in enumerate(taking_part):
            maps = map_tiles(subject.ask("decompose", **seen), mask)
            made = [subject.ask("edit", **seen, **edit) for edit in edits]
            made.append(subject.ask("relight", **seen, environment=environment))
            pictures = [None if image is None else Tile(picture_over_white(image, mask)) for image in made]
            lines.append(Line(subject.label, (input_tile(seen, number), *maps, *pictures), starts=number == 0))
        truth = [*(suite.image(scene, edit) for edit in suite.spec.edits), suite.image(other, base)]
        pictures = [Tile(picture_over_white(image, mask)) for image in truth]
        lines.append(Line("Mitsuba", (None, *map_tiles(suite.intrinsics(scene, base), mask), *pictures)))
    names = [f"{name} {value:g}" for edit in edits for name, value in edit.items()]
    caption = (
        f"From the picture at the left alone: its maps, then edits of metallic {base[0]:g}, roughness {base[1]:g}."
    )
    return Grid(("input", *MAPS, *names, "relit"), tuple(lines), caption)


def map_tiles(found: Intrinsics | None, mask: Mask) -> list[Tile | None]:
    """A tile for each of `MAPS` that is there; a roughness or metallic that is one number has it in its corner."""
    tiles: list[Tile | None] = []
    for name in MAPS:
        value = getattr(found, name, None)
        if value is None:
            tiles.append(None)
        elif name == "environment":
            tiles.append(Tile(map_picture(name, resample_environment(value, ENVIRONMENT)).astype(np.float32)))
        else:
            number = _one_number(value, mask) if name in ("roughness", "metallic") else ""
            tiles.append(Tile(over_white(map_picture(name, value), mask), number))
    return tiles


def _one_number(value: Float[np.ndarray, "h w 1"], mask: Mask) -> str:
    """What a map is everywhere on the object, to what a PNG can tell; empty where it varies."""
    inside = value[mask > 0]
    return f"{inside.mean():.2f}" if np.ptp(inside) < 1 / 255 else ""
