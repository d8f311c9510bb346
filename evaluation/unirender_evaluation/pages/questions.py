"""What the page *What the tables say* asks of the stored results, section by section.

A question is of one of several views of them (`VIEWS`): the run of `small` on `standard`; that run with the edits of
roughness apart by their target (rows `ours-mean@to 0.1`); the runs of both checkpoints on `standard` as one (rows
`ours-mean@small`).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from unirender_evaluation.claims import (
    ANCHORED,
    ANCHORED_COMPOSITE,
    COMPOSITE,
    EDITS,
    OPTIMISED,
    OPTIMISED_ON_MESH,
    OURS,
    PLAIN_COMPOSITE,
    REFINED,
    SHADOWED,
    SPLIT_SUM,
)
from unirender_evaluation.light_balls import GLOSSY_BALL, MATTE_BALL
from unirender_evaluation.metrics import METRICS, Scale
from unirender_evaluation.pages.findings import Question
from unirender_evaluation.task import LIGHT

STANDARD, BY_TARGET, BOTH_SIZES = VIEWS = ("standard", "by target", "both sizes")
UNEDITED, SAMPLED = "unedited-input", "ours-sample"
LOOKED, FLAT, NOT_CLOSED = (f"{OURS}-{name}" for name in ("6-looks", "flat-albedo", "not-closed"))
TARGETS = {"to 0.1": "_r010", "to 0.9": "_r090"}  # of edits of roughness, and how their samples end
MAPS = (("albedo", "psnr"), ("normal", "cosine"), ("roughness", "mse"), ("metallic", "mse"))
PHYSICS = ("physics", "physics")
DECOMPOSED, EDITED = ("inverse", "single-image"), ("rendering", "from-image")
RELIT_BY_HDRI, RELIT_BY_BUFFERS = ("relighting", "from-image-hdri"), ("relighting", "from-image-sd")


@dataclass(frozen=True)
class Section:
    """The lines of one table, and the view that they are of."""

    questions: tuple[Question, ...]
    view: str = STANDARD


def edits(protocol: str, a: str, b: str, text: str, metric: str = "psnr", scale: Scale = "raw") -> list[Question]:
    """Both edits of a protocol of the rendering table."""
    of = "rendering", protocol
    return [Question(f"{q.removeprefix('edit_')} edit, {text}", *of, q, metric, a, b, scale) for q in EDITS]


def maps(a: str, b: str, numbers: Sequence[tuple[str, str]] = MAPS) -> list[Question]:
    """Maps that are found in a picture."""
    return [Question(f"{quantity}, {METRICS[m].label}", *DECOMPOSED, quantity, m, a, b) for quantity, m in numbers]


def relit(a: str, b: str, metric: str = "psnr") -> list[Question]:
    """Relit pictures, by either protocol."""
    told = (("HDRI given", RELIT_BY_HDRI), ("s and d given", RELIT_BY_BUFFERS))
    return [Question(f"relit, {text}, {METRICS[metric].label}", *of, "relit", metric, a, b) for text, of in told]


def lit(a: str, b: str, levels: Sequence[Scale] = ("aligned", "raw")) -> list[Question]:
    """The light that is found in a picture; of the balls with and without one factor for their level."""
    found = [
        Question("log-RMSE", *LIGHT, "environment", "log_rmse_scaled", a, b),
        Question("brightest direction, degrees", *LIGHT, "environment", "peak_deg", a, b),
    ]
    for scale in levels:
        for name, ball in (("matte", MATTE_BALL), ("glossy", GLOSSY_BALL)):
            text = f"{name} ball{', aligned' * (scale == 'aligned')}"
            found.append(Question(text, *LIGHT, ball, "rmse_relative", a, b, scale))
    return found


def by_target(rows: Sequence[str], scale: Scale = "raw") -> list[Question]:
    """Edits of roughness by their target, against the unedited picture."""
    asked = [(target, row) for target in TARGETS for row in rows]
    return [
        Question("roughness edit", *EDITED, EDITS[1], "psnr", f"{row}@{target}", f"{UNEDITED}@{target}", scale)
        for target, row in asked
    ]


def _doing_nothing() -> list[Question]:
    bars = (
        ("albedo", "psnr", "input-as-albedo"),
        ("albedo", "psnr", "mean-albedo"),
        ("normal", "cosine", "mean-normal"),
        ("roughness", "mse", "constant-0-5"),
        ("metallic", "mse", "constant-0-5"),
    )
    asked = [*edits(EDITED[1], OURS, UNEDITED, "from the image"), *edits(EDITED[1], ANCHORED, UNEDITED, "anchored")]
    asked += relit(OURS, UNEDITED)
    asked += [question for quantity, metric, bar in bars for question in maps(OURS, bar, [(quantity, metric)])]
    for metric in ("lpips_vgg", "lpips_alex"):
        asked += [*edits(EDITED[1], OURS, UNEDITED, METRICS[metric].label, metric), relit(OURS, UNEDITED, metric)[0]]
    return asked


def _optimisation() -> list[Question]:
    return [
        question
        for other in (OPTIMISED, OPTIMISED_ON_MESH)
        for question in (
            *maps(OURS, other, MAPS[:3]),
            *edits(EDITED[1], OURS, other, "from the image"),
            relit(OURS, other)[0],
        )
    ]


def _many_views() -> list[Question]:
    numbers = (("novel", "psnr"), ("relit", "psnr"), ("albedo", "psnr"), ("roughness", "mse"), ("metallic", "mse"))
    rows = f"{OPTIMISED}-multi-view", "constant-object"
    return [Question(f"{q}, {METRICS[m].label}", "multi-view", "known-mesh", q, m, *rows) for q, m in numbers]


def _closed_form() -> list[Question]:
    plain = edits(EDITED[1], OURS, PLAIN_COMPOSITE, "from the image")
    plain += edits(EDITED[1], ANCHORED, ANCHORED_COMPOSITE, "anchored")
    given = [question for other in (COMPOSITE, SPLIT_SUM) for question in edits("given", OURS, other, "given")]
    pairs = [*((OURS, other) for other in (COMPOSITE, SPLIT_SUM, SHADOWED)), (SHADOWED, SPLIT_SUM)]
    return [*plain, *given, *(question for pair in pairs for question in edits("given-light", *pair, "given light"))]


def _light() -> list[Question]:
    rivals = ("mean-light", NOT_CLOSED, OPTIMISED, OPTIMISED_ON_MESH)
    return [*(question for other in rivals for question in lit(OURS, other)), *lit(REFINED, OURS, ("aligned",))]


def _physics() -> list[Question]:
    loops = (("shade_input", "the picture's light"), ("shade_heldout", "another light"))
    asked = [Question(f"closed loop, {text}", *PHYSICS, q, "psnr", OURS, "true-maps") for q, text in loops]
    response = "roughness response", *PHYSICS, "roughness_response", "correlation", OURS
    return [*asked, *(Question(*response, b) for b in (COMPOSITE, "shade-true-maps"))]


def _sizes() -> list[Question]:
    def pair(asked: Sequence[Question]) -> list[Question]:
        return [replace(question, a=f"{question.a}@small", b=f"{question.b}@tiny") for question in asked]

    asked = [*maps(OURS, OURS, (*MAPS, ("albedo", "ssim"))), *edits(EDITED[1], OURS, OURS, "from the image")]
    asked += [*edits("given-light", OURS, OURS, "given light"), relit(OURS, OURS)[0]]
    return pair([*asked, *lit(OURS, OURS, ("aligned",))])


def _buffers(a: str, b: str) -> list[Question]:
    return [Question(f"{name}, PSNR", *RELIT_BY_BUFFERS, name, "psnr", a, b) for name in ("specular", "diffuse")]


def _looks() -> list[Question]:
    asked = [*maps(LOOKED, OURS), *_buffers(LOOKED, OURS), *edits(EDITED[1], LOOKED, OURS, "from the image")]
    return [*asked, *relit(LOOKED, OURS), *lit(LOOKED, OURS, ("aligned",))]


def _flat() -> list[Question]:
    asked = maps(FLAT, OURS, [("albedo", metric) for metric in ("psnr", "ssim", "lpips_vgg", "lpips_alex")])
    asked += [*_buffers(FLAT, OURS), *edits(EDITED[1], FLAT, OURS, "from the image")]
    return [*asked, *relit(FLAT, OURS), *relit(FLAT, OURS, "lpips_vgg")]


def _without_brightness() -> list[Question]:
    one = replace(maps(OURS, "input-as-albedo", MAPS[:1])[0], scale="aligned")
    two = replace(relit(OURS, UNEDITED)[0], scale="aligned")
    rest = (edits(EDITED[1], OURS, b, "from the image", scale="aligned") for b in (UNEDITED, PLAIN_COMPOSITE))
    return [one, two, *(question for pair in rest for question in pair)]


def _optimisation_without_brightness() -> list[Question]:
    scales: tuple[tuple[Scale, str], ...] = (("aligned", ""), ("aligned_rgb", ", per channel"))
    return [
        replace(question, scale=scale, text=f"{question.text}{text}")
        for scale, text in scales
        for other in (OPTIMISED, OPTIMISED_ON_MESH)
        for question in (maps(OURS, other, MAPS[:1])[0], relit(OURS, other)[0])
    ]


SECTIONS: Mapping[str, Section] = {
    "doing nothing": Section(tuple(_doing_nothing())),
    "roughness by target": Section(tuple(by_target((OURS, ANCHORED))), BY_TARGET),
    "optimisation": Section(tuple(_optimisation())),
    "refinement": Section((*edits(EDITED[1], REFINED, OURS, "from the image"), relit(REFINED, OURS)[0])),
    "many views": Section(tuple(_many_views())),
    "closed form": Section(tuple(_closed_form())),
    "light": Section(tuple(_light())),
    "physics": Section(tuple(_physics())),
    "samples": Section(
        (
            *maps(SAMPLED, OURS, (*MAPS, ("albedo", "lpips_vgg"))),
            *edits(EDITED[1], SAMPLED, OURS, "from the image"),
        )
    ),
    "both sizes": Section(tuple(_sizes()), BOTH_SIZES),
    "six looks": Section(tuple(_looks())),
    "flat albedo": Section(tuple(_flat())),
    "without brightness": Section(tuple(_without_brightness())),
    "without brightness, by target": Section(tuple(by_target((OURS,), "aligned")), BY_TARGET),
    "without brightness, optimisation": Section(tuple(_optimisation_without_brightness())),
}
# What is asked of two kinds of objects apart: the first lines above, by PSNR and of maps, each against its best rival.
BY_KIND = (
    *maps(OURS, "input-as-albedo", MAPS[:1]),
    *maps(OURS, "mean-normal", MAPS[1:2]),
    *maps(OURS, "constant-0-5", MAPS[2:]),
    *edits(EDITED[1], OURS, UNEDITED, "from the image"),
    relit(OURS, UNEDITED)[0],
)
