"""Public test sets in a user's own folder: what each must offer to be scored.

A set is a list of `Sample`s. A sample is one question about one photograph: `decompose` (maps) or `relight` (the object
under another light). Methods are asked with `inputs`; a folder of predictions answers by the names `folder` and
`answer`. What a set says of its truth stays inside its module.
"""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float

from unirender.camera import Camera
from unirender.intrinsics import Intrinsics
from unirender.system.whole_files import file_sha256
from unirender_evaluation.lpips import Lpips
from unirender_evaluation.metrics import Variant
from unirender_evaluation.tables.specs import TableSpec

MAPS = "intrinsics"  # the answer to `decompose`, as a folder of predictions has it
Asks = Literal["decompose", "relight"]


@dataclass(frozen=True)
class Sample:
    """One question about one photograph."""

    table: str  # of the record
    key: str  # of the record: unique in its table
    object: str  # what intervals are over: samples of one object or scene are not independent
    asks: Asks  # what of a method
    folder: str  # name of the subfolder in which a folder of predictions answers it
    answer: str  # name of the answer's file there, without suffix
    files: tuple[Path, ...]  # all that the question and its truth are read from
    one_picture: bool = True  # whether a single photograph suffices to answer it: else only folders of predictions may

    @property
    def protocol(self) -> str:
        """As records name it."""
        return "single-image" if self.asks == "decompose" else "from-image-hdri"

    def sha256(self) -> str:
        """Over names and contents of its files: what makes its records outdated."""
        digest = hashlib.sha256(f"{self.table}/{self.key}/{self.object}".encode())
        for path in self.files:
            digest.update(path.name.encode() + file_sha256(path).encode())
        return digest.hexdigest()


@dataclass(frozen=True)
class Answer:
    """What a method or a folder says to a sample; what it does not say is None."""

    maps: Intrinsics | None = None
    image: Float[np.ndarray, "h w 3"] | None = None
    depth: Float[np.ndarray, "h w 1"] | None = None


@runtime_checkable
class PublicSet(Protocol):
    """A reader of one public test set.

    Attributes:
        name: on the command line and in the protocol.
        tables: what is printed.
        modules: that measure, part of the records' keys.
        variant: what of a picture counts, for the tables' headings.
        resolution: of what methods are handed, pixels (see each reader); part of the keys.
        averaged_first: what is averaged before the table's means, in the plural; None: nothing, every sample counts.
    """

    name: str
    tables: tuple[TableSpec, ...]
    modules: tuple[str, ...]
    variant: Variant
    resolution: int
    averaged_first: str | None

    def samples(self) -> tuple[Sample, ...]:
        """Every question. Raises `PublicSetError` with all that is wrong with the folder's layout."""
        ...

    def inputs(self, sample: Sample) -> dict[str, Any]:
        """What a method is handed. Raises UnirenderError where a file is broken."""
        ...

    def frame(self, sample: Sample) -> tuple[tuple[int, int], Camera]:
        """Rows and columns that a prediction must have, and the camera."""
        ...

    def score(self, sample: Sample, answer: Answer, lpips: Sequence[Lpips]) -> dict[str, float]:
        """Metric key -> value. Raises UnirenderError where a file of the truth is broken."""
        ...

    def suspicions(self, sample: Sample, answer: Answer) -> dict[str, float]:
        """Metric key -> gain in dB of an answer by each usual mistake undone; nothing where the truth tells none."""
        ...

    def unit(self, sample: str) -> str:
        """What of `averaged_first` the sample of that key belongs to; the key itself where there is nothing."""
        ...

    def why_absent(self, table: str) -> str | None:
        """One line for the user where nothing could be asked for the table of that name; None where something could."""
        ...

    def protocol(self, table: str) -> tuple[tuple[str, str], ...]:
        """(what, value) pairs: what exactly the table of that name measures."""
        ...
