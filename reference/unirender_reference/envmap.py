"""Environments as Mitsuba's `envmap` takes them."""

import numpy as np
from jaxtyping import Float

from unirender.errors import UnirenderError
from unirender.intrinsics import as_radiance
from unirender.light.for_mitsuba import drawable

MOST_RADIANCE = 1e12  # the sun's luminance is 1.6e9 cd/m^2; squares of far more leave the range of float32


def envmap_data(environment: Float[np.ndarray, "h w 3"]) -> Float[np.ndarray, "h2 w+2 3"]:
    """The environment as Mitsuba's `envmap` parameter stores it (`envmap_rows`): one wrapped column on either side."""
    environment = envmap_rows(environment)
    return np.concatenate([environment[:, -1:], environment, environment[:, :1]], axis=1)


def envmap_rows(environment: Float[np.ndarray, "h w 3"]) -> Float[np.ndarray, "h2 w 3"]:
    """The environment, checked, as Mitsuba can sample it: itself, or with a row between each two (`drawable`).

    Raises:
        UnirenderError: it is too small, black, negative, not finite or above `MOST_RADIANCE`.
    """
    environment = as_radiance("environment", environment)
    if environment.ndim != 3 or environment.shape[-1] != 3 or environment.shape[0] < 3 or environment.shape[1] < 2:
        # Mitsuba resamples smaller maps when it loads them.
        raise UnirenderError(
            f"environment: got shape {environment.shape}, expected (height >= 3, width >= 2, 3); "
            "move the channels last, or resample it (unirender.light.resampling.resample_environment)"
        )
    if not np.isfinite(environment).all() or environment.min() < 0:
        raise UnirenderError(
            "environment: got negative, infinite or NaN radiance, expected finite values >= 0; "
            "np.maximum(light, 0) is what to do with a filter's ringing"
        )
    if environment.max() > MOST_RADIANCE:
        raise UnirenderError(
            f"environment: got radiance up to {environment.max():.3g}, expected at most {MOST_RADIANCE:g}; scale it"
        )
    if environment.max() <= 0:
        raise UnirenderError("environment: all texels are black, expected some light; give another one")
    return drawable(environment)
