"""A light as Mitsuba 3 takes it: on a grid from which it draws all of it, and in a file that it reads."""

import numpy as np
from jaxtyping import Float

from unirender.color import luminance
from unirender.light.environment import check_map, texel_solid_angles

POLE_NOISE = 3.0  # relative variance of a light sample up to which the poles of a light may stay as they are
MOST_CONTRAST = 1e3  # that counts between a texel at a pole and the one beside it


def drawable(environment: Float[np.ndarray, "h w 3"]) -> Float[np.ndarray, "h2 w 3"]:
    """The same light on a grid from which Mitsuba draws all of it: itself, or with a row between each two."""
    return middle_rows(environment) if has_bright_pole(environment) else environment


def has_bright_pole(environment: Float[np.ndarray, "h w 3"]) -> bool:
    """Whether Mitsuba would miss light of the first or the last row.

    It draws directions by luminance times sin(theta) of the texels, which is 0 all over these rows: their light is met
    where the rows beside them draw it. Where those are dark, most samples miss it and a few count for all. A sample
    that meets a texel counts about as often too much as the texel is brighter than the one beside it (the contrast);
    the texels' mean contrast, by their share of the light's power, is therefore the variance that they bring.

    Raises:
        UnirenderError: it is no lat-long map.
    """
    check_map(environment)
    brightness = luminance(environment).astype(np.float64)
    power = brightness * texel_solid_angles(*environment.shape[:2])
    noise, total = 0.0, max(float(power.sum()), 1e-300)
    for pole, beside in ((0, 1), (-1, -2)):
        least = np.maximum(brightness[beside], brightness[pole] / MOST_CONTRAST)
        contrast = np.divide(brightness[pole], least, out=np.zeros_like(least), where=least > 0)
        noise += float((power[pole] * contrast).sum()) / total
    return noise > POLE_NOISE


def middle_rows(rows: Float[np.ndarray, "h w 3"]) -> Float[np.ndarray, "h2 w 3"]:
    """Bilinear radiance on a grid with a row between each two: the same light, whose poles have bright neighbours."""
    finer = np.empty((2 * len(rows) - 1, *rows.shape[1:]), rows.dtype)
    finer[::2] = rows
    finer[1::2] = (rows[:-1] + rows[1:]) / 2
    return finer


def pfm_bytes(environment: Float[np.ndarray, "h w 3"]) -> bytes:
    """A PFM file, the rows from below, float32: with one thread Mitsuba hangs over an EXR."""
    rows = np.ascontiguousarray(environment[::-1], "<f4")
    return b"PF\n%d %d\n-1.0\n" % (rows.shape[1], rows.shape[0]) + rows.tobytes()
