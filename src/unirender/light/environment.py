"""Environment maps: the lat-long grid, its orientation, sampling and rotation.

An environment is a lat-long map `[h w 3]` of linear radiance in camera axes, +y up, on the grid of Mitsuba's `envmap`:
row i lies at the polar angle theta = pi i / (h - 1) from +y (so the first and last rows are the poles), column j at the
azimuth phi = 2 pi (j + 1/2) / w, and

    direction = (sin(theta) sin(phi), cos(theta), -sin(theta) cos(phi)).

The middle of the map is +z (behind the camera), its left and right borders meet at -z (behind the object). Between
texels radiance is bilinear; all integrals are exact for that interpolant ("hat" weights). Other resolutions are in
`unirender.light.resampling`, the light that a surface receives from a map in `unirender.light.surface_light`.
"""

from numbers import Integral
from typing import Any

import numpy as np
from jaxtyping import Float

from unirender.arguments import as_floats, as_instance
from unirender.errors import UnirenderError
from unirender.intrinsics import as_radiance, check_radiance

ASPECT_TOLERANCE = 0.02  # of the width over the height, which is 2
POLE_STEP = 1e-16  # from a pole, so small that it turns no other direction
LEAST_ROWS, LEAST_COLUMNS = 3, 2  # of a light to render by: Mitsuba resamples smaller ones
UNIT_TOLERANCE = 0.05  # of squared lengths: 0.7 for half of the root of 2 is near enough


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
