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

from unirender.camera import Camera
from unirender.errors import UnirenderError

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
UNIT_RANGE_MAPS = ("albedo", "roughness", "metallic", "mask")
RANGE_TOLERANCE = 1e-3  # half-precision files round 1 up
NORMAL_TOLERANCE = 0.02


@dataclass(frozen=True)
class Intrinsics:
    """The intrinsic attributes of one picture (or of a batch, with leading axes). Any map may be None: not known.

    Shapes are `[..., H, W, C]` with C of `MAPS`; whatever does not fit is refused here, with a reason.

    Attributes:
        albedo: principled `base_color`, linear, [0, 1].
        normal: shading normal in camera axes, unit; 0 outside the mask.
        roughness: perceptual roughness, [0, 1]; the GGX alpha is its square.
        metallic: [0, 1].
        specular: s, radiance of the same surface as a perfect mirror-tinted reflector of the same roughness under the
            same light, direct light only; linear HDR, >= 0.
        diffuse: d, radiance of the same surface as white Lambertian (irradiance / pi), direct light only; >= 0.
        environment: the light, lat-long HDR radiance in camera axes, own resolution; >= 0. See `unirender.lighting`.
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
        size: tuple[int, ...] | None = None
        for name, channels in MAPS.items():
            value = getattr(self, name)
            if value is None:
                continue
            value = np.asarray(value, dtype=np.float32)
            object.__setattr__(self, name, value)
            if value.ndim < 3 or value.shape[-1] != channels:
                raise UnirenderError(
                    f"{name}: got shape {value.shape}, expected [..., height, width, {channels}]; "
                    "single-channel maps keep their last axis"
                )
            if name in IMAGE_MAPS:
                if size is not None and value.shape[:-1] != size:
                    raise UnirenderError(
                        f"{name}: got size {value.shape[:-1]}, expected {size} like the other maps; resample it first"
                    )
                size = value.shape[:-1]
            _check_range(name, value)

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

    def require(self, *names: str) -> dict[str, Float[np.ndarray, "..."]]:
        """The named maps as a dict.

        Raises:
            UnirenderError: one of them is not known.
        """
        missing = [name for name in names if getattr(self, name) is None]
        if missing:
            raise UnirenderError(
                f"intrinsics: {', '.join(missing)} missing, expected {', '.join(names)}; present: "
                f"{', '.join(self.present) or 'none'}"
            )
        return {name: getattr(self, name) for name in names}


def _check_range(name: str, value: Float[np.ndarray, "..."]) -> None:
    if not np.isfinite(value).all():
        bad = int(np.count_nonzero(~np.isfinite(value)))
        raise UnirenderError(f"{name}: {bad} of {value.size} values are NaN or infinite, expected finite values")
    if value.size == 0:
        raise UnirenderError(f"{name}: got an empty array of shape {value.shape}, expected at least one pixel")
    low, high = float(value.min()), float(value.max())
    if name == "normal":
        longest = float(np.sqrt(np.square(value).sum(axis=-1).max()))
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
