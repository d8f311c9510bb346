"""`Intrinsics`: the data contract that every part of unirender speaks.

All maps are float32 numpy arrays `[..., H, W, C]`. The three-channel colour maps are linear Rec.709; normals are in
camera axes (+x right, +y up, +z towards the viewer). Image-aligned maps are *not* premultiplied: each is the
coverage-weighted mean over the pixel divided by coverage, and 0 where the mask is 0. Light is in display units
(exposure folded in), so that `image_srgb = srgb(clip(image_linear, 0, 1))`.
"""

import dataclasses
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Float

from unirender.blocks import by_rows
from unirender.camera import Camera
from unirender.errors import UnirenderError
from unirender.shown import in_short
from unirender.vectors import lengths

MAPS: dict[str, int] = {
    "albedo": 3,
    "normal": 3,
    "roughness": 1,
    "metallic": 1,
    "specular": 3,
    "diffuse": 3,
    "environment": 3,
    "mask": 1,
}
IMAGE_MAPS = tuple(name for name in MAPS if name != "environment")
RADIANCE_MAPS = ("specular", "diffuse", "environment")
UNIT_RANGE_MAPS = ("albedo", "roughness", "metallic", "mask")
RANGE_TOLERANCE = 1e-3  # half-precision files round 1 up
NORMAL_TOLERANCE = 0.02
LEAST_SIDE = 2  # rows and columns of an environment: its poles, and two directions between them
SHORTEST_NORMAL = 1e-3  # a shorter mean of normals has no direction
UNIT_TOLERANCE = 1e-3  # of a length: half precision rounds it by up to 0.0005


@dataclass(frozen=True, eq=False)
class Intrinsics:
    """The intrinsic attributes of one picture (or of a batch, with leading axes). Any map may be None: not known.

    Shapes are `[..., H, W, C]` with C of `MAPS`; whatever does not fit is refused here, with a reason. Like arrays of
    a program, two with the same values are two (`==` asks whether they are one).

    Attributes:
        albedo: principled `base_color`, linear, [0, 1].
        normal: shading normal in camera axes, unit; 0 outside the mask. A shorter one, as averages are, is kept as
            given; whatever uses a normal uses its direction (`unit_normals`).
        roughness: perceptual roughness, [0, 1]; the GGX alpha is its square.
        metallic: [0, 1].
        specular: s, radiance of the same surface as a perfect mirror-tinted reflector of the same roughness under the
            same light, direct light only; linear HDR, >= 0.
        diffuse: d, radiance of the same surface as white Lambertian (irradiance / pi), direct light only; >= 0.
        environment: the light, lat-long HDR radiance in camera axes, own resolution; >= 0. See `light.environment`.
        mask: coverage, [0, 1].
        camera: vertical field of view and principal point.
    """

    albedo: np.ndarray | None = None
    normal: np.ndarray | None = None
    roughness: np.ndarray | None = None
    metallic: np.ndarray | None = None
    specular: np.ndarray | None = None
    diffuse: np.ndarray | None = None
    environment: np.ndarray | None = None
    mask: np.ndarray | None = None
    camera: Camera = field(default_factory=Camera)

    def __post_init__(self) -> None:
        if not isinstance(self.camera, Camera):
            raise UnirenderError(
                f"camera: got {self.camera!r:.60}, expected a unirender.camera.Camera, like {Camera()}"
            )
        size: tuple[int, ...] | None = None
        for name, channels in MAPS.items():
            value = getattr(self, name)
            if value is None:
                continue
            value = as_radiance(name, value) if name in RADIANCE_MAPS else as_numbers(name, value)
            object.__setattr__(self, name, value)
            if value.ndim < 3 or value.shape[-1] != channels:
                raise UnirenderError(
                    f"{name}: got shape {value.shape}, expected [..., height, width, {channels}]; "
                    "single-channel maps keep their last axis"
                )
            if name == "environment" and min(value.shape[-3:-1]) < LEAST_SIDE:
                raise UnirenderError(
                    f"environment: got shape {value.shape}, expected a lat-long map of at least {LEAST_SIDE} rows (the "
                    f"first and the last lie at the poles) and {LEAST_SIDE} columns"
                )
            if name in IMAGE_MAPS:
                if size is not None and value.shape[:-1] != size:
                    raise UnirenderError(
                        f"{name}: got size {value.shape[:-1]}, expected {size} like the other maps; resample it first"
                    )
                size = value.shape[:-1]
            _check_range(name, value)

    def __repr__(self) -> str:
        maps = [f"{name} {in_short(value)}" for name, value in self.maps.items()]
        return f"Intrinsics({', '.join([*maps, repr(self.camera)])})"

    @property
    def present(self) -> tuple[str, ...]:
        """Names of the maps that are known, in the order of `MAPS`."""
        return tuple(name for name in MAPS if getattr(self, name) is not None)

    @property
    def maps(self) -> dict[str, np.ndarray]:
        """The maps that are known, by name; no copies."""
        return {name: getattr(self, name) for name in self.present}

    @property
    def height(self) -> int:
        return self._size()[0]

    @property
    def width(self) -> int:
        return self._size()[1]

    def _size(self) -> tuple[int, int]:
        for name in IMAGE_MAPS:
            value = getattr(self, name)
            if value is not None:
                return value.shape[-3], value.shape[-2]
        raise UnirenderError("size: no image-aligned map is present, expected at least one")

    def replace(self, **changes: Any) -> "Intrinsics":
        """A copy with some maps (or the camera) replaced; `None` forgets a map."""
        return dataclasses.replace(self, **changes)

    def with_unit_normals(self) -> "Intrinsics":
        """The same with normals of length 1 (`unit_normals`); itself where they are, or where there are none."""
        normal = None if self.normal is None else unit_normals(self.normal)
        return self if normal is self.normal else self.replace(normal=normal)

    def require(self, *names: str) -> dict[str, Float[np.ndarray, "..."]]:
        """The named maps as a dict.

        Raises:
            UnirenderError: one of them is not known, or there is no map of that name.
        """
        if unknown := [name for name in names if name not in MAPS]:
            named = ", ".join(map(repr, unknown))
            raise UnirenderError(f"intrinsics: there is no map {named}, expected some of {', '.join(MAPS)}")
        missing = [name for name in names if getattr(self, name) is None]
        if missing:
            raise UnirenderError(
                f"intrinsics: {', '.join(missing)} missing, expected {', '.join(names)}; present: "
                f"{', '.join(self.present) or 'none'}"
            )
        return {name: getattr(self, name) for name in names}


def as_numbers(name: str, value: Any) -> Float[np.ndarray, "..."]:
    """What somebody handed in as float32.

    Raises:
        UnirenderError: it is no array of numbers.
    """
    try:
        given = np.asarray(value)
        if given.dtype.kind in "cUS":
            raise TypeError("complex numbers, or text")
        return np.asarray(given, dtype=np.float32)
    except (TypeError, ValueError, RuntimeError) as error:  # the last is torch's
        if type(value).__module__ == "torch":
            raise UnirenderError(
                f"{name}: got a tensor that is no array ({error}), expected value.detach().float().cpu().numpy()"
            ) from error
        kind = type(value).__name__
        if isinstance(getattr(value, name, None), np.ndarray):
            raise UnirenderError(f"{name}: got {kind}, expected numbers; it has some as its `{name}`") from error
        got = f"of {value.dtype} values" if isinstance(value, np.ndarray) else f"{value!r:.60}"
        raise UnirenderError(f"{name}: got {kind} {got}, expected numbers") from error


def as_radiance(name: str, value: Any) -> Float[np.ndarray, "..."]:
    """The same of linear radiance, which no whole numbers are: those are display values of a picture.

    Raises:
        UnirenderError: it is no array of numbers, or one of whole numbers.
    """
    numbers = as_numbers(name, value)
    check_radiance(name, value)
    return numbers


def check_radiance(name: str, value: Any) -> None:
    """Looks at the type of an array of radiance.

    Raises:
        UnirenderError: it is one of whole numbers.
    """
    given = np.asarray(value).dtype
    if given.kind in "biu":
        raise UnirenderError(
            f"{name}: got {type(value).__name__} of {given} values, expected linear radiance as floats; read a "
            "photograph or a light file with unirender_reference.lights.load_light(path).environment"
        )


def unit_normals(normal: Float[np.ndarray, "*size 3"]) -> Float[np.ndarray, "*size 3"]:
    """Normals of length 1; unit ones stay as they are, to the bit, and 0, no surface, stays 0.

    Raises:
        UnirenderError: no array of three channels.
    """
    if not isinstance(normal, np.ndarray) or normal.shape[-1:] != (3,):
        raise UnirenderError(f"normal: got {type(normal).__name__} of shape {np.shape(normal)}, expected [..., 3]")
    length = lengths(normal)
    known = length > SHORTEST_NORMAL
    off = np.where(known, np.abs(length - 1) > UNIT_TOLERANCE, length > 0)
    if not off.any():
        return normal
    unit = np.where(known, normal / np.where(known, length, 1), 0)
    return np.where(off, unit, normal).astype(normal.dtype)


def _check_range(name: str, value: Float[np.ndarray, "..."]) -> None:
    """Refuses values that are not finite or out of the map's range, and an empty array."""
    if not np.isfinite(value).all():
        bad = int(np.count_nonzero(~np.isfinite(value)))
        raise UnirenderError(f"{name}: {bad} of {value.size} values are NaN or infinite, expected finite values")
    if value.size == 0:
        raise UnirenderError(f"{name}: got an empty array of shape {value.shape}, expected at least one pixel")
    low, high = float(value.min()), float(value.max())
    if name == "normal":
        longest = float(by_rows(lengths, value).max())
        if longest > 1 + NORMAL_TOLERANCE:
            raise UnirenderError(
                f"normal: longest vector has length {longest:.3f}, expected unit vectors (0 outside the mask); "
                "normalise, and map [0, 1] pictures with 2 x - 1"
            )
    elif name in UNIT_RANGE_MAPS:
        if low < -RANGE_TOLERANCE or high > 1 + RANGE_TOLERANCE:
            raise UnirenderError(f"{name}: got values in [{low:.4g}, {high:.4g}], expected [0, 1]")
    elif low < -RANGE_TOLERANCE:
        raise UnirenderError(f"{name}: got a minimum of {low:.4g}, expected radiance >= 0")
