"""Reading predicted roughness and metallic by a line fitted on new objects (`unirender.training.after.calibrate`).

The line is one between means over objects. So a prediction is moved as a whole, all samples and all pixels by the
same amount: what one sample says beside another, and one pixel beside another, stays, but for the clip.

    value + (k m + c - m),    m the mean over pixels and samples, k m + c and the result clipped to [0, 1]
"""

from collections.abc import Mapping, Sequence

import numpy as np

from unirender.errors import UnirenderError
from unirender.intrinsics import Intrinsics
from unirender.pipelines.masked_maps import constant_map, masked_mean

NAMES = ("roughness", "metallic")

Lines = Mapping[str, Sequence[float]]  # slope k and offset c, by name; one that is missing stays as predicted


def check_lines(lines: object) -> dict[str, list[float]] | None:
    """The lines as a checkpoint's configuration holds them; None: none.

    Raises:
        UnirenderError: an unknown name, or what is no slope >= 0 with an offset.
    """
    if lines is None:
        return None
    found = dict(lines.items()) if isinstance(lines, Mapping) else {}
    if found.keys() - set(NAMES) or not found or not all(_is_line(line) for line in found.values()):
        raise UnirenderError(
            f"calibration: got {lines!r}, expected a slope of 0 or more and an offset by name, {', '.join(NAMES)} or "
            "both, like {'roughness': [0.8, 0.1]}; mend it in model_index.json, or load with calibration=None"
        )
    return {name: [float(value) for value in line] for name, line in found.items()}


def _is_line(line: object) -> bool:
    if not isinstance(line, list | tuple) or len(line) != 2:
        return False
    return all(isinstance(value, int | float) and np.isfinite(value) for value in line) and line[0] >= 0


def calibrated(samples: Sequence[Intrinsics], lines: Lines | None) -> list[Intrinsics]:
    """The samples of one picture, read by the lines; None: as they are.

    Args:
        samples: with the maps that the lines are of, and the mask.
        lines: checked.
    """
    moved = list(samples)
    for name, (slope, offset) in (lines or {}).items():
        maps = [sample.require(name, "mask") for sample in samples]
        mean = float(np.mean([masked_mean(own[name], own["mask"]) for own in maps]))
        step = np.float32(np.clip(slope * mean + offset, 0, 1) - mean)
        read = [constant_map(np.clip(own[name] + step, 0, 1), own["mask"]) for own in maps]
        moved = [sample.replace(**{name: value}) for sample, value in zip(moved, read, strict=True)]
    return moved
