"""From the targets of Marigold's intrinsic images to the contract's maps.

A folder says in `target_properties` what its targets are, and that is obeyed:

    target_names                 their names, in the order of the prediction
    <name>.prediction_space      "srgb" (encoded; also where nothing is said), "linear", or "stack": three scalars in
                                 one picture, named by `sub_target_names`, each with properties of its own
    <name>.up_to_scale           whether the unit is unknown

albedo, roughness and metallicity are taken as they are. Shading S is the d of the model's own equation

    picture = albedo * S + residual                                                             (linear light)

with all light in it, bounced light too. Where S is known up to a scale, the equation gives it: the factors of
albedo * S and of the residual (if that is up to scale, too) are those of the least squares. The residual is what is not
diffuse, and no map of ours: s is not a part of the picture.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.optimize import nnls

from unirender.color import srgb_decode
from unirender.errors import UnirenderError
from unirender_evaluation.adapters.folder import inside
from unirender_evaluation.methods.method import Image, Mask

SPACES = ("srgb", "linear", "stack")
MAP_NAMES = {"albedo": "albedo", "roughness": "roughness", "metallicity": "metallic"}  # the target's -> ours
Properties = Mapping[str, Any]


def check_properties(properties: Any, folder: Path) -> None:
    """Looks whether `target_properties`, whatever JSON they are, can be obeyed.

    Raises:
        UnirenderError: they are absent, of another form, name a space that is not known, or no map of ours.
    """
    where = f"{folder / 'model_index.json'}: target_properties"
    if not isinstance(properties, dict) or not isinstance(properties.get("target_names"), list):
        raise UnirenderError(f"{where}: got {properties!r}, expected the names and properties of the targets")
    _check_names(properties, properties["target_names"], where)
    scalars: list[str] = []
    for name in properties["target_names"]:
        space = _space(properties, name)
        if space not in SPACES:
            raise UnirenderError(f"{where}: {name} is {space!r}, expected one of {', '.join(SPACES)}")
        if space == "stack":
            names = properties[name].get("sub_target_names")
            if not isinstance(names, list) or len(names) != 3:
                raise UnirenderError(f"{where}: {name} stacks {names!r}, expected three names, null for none")
            stacked = [sub for sub in names if sub is not None]
            _check_names(properties, stacked, where)
            scalars += stacked
    for name in scalars:
        if _space(properties, name) not in SPACES[:2]:
            raise UnirenderError(f"{where}: {name} is {_space(properties, name)!r}, expected srgb or linear")
    colours = [name for name in properties["target_names"] if name in ("albedo", "shading")]
    if not colours and not set(scalars) & set(MAP_NAMES):
        names = ", ".join([*properties["target_names"], *scalars])
        raise UnirenderError(f"{where}: names {names}, expected some of {', '.join(MAP_NAMES)}, shading")


def _check_names(properties: Properties, names: list[Any], where: str) -> None:
    """Looks whether they are names, and what they name are tables.

    Raises:
        UnirenderError: they are not.
    """
    for name in names:
        if not isinstance(name, str) or not isinstance(properties.get(name, {}), dict):
            got = properties.get(name) if isinstance(name, str) else name
            raise UnirenderError(f"{where}: got {got!r} as a target, expected names, each with a table of properties")


def decoded_targets(
    prediction: Float[np.ndarray, "targets h w 3"], properties: Properties
) -> dict[str, Float[np.ndarray, "h w c"]]:
    """Every target by name, linear: (h, w, 3), or (h, w, 1) where it was stacked."""
    found: dict[str, np.ndarray] = {}
    for name, value in zip(properties["target_names"], prediction, strict=True):
        if _space(properties, name) != "stack":
            found[name] = _linear(value, properties, name)
            continue
        for channel, sub in enumerate(properties[name]["sub_target_names"]):
            if sub is not None:
                found[sub] = _linear(value[..., channel : channel + 1], properties, sub)
    return found


def target_maps(
    targets: Mapping[str, Float[np.ndarray, "h w c"]], properties: Properties, image_srgb: Image, mask: Mask
) -> dict[str, Float[np.ndarray, "h w c"]]:
    """The contract's maps that the targets give; others are absent.

    Args:
        targets: linear.
        properties: `target_properties`.
        image_srgb: the picture, straight display values: it fixes the scale of the shading.
        mask: coverage.
    """
    channels = {"albedo": 3, "roughness": 1, "metallicity": 1}
    named = {MAP_NAMES[name]: value for name, value in targets.items() if value.shape[-1] == channels.get(name)}
    maps = {name: inside(np.clip(value, 0.0, 1.0), mask) for name, value in named.items()}
    scale = shading_scale(targets, properties, srgb_decode(image_srgb), mask)
    return maps if scale is None else maps | {"diffuse": inside(scale * targets["shading"], mask)}


def shading_scale(
    targets: Mapping[str, Float[np.ndarray, "h w c"]], properties: Properties, image_linear: Image, mask: Mask
) -> float | None:
    """The factor that makes the shading d; None where there is no shading, or nothing to fix its scale by."""
    if "shading" not in targets or targets["shading"].shape[-1] != 3:  # a scalar is no light
        return None
    if not _up_to_scale(properties, "shading"):
        return 1.0
    if "albedo" not in targets or _up_to_scale(properties, "albedo"):
        return None
    # A pixel at display white says only that the radiance is at least 1.
    weight = np.sqrt(mask * (image_linear.max(axis=-1, keepdims=True) < 1))
    columns, rest = [targets["albedo"] * targets["shading"]], image_linear
    if "residual" in targets and _up_to_scale(properties, "residual"):
        columns.append(targets["residual"])
    elif "residual" in targets:
        rest = rest - targets["residual"]
    terms = np.stack([(weight * column).ravel() for column in columns], axis=-1).astype(np.float64)
    return float(nnls(terms, (weight * rest).ravel().astype(np.float64))[0][0])


def _space(properties: Properties, name: str) -> Any:
    return properties.get(name, {}).get("prediction_space", "srgb")


def _up_to_scale(properties: Properties, name: str) -> bool:
    return bool(properties.get(name, {}).get("up_to_scale", False))


def _linear(value: Float[np.ndarray, "h w c"], properties: Properties, name: str) -> Float[np.ndarray, "h w c"]:
    return srgb_decode(value) if _space(properties, name) == "srgb" else value.astype(np.float32)
