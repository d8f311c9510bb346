"""The rim of a mask, where the object covers part of a pixel, in a picture that has a background.

There the picture shows a mixture, S = m F + (1 - m) B, of display values or in linear light. Maps and renderings want F
alone, as an RGBA picture has it: a bright background passes for a rim of reflected light. A background that is darker
than the object does little harm, and an object that darkens towards its outline looks the same: it is left alone.

A mask that is too large has the background's colour in its outermost pixels, whole as they may be, and nothing tells
what the object looks like there: that is told, and not mended.

Notation: m the coverage, S the picture, F the object's colour, B the background's. F and B are looked for in the
nearest pixels that are wholly covered and not at all.
"""

import numpy as np
from jaxtyping import Bool, Float, Int

from unirender.color import srgb_decode

NONE, WHOLE = 0.01, 0.95  # coverage up to which a pixel shows background alone, and from which the object alone
REACH = 2  # pixels, along rows and columns, as far as F and B are looked for; a wider rim is a soft matte's
WIDEST = 0.1  # share of the picture from which a rim is no outline, but a matte
LEAST_DIFFERENCE = 0.05  # of the two colours, on average and times 1 - m, below which nothing can be told
APART = 3  # pixels from the outline to what counts as the object, and as the background, beside it
LEAST_CONTRAST = 0.1  # of these two, root mean square, below which nothing can be told
BACKGROUND = 0.9  # nearness from which an outline counts as one: masks of the suites' coverage above 0.5 reached 0.87
MIXED = 0.75  # explained by a mixture, from which a rim counts as one: straight renders reached 0.64

Place = tuple[Int[np.ndarray, " k"], Int[np.ndarray, " k"]]  # rows and columns


def mixture_explains(image_srgb: Float[np.ndarray, "h w 3"], mask: Float[np.ndarray, "h w 1"]) -> float:
    """How much of the rim's difference from the object beside it a mixture with the background explains,

        1 - sum |S - F - (1 - m) (B - F)|^2 / sum |S - F|^2,

    of display values or in linear light, whichever is more.

    Args:
        image_srgb: display values.
        mask: coverage.

    Returns:
        Near 1 of a picture with a background brighter than the object, mostly below 0 of straight colours. 0 where
        there is no rim, where it is no outline, or where most of the background is no brighter.
    """
    rim = _rim(mask)
    if len(rim[0]) > WIDEST * mask.size:
        return 0.0
    whole, has_whole = _nearest(mask[..., 0] >= WHOLE, rim)
    none, has_none = _nearest(mask[..., 0] <= NONE, rim)
    both = has_whole & has_none
    brighter = both & (image_srgb[none].mean(axis=-1) > image_srgb[whole].mean(axis=-1))
    if 2 * brighter.sum() <= both.sum():
        return 0.0
    uncovered = 1 - mask[rim][brighter]
    s, f, b = (image_srgb[place][brighter].astype(np.float64) for place in (rim, whole, none))
    if np.square(uncovered * (b - f)).mean() < LEAST_DIFFERENCE**2:
        return 0.0
    in_linear_light = _explained(srgb_decode(s), srgb_decode(f), srgb_decode(b), uncovered)
    return max(_explained(s, f, b, uncovered), in_linear_light)


def outline_is_background(image_srgb: Float[np.ndarray, "h w 3"], mask: Float[np.ndarray, "h w 1"]) -> float:
    """How much nearer the outermost covered pixels of a mask are to the background than the object beside them is,

        1 - sum |S - B|^2 / sum |F - B|^2,

    with F and B the colours of the nearest pixels that are `APART` further inside and outside.

    Args:
        image_srgb: display values.
        mask: coverage.

    Returns:
        Near 1 where the mask is too large by a pixel or more. 0 where F and B are alike, or nothing is as far apart.
    """
    covered = mask[..., 0] >= WHOLE
    rows, columns = np.nonzero(covered & ~_shrunk(covered, 1))
    outline = rows, columns
    inside, has_inside = _nearest(_shrunk(covered, APART), outline, APART + 1)
    outside, has_outside = _nearest(_shrunk(mask[..., 0] <= NONE, APART - 1), outline, APART + 1)
    both = has_inside & has_outside
    s, f, b = (image_srgb[place][both].astype(np.float64) for place in (outline, inside, outside))
    power = np.square(f - b).sum()
    if not both.any() or power < LEAST_CONTRAST**2 * f.size:
        return 0.0
    return float(1 - np.square(s - b).sum() / power)


def _shrunk(there: Bool[np.ndarray, "h w"], pixels: int) -> Bool[np.ndarray, "h w"]:
    """Those from which all within that many steps along rows and columns are there, or beyond the frame."""
    for _ in range(pixels):
        wide = np.pad(there, 1, constant_values=True)
        there = there & wide[:-2, 1:-1] & wide[2:, 1:-1] & wide[1:-1, :-2] & wide[1:-1, 2:]
    return there


def _explained(
    s: Float[np.ndarray, "k 3"],
    f: Float[np.ndarray, "k 3"],
    b: Float[np.ndarray, "k 3"],
    uncovered: Float[np.ndarray, "k 1"],
) -> float:
    power = np.square(s - f).sum()
    return 0.0 if power == 0 else float(1 - np.square(s - f - uncovered * (b - f)).sum() / power)


def without_background(
    image_srgb: Float[np.ndarray, "h w 3"], mask: Float[np.ndarray, "h w 1"]
) -> Float[np.ndarray, "h w 3"]:
    """The picture with F, the colour of the nearest wholly covered pixel, in the rim of its mask.

    Args:
        image_srgb: display values of a picture with a background.
        mask: coverage. Pixels further than `REACH` from a wholly covered one stay as they are.
    """
    rim = _rim(mask)
    (rows, columns), found = _nearest(mask[..., 0] >= WHOLE, rim)
    straight = image_srgb.copy()
    straight[rim[0][found], rim[1][found]] = image_srgb[rows[found], columns[found]]
    return straight


def _rim(mask: Float[np.ndarray, "h w 1"]) -> Place:
    rows, columns = np.nonzero((mask[..., 0] > NONE) & (mask[..., 0] < WHOLE))
    return rows, columns


def _nearest(there: Bool[np.ndarray, "h w"], places: Place, reach: int = REACH) -> tuple[Place, Bool[np.ndarray, " k"]]:
    """The nearest pixel of those that are there, for each place, and whether there is one within `reach`."""
    last_row, last_column = there.shape[0] - 1, there.shape[1] - 1
    rows, columns = places[0].copy(), places[1].copy()
    found = np.zeros(len(rows), bool)
    steps = range(-reach, reach + 1)
    for down, right in sorted(((i, j) for i in steps for j in steps), key=lambda step: step[0] ** 2 + step[1] ** 2):
        row = np.clip(places[0] + down, 0, last_row)
        column = np.clip(places[1] + right, 0, last_column)
        hit = ~found & there[row, column]
        rows[hit], columns[hit] = row[hit], column[hit]
        found |= hit
    return (rows, columns), found
