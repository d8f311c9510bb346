"""What the tables are: their columns, and the protocols under which a method may be asked.

Names and columns are the paper's, whose Tables 1, 2 and 3 are `rendering`, `inverse` and `relighting`. A protocol says
what a method is given; only the paper's own carries published values (`Protocol.published`), so that a method that was
told more can never stand beside them.
"""

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass

from unirender_evaluation.metrics import METRICS, Metric, Variant, metric_key
from unirender_evaluation.multiview.settings import STANDARD as VIEWS

GRID_MSE = 0.100  # mean of (x - 0.5)^2 over x in {0, .1 .. 1}: what a constant 0.5 scores on the paper's materials
GRID_TOLERANCE = 0.002  # a suite whose constant scores within it has the paper's distribution of materials


@dataclass(frozen=True)
class Protocol:
    """What a method is given."""

    key: str  # as in records
    label: str  # as in headings
    given: str  # one sentence
    published: bool = False  # whether the paper's numbers were taken this way
    truth: str = ""  # where it is not the suite's stored truth: what results are scored against
    framed: bool = True  # whether what is scored fills the picture's frame, so that it has a mask and a colour space


PROTOCOLS: dict[str, Protocol] = {
    protocol.key: protocol
    for protocol in (
        Protocol(
            "from-image",
            "from the image",
            "one image and its mask; the method decomposes it, edits, renders",
            published=True,
        ),
        Protocol("given", "given", "true maps and the true target light buffers s and d"),
        Protocol("given-light", "given light", "true maps and the HDRI, no light buffers"),
        Protocol("single-image", "from the image", "one image and its mask", published=True),
        Protocol(
            "from-image-sd",
            "from the image, target s and d given",
            "one image and its mask, and the target's true light buffers s and d",
            published=True,
        ),
        Protocol("from-image-hdri", "from the image, HDRI given", "one image and its mask, and the target's HDRI"),
        Protocol("light-from-image", "from the image", "one image and its mask", framed=False),
        Protocol("physics", "physics", "what each test says"),
        Protocol(
            "known-mesh",
            f"{VIEWS.seen} views, known mesh",
            f"{VIEWS.seen} pictures from all around (8-bit sRGB) with masks and cameras, and the true mesh without its "
            "looks; neither light nor material",
            truth=f"rendered in this run, {VIEWS.seen} seen and {VIEWS.held_out} held-out cameras; pictures are scored "
            f"on the held-out ones, {VIEWS.truth_spp} spp, against results at {VIEWS.spp} spp",
        ),
    )
}


@dataclass(frozen=True)
class Column:
    """One number per row: a quantity under a metric."""

    group: str  # header above the metric, e.g. "Albedo"
    quantity: str  # as in metric keys
    metric: Metric
    overrides: Mapping[str, str] = dataclasses.field(default_factory=dict)  # variant axes that the column pins
    published: bool = True  # whether the paper has this number
    uniform_grid: float | None = None  # what the constant 0.5 scores on the paper's grid of 11 levels: for the dagger

    def key(self, variant: Variant) -> str:
        """The metric key that the column shows under a variant."""
        return metric_key(self.quantity, self.metric, self.variant(variant))

    def variant(self, variant: Variant) -> Variant:
        """The variant with the axes that the column pins."""
        return dataclasses.replace(variant, **self.overrides)

    @property
    def published_key(self) -> str:
        return f"{self.quantity}.{self.metric.name}"


@dataclass(frozen=True)
class TableSpec:
    """What a table is made of."""

    name: str  # as in records
    title: str
    columns: tuple[Column, ...]
    protocols: tuple[str, ...]  # keys of PROTOCOLS, the paper's first
    description: str = ""
    remarks: tuple[tuple[str, tuple[str, ...]], ...] = ()  # each with the groups of columns that it is about


def _image_columns(group: str, quantity: str, *, ssim: bool = True) -> tuple[Column, ...]:
    names = ("psnr", "ssim", "lpips_vgg", "lpips_alex") if ssim else ("psnr", "lpips_vgg", "lpips_alex")
    return tuple(Column(group, quantity, METRICS[name], published=name != "lpips_alex") for name in names)


_IN_MASK = {"mask": "masked"}
TABLES: dict[str, TableSpec] = {
    "rendering": TableSpec(
        "rendering",
        "Rendering (material edits)",
        (
            *_image_columns("Metallic", "edit_metallic", ssim=False),
            *_image_columns("Roughness", "edit_roughness", ssim=False),
        ),
        ("from-image", "given", "given-light"),
        "Base metallic 0.5 and roughness 0.5; targets metallic 1.0, roughness 0.1 and 0.9.",
    ),
    "inverse": TableSpec(
        "inverse",
        "Inverse rendering",
        (
            *_image_columns("Albedo", "albedo"),
            Column("Albedo", "albedo", METRICS["ciede2000"], published=False),
            Column("Metallic", "metallic", METRICS["mse"], _IN_MASK, uniform_grid=GRID_MSE),
            Column("Roughness", "roughness", METRICS["mse"], _IN_MASK, uniform_grid=GRID_MSE),
            Column("Normal", "normal", METRICS["cosine"]),
            Column("Mask", "mask", METRICS["iou"], published=False),  # only where some row has one of its own
        ),
        ("single-image",),
        "One image in; maps out.",
        (("Metallic, roughness and normal are always taken inside the mask.", ("Metallic", "Roughness", "Normal")),),
    ),
    "relighting": TableSpec(
        "relighting",
        "Relighting",
        (
            *_image_columns("Specular", "specular"),
            *_image_columns("Diffuse", "diffuse"),
            *_image_columns("Relit", "relit"),
        ),
        ("from-image-sd", "from-image-hdri"),
        "Specular and diffuse: the light buffers found in the input. Relit: the object under another light.",
    ),
}
