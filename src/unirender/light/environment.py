"""Environment maps: the lat-long grid, its orientation, sampling, rotation and resampling.

An environment is a lat-long map `[h w 3]` of linear radiance in camera axes, +y up, on the grid of Mitsuba's `envmap`:
row i lies at the polar angle theta = pi i / (h - 1) from +y (so the first and last rows are the poles), column j at the
azimuth phi = 2 pi (j + 1/2) / w, and

    direction = (sin(theta) sin(phi), cos(theta), -sin(theta) cos(phi)).

The middle of the map is +z (behind the camera), its left and right borders meet at -z (behind the object). Between
texels radiance is bilinear; all integrals here are exact for that interpolant ("hat" weights). The light that a surface
receives from a map is in `unirender.light.surface_light`.
"""

import functools
from numbers import Integral
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from unirender.arguments import as_floats, as_instance
from unirender.color import luminance
from unirender.errors import UnirenderError
from unirender.intrinsics import as_radiance, check_radiance

if TYPE_CHECKING:
    from scipy.sparse import csr_array

ASPECT_TOLERANCE = 0.02  # of the width over the height, which is 2
POLE_STEP = 1e-16  # from a pole, so small that it turns no other direction
LEAST_ROWS, LEAST_COLUMNS = 3, 2  # of a light to render by: Mitsuba resamples smaller ones
UNIT_TOLERANCE = 0.05  # of squared lengths: 0.7 for half of the root of 2 is near enough
POLE_NOISE = 3.0  # relative variance of a light sample up to which the poles of a light may stay as they are
MOST_CONTRAST = 1e3  # that counts between a texel at a pole and the one beside it
AREA_POINTS = 16  # of a pixel's rows: a pole's light to 0.2 %
MOST_ALIASING = 0.005  # share of a texel's energy, away from the poles, that may come of how two grids lie together


def as_light(environment: Any) -> Float[np.ndarray, "h w 3"]:
    """An environment that somebody handed in, as float32; it may be black.

    Raises:
        UnirenderError: it is no array of floats, of a wrong shape, too small, NaN, infinite or negative.
    """
    light = as_radiance("environment", environment)
    if light.ndim != 3 or light.shape[-1] != 3 or light.shape[0] < LEAST_ROWS or light.shape[1] < LEAST_COLUMNS:
        raise UnirenderError(
            f"environment: got shape {light.shape}, expected a lat-long map [height, width, 3] of at least "
            f"{LEAST_ROWS} x {LEAST_COLUMNS} texels"
        )
    if not np.isfinite(light).all() or light.min() < 0:
        raise UnirenderError("environment: got NaN, infinite or negative radiance, expected finite values >= 0")
    return light


def is_twice_as_wide(height: int, width: int) -> bool:
    """Whether a map of that size is a lat-long map by its shape."""
    return height >= 2 and abs(width / height - 2) <= ASPECT_TOLERANCE


def check_sphere(environment: Float[np.ndarray, "*n eh ew 3"]) -> None:
    """Looks at the shape of a light.

    Raises:
        UnirenderError: it is not twice as wide as high, nor, with its first and last row at the poles, has equal steps
            both ways; a light probe or a photograph, say.
    """
    height, width = environment.shape[-3:-1]
    if not is_twice_as_wide(height, width) and width != 2 * (height - 1):
        raise UnirenderError(
            f"environment: got {width}x{height}, expected a lat-long map twice as wide as high; unwrap a light probe "
            "first; of a photograph's file unirender_reference.lights.load_light(path, photograph=True) makes one"
        )


def environment_directions(height: int, width: int) -> Float[np.ndarray, "h w 3"]:
    """Unit directions of the texels, camera axes.

    Raises:
        UnirenderError: height and width are no whole numbers of at least 1.
    """
    if not all(isinstance(side, Integral) and side >= 1 for side in (height, width)):
        raise UnirenderError(f"environment: got size {(height, width)}, expected whole numbers of at least 1")
    theta = np.pi * np.arange(height) / max(height - 1, 1)
    phi = 2 * np.pi * (np.arange(width) + 0.5) / width
    theta, phi = np.meshgrid(theta, phi, indexing="ij")
    sine = np.abs(np.sin(theta))  # rounding makes that of the last row negative for some heights
    x, y, z = sine * np.sin(phi), np.cos(theta), -sine * np.cos(phi)
    return np.stack([x, y, z], axis=-1).astype(np.float32)


def texel_solid_angles(height: int, width: int) -> Float[np.ndarray, "h w"]:
    """Integral of each texel's bilinear weight over the sphere, in steradians; they sum to 4 pi."""
    check_shape((height, width))
    step = np.pi / (height - 1)
    rows = np.sin(np.pi * np.arange(height) / (height - 1)) * 2 * (1 - np.cos(step)) / step
    rows[0] = rows[-1] = 1 - np.sin(step) / step
    return np.repeat((rows * 2 * np.pi / width)[:, None], width, axis=1).astype(np.float32)


def sample_environment(
    environment: Float[np.ndarray, "h w 3"], directions: Float[np.ndarray, "*n 3"]
) -> Float[np.ndarray, "*n 3"]:
    """Bilinear radiance in the given unit directions, as Mitsuba interpolates it.

    Raises:
        UnirenderError: the map has another shape, or a direction is not unit.
    """
    check_map(environment)
    height, width = environment.shape[:2]
    directions = as_floats(directions, "directions")
    if directions.shape[-1:] != (3,):
        raise UnirenderError(f"directions: got shape {directions.shape}, expected [..., 3]")
    squared = np.einsum("...c,...c->...", directions, directions)
    if not (np.abs(squared - 1) < UNIT_TOLERANCE).all():
        raise UnirenderError(
            f"directions: got lengths from {np.sqrt(squared.min()):.3g} to {np.sqrt(squared.max()):.3g}, expected unit "
            "vectors; normalise them"
        )
    row = np.arccos(np.clip(directions[..., 1], -1, 1)) * ((height - 1) / np.pi)
    column = np.arctan2(directions[..., 0], -directions[..., 2]) * (width / (2 * np.pi)) - 0.5
    row_0 = np.clip(np.floor(row).astype(np.int64), 0, height - 2)
    column_0 = np.floor(column).astype(np.int64)
    f_row, f_column = (row - row_0)[..., None], (column - column_0)[..., None]
    column_0, column_1 = column_0 % width, (column_0 + 1) % width
    top = environment[row_0, column_0] * (1 - f_column) + environment[row_0, column_1] * f_column
    bottom = environment[row_0 + 1, column_0] * (1 - f_column) + environment[row_0 + 1, column_1] * f_column
    return (top * (1 - f_row) + bottom * f_row).astype(np.float32)


def rotate_environment(
    environment: Float[np.ndarray, "h w 3"], rotation: Float[np.ndarray, "3 3"]
) -> Float[np.ndarray, "h w 3"]:
    """The light turned by `rotation`: the new radiance from R x is the old one from x. Bilinear resampling.

    Turns about +y keep the energy of every light. Others may lose or double what is smaller than a few texels.

    Raises:
        UnirenderError: the map has another shape, or the matrix is no rotation.
    """
    check_map(environment)
    rotation = np.asarray(rotation, dtype=np.float32)
    unmoved = rotation @ rotation.T if rotation.shape == (3, 3) else np.zeros((3, 3))
    if not (np.abs(unmoved - np.eye(3)) < UNIT_TOLERANCE).all() or np.linalg.det(rotation) < 0:
        raise UnirenderError(f"rotation: got {rotation.tolist()}, expected the 3 x 3 matrix of a rotation")
    directions = environment_directions(*environment.shape[:2])
    # At the pole of row 0 a direction has no azimuth: texels keep that of their column, as the last row's by rounding.
    directions[0] += np.float32(POLE_STEP) * directions[1] * np.array([1, 0, 1], dtype=np.float32)
    return sample_environment(environment, directions @ rotation)


def mirror_environment(environment: Float[np.ndarray, "*n h w 3"]) -> Float[np.ndarray, "*n h w 3"]:
    """The light seen in a mirror that flips x; exact."""
    as_instance(environment, np.ndarray, "environment")
    return environment[..., ::-1, :].copy()


def mean_radiance(environment: Float[np.ndarray, "h w 3"]) -> Float[np.ndarray, " 3"]:
    """Average over the sphere, by solid angle."""
    check_map(environment)
    weights = texel_solid_angles(*environment.shape[:2])
    return (np.einsum("hw,hwc->c", weights, environment, dtype=np.float64) / (4 * np.pi)).astype(np.float32)


def drawable(environment: Float[np.ndarray, "h w 3"]) -> Float[np.ndarray, "h2 w 3"]:
    """The same light on a grid from which Mitsuba draws all of it: itself, or with a row between each two."""
    return middle_rows(environment) if has_bright_pole(environment) else environment


def pfm_bytes(environment: Float[np.ndarray, "h w 3"]) -> bytes:
    """A PFM file, the rows from below, float32: with one thread Mitsuba hangs over an EXR."""
    rows = np.ascontiguousarray(environment[::-1], "<f4")
    return b"PF\n%d %d\n-1.0\n" % (rows.shape[1], rows.shape[0]) + rows.tobytes()


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


def resample_environment(
    environment: Float[np.ndarray, "h w 3"], shape: tuple[int, int]
) -> Float[np.ndarray, "h2 w2 3"]:
    """The environment at another resolution; energy-preserving where it shrinks, bilinear where it grows.

    Where it grows by a factor that is no whole number, texels of the old map would be met by more or fewer of the new
    one's as they happen to lie: where that matters (`MOST_ALIASING`), it is energy-preserving there as well.
    Beside the poles, where texels are small, samples say more: of 16 rows that become 32 (the network's light, where s
    and d are derived from it), up to 5 % too much of a lamp on the first or the last row, 1.2 % on the next.
    """
    check_map(environment)
    check_shape(shape)
    height, width = environment.shape[:2]
    return _mixed(environment, *resampling_operators((height, width), tuple(shape)), shape)


def area_pixels(environment: Float[np.ndarray, "h w 3"], finer: int) -> Float[np.ndarray, "h2 w2 3"]:
    """The light as most programs read a map: its rows are areas between the poles. Bilinear, `finer` times as fine.

    A pixel is the mean over its rows by solid angle: beside a bright pole its centre alone would say up to half more.
    """
    check_map(environment)
    height, width = environment.shape[:2]
    shape = finer * height, finer * width
    count = AREA_POINTS * shape[0]
    theta = (np.arange(count) + 0.5) * np.pi / count
    pixels = hat_weights(np.arange(count) // AREA_POINTS * 1.0, shape[0])  # each point lies in one
    rows = weighted_means(pixels, np.sin(theta)) @ hat_weights(theta * (height - 1) / np.pi, height)
    columns = hat_weights((np.arange(shape[1]) + 0.5) / finer - 0.5, width, wrap=True)
    return _mixed(environment, rows, columns, shape)


def _mixed(
    environment: Float[np.ndarray, "h w 3"], rows: "csr_array", columns: "csr_array", shape: tuple[int, int]
) -> Float[np.ndarray, "h2 w2 3"]:
    """`rows @ environment @ columns.T` for each channel, which has that shape."""
    height, width = environment.shape[:2]
    mixed = (rows @ environment.reshape(height, -1)).reshape(shape[0], width, 3).transpose(1, 0, 2)
    new = (columns @ mixed.reshape(width, -1)).reshape(shape[1], shape[0], 3).transpose(1, 0, 2)
    return np.ascontiguousarray(new, dtype=np.float32)


@functools.lru_cache(maxsize=64)
def resampling_operators(source: tuple[int, int], target: tuple[int, int]) -> tuple["csr_array", "csr_array"]:
    """Sparse matrices `[h2 h]`, `[w2 w]` of `resample_environment`: `new = rows @ old @ columns.T` for each channel.

    A target texel of a smaller map is the integral of the bilinear radiance against the texel's own bilinear weight,
    divided by the integral of that weight; the weights are a partition of unity, so the total is kept.
    """
    from scipy.sparse import csr_array

    (h, w), (h2, w2) = source, target
    check_shape(source)
    check_shape(target)
    if _is_integrated((h2 - 1) / (h - 1)):
        count = 64 * max(h, h2)
        theta = (np.arange(count) + 0.5) * np.pi / count  # midpoint rule over the polar angle
        old, new = hat_weights(theta * (h - 1) / np.pi, h), hat_weights(theta * (h2 - 1) / np.pi, h2)
        rows = weighted_means(new, np.sin(theta)) @ old
    else:
        rows = hat_weights(np.arange(h2) * (h - 1) / (h2 - 1), h)
    if _is_integrated(w2 / w):
        count = 64 * max(w, w2)
        u = (np.arange(count) + 0.5) / count
        old, new = hat_weights(u * w - 0.5, w, wrap=True), hat_weights(u * w2 - 0.5, w2, wrap=True)
        columns = weighted_means(new, np.ones(count)) @ old
    else:
        columns = hat_weights((np.arange(w2) + 0.5) * w / w2 - 0.5, w, wrap=True)
    return csr_array(rows, dtype=np.float32), csr_array(columns, dtype=np.float32)


def _is_integrated(growth: float) -> bool:
    """Whether a map whose steps become `growth` times finer is integrated instead of sampled.

    Samples of a hat at `growth` points a step sum to what it holds but for a part that moves with where they fall, up
    to 2 sinc(growth)^2 (Poisson's sum): none for whole numbers. Below 2 that part moves slowly and adds up.
    """
    return growth != 1 and (growth < 2 or 2 * float(np.sinc(growth)) ** 2 > MOST_ALIASING)


def hat_weights(position: Float[np.ndarray, " m"], n: int, wrap: bool = False) -> "csr_array":
    """Weights `[m n]` of the n texels in the linear interpolant at fractional texel positions; two in a row."""
    from scipy.sparse import csr_array

    first = np.floor(position).astype(np.int64)
    if not wrap:
        first = np.clip(first, 0, n - 2)
    fraction = position - first
    columns = np.stack([first % n, (first + 1) % n], axis=1)
    weights = np.stack([1 - fraction, fraction], axis=1)
    return csr_array((weights.ravel(), columns.ravel(), 2 * np.arange(len(position) + 1)), shape=(len(position), n))


def weighted_means(weights: "csr_array", measure: Float[np.ndarray, " m"]) -> "csr_array":
    """The matrix `[n m]` that averages values at m points under each of n weights `[m n]`, points by their measure."""
    from scipy.sparse import csr_array, diags_array

    total = weights.T @ measure
    return csr_array(diags_array(1 / total) @ weights.T @ diags_array(measure))


def check_map(environment: Any) -> None:
    """Looks at a lat-long map that somebody handed in.

    Raises:
        UnirenderError: it is one of whole numbers, or of a wrong shape.
    """
    check_radiance("environment", environment)
    shape = np.shape(environment)
    if len(shape) != 3 or shape[-1] != 3:
        raise UnirenderError(f"environment: got shape {shape}, expected a lat-long map [height, width, 3]")
    check_shape(shape[:2])


def check_shape(shape: Any) -> None:
    """Looks at the rows and columns of a map.

    Raises:
        UnirenderError: these are no two whole numbers of at least 2.
    """
    sides = shape if isinstance(shape, tuple | list) else ()
    if len(sides) != 2 or not all(isinstance(side, Integral) and int(side) >= 2 for side in sides):
        raise UnirenderError(f"environment: got size {shape}, expected a lat-long map of at least 2 x 2 texels")
