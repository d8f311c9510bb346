"""Maps as image editors and other programs keep them: a file for each map, named like it (`albedo.png`).

The kind of the file says how it is encoded, as `files.write_result` has it. PNG, JPG and the like hold display values:
colours and radiance through sRGB, normals as (n + 1) / 2, the others as they are. An EXR holds the linear values
themselves, and normals in [-1, 1].
"""

import logging
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float

from unirender.blocks import by_rows
from unirender.color import eight_bits, srgb_decode, unpremultiply
from unirender.errors import UnirenderError
from unirender.exr import MAP_CHANNELS, Channels, read_exr
from unirender.intrinsics import IMAGE_MAPS, MAPS, RADIANCE_MAPS
from unirender.picture_files.display_files import srgb_values_and_remarks, stored_values
from unirender.pictures import DISPLAY_WHITE, OPAQUE, check_finite, read_mask
from unirender.visualization import map_picture

SUFFIXES = (".bmp", ".exr", ".jpeg", ".jpg", ".png", ".tif", ".tiff", ".webp")
BESIDE_MAPS = ("image", "intrinsics")  # of a result folder
SHOWN = 3  # names of files
SPREAD = ".std"  # how the spreads of several samples are named
COLOURS = ("albedo", *RADIANCE_MAPS)
NO_NORMAL = (0.01, 1.5)  # lengths: 0 in 8 bits has up to 0.007, and black and white, behind an object, have 1.7
LONGEST = 1.1  # median length of the normals of a picture: of sRGB-encoded ones it is about 1.2
ASIDE = 0.1  # x and y, up to which normals may all face the viewer
COLOURED = 0.1  # mean difference of the channels; a network's grey pictures have a hundredth
SAME_LEVELS = 1  # of 255, by which a picture and the map that it was made of may differ: both are rounded

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class MapFile:
    """A map that was read from a file of its own.

    Attributes:
        value: the map, not premultiplied.
        shown: its display values, of 8 or 16 bits as they stand in the file.
        alpha: how opaque the file is; None where it has no alpha channel.
    """

    value: Float[np.ndarray, "h w c"]
    shown: Float[np.ndarray, "h w c"]
    alpha: Float[np.ndarray, "h w 1"] | None = None

    def differs(self, name: str, stored: Float[np.ndarray, "h w c"]) -> Bool[np.ndarray, "h w"]:
        """Where it is opaque, another value than that of a map, and shown as another by more than 8 bits round."""
        changed = by_rows(partial(_differs, name), self.shown, self.value, stored)
        return changed if self.alpha is None else changed & (self.alpha[..., 0] > 0.5)


def _differs(
    name: str, shown: Float[np.ndarray, "h w c"], value: Float[np.ndarray, "h w c"], stored: Float[np.ndarray, "h w c"]
) -> np.ndarray:
    levels, others = (eight_bits(picture).astype(np.int16) for picture in (shown, map_picture(name, stored)))
    return (np.abs(levels - others).max(axis=-1) > SAME_LEVELS) & (value != stored).any(axis=-1)


def map_files(folder: Path) -> dict[str, Path]:
    """The files of a folder that are named like an image-aligned map, by its name.

    Raises:
        UnirenderError: two of them are the same map.
    """
    found: dict[str, Path] = {}
    for path in _pictures(folder):
        name = path.stem.lower()
        if name in found:
            raise UnirenderError(f"{path}: is the map {name}, as {found[name].name} is; keep the one that counts")
        if name in IMAGE_MAPS:
            found[name] = path
    return found


def report_unread(folder: Path) -> None:
    """Logs the pictures of a folder that are named like no map, and like nothing that lies beside maps."""
    names = [path.name for path in _pictures(folder) if not _is_expected(path.stem.lower())]
    if names:
        more = f" and {len(names) - SHOWN} more" if len(names) > SHOWN else ""
        logger.warning(
            "%s: not read: %s%s; maps are named %s", folder, ", ".join(names[:SHOWN]), more, ", ".join(IMAGE_MAPS)
        )


def _pictures(folder: Path) -> list[Path]:
    return [path for path in sorted(folder.glob("[!.]*")) if path.suffix.lower() in SUFFIXES and path.is_file()]


def _is_expected(name: str) -> bool:
    return name in (*MAPS, *BESIDE_MAPS) or name.endswith(SPREAD)


def read_maps(files: Mapping[str, Path]) -> dict[str, Float[np.ndarray, "h w c"]]:
    """The maps of files by name, 0 outside of the mask. Where there is no file of it, the mask is what is opaque.

    Raises:
        UnirenderError: a file is broken, of another size than the others, or no such map.
    """
    values, alphas = {}, {}
    for name in [name for name in files if name != "mask"]:
        found = read_map_file(files[name], name)
        values[name], alphas[name] = found.value, found.alpha
    if not values:
        return {}
    sizes = [value.shape[:2] for value in values.values()]
    size = max(sizes, key=sizes.count)
    for name, value in values.items():
        check_size(files[name], value, size)
    mask = read_mask(files["mask"], size) if "mask" in files else None
    if mask is None:
        mask = next((alphas[name] for name in IMAGE_MAPS if alphas.get(name) is not None), None)
    cover = np.ones((*size, 1), np.float32) if mask is None else mask
    for name, value in values.items():
        _report_lost(files[name], name, value, alphas[name], cover > 0.5)
        values[name] = np.where(cover > 0, value, 0)
    return values if mask is None else values | {"mask": mask}


def read_map_file(path: Path, name: str) -> MapFile:
    """A map, of any kind but the mask, from a file.

    Args:
        path: of the file.
        name: of the map.

    Raises:
        UnirenderError: the file is broken, or no such map.
    """
    try:
        return _read_exr_map(path, name) if path.suffix.lower() == ".exr" else _read_display_map(path, name)
    except UnirenderError as error:
        raise UnirenderError(str(error) if str(path) in str(error) else f"{path}: {error}") from error


def check_size(
    path: Path, value: Float[np.ndarray, "h w c"], size: tuple[int, ...], like: str = "the other maps"
) -> None:
    """Looks at the size of a map.

    Raises:
        UnirenderError: it is not that of what it has to be like, rows and columns.
    """
    if value.shape[:2] != size:
        rows, columns = value.shape[:2]
        raise UnirenderError(
            f"{path}: is {columns} x {rows} pixels, expected {size[1]} x {size[0]} like {like}; resample it"
        )


def _report_lost(
    path: Path,
    name: str,
    value: Float[np.ndarray, "h w c"],
    alpha: Float[np.ndarray, "h w 1"] | None,
    inside: Bool[np.ndarray, "h w 1"],
) -> None:
    """Logs what a file cannot say of the object: where it is transparent, and radiance above display white."""
    if alpha is not None and (hidden := float((alpha <= 0.5)[inside].mean())):
        logger.warning("%s: is transparent on %.3g%% of the object, where its hidden colour counts", path, 100 * hidden)
    if name not in RADIANCE_MAPS or path.suffix.lower() == ".exr":
        return
    white = value.max(axis=-1, keepdims=True) >= srgb_decode(np.array(DISPLAY_WHITE))
    if share := float(white[inside].mean()):
        logger.warning(
            "%s: is at display white on %.3g%% of the object, where brighter light is lost: an EXR holds it",
            path,
            100 * share,
        )


def normals_of_picture(
    values: Float[np.ndarray, "h w 3"], mask: Float[np.ndarray, "h w 1"]
) -> Float[np.ndarray, "h w 3"]:
    """Unit normals of a picture of (n + 1) / 2; 0 outside of the mask, and where it has no direction.

    Raises:
        UnirenderError: most are longer than unit vectors.
    """
    return unit_where_known(2 * values - 1, mask, "write (n + 1) / 2 of unit normals, without encoding it to sRGB")


def unit_where_known(
    normal: Float[np.ndarray, "h w 3"], mask: Float[np.ndarray, "h w 1"], advice: str
) -> Float[np.ndarray, "h w 3"]:
    """Vectors of length 1; 0 outside of the mask, and where their length is that of no normal.

    Raises:
        UnirenderError: most are longer than unit vectors; `advice` says what to do.
    """
    length = np.linalg.norm(normal, axis=-1, keepdims=True)
    there = (length > NO_NORMAL[0]) & (length < NO_NORMAL[1]) & (mask > 0)
    if there.any() and (median := float(np.median(length[there]))) > LONGEST:
        raise UnirenderError(f"its normals have a length of {median:.2f} (median), expected 1: {advice}")
    return np.divide(normal, length, out=np.zeros_like(normal), where=there)


def one_channel(values: Float[np.ndarray, "h w c"], name: str) -> Float[np.ndarray, "h w 1"]:
    """Grey of a picture: the mean of its channels, which are equal but for noise where it is not black.

    Args:
        values: as stored.
        name: what to call the file in messages.

    Raises:
        UnirenderError: it is in colour.
    """
    seen = values[(values != 0).any(axis=-1)]
    if len(seen) and (difference := float(np.ptp(seen, axis=-1).mean())) > COLOURED:
        raise UnirenderError(
            f"{name} is in colour: its channels differ by {difference:.2g} in the mean, expected one "
            "value a pixel; write it as grey: of glTF's metallicRoughness, roughness is the green channel and metallic "
            "the blue; of a network's three channels that should be one, their mean"
        )
    return values.mean(axis=-1, keepdims=True, dtype=np.float64).astype(np.float32)


def _read_display_map(path: Path, name: str) -> MapFile:
    if name in COLOURS:
        values, remarks = srgb_values_and_remarks(path, str(path))
        for remark in remarks.values():
            logger.warning("%s: %s", path, remark)
    else:
        values = stored_values(path)
    shown, alpha = values[..., :3], _transparency(values[..., 3:])
    if name == "normal":
        opaque = np.ones_like(shown[..., :1]) if alpha is None else alpha
        return MapFile(normals_of_picture(shown, opaque), shown, alpha)
    if name in COLOURS:
        return MapFile(srgb_decode(shown), shown, alpha)
    grey = one_channel(shown, str(path))
    return MapFile(grey, grey, alpha)


def _read_exr_map(path: Path, name: str) -> MapFile:
    channels, _ = read_exr(path)
    value, alpha = _map_of_channels(channels, name, path), None
    check_finite(value, str(path))
    if "A" in channels:
        coverage = np.clip(channels["A"], 0, 1)[..., None]
        value, alpha = unpremultiply(value, coverage), _transparency(coverage)
    if name == "normal":
        if value.min() >= 0 and value[..., :2].max(axis=(0, 1)).min() > ASIDE:
            logger.warning("%s: no x, y or z is negative: an EXR holds the unit normals themselves, in [-1, 1]", path)
        opaque = np.ones_like(value[..., :1]) if alpha is None else alpha
        value = unit_where_known(value, opaque, "an EXR holds the unit normals themselves, in [-1, 1]")
    return MapFile(value, map_picture(name, value), alpha)


def _transparency(alpha: Float[np.ndarray, "h w c"]) -> Float[np.ndarray, "h w 1"] | None:
    """An alpha channel; None where there is none, or one that hides nothing."""
    return alpha if alpha.size and alpha.min() < OPAQUE else None


def _map_of_channels(channels: Channels, name: str, path: Path) -> Float[np.ndarray, "h w c"]:
    """The map's own channels; else X, Y and Z of normals, or R, G and B, or one channel of whatever name."""
    own = [*MAP_CHANNELS[name]], [*("XYZ" if name == "normal" else "RGB")], [*"RGB"]
    one = [key for key in channels if key != "A"]
    names = next((each for each in own if set(each) <= channels.keys()), one)
    value = np.stack([channels[key] for key in names], axis=-1)
    if MAPS[name] == 1 and value.shape[-1] in (1, 3):
        return one_channel(value, str(path))
    if value.shape[-1] not in (1, 3) or (value.shape[-1] == 1 and name == "normal"):
        expected = "X, Y and Z" if name == "normal" else "R, G and B"
        raise UnirenderError(f"has the channels {', '.join(sorted(channels))}, expected {expected}; rename them")
    return value if value.shape[-1] == 3 else np.repeat(value, 3, axis=-1)
