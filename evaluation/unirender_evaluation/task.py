"""What a question is: its table and protocol, what a method is given, and the truth to score the answer against."""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Literal

from unirender.intrinsics import Intrinsics
from unirender_evaluation.methods.method import Image, Mask
from unirender_evaluation.suites.suite import Scene
from unirender_reference.shapes import MeshObject

Capability = Literal["decompose", "edit", "relight", "render"]
LIGHT = ("light", "light-from-image")
LIGHT_ANSWER = "environment"
PROTOCOLS: tuple[tuple[str, str], ...] = (
    ("rendering", "from-image"),
    ("rendering", "given"),
    ("rendering", "given-light"),
    ("inverse", "single-image"),
    ("relighting", "from-image-sd"),
    ("relighting", "from-image-hdri"),
    LIGHT,
)


@dataclass(frozen=True)
class Asked:
    """The arrays of a question: what the method is handed (`inputs`), and what the scorer keeps (`truth_*`)."""

    mask: Mask
    inputs: dict[str, dict[str, Any]]  # by capability
    truth_image: Image | None = None
    truth_variance: Image | None = None
    truth_twin: Image | None = None  # of many times the samples, where the suite has one
    truth_maps: Intrinsics | None = None


@dataclass(frozen=True)
class Task:
    """One question: its identity, and its arrays (`Asked`), which are read when one of them is wanted.

    Which questions a run has answered already is looked up without them.

    `folder` and `answer` name the file of a predictions folder that answers it: `<folder>/<answer>.exr` or `.png`; for
    maps `<folder>/intrinsics.exr` or one PNG per map, for the light `<folder>/environment.exr` or `.hdr`.
    """

    table: str
    protocol: str
    sample: str
    scene: Scene
    asks: tuple[Capability, ...]
    folder: str
    answer: str
    read: Callable[[], Asked] = field(repr=False)
    geometry: Callable[[], MeshObject] | None = field(default=None, repr=False)  # of the object: for `Row.told` alone
    quantity: str = "relit"

    @property
    def identity(self) -> str:
        """What tells a question from all others of a suite: table, protocol and sample."""
        return f"{self.table}/{self.protocol}/{self.sample}"

    @property
    def scores_picture(self) -> bool:
        """Whether the answer, or a part of it, is a picture."""
        return self.asks != ("decompose",)

    @property
    def asks_light(self) -> bool:
        """Whether the answer is the light alone."""
        return self.answer == LIGHT_ANSWER

    @cached_property
    def asked(self) -> Asked:
        """The arrays, read once; not to be written into.

        Raises:
            UnirenderError: the suite's truth lacks one of them.
        """
        return self.read()

    @property
    def mask(self) -> Mask:
        """True coverage [h w 1]."""
        return self.asked.mask

    @property
    def inputs(self) -> dict[str, dict[str, Any]]:
        """Keyword arguments for each capability that is asked for; all that a method sees."""
        return self.asked.inputs

    @property
    def truth_image(self) -> Image | None:
        """The true picture, linear, premultiplied; None where none is asked for."""
        return self.asked.truth_image

    @property
    def truth_variance(self) -> Image | None:
        """Its variance, as a mean of noisy renders."""
        return self.asked.truth_variance

    @property
    def truth_twin(self) -> Image | None:
        """The same picture rendered independently with more samples, where the suite has one."""
        return self.asked.truth_twin

    @property
    def truth_maps(self) -> Intrinsics | None:
        """The true maps; None where none are asked for."""
        return self.asked.truth_maps
