"""The members of a group, read and held against the data contract.

What the contract does not allow is refused here, once, before anything is trained on it: a mask of 255, normals stored
as colours, light that is negative or not finite, a background, another camera. Half precision's rounding is within the
tolerances. `where` and `file` are how a message names the group, or its member.
"""

import json
import math
import re
from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from unirender.camera import Camera
from unirender.errors import UnirenderError
from unirender.exr import CAMERA_ATTRIBUTE, HALF_MAX, Channels, channels_rgb, read_exr_bytes
from unirender.intrinsics import NORMAL_TOLERANCE, RANGE_TOLERANCE, Intrinsics
from unirender.light.exposure import MASK_THRESHOLD

KINDS = ("basis", "independent", "one-at-a-time", "paper", "sweep")  # what `vary` may be
BLACK = 1e-3  # radiance that shows nothing
LEAST_OUTSIDE = 0.01  # share of a picture's pixels whose median says something
ADVICE = "remake the data set; for shards of your own see `Your own renders` on the docs' page on training"

_LIGHT = re.compile(
    r"l(?P<light>\d+)\.(?:(?P<environment>environment)|(?P<diffuse>diffuse)|(?:r(?P<level>\d+)|maps)\.(?P<specular>specular)"
    r"|m(?P<metallic>\d+)_r(?P<roughness>\d+)|maps)\.exr"
)
_CAMERA_START = "fov_deg="
_CAMERA_JSON = '{"fov_deg": 36, "principal": [0.5, 0.5]}'


def members_of_lights(members: Mapping[str, bytes], where: str) -> dict[str, re.Match[str]]:
    """The members of the lights, in order of name, by what their names say.

    Raises:
        UnirenderError: one is unknown, or beyond 100 percent.
    """
    found = {}
    for name in sorted(members):
        if name in ("json", "shared.exr"):
            continue
        if name == "visible.npy":
            raise UnirenderError(
                f"{where}: has no pictures but {name}, which directions the object hides; `unirender "
                "train-visibility` learns from that, `unirender train` from data of another --vary"
            )
        match = _LIGHT.fullmatch(name)
        if match is None:
            raise UnirenderError(f"{where}: unknown member {name!r}; was it written by another version?")
        for part in ("metallic", "roughness", "level"):
            if (value := percent(match[part])) is not None and value > 100:
                raise UnirenderError(
                    f"{where}: member {name} says {value} percent, expected 0 to 100: roughness 0.3 is r030"
                )
        found[name] = match
    return found


def vary_of(members: Mapping[str, bytes], where: str) -> str:
    """What the group's json says that its pictures differ in.

    Raises:
        UnirenderError: it says nothing of it, or of another camera than the contract's.
    """
    known = f"expected one of {', '.join(KINDS)}"
    if "json" not in members:
        raise UnirenderError(f'{where}: member json is missing, expected one like {{"vary": "independent"}}; {ADVICE}')
    try:
        about: Any = json.loads(members["json"])
    except ValueError as error:
        raise UnirenderError(f"{where}.json: cannot be read as JSON ({error}); {ADVICE}") from error
    if not isinstance(about, dict):
        raise UnirenderError(f"{where}.json: got {about!r:.60}, expected an object with the entry vary; {ADVICE}")
    if "vary" not in about:
        raise UnirenderError(f"{where}.json: the entry vary is missing, {known}; {ADVICE}")
    if about["vary"] not in KINDS:
        raise UnirenderError(f"{where}.json: vary is {about['vary']!r:.60}, {known}")
    if isinstance(camera := about.get("camera"), dict):
        default = Camera()
        try:
            x, y = map(float, camera.get("principal", default.principal))
            own = Camera(float(camera.get("fov_deg", default.fov_deg)), (x, y))
        except (TypeError, ValueError) as error:
            raise UnirenderError(f"{where}.json: camera: got {camera!r:.80}, expected {_CAMERA_JSON}") from error
        _check_camera(own, f"{where}.json")
    return about["vary"]


def decoded(data: bytes, file: str) -> tuple[Channels, dict[str, str]]:
    """Channels and attributes of an EXR.

    Raises:
        UnirenderError: it is none, or was taken by another camera than the contract's.
    """
    channels, attributes = read_exr_bytes(data, name=file)
    text = attributes.get(CAMERA_ATTRIBUTE, "")
    if text.startswith(_CAMERA_START):  # other programs have attributes of that name, too
        _check_camera(Camera.parse(text), file)
    return channels, attributes


def surface(channels: Channels, own_maps: bool, file: str) -> Float[np.ndarray, "c h w"]:
    """Albedo, normal, mask, and roughness and metallic where they are the object's own.

    Raises:
        UnirenderError: one is missing or outside its range, the mask covers nothing, or normals are not unit.
    """
    parts = {"albedo": "RGB", "normal": "XYZ", "mask": "Y"}
    parts |= {"roughness": "Y", "metallic": "Y"} if own_maps else {}
    maps = _in_contract(file, **{name: _stack(channels, file, name, names) for name, names in parts.items()})
    maps = maps.with_unit_normals().require(*parts)
    inside = channels["mask.Y"] > MASK_THRESHOLD
    if not inside.any():
        raise UnirenderError(
            f"{file}: mask: no pixel has coverage above {MASK_THRESHOLD}, expected an object in view; leave the group "
            "out, or mend its mask"
        )
    length = float(np.median(np.linalg.norm(_stack(channels, file, "normal", "XYZ")[inside], axis=-1)))
    if abs(length - 1) > NORMAL_TOLERANCE:
        raise UnirenderError(
            f"{file}: normal: most vectors on the object have a length of {length:.3f}, expected 1; normalise, and map "
            "[0, 1] pictures with 2 x - 1"
        )
    return np.moveaxis(np.concatenate(list(maps.values()), axis=-1), -1, 0)


def light_map(channels: Channels, file: str) -> Float[np.ndarray, "h w 3"]:
    """The light, a lat-long map of linear radiance.

    Raises:
        UnirenderError: it is none, or has values below 0 or not finite.
    """
    environment = _stack(channels, file, "")
    height, width = environment.shape[:2]
    if not 2 * (height - 1) <= width <= 2 * height:  # rows from pole to pole, or as many as a picture has
        raise UnirenderError(
            f"{file}: is {width} x {height} texels, expected a lat-long map, twice as wide as high; resample it first"
        )
    return _in_contract(file, environment=environment).require("environment")["environment"]


def radiance(channels: Channels, kind: str, interpolated: bool, file: str) -> Float[np.ndarray, "h w 3"]:
    """s, d or, where `kind` is empty, the picture; linear.

    Args:
        channels: of the member.
        kind: `specular`, `diffuse` or nothing.
        interpolated: whether noise may be below 0.
        file: for messages.

    Raises:
        UnirenderError: values are not finite, below 0 or too bright for half precision.
    """
    rgb = _stack(channels, file, kind if f"{kind}.R" in channels else "")
    if bad := int(np.count_nonzero(~np.isfinite(rgb))):
        raise UnirenderError(f"{file}: {bad} of {rgb.size} values are NaN or infinite, expected finite values")
    if (high := float(np.abs(rgb).max())) > HALF_MAX:
        raise UnirenderError(
            f"{file}: got {high:.4g}, half precision ends at {HALF_MAX:g}; lower the exposure of the light"
        )
    if not interpolated and (low := float(rgb.min())) < -RANGE_TOLERANCE:
        raise UnirenderError(f"{file}: got a minimum of {low:.4g}, expected radiance >= 0")
    return rgb


def check_background(picture: Float[np.ndarray, "h w 3"], outside: Bool[np.ndarray, "h w"], file: str) -> None:
    """Looks whether a picture is premultiplied; noise and denoisers reach a few pixels outside the mask, too.

    Raises:
        UnirenderError: most of what is outside can be seen.
    """
    if outside.mean() > LEAST_OUTSIDE and (seen := float(np.median(picture[outside].max(axis=-1)))) > BLACK:
        raise UnirenderError(
            f"{file}: shows its background (median radiance {seen:.3g} where the mask is 0), expected 0 there; "
            "premultiply it: multiply it by the coverage"
        )


def percent(digits: str | None) -> int | None:
    """Of a part of a member's name; None where it has none."""
    return None if digits is None else int(digits)


def _check_camera(camera: Camera, file: str) -> None:
    own = Camera()
    numbers = zip((camera.fov_deg, *camera.principal), (own.fov_deg, *own.principal), strict=True)
    if not all(math.isclose(a, b, rel_tol=1e-3) for a, b in numbers):
        raise UnirenderError(
            f"{file}: was taken by the camera {camera.describe()}, expected {own.describe()}, which training takes for "
            "that of every picture; render it with that one"
        )


def _stack(channels: Channels, file: str, prefix: str, components: str = "RGB") -> Float[np.ndarray, "h w c"]:
    try:
        return channels_rgb(channels, prefix, components)
    except UnirenderError as error:
        raise UnirenderError(f"{file}: {error}; {ADVICE}") from error


def _in_contract(file: str, **maps: np.ndarray) -> Intrinsics:
    try:
        return Intrinsics().replace(**maps)
    except UnirenderError as error:
        raise UnirenderError(f"{file}: {error}") from error
