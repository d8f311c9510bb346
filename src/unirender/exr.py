"""Single-part, multi-channel OpenEXR files of the data contract.

Channel names: `R,G,B[,A]` (the image, premultiplied), `albedo.R/G/B`, `normal.X/Y/Z`, `roughness.Y`, `metallic.Y`,
`specular.R/G/B`, `diffuse.R/G/B`; the mask is `A`, or `mask.Y` where there is no image. Half precision by default; an
environment is a file of its own in float32, since the sun overflows half, and says that it stands on the grid of
`light.environment`: most lat-long maps do not. Provenance stands in string attributes `unirender:*`. Equal content
gives equal bytes.
"""

import hashlib
import io
import re
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import OpenEXR
from jaxtyping import Float

from unirender.arguments import as_instance, as_path
from unirender.camera import Camera
from unirender.errors import UnirenderError
from unirender.intrinsics import IMAGE_MAPS, Intrinsics, as_numbers
from unirender.picture_files.primaries import in_rec709
from unirender.system.whole_files import is_special, replace_file

Channels = dict[str, Float[np.ndarray, "h w"]]
COMBINED = re.compile(r"(^|\.)Combined\.R$")  # what a layer of Blender's calls the red of its picture

SIGNATURE = b"\x76\x2f\x31\x01"
HALF_MAX = 65504.0
HALF_FULL = 2.0**-10  # half precision has all its digits down to 2^-14: of radiance that ends below, too few are left
ATTRIBUTE_PREFIX = "unirender:"
CAMERA_ATTRIBUTE = "camera"  # as `unirender.camera.Camera.describe` has it
LIGHT_ATTRIBUTE = "light_sha256"  # of maps: of the environment beside them, to which s and d belong (`light_sha256`)
GRID_ATTRIBUTE, POLE_GRID = "grid", "poles"
GAUGE_ATTRIBUTE = "exposure_factor"  # of ground truth: its environments are on the pole grid, too
_COMPONENTS = {"normal": "XYZ", "albedo": "RGB", "specular": "RGB", "diffuse": "RGB"}  # the others: "Y"
COLORS = ("", *(name for name, components in _COMPONENTS.items() if components == "RGB"))  # "": the image
MAP_CHANNELS: Mapping[str, tuple[str, ...]] = {
    name: tuple(f"{name}.{component}" for component in _COMPONENTS.get(name, "Y")) for name in IMAGE_MAPS
}
COLOR_SPACE_ATTRIBUTE = "colorInteropID"  # of OpenEXR 3.4 and later: <transfer>_<primaries>_<scene or display>
OUR_COLOR_SPACES = ("lin_rec709_scene", "data", "unknown", "")
SQUARE = 0.02  # of 1: how far pixels may be from square, as writers round


def write_exr(
    path: str | Path,
    channels: Mapping[str, np.ndarray],
    *,
    half: bool = True,
    attributes: Mapping[str, str] | None = None,
) -> None:
    """Writes a file, moved into place when it is complete (`whole_files.replace_file`).

    Args:
        path: where; its folder is made where there is none.
        channels: `[h w]` float arrays by channel name.
        half: store 16-bit floats; radiance above 65504 is then refused, not clipped.
        attributes: provenance; keys get the prefix `unirender:`.

    Raises:
        UnirenderError: shapes differ or are empty, a name is no text, or a value is no number, not finite, or does not
            fit into half precision.
        OSError: it cannot be written; what was there stays.
    """
    replace_file(as_path(path), exr_bytes(channels, half=half, attributes=attributes))


def write_environment(
    path: str | Path, environment: Float[np.ndarray, "h w 3"], attributes: Mapping[str, str] | None = None
) -> None:
    """Writes an environment of the contract (rows on the poles, `light.environment`) in float32, marked as one.

    `on_pole_grid` knows it again. Arguments and errors as `write_exr`.
    """
    marked = {**(attributes or {}), GRID_ATTRIBUTE: POLE_GRID}
    write_exr(path, image_channels(environment), half=False, attributes=marked)


def header_camera(attributes: Mapping[str, str]) -> Camera | None:
    """The camera that a file's header states as ours do; None where it states none, or what others call a camera."""
    try:
        return Camera.parse(attributes.get(CAMERA_ATTRIBUTE, ""))
    except UnirenderError:
        return None


def radiance_fits_half(channels: Mapping[str, np.ndarray]) -> bool:
    """Whether half precision holds the image, s and d among some channels: none is too bright for it, or dim in all."""
    names = [*"RGB", *MAP_CHANNELS["specular"], *MAP_CHANNELS["diffuse"]]
    peaks = [float(np.max(channels[name], initial=0)) for name in names if name in channels]
    peak = max(peaks, default=0.0)
    return peak == 0 or HALF_FULL <= peak <= HALF_MAX


def on_pole_grid(attributes: Mapping[str, str]) -> bool:
    """Whether a lat-long map with these attributes is an environment of the contract, to be taken as it is.

    True for files of `write_environment` and for those of data sets and suites, which carry their exposure factor.
    Every other map is taken as areas: its first and last row end at the poles.
    """
    return attributes.get(GRID_ATTRIBUTE) == POLE_GRID or GAUGE_ATTRIBUTE in attributes


def exr_bytes(
    channels: Mapping[str, np.ndarray], *, half: bool = True, attributes: Mapping[str, str] | None = None
) -> bytes:
    """The bytes of an EXR file; arguments and errors as `write_exr`."""
    as_instance(channels, Mapping, "EXR channels")
    shapes = {name: np.shape(value) for name, value in channels.items()}
    common = next(iter(shapes.values()), ())
    if set(shapes.values()) != {common} or len(common) != 2 or 0 in common:
        raise UnirenderError(f"EXR channels: got shapes {shapes}, expected one common [height, width]")
    if unnamed := [name for name in channels if not isinstance(name, str) or not name]:
        raise UnirenderError(f"EXR channels: got the names {', '.join(map(repr, unnamed))}, expected text")
    stored = {}
    for name, value in channels.items():
        value = as_numbers(f"EXR channel {name}", value)
        if not np.isfinite(value).all():
            raise UnirenderError(f"EXR channel {name}: got NaN or infinity, expected finite values")
        if half and np.abs(value).max(initial=0.0) > HALF_MAX:
            raise UnirenderError(
                f"EXR channel {name}: got {np.abs(value).max():.4g}, half precision ends at {HALF_MAX:g}; "
                "lower the exposure of the light (in Python: or pass half=False)"
            )
        stored[name] = np.ascontiguousarray(value, dtype=np.float16 if half else np.float32)
    header: dict[str, object] = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    for key, value in as_instance(attributes or {}, Mapping, "EXR attributes").items():
        text = str(value).encode(errors="backslashreplace").decode()  # the name of a file need not be UTF-8
        header[key if key.startswith(ATTRIBUTE_PREFIX) else ATTRIBUTE_PREFIX + key] = text
    stream = io.BytesIO()
    OpenEXR.File(header, stored, num_threads=0).write(stream)
    return stream.getvalue()


def read_exr(path: str | Path) -> tuple[Channels, dict[str, str]]:
    """Channels `[h w]` (float32) by name, and the string attributes (`unirender:` removed) of a file.

    Colours of a file that states other primaries come in Rec.709 (`unirender.picture_files.primaries`). The picture of
    Blender's layer, `ViewLayer.Combined.R` and so on, is R, G, B and A where a file has one such layer and no R.

    Raises:
        UnirenderError: the file is missing, a pipe, no readable single-part OpenEXR, or stores pixels of another part
            than its picture.
    """
    path = as_path(path)
    if is_special(path):  # which would wait for who writes to it, or never end
        raise UnirenderError(f"{path}: is a pipe or a device, expected an OpenEXR file; save it as a file first")
    try:
        data = path.read_bytes()
    except OSError as error:
        raise UnirenderError(f"{path}: cannot be read ({error.strerror}), expected an OpenEXR file") from error
    return read_exr_bytes(data, name=str(path))


def pixel_count(path: Path) -> int:
    """By the header of a file; 0 where it has none that can be read."""
    try:
        low, high = OpenEXR.File(str(path), header_only=True).header()["dataWindow"]
    except Exception:  # several types, as in reading
        return 0
    return (int(high[0]) - int(low[0]) + 1) * (int(high[1]) - int(low[1]) + 1)


def channel_names(path: Path) -> frozenset[str]:
    """By the header of a file; none where it has none that can be read."""
    try:
        return frozenset(channel.name for channel in OpenEXR.File(str(path), header_only=True).header()["channels"])
    except Exception:  # several types, as in reading
        return frozenset()


def stated(path: Path, attribute: str) -> str | None:
    """An attribute of ours in the header of a file; None where there is none that can be read."""
    if not path.is_file():
        return None
    try:
        return OpenEXR.File(str(path), header_only=True).header().get(ATTRIBUTE_PREFIX + attribute)
    except Exception:  # several types, as in reading
        return None


def light_sha256(environment: Float[np.ndarray, "eh ew 3"]) -> str:
    """What tells one light from another."""
    return hashlib.sha256(repr(environment.shape).encode() + environment.tobytes()).hexdigest()


def read_exr_bytes(data: bytes, name: str = "EXR data") -> tuple[Channels, dict[str, str]]:
    """As `read_exr`, from memory; `name` stands in error messages."""
    try:
        file = OpenEXR.File(io.BytesIO(data), separate_channels=True, num_threads=0)
        parts = len(file.parts)
        stored_channels, header = _named(file.channels()), file.header()
        _check_stored(stored_channels, header, name)
        channels = {key: np.asarray(channel.pixels, dtype=np.float32) for key, channel in stored_channels.items()}
    except UnirenderError:
        raise
    except Exception as error:  # the binding raises several types for broken data
        kind = "damaged or mip-mapped" if data.startswith(SIGNATURE) else "of another kind" if data else "empty"
        message = f"{name}: not a readable OpenEXR file: it is {kind}; write it again, as scan lines"
        raise UnirenderError(message) from error
    if parts != 1:
        raise UnirenderError(f"{name}: got {parts} parts, expected a single-part file; split it first")
    stored, shown = (
        tuple(tuple(int(x) for x in corner) for corner in header[window]) for window in ("dataWindow", "displayWindow")
    )
    if stored != shown:
        raise UnirenderError(
            f"{name}: the pixels cover {stored} (dataWindow) and the picture {shown} (displayWindow), from the first "
            "pixel to the last, expected the same; save the whole picture"
        )
    if "chromaticities" in header:
        channels = in_rec709(channels, header["chromaticities"], COLORS, name)
    attributes = {key.removeprefix(ATTRIBUTE_PREFIX): value for key, value in header.items() if isinstance(value, str)}
    return channels, attributes


def _named(channels: Mapping[str, OpenEXR.Channel]) -> dict[str, OpenEXR.Channel]:
    """The channels, those of the one combined picture by their last letter."""
    layers = {name[:-1] for name in channels if COMBINED.search(name)}
    layer = layers.pop() if len(layers) == 1 and "R" not in channels else ""
    return {name.removeprefix(layer): channel for name, channel in channels.items()}


def _check_stored(channels: Mapping[str, OpenEXR.Channel], header: Mapping[str, object], name: str) -> None:
    """Looks for pixels that are no picture of radiance, before any is converted.

    Raises:
        UnirenderError: a deep file, channels with fewer pixels than the picture, colours that are whole numbers or of
            another space than the numbers of `chromaticities` can say, or pixels that are not square.
    """
    got = ""
    for key, channel in channels.items():
        kind = channel.pixels.dtype.kind
        if kind == "O":
            got = f"a deep file (several samples in a pixel of {key}), expected one value a pixel; flatten it first"
        elif (channel.xSampling, channel.ySampling) != (1, 1):
            step = f"{channel.xSampling} x {channel.ySampling}"
            got = f"one value of {key} for {step} pixels, expected one for each; save it as R, G, B without subsampling"
        elif kind in "ui" and key.rpartition(".")[2] in ("R", "G", "B"):
            got = f"whole numbers in {key}, expected radiance in half or float; divide them by their white first"
    space, ratio = header.get(COLOR_SPACE_ATTRIBUTE), header.get("pixelAspectRatio", 1.0)
    by_numbers = str(space).startswith("lin_") and "chromaticities" in header
    if "R" in channels and not (space in (None, *OUR_COLOR_SPACES) or by_numbers):
        got = f"colours of {space!r} ({COLOR_SPACE_ATTRIBUTE}), expected linear Rec.709; convert it first"
    if isinstance(ratio, float) and abs(ratio - 1) > SQUARE:
        got = f"pixels {ratio:.3g} times as wide as high (pixelAspectRatio), expected square ones; resample it first"
    if got:
        raise UnirenderError(f"{name}: got {got}")


def image_channels(image_linear: Float[np.ndarray, "h w c"]) -> Channels:
    """`[h w 3]` or `[h w 4]` premultiplied linear image -> channels R, G, B[, A].

    Raises:
        UnirenderError: it is no array of such a shape.
    """
    as_instance(image_linear, np.ndarray, "picture")
    if image_linear.ndim != 3 or image_linear.shape[-1] not in (3, 4):
        raise UnirenderError(f"picture: got shape {image_linear.shape}, expected (height, width, 3 or 4)")
    return {name: image_linear[..., i] for i, name in enumerate("RGBA"[: image_linear.shape[-1]])}


def channels_rgb(channels: Channels, prefix: str = "", components: str = "RGB") -> Float[np.ndarray, "h w c"]:
    """Channels `prefix.R`, ... stacked to `[h w 3]`.

    Raises:
        UnirenderError: a channel is missing.
    """
    names = [f"{prefix}.{c}" if prefix else c for c in components]
    missing = [name for name in names if name not in channels]
    if missing:
        raise UnirenderError(f"EXR channels {', '.join(missing)} missing; the file has {', '.join(sorted(channels))}")
    return np.stack([channels[name] for name in names], axis=-1)


def intrinsics_channels(intrinsics: Intrinsics) -> Channels:
    """The image-aligned maps that are present, as channels; the mask as `mask.Y`."""
    channels: Channels = {}
    as_instance(intrinsics, Intrinsics, "channels of intrinsics")
    for name in IMAGE_MAPS:
        value = getattr(intrinsics, name)
        if value is not None:
            for i, channel in enumerate(MAP_CHANNELS[name]):
                channels[channel] = value[..., i]
    return channels


def intrinsics_from_channels(
    channels: Channels,
    environment: Float[np.ndarray, "eh ew 3"] | None = None,
    camera: Camera | None = None,
) -> Intrinsics:
    """The inverse of `intrinsics_channels`; maps without channels are None, the mask is `mask.Y` or else `A`.

    Raises:
        UnirenderError: a map has some of its channels only, or values outside the contract.
    """
    maps: dict[str, np.ndarray] = {}
    as_instance(channels, Mapping, "EXR channels")
    for name in IMAGE_MAPS:
        if any(channel in channels for channel in MAP_CHANNELS[name]):
            maps[name] = channels_rgb(channels, name, _COMPONENTS.get(name, "Y"))
    if "mask" not in maps and "A" in channels:
        maps["mask"] = channels["A"][..., None]
    return Intrinsics(**maps, environment=environment, camera=Camera() if camera is None else camera)
