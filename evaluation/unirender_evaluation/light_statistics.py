"""Measures the mean light of training data, once: `python -m unirender_evaluation.light_statistics DATA`.

The same as `training_statistics` for the light: written to `data/light_statistics.toml`, which states where the numbers
come from.
"""

import json
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from unirender.errors import UnirenderError
from unirender.exr import channels_rgb
from unirender.light.environment import mean_radiance
from unirender.light.resampling import resample_environment
from unirender.system.whole_files import replace_file
from unirender_evaluation.light_metrics import SHAPE
from unirender_evaluation.metrics import LOG_EPSILON
from unirender_evaluation.training_statistics import main, shard_files, stored_statistics

FILE = "data/light_statistics.toml"
SUFFIX = ".environment.exr"


@cache
def light_statistics() -> dict[str, Any]:
    """`rows` (16 x RGB, display units, from +y down) and `provenance`."""
    return stored_statistics(FILE)


def light_means(folder: Path) -> Iterator[tuple[Float[np.ndarray, "16 3"], float]]:
    """Of every light of a dataset folder the mean of ln(radiance + `LOG_EPSILON`) over each row, and the mean radiance
    over the sphere and the channels."""
    for _, channels in shard_files(folder, SUFFIX):
        light = resample_environment(channels_rgb(channels), SHAPE)
        yield np.log(light.astype(np.float64) + LOG_EPSILON).mean(axis=1), float(mean_radiance(light).mean())


def write_statistics(folder: Path, path: Path) -> str:
    """Measures a dataset folder and writes the TOML file; returns its text.

    Raises:
        UnirenderError: the folder has no shard with lights.
    """
    means = list(light_means(folder))
    if not means:
        raise UnirenderError(
            f"{folder}: no shard-*.tar with lights, expected the folder that `unirender dataset` wrote"
        )
    config = json.loads((folder / "manifest.json").read_text(encoding="utf-8"))["config"]
    logs, radiances = zip(*means, strict=True)
    rows = np.exp(np.mean(logs, axis=0)) - LOG_EPSILON
    # A mean of logarithms is darker than the lights, whose lamps it forgets: brought to their mean radiance.
    rows *= np.mean(radiances) / mean_radiance(np.repeat(rows[:, None], SHAPE[1], axis=1).astype(np.float32)).mean()
    lines = [f"    [{', '.join(f'{x:.4f}' for x in row)}]," for row in rows]
    text = (
        "# Written by `python -m unirender_evaluation.light_statistics DATA`.\n"
        f"rows = [\n{chr(10).join(lines)}\n]\n"
        f'provenance = "mean over {len(means)} lights of training groups (split {config["split"]}, seed '
        f"{config['seed']}, {config['resolution']} px) of ln(radiance + {LOG_EPSILON:g}) at each of {SHAPE[0]} rows, "
        "all azimuths, times one factor to the lights' mean radiance; display units, camera axes, first row +y\"\n"
    )
    replace_file(path, text)
    return text


if __name__ == "__main__":
    main("unirender_evaluation.light_statistics", write_statistics, FILE)
