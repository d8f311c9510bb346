"""How much the maps of a film change from one frame to the next, beside the frames themselves.

A decomposition flickers where its maps change more than the film does. Light to import.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from unirender.files import read_result
from unirender.intrinsics import MAPS
from unirender.pictures import read_picture
from unirender.visualization import map_picture


@dataclass(frozen=True)
class FilmFrame:
    """A frame and its decomposition, as people look at them: display values in [0, 1].

    Attributes:
        shown: the frame itself as `input`, and each map as its PNG shows it.
        mask: coverage.
    """

    shown: dict[str, Float[np.ndarray, "h w c"]]
    mask: Float[np.ndarray, "h w 1"]

    @classmethod
    def read(cls, picture: Path, result: Path) -> "FilmFrame":
        """The picture's file and its result folder.

        Raises:
            UnirenderError: one of them is gone or broken.
        """
        maps = read_result(result, edits=False).maps
        shown = {name: np.clip(map_picture(name, maps[name]), 0, 1) for name in MAPS if name in maps and name != "mask"}
        return cls({"input": read_picture(picture).image_srgb} | shown, maps["mask"])

    def comparable(self, other: "FilmFrame") -> bool:
        """Whether both are of one size and show the object at a common pixel."""
        return self.mask.shape == other.mask.shape and bool((np.minimum(self.mask, other.mask) > 0).any())

    def difference(self, other: "FilmFrame") -> dict[str, float]:
        """Mean absolute difference of each picture; pixels count by the smaller coverage, those of the light alike.

        Args:
            other: `comparable` to this.
        """
        inside = np.minimum(self.mask, other.mask)[..., 0]
        found = {}
        for name, value in self.shown.items():
            change = np.abs(value - other.shown[name]).mean(axis=-1)
            seen = None if name == "environment" else inside
            found[name] = float(np.average(change, weights=seen))
        return found


def temporal_difference(frames: Sequence[tuple[Path, Path] | None]) -> dict[str, float]:
    """The difference of successive frames, mean over the pairs.

    Args:
        frames: picture file and result folder of each frame, in order; None for one without a result.

    Returns:
        `pairs`: how many successive frames both have a result and are `FilmFrame.comparable`; and, unless there are
        none, the mean over them of what `FilmFrame.difference` gives.
    """
    differences: list[dict[str, float]] = []
    before: FilmFrame | None = None
    for files in frames:
        frame = None if files is None else FilmFrame.read(*files)
        if before is not None and frame is not None and before.comparable(frame):
            differences.append(before.difference(frame))
        before = frame
    means = {name: float(np.mean([pair[name] for pair in differences])) for name in (differences or [{}])[0]}
    return {"pairs": len(differences)} | means
