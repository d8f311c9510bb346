"""Sheets of small pictures with labels (Pillow)."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from PIL import Image, ImageDraw, ImageFont

from unirender.color import eight_bits, image_srgb, luminance

BACKGROUND = 0.82  # display grey
INK = (26, 26, 26)
FONT, LINE, GAP = 13, 18, 6  # pixels: size of the letters, height of a line of text, between tiles
PREVIEW_PERCENTILE, PREVIEW_LEVEL = 90.0, 0.8


def environment_preview(environment: Float[np.ndarray, "h w 3"]) -> Float[np.ndarray, "h w 3"]:
    """An environment as display values: its 90th percentile of luminance is shown at 0.8 of display white (linear)."""
    level = float(np.percentile(luminance(environment), PREVIEW_PERCENTILE))
    level = level if level > 0 else float(luminance(environment).max()) or 1.0
    return image_srgb(environment * (PREVIEW_LEVEL / level))


def table_sheet(
    rows: Sequence[Sequence[Float[np.ndarray, "_ _ 3"]]],
    row_labels: Sequence[str],
    column_labels: Sequence[str],
) -> Image.Image:
    """Tiles in rows and columns, centred in their cells, with labels (of several lines) left and above.

    Args:
        rows: display values; every row as long as `column_labels`.
        row_labels: one for each row.
        column_labels: one for each column.
    """
    font = ImageFont.load_default(FONT)
    lines = max(len(label.splitlines()) for label in row_labels)
    height = max(lines * LINE, *(tile.shape[0] for row in rows for tile in row))
    words = (line for label in column_labels for line in label.splitlines())
    width = max(*(round(font.getlength(line)) for line in words), *(tile.shape[1] for row in rows for tile in row))
    left = max(round(font.getlength(line)) for label in row_labels for line in label.splitlines()) + 2 * GAP
    top = LINE * max(label.count("\n") + 1 for label in column_labels) + GAP
    size = (left + len(column_labels) * (width + GAP), top + len(rows) * (height + GAP))
    sheet, draw = _blank(size)
    for j, label in enumerate(column_labels):
        x = left + j * (width + GAP) + width / 2
        draw.multiline_text((x, top - GAP), label, INK, font, anchor="md", align="center")
    for i, (row, label) in enumerate(zip(rows, row_labels, strict=True)):
        y = top + i * (height + GAP)
        draw.multiline_text((GAP, y + height / 2), label, INK, font, anchor="lm")
        for j, tile in enumerate(row):
            x = left + j * (width + GAP)
            corner = (x + (width - tile.shape[1]) // 2, y + (height - tile.shape[0]) // 2)
            sheet.paste(Image.fromarray(eight_bits(tile)), corner)
    return sheet


def captioned_sheet(tiles: Sequence[Float[np.ndarray, "h w 3"]], captions: Sequence[str], columns: int) -> Image.Image:
    """Tiles of one size, row by row, each over its caption, whose lines are broken between words at a tile's width."""
    font = ImageFont.load_default(FONT)
    height, width = tiles[0].shape[:2]
    broken = [[part for line in caption.splitlines() for part in _broken(line, width, font)] for caption in captions]
    cell = (width + GAP, height + max(map(len, broken)) * LINE + GAP)
    columns = min(columns, len(tiles))
    size = (columns * cell[0] + GAP, -(-len(tiles) // columns) * cell[1] + GAP)
    sheet, draw = _blank(size)
    for k, (tile, lines) in enumerate(zip(tiles, broken, strict=True)):
        x, y = GAP + (k % columns) * cell[0], GAP + (k // columns) * cell[1]
        sheet.paste(Image.fromarray(eight_bits(tile)), (x, y))
        draw.multiline_text((x, y + height + 2), "\n".join(lines), INK, font)
    return sheet


def _blank(size: tuple[int, int]) -> tuple[Image.Image, ImageDraw.ImageDraw]:
    sheet = Image.new("RGB", size, (round(255 * BACKGROUND),) * 3)
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
