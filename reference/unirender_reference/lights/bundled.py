"""The 26 CC0 maps that ship with the package (made by `lights/convert.py`; licences in `data/lights`)."""

import functools
import tomllib
from importlib import resources
from importlib.resources.abc import Traversable

import numpy as np
from jaxtyping import Float

from unirender.errors import UnirenderError
from unirender.exr import channels_rgb, read_exr_bytes
from unirender_reference.lights.light import Light, normalized


def data_folder() -> Traversable:
    """Where the maps and their catalogue lie."""
    return resources.files("unirender_reference") / "data" / "lights"


@functools.cache
def catalogue() -> dict[str, dict[str, str]]:
    """Rows of `lights.toml` by name: file, source, package, license, split, source_sha256."""
    return tomllib.loads((data_folder() / "lights.toml").read_text(encoding="utf-8"))


def bundled_light(name: str) -> Light:
    """One bundled map, 64 x 128, by its name in the catalogue.

    Raises:
        UnirenderError: no map of that name.
    """
    if name not in catalogue():
        raise UnirenderError(f"bundled light {name!r}: unknown, expected one of {', '.join(sorted(catalogue()))}")
    row = catalogue()[name]
    return Light(
        name, _stored(row["file"]).copy(), {"source": row["package"], "license": row["license"], "split": row["split"]}
    )


@functools.cache
def _stored(file: str) -> Float[np.ndarray, "h w 3"]:
    channels, _ = read_exr_bytes((data_folder() / file).read_bytes(), name=file)
    return normalized(channels_rgb(channels), file)


def bundled_lights(split: str | None = None) -> list[Light]:
    """The bundled maps of a split ("train", "test"), or all, in name order.

    Raises:
        UnirenderError: another split.
    """
    if split not in (None, "train", "test"):
        raise UnirenderError(f"bundled_lights: got split {split!r}, expected 'train', 'test' or None")
    return [bundled_light(name) for name, row in sorted(catalogue().items()) if split in (None, row["split"])]
