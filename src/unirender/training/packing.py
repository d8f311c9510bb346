"""One group of a shard, decoded: its members are read, held against the data contract, and become rows of arrays.

What the contract does not allow is refused here, once, before anything is trained on it: a mask of 255, normals stored
as colours, light that is negative or not finite, another camera. Half precision's rounding is within the tolerances.
"""

import json
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Float16

from unirender.camera import Camera
from unirender.errors import UnirenderError
from unirender.exposure import MASK_THRESHOLD
from unirender.exr import CAMERA_ATTRIBUTE, HALF_MAX, Channels, channels_rgb, read_exr_bytes
from unirender.intrinsics import NORMAL_TOLERANCE, RANGE_TOLERANCE, Intrinsics
from unirender.training.environments import turned_environments

ENVIRONMENT_SIZE = (16, 32)  # the environment that the model predicts
SCALAR_CHANNELS = 7  # of shared maps without roughness and metallic
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
_INTERPOLATED = "interpolated"  # attribute of pictures whose noise may be below 0


@dataclass(frozen=True)
class Pair:
    """One picture of a group and the rows of its buffers in `Shard.pixels` (`light`: row of `Shard.environment`).

    Metallic and roughness are both None where they are the group's maps.
    """

    light: int
    metallic: float | None
    roughness: float | None
    image: int
    specular: int
    diffuse: int


@dataclass(frozen=True)
class Group:
    """An object under its lights; `shared` is a row of `Shard.shared`."""

    key: str
    vary: str
    shared: int
    pairs: tuple[Pair, ...]


class Packer:
    """Collects the rows of a shard's arrays.

    Args:
        path: of the shard, for messages.
    """

    def __init__(self, path: str) -> None:
        self.path = path
        self._pixels: list[Float16[np.ndarray, "3 h w"]] = []
        self._shared: list[Float16[np.ndarray, "c h w"]] = []
        self._environment: list[Float[np.ndarray, "4 3 16 32"]] = []
        self._size: tuple[tuple[int, ...], str] | None = None  # of the pictures, and the group that it is of

    def add(self, key: str, members: Mapping[str, bytes]) -> Group:
        """Takes a group's members, by name without the key.

        Raises:
            UnirenderError: a member is missing, unknown, damaged, of another size, or has values outside the contract.
        """
        where = f"{self.path}: group {key}"
        found = _matched(members, where)
        images: list[tuple[int, int | None, int | None]] = [  # light, metallic, roughness in percent
            (int(match["light"]), _percent(match["metallic"]), _percent(match["roughness"]))
            for match in found.values()
            if not (match["environment"] or match["diffuse"] or match["specular"])
        ]
        vary = _vary(members, where)
        if not images:
            raise UnirenderError(f"{where}: has no picture, expected at least one; {ADVICE}")
        own_maps = any(metallic is None for _, metallic, _ in images)
        if own_maps and vary == "basis":
            raise UnirenderError(
                f"{where}: vary is basis and the pictures have the object's own roughness and metallic maps, expected "
                "pictures at metallic 0, 0.5 and 1; write vary independent"
            )
        size = self._add_shared(key, members, own_maps)
        rows: dict[tuple, int] = {}
        lights: dict[int, int] = {}
        for name, match in found.items():
            file, light = f"{where}.{name}", int(match["light"])
            channels, attributes = _decoded(members[name], file)
            if match["environment"]:
                lights[light] = len(self._environment)
                turned = turned_environments(_light(channels, file), ENVIRONMENT_SIZE)
                self._environment.append(np.ascontiguousarray(np.moveaxis(turned, -1, 1)))
                continue
            kind = "diffuse" if match["diffuse"] else "specular" if match["specular"] else ""
            pixels = _radiance(channels, kind, _INTERPOLATED in attributes, file)
            if pixels.shape[:2] != size:
                raise UnirenderError(
                    f"{file}: is {_text(pixels.shape)} pixels, expected {_text(size)}, the size of shared.exr"
                )
            if kind == "diffuse":
                rows[light, "diffuse"] = len(self._pixels)
            elif kind == "specular":
                rows[light, "specular", _percent(match["level"])] = len(self._pixels)
            else:
                rows[light, _percent(match["metallic"]), _percent(match["roughness"])] = len(self._pixels)
            if not kind:
                _check_background(pixels, self._shared[-1][6] == 0, file)
            self._pixels.append(np.moveaxis(pixels, -1, 0).astype(np.float16))
        pairs = tuple(
            _pair(*image, rows, lights, where)
            for image in sorted(images, key=lambda image: tuple(part or 0 for part in image))
        )
        return Group(key=key, vary=vary, shared=len(self._shared) - 1, pairs=pairs)

    def arrays(self) -> dict[str, np.ndarray]:
        """`pixels`, `shared` and `environment` of a shard; roughness and metallic of groups without maps are 0."""
        channels = max(len(row) for row in self._shared)
        shared = [np.pad(row, ((0, channels - len(row)), (0, 0), (0, 0))) for row in self._shared]
        stacks = {"pixels": self._pixels, "shared": shared, "environment": self._environment}
        return {name: np.stack(rows) for name, rows in stacks.items()}

    def _add_shared(self, key: str, members: Mapping[str, bytes], own_maps: bool) -> tuple[int, ...]:
        """Takes what does not depend on the light; height and width."""
        where = f"{self.path}: group {key}"
        file = f"{where}.shared.exr"
        if "shared.exr" not in members:
            raise UnirenderError(f"{where}: shared.exr is missing, expected albedo, normal and mask; {ADVICE}")
        channels, _ = _decoded(members["shared.exr"], file)
        maps = _surface(channels, own_maps, file)
        size = maps.shape[1:]
        if self._size is None:
            self._size = size, key
        if size != self._size[0]:
            raise UnirenderError(
                f"{file}: is {_text(size)} pixels, expected {_text(self._size[0])}, the size of group {self._size[1]}; "
                "make one folder per size"
            )
        self._shared.append(maps.astype(np.float16))
        return size


def _matched(members: Mapping[str, bytes], where: str) -> dict[str, re.Match[str]]:
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
            if (percent := _percent(match[part])) is not None and percent > 100:
                raise UnirenderError(
                    f"{where}: member {name} says {percent} percent, expected 0 to 100: roughness 0.3 is r030"
                )
        found[name] = match
    return found


def _vary(members: Mapping[str, bytes], where: str) -> str:
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


def _decoded(data: bytes, file: str) -> tuple[Channels, dict[str, str]]:
    """Channels and attributes of an EXR.

    Raises:
        UnirenderError: it is none, or was taken by another camera than the contract's.
    """
    channels, attributes = read_exr_bytes(data, name=file)
    text = attributes.get(CAMERA_ATTRIBUTE, "")
    if text.startswith(_CAMERA_START):  # other programs have attributes of that name, too
        _check_camera(Camera.parse(text), file)
    return channels, attributes


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


def _surface(channels: Channels, own_maps: bool, file: str) -> Float[np.ndarray, "c h w"]:
    """Albedo, normal, mask, and roughness and metallic where they are the object's own."""
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


def _light(channels: Channels, file: str) -> Float[np.ndarray, "h w 3"]:
    environment = _stack(channels, file, "")
    height, width = environment.shape[:2]
    if not 2 * (height - 1) <= width <= 2 * height:  # rows from pole to pole, or as many as a picture has
        raise UnirenderError(
            f"{file}: is {width} x {height} texels, expected a lat-long map, twice as wide as high; resample it first"
        )
    return _in_contract(file, environment=environment).require("environment")["environment"]


def _radiance(channels: Channels, kind: str, interpolated: bool, file: str) -> Float[np.ndarray, "h w 3"]:
    """s, d or, where `kind` is empty, the picture."""
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


def _check_background(picture: Float[np.ndarray, "h w 3"], outside: Bool[np.ndarray, "h w"], file: str) -> None:
    """Looks whether a picture is premultiplied; noise and denoisers reach a few pixels outside the mask, too."""
    if outside.mean() > LEAST_OUTSIDE and (seen := float(np.median(picture[outside].max(axis=-1)))) > BLACK:
        raise UnirenderError(
            f"{file}: shows its background (median radiance {seen:.3g} where the mask is 0), expected 0 there; "
            "premultiply it: multiply it by the coverage"
        )


def _pair(
    light: int,
    metallic: int | None,
    roughness: int | None,
    rows: Mapping[tuple, int],
    lights: Mapping[int, int],
    where: str,
) -> Pair:
    """A picture with the rows of what explains it.

    Raises:
        UnirenderError: something of it is missing.
    """
    level = "maps" if roughness is None else f"r{roughness:03d}"
    picture = f"l{light}.{level if metallic is None else f'm{metallic:03d}_{level}'}.exr"
    needed = {
        f"l{light}.environment.exr": lights.get(light),
        f"l{light}.diffuse.exr": rows.get((light, "diffuse")),
        f"l{light}.{level}.specular.exr": rows.get((light, "specular", roughness)),
    }
    for name, row in needed.items():
        if row is None:
            raise UnirenderError(f"{where}: member {name} is missing, which {picture} needs; {ADVICE}")
    environment, diffuse, specular = needed.values()
    assert environment is not None
    assert diffuse is not None
    assert specular is not None
    return Pair(
        light=environment,
        metallic=None if metallic is None else metallic / 100,
        roughness=None if roughness is None else roughness / 100,
        image=rows[light, metallic, roughness],
        specular=specular,
        diffuse=diffuse,
    )


def _percent(digits: str | None) -> int | None:
    return None if digits is None else int(digits)


def _text(shape: tuple[int, ...]) -> str:
    return f"{shape[1]} x {shape[0]}"
