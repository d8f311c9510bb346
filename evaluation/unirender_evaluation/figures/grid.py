"""Draws the paper's kinds of figure: a grid of labelled pictures, in rows that belong to one scene.

A grid says what stands where; `panels` fills it. Pictures are display values in [0, 1] over white, `[h, w, 3]`,
enlarged by a whole factor without interpolation, so that every pixel of the suite can be counted. A grid of many
columns is folded: a page would shrink it until nobody can read its labels.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path

import numpy as np
from jaxtyping import Float
from PIL import Image, ImageDraw, ImageFont

from unirender.color import eight_bits
from unirender.errors import UnirenderError
from unirender.system.whole_files import replace_file

SIDE = 128  # of a cell, pixels, about: the nearest whole multiple of the pictures' own size, and never less than it
WIDEST = 6  # columns beside one another; the others follow below, all rows again
GAP, GROUP_GAP, HEADER, MARGIN = 6, 16, 24, 12
HEADING_LINES = 3  # of a column's name; what is longer loses its middle
INK, SOFT = "#222222", "#666666"
FONT, SMALL = 13, 12

Shown = Float[np.ndarray, "_ _ 3"]


@dataclass(frozen=True)
class Tile:
    """One picture, with a text in its lower right corner."""

    picture: Shown
    corner: str = ""


@dataclass(frozen=True)
class Line:
    """One row of a grid: `tiles` may have holes; `starts` is set where another scene begins."""

    label: str
    tiles: tuple[Tile | None, ...]
    starts: bool = False


@dataclass(frozen=True)
class Grid:
    """A figure: `columns` are the headings; `caption` stands below.

    Raises:
        UnirenderError: it or one of its lines is empty, or a line has not as many tiles as there are columns.
    """

    columns: tuple[str, ...]
    lines: tuple[Line, ...]
    caption: str = ""

    def __post_init__(self) -> None:
        if not self.columns or not self.lines:
            raise UnirenderError("figure: got no pictures, expected at least one row and one column")
        for line in self.lines:
            if len(line.tiles) != len(self.columns):
                raise UnirenderError(
                    f"figure, row {line.label!r}: got {len(line.tiles)} pictures, expected {len(self.columns)}"
                )
            if not any(tile is not None for tile in line.tiles):
                raise UnirenderError(f"figure, row {line.label!r}: got no picture, expected at least one")


def over_white(values: Float[np.ndarray, "h w c"], mask: Float[np.ndarray, "h w 1"]) -> Float[np.ndarray, "h w 3"]:
    """A map's display values over the page; one channel becomes grey."""
    rgb = np.broadcast_to(values, (*values.shape[:2], 3))
    return (rgb * mask + (1 - mask)).astype(np.float32)


def cell_side(grid: Grid) -> int:
    """Pixels of a cell's side: the widest picture, enlarged by a whole factor to about `SIDE`."""
    widest = max(max(tile.picture.shape[:2]) for line in grid.lines for tile in line.tiles if tile is not None)
    return widest * max(1, round(SIDE / widest))


def folded(columns: int) -> list[range]:
    """The columns that stand beside one another: as few parts as `WIDEST` allows, as even as they can be."""
    most = -(-columns // -(-columns // WIDEST))
    return [range(first, min(first + most, columns)) for first in range(0, columns, most)]


def draw(grid: Grid) -> Image.Image:
    """The picture of a grid: headings above, labels at the left, the caption below."""
    side, font = cell_side(grid), ImageFont.load_default(FONT)
    small = ImageFont.load_default(SMALL)
    left = MARGIN + max(_width(line.label, font) for line in grid.lines) + MARGIN
    parts = folded(len(grid.columns))
    width = left + len(parts[0]) * (side + GAP) + MARGIN - GAP
    caption = _wrapped(grid.caption, small, width - 2 * MARGIN)
    names = _headings(grid.columns, font, side)
    headings, places, y = [], [], MARGIN
    for part in parts:
        y += GROUP_GAP if headings else 0
        y += HEADER + (max(len(names[column]) for column in part) - 1) * (FONT + 3)
        headings.append(y)
        for number, line in enumerate(grid.lines):
            y += GROUP_GAP if line.starts and number else 0
            high = _height([line.tiles[column] for column in part], side)
            places.append((part, line, y, high))
            y += high + GAP
    sheet = Image.new("RGB", (width, y + len(caption) * (SMALL + 6) + MARGIN), "white")
    pen = ImageDraw.Draw(sheet)
    for part, bottom in zip(parts, headings, strict=True):
        for place, column in enumerate(part):
            for above, text in enumerate(reversed(names[column])):
                at = (left + place * (side + GAP) + side // 2, bottom - HEADER // 2 - above * (FONT + 3))
                pen.text(at, text, fill=INK, font=font, anchor="mm")
    for part, line, top, high in places:
        pen.text((left - MARGIN, top + high // 2), line.label, fill=INK, font=font, anchor="rm")
        for place, column in enumerate(part):
            if (tile := line.tiles[column]) is not None:
                _paste(sheet, pen, tile, (left + place * (side + GAP), top), (side, high))
    for number, text in enumerate(caption):
        pen.text((MARGIN, y + 4 + number * (SMALL + 6)), text, fill=SOFT, font=small)
    return sheet


def save(grid: Grid, path: Path) -> Path:
    """Writes the figure as a PNG, complete or not at all; returns the path."""
    content = BytesIO()
    draw(grid).save(content, format="PNG", optimize=True)
    return replace_file(path, content.getvalue())


def _paste(
    sheet: Image.Image, pen: ImageDraw.ImageDraw, tile: Tile, corner: tuple[int, int], cell: tuple[int, int]
) -> None:
    """A picture in the middle of its cell of (width, height) pixels."""
    height, width = tile.picture.shape[:2]
    factor = _factor(tile, cell[0])
    levels = eight_bits(tile.picture)
    picture = Image.fromarray(levels).resize((width * factor, height * factor), Image.Resampling.NEAREST)
    x, y = corner[0] + (cell[0] - picture.width) // 2, corner[1] + (cell[1] - picture.height) // 2
    sheet.paste(picture, (x, y))
    if tile.corner:
        font = ImageFont.load_default(SMALL)
        at = (corner[0] + cell[0] - 4, corner[1] + cell[1] - 3)
        box = pen.textbbox(at, tile.corner, font=font, anchor="rs")
        pen.rectangle((box[0] - 3, box[1] - 2, box[2] + 3, box[3] + 2), fill="white")
        pen.text(at, tile.corner, fill=INK, font=font, anchor="rs")


def _factor(tile: Tile, side: int) -> int:
    """By which a picture is enlarged."""
    return max(1, side // max(tile.picture.shape[:2]))


def _height(tiles: Sequence[Tile | None], side: int) -> int:
    """Of a row: its highest picture's (lights are wider than high); of holes alone, that of a label."""
    return max((tile.picture.shape[0] * _factor(tile, side) for tile in tiles if tile is not None), default=HEADER)


def _width(text: str, font: "ImageFont.FreeTypeFont | ImageFont.ImageFont") -> int:
    return int(np.ceil(font.getlength(text)))


def _headings(
    texts: Sequence[str], font: "ImageFont.FreeTypeFont | ImageFont.ImageFont", width: int
) -> list[list[str]]:
    """The lines of each column's name: `HEADING_LINES`, or as many more as tell different names apart."""
    whole = [_wrapped(text, font, width) for text in texts]
    for most in range(HEADING_LINES, max(map(len, whole))):
        found = [_shortened(text, font, width, most) for text in texts]
        if len(set(map(tuple, found))) == len(set(map(tuple, whole))):
            return found
    return whole


def _shortened(text: str, font: "ImageFont.FreeTypeFont | ImageFont.ImageFont", width: int, most: int) -> list[str]:
    """The text in at most so many lines, without its middle where it needs more."""
    kept, lines = len(text), _wrapped(text, font, width)
    while len(lines) > most and kept > 0:
        kept -= 1
        lines = _wrapped(f"{text[: kept - kept // 2]}...{text[len(text) - kept // 2 :]}", font, width)
    return lines


def _wrapped(text: str, font: "ImageFont.FreeTypeFont | ImageFont.ImageFont", width: int) -> list[str]:
    """The text in lines that fit, broken behind a space, _ or -, else where the line is full."""
    lines: list[str] = []
    for word in re.split(r"(?<=[\s_-])", " ".join(text.split())):
        if lines and _width((lines[-1] + word).rstrip(), font) <= width:
            lines[-1] += word
            continue
        lines.append("")
        for letter in word:
            if lines[-1] and _width((lines[-1] + letter).rstrip(), font) > width:
                lines.append("")
            lines[-1] += letter
    return [line.rstrip() for line in lines if line.strip()]
