"""Measures the constants of the trivial rows on training data, once: `python -m
unirender_evaluation.training_statistics DATA`.

The trivial rows must know what a lazy method would know: the mean of the training distribution, never of a suite.
Written to `data/training_statistics.toml`, which states where the numbers come from.
"""

import json
import sys
import tarfile
import tomllib
from collections.abc import Callable, Iterator
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

from unirender.color import image_srgb
from unirender.errors import UnirenderError
from unirender.exr import Channels, channels_rgb, read_exr_bytes
from unirender.system.whole_files import replace_file

FILE = "data/training_statistics.toml"


@cache
def training_statistics() -> dict[str, Any]:
    """`albedo_srgb` (display values), `normal` (unit, camera axes) and `provenance`."""
    return stored_statistics(FILE)


def stored_statistics(name: str) -> dict[str, Any]:
    """A TOML file of the package."""
    return tomllib.loads((resources.files("unirender_evaluation") / name).read_text(encoding="utf-8"))


def object_means(folder: Path) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Coverage-weighted means [3] of (albedo as display values, normal) of every group of a dataset folder.

    Raises:
        UnirenderError: a group has no mask.
    """
    for name, channels in shard_files(folder, ".shared.exr"):
        weight = channels.get("mask.Y", channels.get("A"))
        if weight is None:
            raise UnirenderError(f"{name} has no mask, expected a dataset of `unirender dataset`")
        weight = weight[..., None] / weight.sum()
        albedo = image_srgb(channels_rgb(channels, "albedo"))
        yield (albedo * weight).sum((0, 1)), (channels_rgb(channels, "normal", "XYZ") * weight).sum((0, 1))


def shard_files(folder: Path, suffix: str) -> Iterator[tuple[str, Channels]]:
    """Each EXR file of a dataset folder whose name ends so: what to call it in messages, and its channels."""
    for shard in sorted(folder.glob("shard-*.tar")):
        with tarfile.open(shard) as tar:
            for member in tar.getmembers():
                stream = tar.extractfile(member) if member.name.endswith(suffix) else None
                if stream is not None:
                    yield f"{shard}: {member.name}", read_exr_bytes(stream.read())[0]


def write_statistics(folder: Path, path: Path) -> str:
    """Measures a dataset folder and writes the TOML file; returns its text.

    Raises:
        UnirenderError: the folder has no shard with groups.
    """
    means = list(object_means(folder))
    if not means:
        raise UnirenderError(
            f"{folder}: no shard-*.tar with groups, expected the folder that `unirender dataset` wrote"
        )
    albedo, normal = (np.mean([pair[i] for pair in means], axis=0) for i in (0, 1))
    normal = normal / np.linalg.norm(normal)
    config = json.loads((folder / "manifest.json").read_text(encoding="utf-8"))["config"]
    numbers = {"albedo_srgb": albedo, "normal": normal}
    lines = [f"{name} = [{', '.join(f'{x:.4f}' for x in value)}]" for name, value in numbers.items()]
    provenance = (
        f"mean over {len(means)} training groups (split {config['split']}, seed {config['seed']}, "
        f"{config['resolution']} px) of each group's coverage-weighted mean; albedo as sRGB display values; "
        "the normal's mean, normalised"
    )
    head = "# Written by `python -m unirender_evaluation.training_statistics DATA`."
    text = "\n".join([head, *lines, f'provenance = "{provenance}"']) + "\n"
    replace_file(path, text)
    return text


def main(module: str, write: Callable[[Path, Path], str], name: str) -> NoReturn:
    """Entry point of a module that measures a dataset folder: 0, or 1 with one line on standard error.

    Args:
        module: its name, as it is run.
        write: measures the folder and writes the file; returns the file's text.
        name: of the file, in the package.
    """
    if len(sys.argv) != 2:
        sys.exit(f"usage: python -m {module} DATA")
    try:
        sys.stdout.write(write(Path(sys.argv[1]), Path(str(resources.files("unirender_evaluation") / name))))
    except UnirenderError as error:
        sys.exit(str(error))
    sys.exit(0)


if __name__ == "__main__":
    main("unirender_evaluation.training_statistics", write_statistics, FILE)
