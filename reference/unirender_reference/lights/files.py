"""Lights from files: lat-long HDR or EXR maps, and photographs by a stated rule.

**Photographs.** A photograph is neither high dynamic range nor a whole sphere. The rule (used for LDR files):

1. *Range.* Display values are decoded to linear and expanded above `KNEE`: with m the largest linear channel,
   `rgb * (1 + (PEAK - 1) * t^2)`, t = clip((m - KNEE) / (1 - KNEE), 0, 1). White becomes PEAK; all below KNEE stays.
2. *Sphere.* The picture fills azimuths of 180 degrees about +z (behind the camera, where a frontal object sees it) and,
   cropped if need be, elevations -45 to +45 degrees; its mirror image fills the other half, so that both borders meet.
   Above and below, its edge row runs on and fades over 30 degrees to that row's mean colour; below, the light is
   multiplied by `FLOOR` as it fades (a floor is darker than what stands on it).

A lat-long LDR panorama (`photograph=False`) gets step 1 only.

**Lat-long maps.** The pixels of a map are areas: its first row ends at the pole, and it is resampled to the contract's
grid, whose first row lies on it. An EXR that unirender wrote is on that grid already (`unirender.exr.on_pole_grid`) and
taken as it is. Pixels of a Radiance file are divided by what its header says they were multiplied by (`EXPOSURE`,
`COLORCORR`), and their colours brought to Rec.709 where it states other `PRIMARIES`.
"""

import logging
import math
import re
from pathlib import Path

import numpy as np
from jaxtyping import Float
from PIL import Image

from unirender.arguments import as_path, check_switches
from unirender.blocks import by_rows
from unirender.color import srgb_decode
from unirender.errors import UnirenderError
from unirender.exr import channels_rgb, image_channels, on_pole_grid, pixel_count, read_exr
from unirender.light.environment import check_shape, is_twice_as_wide
from unirender.light.resampling import resample_environment
from unirender.picture_files import display_files
from unirender.picture_files.primaries import REC709, in_rec709
from unirender.pictures import check_finite, negative_share
from unirender.system.machine import memory_excess
from unirender_reference.backend import mitsuba
from unirender_reference.lights.light import SHAPE, Light, area_resampled, mean_luminance

PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
KNEE, PEAK, FLOOR = 0.8, 16.0, 0.5
WINDOW_DEG, FADE_DEG = 45.0, 30.0
MOST_HEADER_BYTES = 2**16  # of a Radiance file
# Pixels in another order than by rows from the top left, which alone Mitsuba reads.
RGBE_TURNED = re.compile(rb"#\?.*?\n\n(?!-Y \d+ \+X )([-+][XY] \d+ [-+][XY] \d+)\s*\n", re.DOTALL)
OLD_RUNS = "its pixels are run-length coded as Radiance did before 1991"
NEW_RUNS = b"\2\2"  # how rows begin that are coded as since then
XYZE = "32-bit_rle_xyze"  # Mitsuba takes its white for one of D65, which Radiance's is not
HEADER_NUMBERS = {  # of a Radiance file: how many, and what
    "EXPOSURE": (1, "a number above 0"),
    "COLORCORR": (3, "three numbers above 0"),
    "PRIMARIES": (8, "x, y of red, green, blue and white"),
}
SIZES = re.compile(rb"#\?.*?\n-Y (\d+) \+X (\d+)\s*\n|P[Ff]\s+(\d+)\s+(\d+)\s", re.DOTALL)  # of RGBE, of PFM
BYTES_A_TEXEL, BYTES_OF_NONE = 50, 5e8  # of memory: what it takes to read a map and bring it to the contract's grid
HDR_SUFFIXES = {".hdr", ".rgbe", ".pic", ".exr", ".pfm"}
PHOTOGRAPH_SHAPE = (128, 256)

_log = logging.getLogger("unirender.lights")


def load_light(
    path: str | Path,
    photograph: bool | None = None,
    shape: tuple[int, int] | None = None,
    normalise: bool = True,
) -> Light:
    """Loads a light from a file.

    Args:
        path: a lat-long HDR/EXR/PFM map, or an LDR picture.
        photograph: True: an ordinary picture, put on the sphere by the module's rule; False: a lat-long map;
            None: by suffix (HDR formats are lat-long, others are photographs, and this is logged).
        shape: rows and columns of the result; None: the file's own for lat-long maps (bit for bit where it is on the
            contract's grid; other maps of fewer than 64 rows 64 x 128: on fewer rows lamps would smear), 128 x 256 for
            photographs.
        normalise: scale to mean luminance 1; False keeps the radiance of the file (of a photograph: white is `PEAK`).

    Returns:
        The light; `scale` in its provenance is the factor from the file's radiance to the light's. Negative values of
        resampled HDR files (ringing of their makers' filters) are set to 0 *after* resampling, and their share of the
        total is in the provenance.

    Raises:
        UnirenderError: missing, unreadable, too large for the machine, not finite, black, more negative than ringing
            is, or no lat-long map; or the shape is none of a map.
    """
    path = as_path(path, "light")
    check_switches(normalise=normalise)
    if photograph is not None:
        check_switches(photograph=photograph)
    if not path.is_file():
        missing = "is a folder" if path.is_dir() else "no such file"
        raise UnirenderError(
            f"light {path}: {missing}, expected an HDR, EXR, PFM, PNG or JPG file (`unirender lights --export FOLDER` "
            "writes the bundled ones)"
        )
    if shape is not None:
        check_shape(shape)
    hdr = path.suffix.lower() in HDR_SUFFIXES
    _check_memory(path, hdr)
    pixels, attributes = _read_hdr(path) if hdr else (expand_range(srgb_decode(_read_ldr(path))), {})
    check_finite(pixels, f"light {path}")
    as_photograph = photograph if photograph is not None else not hdr
    if as_photograph and photograph is None:
        _log.warning(
            "light %s: taken as a photograph of what lies behind the camera, not as a panorama, which is a lat-long "
            "HDR, EXR or PFM file (in Python also any other, with photograph=False)",
            path,
        )
    provenance = {"source": "file", "file": path.name, "rule": "lat-long"}
    if as_photograph:
        provenance["rule"] = f"photograph: knee {KNEE:g}, peak {PEAK:g}, window {WINDOW_DEG:g} deg, floor {FLOOR:g}"
        environment = photograph_environment(pixels, shape or PHOTOGRAPH_SHAPE)
    else:
        h, w = pixels.shape[:2]
        if not is_twice_as_wide(h, w):
            raise UnirenderError(
                f"light {path}: got {w}x{h}, expected a lat-long map twice as wide as high; unwrap a light probe "
                "first; an ordinary photograph is a PNG or JPG file (in Python also any other, with photograph=True)"
            )
        if on_pole_grid(attributes):
            provenance["rule"] = "lat-long on the contract's grid"
            environment = pixels if shape in (None, (h, w)) else resample_environment(pixels, shape)
        else:
            environment = area_resampled(pixels, shape or (SHAPE if h < SHAPE[0] else (h, w)))
    if negative := negative_share(environment, f"light {path}"):
        provenance["negative_share"] = f"{negative:.2e}"
    environment = np.maximum(environment, 0)
    mean = mean_luminance(environment, f"light {path}")
    if normalise:
        environment = (environment / mean).astype(np.float32)
    provenance["scale"] = repr(1 / mean if normalise else 1.0)
    name = path.stem.replace(".", "-").replace("/", "-") or "light"
    return Light(name, environment, provenance)


def expand_range(linear: Float[np.ndarray, "h w 3"]) -> Float[np.ndarray, "h w 3"]:
    """Step 1 of the photograph rule: linear [0, 1] -> [0, PEAK], colour kept."""
    t = np.clip((linear.max(-1, keepdims=True) - KNEE) / (1 - KNEE), 0, 1)
    return (linear * (1 + (PEAK - 1) * t * t)).astype(np.float32)


def photograph_environment(pixels: Float[np.ndarray, "h w 3"], shape: tuple[int, int]) -> Float[np.ndarray, "h2 w2 3"]:
    """Step 2 of the photograph rule: a linear picture on the sphere."""
    rows, half = 2 * shape[0], shape[1]  # drawn at twice the size, then averaged on to the grid
    window = round(rows * 2 * WINDOW_DEG / 180)
    h, w = pixels.shape[:2]
    wanted = min(h, max(1, round(w * window / half)))  # equal angles per pixel both ways; the middle is kept
    crop = pixels[(h - wanted) // 2 : (h - wanted) // 2 + wanted]
    image = _box_resize(crop, (window, half))
    image = np.concatenate([image[:, : half // 2][:, ::-1], image, image[:, half // 2 :][:, ::-1]], axis=1)
    top = (rows - window) // 2
    bottom = rows - window - top
    fade = rows * FADE_DEG / 180
    up = np.clip((np.arange(top)[::-1] + 0.5) / fade, 0, 1)[:, None, None]
    down = np.clip((np.arange(bottom) + 0.5) / fade, 0, 1)[:, None, None]
    sky = image[:1] * (1 - up) + image[0].mean(0) * up
    floor = (image[-1:] * (1 - down) + image[-1].mean(0) * down) * (1 - (1 - FLOOR) * down)
    return area_resampled(np.concatenate([sky, image, floor]), shape)


def _box_resize(pixels: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    size = (shape[1], shape[0])
    channels = [
        np.asarray(Image.fromarray(np.ascontiguousarray(pixels[..., k], np.float32)).resize(size, Image.Resampling.BOX))
        for k in range(3)
    ]
    return np.stack(channels, -1)


def _read_ldr(path: Path) -> Float[np.ndarray, "h w 3"]:
    """Display values of a picture, upright; an alpha channel is dropped."""
    return np.ascontiguousarray(display_files.srgb_values(path, f"light {path}")[..., :3])


def _check_memory(path: Path, hdr: bool) -> None:
    """Looks at the size of a map or a photograph in its header, if that can be read."""
    texels = _texels(path) if hdr else display_files.pixel_count(path)
    if excess := memory_excess(BYTES_OF_NONE + BYTES_A_TEXEL * texels):
        raise UnirenderError(f"light {path}: {texels / 1e6:,.3g} million texels, which {excess}; scale it down first")


def _texels(path: Path) -> int:
    """Of a map, by its header; 0 where that cannot be read."""
    if texels := pixel_count(path):
        return texels
    with path.open("rb") as file:
        found = SIZES.match(file.read(MOST_HEADER_BYTES))
    return math.prod(int(side) for side in found.groups() if side) if found else 0


def _read_hdr(path: Path) -> tuple[Float[np.ndarray, "h w 3"], dict[str, str]]:
    """Radiance, and the attributes of an EXR's header."""
    if path.suffix.lower() == ".exr":
        channels, attributes = read_exr(path)
        if "R" not in channels and "Y" in channels and not {"RY", "BY", "X"} & channels.keys():
            channels = dict.fromkeys("RGB", channels["Y"])
        if not channels.keys() >= set("RGB"):
            raise UnirenderError(
                f"light {path}: got EXR channels {', '.join(sorted(channels))}, expected R, G, B, or Y alone (grey); "
                "convert the file"
            )
        return channels_rgb(channels), attributes
    mi = mitsuba()
    try:
        with path.open("rb") as file:
            if file.read(len(PNG_SIGNATURE)) == PNG_SIGNATURE:
                raise UnirenderError(
                    f"light {path}: is a PNG under another name, expected radiance (RGBE, PFM or EXR); name it .png"
                )
            file.seek(0)
            turned = RGBE_TURNED.match(file.read(MOST_HEADER_BYTES))
        if turned:
            raise UnirenderError(
                f"light {path}: its pixels are stored as {turned[1].decode()!r}, expected '-Y height +X width' (from "
                "the top left, by rows); write the file again"
            )
        bitmap = mi.Bitmap(str(path)).convert(mi.Bitmap.PixelFormat.RGB, mi.Struct.Type.Float32, srgb_gamma=False)
    except (OSError, RuntimeError) as error:
        reason = OLD_RUNS if _has_old_runs(path) else str(error).strip().splitlines()[-1]
        raise UnirenderError(
            f"light {path}: not a readable HDR map ({reason}), expected RGBE, PFM or EXR; save it as EXR"
        ) from error
    return _as_its_header_says(np.array(bitmap), path), {}


def _has_old_runs(path: Path) -> bool:
    """Whether a Radiance file repeats pixels by others of 1, 1, 1 and a count, and has all of them then.

    Of such pixels in a row each has the next eight bits of the count.
    """
    data = path.read_bytes()
    header = SIZES.match(data[:MOST_HEADER_BYTES])
    if header is None or header[1] is None or data.startswith(NEW_RUNS, header.end()):
        return False
    start = header.end()
    pixels = np.frombuffer(data, np.uint8, (len(data) - start) // 4 * 4, start).reshape(-1, 4)
    run, place = (pixels[:, :3] == 1).all(axis=1), np.arange(len(pixels))
    digit = place - np.maximum.accumulate(np.where(run, -1, place)) - 1  # of a count, from the lowest
    lengths = np.where(run, pixels[:, 3] * 256.0 ** np.minimum(digit, 4), 1)
    return bool(run.any() and lengths.sum() == int(header[1]) * int(header[2]))


def _as_its_header_says(pixels: Float[np.ndarray, "h w 3"], path: Path) -> Float[np.ndarray, "h w 3"]:
    """Radiance in Rec.709 from the pixels of a Radiance file; those of any other file as they are."""
    factor, primaries = np.ones(3), REC709
    with path.open("rb") as file:
        header = file.read(MOST_HEADER_BYTES)
    lines = header.split(b"\n\n", 1)[0].decode(errors="replace").split("\n") if header.startswith(b"#?") else []
    for line in lines:
        name, _, text = line.partition("=")
        name = name.rstrip()  # indented lines belong to the pictures that this one was made of
        if name == "FORMAT" and text.strip() == XYZE:
            raise UnirenderError(f"light {path}: got {XYZE}, expected RGB; convert the file (Radiance: ra_xyze -r)")
        if name not in HEADER_NUMBERS:
            continue
        count, expected = HEADER_NUMBERS[name]
        try:
            values = [float(word) for word in text.split()]
        except ValueError:
            values = []
        least = -math.inf if name == "PRIMARIES" else 0
        if len(values) != count or not all(least < value < math.inf for value in values):
            raise UnirenderError(
                f"light {path}: its header has {line[:60]!r}, expected {expected}; write the file again"
            )
        if name != "PRIMARIES":
            factor *= values
        elif any(values):  # Photoshop writes zeros
            primaries = values
    channels = image_channels(by_rows(lambda rows: (rows / factor).astype(np.float32), pixels))
    return channels_rgb(in_rec709(channels, primaries, ("",), f"light {path}"))
