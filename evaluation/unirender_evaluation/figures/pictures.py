"""Figures of somebody's own pictures: what methods find in photographs, where nobody knows the truth.

A row is a picture and a subject: the input, the maps found in it, the rendering of these maps, edits, relightings; or,
in a strip, the input edited over values of one material parameter.
"""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float
from PIL import Image as PillowImage

from unirender.blocks import row_blocks
from unirender.camera import Camera
from unirender.color import image_srgb, srgb_decode, unpremultiply
from unirender.errors import UnirenderError
from unirender.pictures import Picture, check_mask, read_picture
from unirender_evaluation.figures.grid import Grid, Line, Tile
from unirender_evaluation.figures.overview import MAPS, map_tiles
from unirender_evaluation.figures.panels import Subject, able, input_tile, picture_over_white

SIDE = 128  # pixels of the square in which methods see an object
MARGIN = 0.1  # of that square, left free on each side of the object at least
EDITS: tuple[dict[str, float], ...] = ({"metallic": 1.0}, {"roughness": 0.1}, {"roughness": 0.9})

Environment = Float[np.ndarray, "eh ew 3"]


def read_cut_out(path: Path) -> Picture:
    """A picture whose alpha channel cuts the object out.

    Raises:
        UnirenderError: it cannot be read, or has no alpha channel, or one that covers nothing.
    """
    picture = read_picture(path)
    if picture.mask is None:
        raise UnirenderError(
            f"{path}: has no alpha channel, which is to say where the object is; save it as a PNG with transparency"
        )
    check_mask(picture.mask, str(path))
    return picture


def framed(picture: Picture, side: int = SIDE) -> Picture:
    """The object alone, in the middle of a square: what lies outside its bounding box is cut off."""
    assert picture.mask is not None, "read_cut_out has looked"
    rows, columns = (np.flatnonzero((picture.mask[..., 0] >= 0.5).any(axis=axis)) for axis in (1, 0))
    high, wide = int(rows[-1] - rows[0]) + 1, int(columns[-1] - columns[0]) + 1
    half = max(high, wide) / (1 - 2 * MARGIN) / 2  # of the square, in pixels of the picture; it may stick out
    starts = [float(first) + extent / 2 - half for first, extent in ((rows[0], high), (columns[0], wide))]
    ends = [start + 2 * half for start in starts]
    height, width = picture.mask.shape[:2]
    inside = [
        slice(max(0, math.floor(s)), min(n, math.ceil(e)))
        for s, e, n in zip(starts, ends, (height, width), strict=True)
    ]
    outside = [
        (max(0, -math.floor(s)), max(0, math.ceil(e) - n))
        for s, e, n in zip(starts, ends, (height, width), strict=True)
    ]
    image, mask = (values[inside[0], inside[1]] for values in (picture.image_srgb, picture.mask))
    cut = np.concatenate([srgb_decode(image) * mask, mask], axis=-1)
    spans = [(begin := start - math.floor(start), begin + 2 * half) for start in starts]
    resampled = _resampled(cut, outside, spans, side)
    mask = np.clip(resampled[..., 3:], 0, 1)
    return Picture(np.clip(image_srgb(unpremultiply(resampled[..., :3], mask)), 0, 1), mask, picture.name)


def _resampled(
    cut: Float[np.ndarray, "h w c"],
    outside: Sequence[tuple[int, int]],
    spans: Sequence[tuple[float, float]],
    side: int,
) -> Float[np.ndarray, "s s c"]:
    """A square of a picture that is padded with 0. First along the rows, some at a time, so that the padded picture,
    which may be many times as large, is never there as a whole.

    Args:
        cut: the picture.
        outside: rows and columns of padding, before and after.
        spans: rows and columns of the padded picture where the square begins and ends.
        side: that the square gets, pixels.
    """
    (above, below), (rows_span, columns_span) = outside[0], spans
    how = PillowImage.Resampling.BOX if columns_span[1] - columns_span[0] > side else PillowImage.Resampling.BILINEAR
    narrow = np.zeros((above + len(cut) + below, side, cut.shape[-1]), np.float32)
    for rows in row_blocks(len(cut), sum(outside[1]) + cut.shape[1]):
        strip = np.pad(cut[rows], ((0, 0), outside[1], (0, 0)))
        box = (columns_span[0], 0, columns_span[1], len(strip))
        narrow[above:][rows] = _resized(strip, (side, len(strip)), how, box)
    return _resized(narrow, (side, side), how, (0, rows_span[0], side, rows_span[1]))


def _resized(
    picture: Float[np.ndarray, "h w c"],
    size: tuple[int, int],
    how: PillowImage.Resampling,
    box: tuple[float, float, float, float],
) -> Float[np.ndarray, "h2 w2 c"]:
    """The box of a picture by Pillow, which takes floats of one channel; `size` and `box` as it has them."""
    channels = (PillowImage.fromarray(np.ascontiguousarray(c, np.float32)) for c in np.moveaxis(picture, -1, 0))
    return np.stack([np.asarray(channel.resize(size, how, box=box)) for channel in channels], axis=-1)


def pictures_sheet(
    subjects: Sequence[Subject], pictures: Sequence[Picture], lights: Mapping[str, Environment], camera: Camera
) -> Grid:
    """What every subject makes of pictures whose truth is unknown."""
    lines = []
    for picture in pictures:
        assert picture.mask is not None, "framed gives one"
        seen, mask = {"image_srgb": picture.image_srgb, "mask": picture.mask, "camera": camera}, picture.mask
        for number, subject in enumerate(able(subjects, "decompose", "sheet of pictures")):
            maps = subject.ask("decompose", **seen)
            made = [None if maps is None else subject.ask("render", intrinsics=maps.replace(mask=mask))]
            made += [subject.ask("edit", **seen, **edit) for edit in EDITS]
            made += [subject.ask("relight", **seen, environment=light) for light in lights.values()]
            tiles = [None if image is None else Tile(picture_over_white(image, mask)) for image in made]
            label = picture.name if len(subjects) == 1 else f"{picture.name}, {subject.label}"
            lines.append(Line(label, (input_tile(seen, number), *map_tiles(maps, mask), *tiles), starts=number == 0))
    edits = [f"{name} {value:g}" for edit in EDITS for name, value in edit.items()]
    columns = ("input", *MAPS, "rendered", *edits, *lights)
    caption = (
        "From the picture at the left alone: its maps, these rendered again, edits, and relightings. The truth is not "
        "known. The object is cut out by the picture's alpha channel; the camera is taken to be the benchmark's."
    )
    return Grid(columns, tuple(lines), caption)


def pictures_strip(
    subjects: Sequence[Subject], pictures: Sequence[Picture], what: str, values: Sequence[float], camera: Camera
) -> Grid:
    """Pictures edited over values of "metallic" or "roughness"; the other parameter stays as it is found."""
    taking_part, lines = able(subjects, "edit", f"{what} strip"), []
    for picture in pictures:
        assert picture.mask is not None, "framed gives one"
        seen, mask = {"image_srgb": picture.image_srgb, "mask": picture.mask, "camera": camera}, picture.mask
        for number, subject in enumerate(taking_part):
            made = [subject.ask("edit", **seen, **{what: value}) for value in values]
            tiles = [None if image is None else Tile(picture_over_white(image, mask)) for image in made]
            label = picture.name if len(taking_part) == 1 else f"{picture.name}, {subject.label}"
            lines.append(Line(label, (input_tile(seen, number), *tiles), starts=number == 0))
    other = "roughness" if what == "metallic" else "metallic"
    caption = f"Edits of {what}; {other} stays as it is found in the picture. The truth is not known."
    return Grid(("input", *(f"{what} {value:g}" for value in values)), tuple(lines), caption)
