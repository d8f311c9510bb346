"""How the files of a predictions folder are to be read, where they do not follow the contract: `conventions.toml`.

    normal_axes   = ["+x", "-y", "-z"]  # the three channels of a normal in camera axes (+x right, +y up, +z to the
                                        # viewer); default ["+x", "+y", "+z"], this one is OpenCV's
    exr_colour    = "srgb"              # albedo and rendered pictures in EXR are "linear" (default) or "srgb"
    png_colour    = "linear"            # the same for PNG, s and d included: "srgb" (default) or "linear"
    roughness     = "alpha"             # "perceptual" (default), or the GGX alpha, its square
    premultiplied = false               # rendered pictures: black outside (default), or straight colour

Every key may be left out, and the file too.
"""

import tomllib
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from unirender.color import srgb_decode
from unirender.errors import UnirenderError

FILE = "conventions.toml"
CHOICES: dict[str, tuple[Any, ...]] = {
    "exr_colour": ("linear", "srgb"),
    "png_colour": ("srgb", "linear"),
    "roughness": ("perceptual", "alpha"),
    "premultiplied": (True, False),
}
AXES = ("x", "y", "z")


@dataclass(frozen=True)
class Conventions:
    """See the module; the defaults are the contract's."""

    normal_axes: tuple[str, ...] = ("+x", "+y", "+z")
    exr_colour: str = "linear"
    png_colour: str = "srgb"
    roughness: str = "perceptual"
    premultiplied: bool = True

    def linear(self, value: Float[np.ndarray, "h w c"], suffix: str) -> Float[np.ndarray, "h w c"]:
        """Colours as stored in a file of that suffix, made linear."""
        transfer = self.png_colour if suffix == ".png" else self.exr_colour
        return srgb_decode(value) if transfer == "srgb" else value

    def camera_normal(self, value: Float[np.ndarray, "h w 3"]) -> Float[np.ndarray, "h w 3"]:
        """Normals as stored, in camera axes."""
        turned = np.zeros_like(value)
        for channel, axis in enumerate(self.normal_axes):
            turned[..., AXES.index(axis[-1])] = -value[..., channel] if axis.startswith("-") else value[..., channel]
        return turned

    def perceptual(self, value: Float[np.ndarray, "h w 1"]) -> Float[np.ndarray, "h w 1"]:
        """Roughness as stored, made perceptual."""
        return np.sign(value) * np.sqrt(np.abs(value)) if self.roughness == "alpha" else value


def read_conventions(folder: Path) -> Conventions:
    """The conventions of a predictions folder; the contract's where it has no `conventions.toml`.

    Raises:
        UnirenderError: no TOML, or an unknown key or value; all of them at once, a line each.
    """
    path = folder / FILE
    if not path.is_file():
        return Conventions()
    try:
        data = tomllib.loads(path.read_text(encoding="utf-8-sig"))
    except (OSError, ValueError, RecursionError) as error:
        raise UnirenderError(
            f"{path}: not a readable TOML file ({error}), expected lines like premultiplied = false"
        ) from None
    known = [field.name for field in fields(Conventions)]
    problems = [f"{path}: unknown key {key!r}, expected some of {', '.join(known)}" for key in data if key not in known]
    for key, choices in CHOICES.items():
        value = data.get(key, choices[0])
        if not any(value == choice and type(value) is type(choice) for choice in choices):
            problems.append(f"{path}: {key} is {value!r}, expected {' or '.join(map(repr, choices))}")
    axes = data.get("normal_axes", ["+x", "+y", "+z"])
    if not _are_axes(axes):
        problems.append(
            f'{path}: normal_axes is {axes!r}, expected x, y and z once each with signs: ["+x", "-y", "-z"]'
        )
    if problems:
        raise UnirenderError("\n".join(problems))
    values: dict[str, Any] = data | {"normal_axes": tuple(axes)}
    return Conventions(**values)


def _are_axes(axes: Any) -> bool:
    if not isinstance(axes, list) or not all(isinstance(axis, str) for axis in axes):
        return False
    bare = [axis[1:] if axis[:1] in ("+", "-") else axis for axis in axes]
    return sorted(bare) == list(AXES)
