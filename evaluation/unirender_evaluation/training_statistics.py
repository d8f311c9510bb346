"""Measures the constants of the trivial rows on training data, once: `python -m
unirender_evaluation.training_statistics DATA`.

The trivial rows must know what a lazy method would know: the means of the training distribution, never of a suite.
Written to `OBJECTS` and `LIGHTS`, which state where the numbers come from.
"""

import json
import sys
import tarfile
import tomllib
from collections.abc import Iterator
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from unirender.color import image_srgb
from unirender.errors import UnirenderError
from unirender.exr import Channels, channels_rgb, read_exr_bytes
from unirender.light.environment import mean_radiance
from unirender.light.resampling import resample_environment
from unirender.system.whole_files import replace_file
from unirender_evaluation.light_metrics import SHAPE
from unirender_evaluation.metrics import LOG_EPSILON

OBJECTS, LIGHTS = "data/training_statistics.toml", "data/light_statistics.toml"
HEAD = "# Written by `python -m unirender_evaluation.training_statistics DATA`."


@cache
def training_statistics() -> dict[str, Any]:
    """`albedo_srgb` (display values), `normal` (unit, camera axes) and `provenance`."""
    return _stored(OBJECTS)


@cache
def light_statistics() -> dict[str, Any]:
    """`rows` (16 x RGB, display units, from +y down) and `provenance`."""
    return _stored(LIGHTS)


def _stored(name: str) -> dict[str, Any]:
    return tomllib.loads((resources.files("unirender_evaluation") / name).read_text(encoding="utf-8"))


def object_means(folder: Path) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Coverage-weighted means [3] of (albedo as display values, normal) of every group of a dataset folder.

    Raises:
        UnirenderError: a group has no mask.
    """
    for name, channels in _shard_files(folder, ".shared.exr"):
        weight = channels.get("mask.Y", channels.get("A"))
        if weight is None:
            raise UnirenderError(f"{name} has no mask, expected a dataset of `unirender dataset`")
        weight = weight[..., None] / weight.sum()
        albedo = image_srgb(channels_rgb(channels, "albedo"))
        yield (albedo * weight).sum((0, 1)), (channels_rgb(channels, "normal", "XYZ") * weight).sum((0, 1))


def light_means(folder: Path) -> Iterator[tuple[Float[np.ndarray, "16 3"], float]]:
    """Of every light of a dataset folder the mean of ln(radiance + `LOG_EPSILON`) over each row, and the mean radiance
    over the sphere and the channels."""
    for _, channels in _shard_files(folder, ".environment.exr"):
        light = resample_environment(channels_rgb(channels), SHAPE)
        yield np.log(light.astype(np.float64) + LOG_EPSILON).mean(axis=1), float(mean_radiance(light).mean())


def _shard_files(folder: Path, suffix: str) -> Iterator[tuple[str, Channels]]:
    """Each EXR file of a dataset folder whose name ends so: what to call it in messages, and its channels."""
    for shard in sorted(folder.glob("shard-*.tar")):
        with tarfile.open(shard) as tar:
            for member in tar.getmembers():
                stream = tar.extractfile(member) if member.name.endswith(suffix) else None
                if stream is not None:
                    yield f"{shard}: {member.name}", read_exr_bytes(stream.read())[0]


def measure(folder: Path) -> dict[str, str]:
    """The TOML files, by name, of a dataset folder.

    Raises:
        UnirenderError: the folder has no shard with groups.
    """
    objects, lights = list(object_means(folder)), list(light_means(folder))
    if not objects or not lights:
        raise UnirenderError(
            f"{folder}: no shard-*.tar with groups and lights, expected the folder that `unirender dataset` wrote"
        )
    config = json.loads((folder / "manifest.json").read_text(encoding="utf-8"))["config"]
    told = f"training groups (split {config['split']}, seed {config['seed']}, {config['resolution']} px) of"
    return {OBJECTS: _objects_text(objects, told), LIGHTS: _lights_text(lights, told)}


def _objects_text(means: list[tuple[np.ndarray, np.ndarray]], told: str) -> str:
    albedo, normal = (np.mean([pair[i] for pair in means], axis=0) for i in (0, 1))
    numbers = {"albedo_srgb": albedo, "normal": normal / np.linalg.norm(normal)}
    lines = [f"{name} = [{', '.join(f'{x:.4f}' for x in value)}]" for name, value in numbers.items()]
    provenance = (
        f"mean over {len(means)} {told} each group's coverage-weighted mean; albedo as sRGB display values; the "
        "normal's mean, normalised"
    )
    return "\n".join([HEAD, *lines, f'provenance = "{provenance}"']) + "\n"


def _lights_text(means: list[tuple[np.ndarray, float]], told: str) -> str:
    logs, radiances = zip(*means, strict=True)
    rows = np.exp(np.mean(logs, axis=0)) - LOG_EPSILON
    # A mean of logarithms is darker than the lights, whose lamps it forgets: brought to their mean radiance.
    rows *= np.mean(radiances) / mean_radiance(np.repeat(rows[:, None], SHAPE[1], axis=1).astype(np.float32)).mean()
    lines = [f"    [{', '.join(f'{x:.4f}' for x in row)}]," for row in rows]
    provenance = (
        f"mean over {len(means)} lights of {told} ln(radiance + {LOG_EPSILON:g}) at each of {SHAPE[0]} rows, all "
        "azimuths, times one factor to the lights' mean radiance; display units, camera axes, first row +y"
    )
    return "\n".join([HEAD, "rows = [", *lines, "]", f'provenance = "{provenance}"']) + "\n"


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit("usage: python -m unirender_evaluation.training_statistics DATA")
    try:
        for name, text in measure(Path(sys.argv[1])).items():
            replace_file(Path(str(resources.files("unirender_evaluation") / name)), text)
            sys.stdout.write(text)
    except UnirenderError as error:
        sys.exit(str(error))
