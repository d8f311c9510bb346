"""The rows of our model: what they keep of a picture, and for how long."""

from types import SimpleNamespace
from typing import Any

import numpy as np

from unirender.camera import Camera
from unirender_evaluation.methods.decompositions import KEPT, Decompositions
from unirender_evaluation.methods.pipeline import PipelineMethod


class Counting:
    """A pipeline that counts the pictures which it decomposes."""

    def __init__(self) -> None:
        self.asked: list[float] = []

    def decompose(self, image_srgb: np.ndarray, **_: Any) -> SimpleNamespace:
        self.asked.append(float(image_srgb[0, 0, 0]))
        return SimpleNamespace(intrinsics=None)


def test_rows_share_decompositions_but_thousands_of_them_are_not_kept() -> None:
    pipeline, shared, mask = Counting(), Decompositions[Any](), np.ones((2, 2, 1), np.float32)
    rows = [PipelineMethod(pipeline, name, "w", decompositions=shared) for name in "ab"]
    pictures = [np.full((2, 2, 3), value, np.float32) for value in np.linspace(0, 1, 2 * KEPT)]
    for picture in pictures:
        for row in rows:
            row._decomposition(picture, mask, Camera())
    assert len(pipeline.asked) == len(pictures)
    rows[0]._decomposition(pictures[-KEPT], mask, Camera())
    assert len(pipeline.asked) == len(pictures)
    rows[0]._decomposition(pictures[-KEPT - 1], mask, Camera())
    assert len(pipeline.asked) == len(pictures) + 1
