"""What the readers of whole scenes (IIW, MAW) share: a photograph without an object's mask, and only albedo asked."""

from pathlib import Path
from typing import Any

import numpy as np

from unirender.camera import DEFAULT_FOV_DEG, Camera
from unirender.color import image_srgb, srgb_decode
from unirender_evaluation.public.files import image_size, read_photograph, shrunk
from unirender_evaluation.public.sets import MAPS, Sample

RESOLUTION = 512


class Scenes:
    """Photographs of whole scenes; the first file of each sample is the photograph.

    Args:
        folder: where the set is.
        resolution: the longest side of what methods are handed, pixels; larger photographs are scaled down to it.
    """

    averaged_first: str | None = None

    def __init__(self, folder: Path, resolution: int = RESOLUTION) -> None:
        self.folder, self.resolution = folder, resolution

    def inputs(self, sample: Sample) -> dict[str, Any]:
        """The photograph in 8 bits, all of it covered, through the contract's camera."""
        picture = read_photograph(sample.files[0])
        if max(picture.shape[:2]) > self.resolution:
            picture = image_srgb(shrunk(srgb_decode(picture), self.resolution))
        picture = (np.round(picture * 255) / 255).astype(np.float32)
        return {"image_srgb": picture, "mask": np.ones((*picture.shape[:2], 1), np.float32), "camera": Camera()}

    def frame(self, sample: Sample) -> tuple[tuple[int, int], Camera]:
        """The photograph's own size: a folder of predictions is made from the set itself."""
        return image_size(sample.files[0]), Camera()

    def unit(self, sample: str) -> str:
        """Every photograph counts."""
        return sample

    def why_absent(self, table: str) -> str | None:
        """There is always something to ask."""
        return None

    def about_scenes(self) -> tuple[tuple[str, str], ...]:
        """(what, value) pairs for the protocol line."""
        return (
            ("given", f"one photograph, its longest side at most {self.resolution} px; field of view unknown, taken as "
             f"{DEFAULT_FOV_DEG:g} degrees"),
            ("mask", "none: the whole photograph counts as the object, while our model was trained on single objects"),
        )  # fmt: skip


def scene_sample(table: str, name: str, scene: str, files: tuple[Path, ...]) -> Sample:
    """The question for a photograph's maps; its answer lies in a subfolder of the sample's name."""
    return Sample(table, name, scene, "decompose", name, MAPS, files)
