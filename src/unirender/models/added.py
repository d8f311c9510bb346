"""What features of a clean picture add to a dual-stream network, whichever features they are.

Notation: b batch, H W image size; 15 channels: attribute pictures without the light (material, albedo, normal, s, d).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor


@dataclass(frozen=True)
class Answers:
    """What a `unirender.models.picture_encoder.PictureEncoder` says itself of pictures; packed, in [-1, 1].

    Attributes:
        whole: mean over the object.
        cells: mean over the object inside each cell.
        light: packed.
    """

    whole: Float[Tensor, "b 15"]
    cells: Float[Tensor, "b 15 h w"]
    light: Float[Tensor, "b 3 eh ew"]

    def each(self, change: Callable[[Tensor], Tensor]) -> "Answers":
        """The answers with `change` made of each of their tensors: other rows, or another form."""
        return Answers(change(self.whole), change(self.cells), change(self.light))


@dataclass(frozen=True)
class Added:
    """What the features of a batch add; zeros in rows without any.

    Attributes:
        levels: to what comes into each level of the image stream's encoder that has a stage, finest first.
        summary: to the time embedding of the attribute stream's decoder.
        skips: to each entry of the feature pyramid that comes to that decoder; None: nothing.
        answers: of an encoder that is asked; None of other features.
    """

    levels: Sequence[Tensor]
    summary: Float[Tensor, "b e"]
    skips: Sequence[Tensor | None] = ()
    answers: Answers | None = None
