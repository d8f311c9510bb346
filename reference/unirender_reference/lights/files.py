"""Lights from files: lat-long HDR or EXR maps, and photographs by the rule of `photograph`.

The pixels of a map are areas: its first row ends at the pole, and it is resampled to the contract's grid, whose first
row lies on it. An EXR that unirender wrote is on that grid already (`unirender.exr.on_pole_grid`) and taken as it is.
"""

import logging
from pathlib import Path

import numpy as np
from jaxtyping import Float

from unirender.arguments import as_path, check_switches
from unirender.color import srgb_decode
from unirender.errors import UnirenderError
from unirender.exr import channels_rgb, on_pole_grid, pixel_count, read_exr
from unirender.light.environment import check_shape, is_twice_as_wide
from unirender.light.resampling import resample_environment
from unirender.picture_files import display_files
from unirender.pictures import check_finite, negative_share
from unirender.system.machine import memory_excess
from unirender_reference.lights.light import SHAPE, Light, area_resampled, mean_luminance
from unirender_reference.lights.photograph import (
    PHOTOGRAPH_SHAPE,
    RULE,
    expand_range,
    photograph_environment,
    shown_rows,
)
from unirender_reference.lights.radiance import header_texels, read_radiance

BYTES_A_TEXEL, BYTES_OF_NONE = 50, 5e8  # of memory: what it takes to read a map and bring it to the contract's grid
MUCH_CLEAR = 0.05  # transparent share of a photograph from which a notice is due
MOST_ROWS = 0.6  # share of its height that is taken, likewise: of 3 : 2 it is 0.75, of a square 0.5
HDR_SUFFIXES = {".hdr", ".rgbe", ".pic", ".exr", ".pfm"}

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
        photograph: True: an ordinary picture, put on the sphere by the rule of `photograph`; False: a lat-long map;
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
    if as_photograph and (seen := shown_rows(*pixels.shape[:2])) < MOST_ROWS:
        _log.warning("light %s: only the middle %.0f%% of its height is taken, as more does not fit", path, 100 * seen)
    if as_photograph:
        rule, environment = RULE, photograph_environment(pixels, shape or PHOTOGRAPH_SHAPE)
    else:
        rule, environment = _lat_long(pixels, on_pole_grid(attributes), shape, path)
    provenance = {"source": "file", "file": path.name, "rule": rule}
    if negative := negative_share(environment, f"light {path}"):
        provenance["negative_share"] = f"{negative:.2e}"
    environment = np.maximum(environment, 0)
    mean = mean_luminance(environment, f"light {path}")
    if normalise:
        environment = (environment / mean).astype(np.float32)
    provenance["scale"] = repr(1 / mean if normalise else 1.0)
    name = path.stem.replace(".", "-").replace("/", "-") or "light"
    return Light(name, environment, provenance)


def _lat_long(
    pixels: Float[np.ndarray, "h w 3"], on_grid: bool, shape: tuple[int, int] | None, path: Path
) -> tuple[str, Float[np.ndarray, "h2 w2 3"]]:
    """What the provenance says of a map's grid, and the map on the contract's; arguments as in `load_light`."""
    h, w = pixels.shape[:2]
    if not is_twice_as_wide(h, w):
        raise UnirenderError(
            f"light {path}: got {w}x{h}, expected a lat-long map twice as wide as high; unwrap a light probe first; an "
            "ordinary photograph is a PNG or JPG file (in Python also any other, with photograph=True)"
        )
    if not on_grid:
        return "lat-long", area_resampled(pixels, shape or (SHAPE if h < SHAPE[0] else (h, w)))
    same = shape in (None, (h, w))
    return "lat-long on the contract's grid", pixels if same else resample_environment(pixels, shape)


def _read_ldr(path: Path) -> Float[np.ndarray, "h w 3"]:
    """Display values of a picture, upright; an alpha channel is dropped."""
    values = display_files.srgb_values(path, f"light {path}")
    if values.shape[-1] == 4 and (clear := 1 - float(values[..., 3].mean())) > MUCH_CLEAR:
        _log.warning(
            "light %s: %.0f%% of it is transparent, as around an object that is cut out, and taken as light, too: "
            "expected a picture of the surroundings",
            path,
            100 * clear,
        )
    return np.ascontiguousarray(values[..., :3])


def _check_memory(path: Path, hdr: bool) -> None:
    """Looks at the size of a map or a photograph in its header, if that can be read."""
    texels = (pixel_count(path) or header_texels(path)) if hdr else display_files.pixel_count(path)
    if excess := memory_excess(BYTES_OF_NONE + BYTES_A_TEXEL * texels):
        raise UnirenderError(f"light {path}: {texels / 1e6:,.3g} million texels, which {excess}; scale it down first")


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
    return read_radiance(path), {}
