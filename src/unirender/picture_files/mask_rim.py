"""The rim of a mask, where the object covers part of a pixel, in a picture that has a background.

There the picture shows a mixture, m F + (1 - m) B. Maps and renderings want F alone, as an RGBA picture has it: a
bright background passes for a rim of reflected light.

Notation: m the coverage, S the picture, F the object's colour, B the background's; display values. F and B are looked
for in the nearest pixels that are wholly covered and not at all.
"""

import numpy as np
from jaxtyping import Bool, Float, Int

NONE, WHOLE = 0.01, 0.95  # coverage up to which a pixel shows background alone, and from which the object alone
REACH = 2  # pixels, along rows and columns, as far as F and B are looked for; a wider rim is a soft matte's
LEAST_DIFFERENCE = 0.05  # of the two colours, on average and times 1 - m, below which nothing can be told
MIXED = 0.8  # share of the background from which a rim counts as mixed

Place = tuple[Int[np.ndarray, " k"], Int[np.ndarray, " k"]]  # rows and columns


def background_share(image_srgb: Float[np.ndarray, "h w 3"], mask: Float[np.ndarray, "h w 1"]) -> float:
    """How much of the background is mixed into the rim: least squares of S - F = share (1 - m) (B - F).

    Args:
        image_srgb: display values.
        mask: coverage.

    Returns:
        Near 1 of a picture with a background (about 0.7 over black in linear light, where little of it shows), near 0
        of straight colours. 0 where there is no rim, or the two colours are alike.
    """
    rim = _rim(mask)
    whole, has_whole = _nearest(mask[..., 0] >= WHOLE, rim)
    none, has_none = _nearest(mask[..., 0] <= NONE, rim)
    both = has_whole & has_none
    if not both.any():
        return 0.0
    inside = image_srgb[whole][both].astype(np.float64)
    mixture = (1 - mask[rim][both]) * (image_srgb[none][both] - inside)
    power = np.square(mixture).sum()
    if power < mixture.size * LEAST_DIFFERENCE**2:
        return 0.0
    return float((mixture * (image_srgb[rim][both] - inside)).sum() / power)


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


def _nearest(there: Bool[np.ndarray, "h w"], places: Place) -> tuple[Place, Bool[np.ndarray, " k"]]:
    """The nearest pixel of those that are there, for each place, and whether there is one within `REACH`."""
    last_row, last_column = there.shape[0] - 1, there.shape[1] - 1
    rows, columns = places[0].copy(), places[1].copy()
    found = np.zeros(len(rows), bool)
    steps = range(-REACH, REACH + 1)
    for down, right in sorted(((i, j) for i in steps for j in steps), key=lambda step: step[0] ** 2 + step[1] ** 2):
        row = np.clip(places[0] + down, 0, last_row)
        column = np.clip(places[1] + right, 0, last_column)
        hit = ~found & there[row, column]
        rows[hit], columns[hit] = row[hit], column[hit]
        found |= hit
    return (rows, columns), found
