"""Sheets of small pictures with labels (Pillow)."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from PIL import Image, ImageDraw, ImageFont

from unirender.color import eight_bits, image_srgb, luminance

LINE = 1.35  # height of a line of text, in font sizes
PREVIEW_PERCENTILE, PREVIEW_LEVEL = 90.0, 0.8


@dataclass(frozen=True)
class Style:
    """How a sheet looks: colours are display values in [0, 1]; sizes are in pixels."""

    background: float = 0.82
    text: float = 0.1
    font: int = 13
    gap: int = 6

    @property
    def line(self) -> int:
        return round(LINE * self.font)


LIGHT, DARK = Style(), Style(background=0.11, text=0.9)


def environment_preview(environment: Float[np.ndarray, "h w 3"]) -> Float[np.ndarray, "h w 3"]:
    """An environment as display values: its 90th percentile of luminance is shown at 0.8 of display white (linear)."""
    level = float(np.percentile(luminance(environment), PREVIEW_PERCENTILE))
    level = level if level > 0 else float(luminance(environment).max()) or 1.0
    return image_srgb(environment * (PREVIEW_LEVEL / level))


def table_sheet(
    rows: Sequence[Sequence[Float[np.ndarray, "_ _ 3"]]],
    row_labels: Sequence[str],
    column_labels: Sequence[str],
    style: Style = LIGHT,
) -> Image.Image:
    """Tiles in rows and columns, centred in their cells, with labels (of several lines) left and above.

    Args:
        rows: display values; every row as long as `column_labels`.
        row_labels: one for each row.
        column_labels: one for each column.
        style: colours and sizes.
    """
    font = ImageFont.load_default(style.font)
    lines = max(len(label.splitlines()) for label in row_labels)
    height = max(lines * style.line, *(tile.shape[0] for row in rows for tile in row))
    words = (line for label in column_labels for line in label.splitlines())
    width = max(*(round(font.getlength(line)) for line in words), *(tile.shape[1] for row in rows for tile in row))
    left = max(round(font.getlength(line)) for label in row_labels for line in label.splitlines()) + 2 * style.gap
    top = style.line * max(len(label.splitlines()) for label in column_labels) + style.gap
    size = (left + len(column_labels) * (width + style.gap), top + len(rows) * (height + style.gap))
    sheet, draw = _blank(size, style)
    ink = (round(255 * style.text),) * 3
    for j, label in enumerate(column_labels):
        x = left + j * (width + style.gap) + width / 2
        draw.multiline_text((x, top - style.gap), label, ink, font, anchor="md", align="center")
    for i, (row, label) in enumerate(zip(rows, row_labels, strict=True)):
        y = top + i * (height + style.gap)
        draw.multiline_text((style.gap, y + height / 2), label, ink, font, anchor="lm")
        for j, tile in enumerate(row):
            x = left + j * (width + style.gap)
            corner = (x + (width - tile.shape[1]) // 2, y + (height - tile.shape[0]) // 2)
            sheet.paste(Image.fromarray(eight_bits(tile)), corner)
    return sheet


def captioned_sheet(tiles: Sequence[Float[np.ndarray, "h w 3"]], captions: Sequence[str], columns: int) -> Image.Image:
    """Tiles of one size, row by row, each over its caption, whose lines are broken between words at a tile's width."""
    style = LIGHT
    font = ImageFont.load_default(style.font)
    height, width = tiles[0].shape[:2]
    broken = [[part for line in caption.splitlines() for part in _broken(line, width, font)] for caption in captions]
    cell = (width + style.gap, height + max(map(len, broken)) * style.line + style.gap)
    columns = min(columns, len(tiles))
    size = (columns * cell[0] + style.gap, -(-len(tiles) // columns) * cell[1] + style.gap)
    sheet, draw = _blank(size, style)
    for k, (tile, lines) in enumerate(zip(tiles, broken, strict=True)):
        x, y = style.gap + (k % columns) * cell[0], style.gap + (k // columns) * cell[1]
        sheet.paste(Image.fromarray(eight_bits(tile)), (x, y))
        draw.multiline_text((x, y + height + 2), "\n".join(lines), (round(255 * style.text),) * 3, font)
    return sheet


def _blank(size: tuple[int, int], style: Style) -> tuple[Image.Image, ImageDraw.ImageDraw]:
    sheet = Image.new("RGB", size, (round(255 * style.background),) * 3)
    return sheet, ImageDraw.Draw(sheet)


def _broken(line: str, width: int, font: ImageFont.FreeTypeFont | ImageFont.ImageFont) -> list[str]:
    """A line's words in as many lines as they need; a word that is too long for one is cut."""
    lines = [""]
    for word in line.split():
        longer = f"{lines[-1]} {word}".strip()
        if font.getlength(longer) <= width:
            lines[-1] = longer
        else:
            lines.append(_cut(word, width, font))
    return [part for part in lines if part]


def _cut(word: str, width: int, font: ImageFont.FreeTypeFont | ImageFont.ImageFont) -> str:
    while word and font.getlength(word) > width:
        word = word[:-1]
    return word
