"""What an answer looks like that is in other units or conventions than the contract's: told before it is scored.

A picture is linear radiance, premultiplied: at a suite's exposure about 1, and black where no object is.
"""

import numpy as np
from scipy.ndimage import binary_dilation

from unirender_evaluation.methods.method import Image, Mask

TOO_BRIGHT = 20.0  # median in the mask; that of the suites' pictures is below 1
NEGATIVE = -0.25  # a tenth of the values may be below: networks, denoisers and resampling ring
BACKGROUND = 0.02  # median radiance behind the object, 39 of 255 as a display value: stray pixels do no harm
AWAY = 2  # pixels from the object, which antialiasing and resampling do not reach


def picture_doubt(image: Image, mask: Mask) -> str | None:
    """Why a rendered picture is not linear radiance, premultiplied; None: nothing says so.

    Says nothing where all is covered: public sets' photographs have any exposure and no background that is known.

    Args:
        image: linear.
        mask: the true coverage.
    """
    return None if mask.all() else range_doubt(image, mask) or _background_doubt(image, mask)


def range_doubt(image: Image, mask: Mask, usual: float = 1.0) -> str | None:
    """Why a picture's values in the mask are no radiance of a usual exposure; None: nothing says so.

    Args:
        image: linear.
        mask: the true coverage.
        usual: what white is, or nearly.
    """
    inside = image[mask[..., 0] > 0]
    if not inside.size:
        return None
    if (median := float(np.median(inside))) > TOO_BRIGHT * usual:
        return f"its median in the mask is {median:.3g}, expected linear radiance with white at {usual:.3g} (0 to 255?)"
    if (tenth := float(np.quantile(inside, 0.1))) < NEGATIVE * usual:
        return f"a tenth of its values in the mask is below {tenth:.3g}, expected radiance from 0 (-1 to 1?)"
    return None


def _background_doubt(image: Image, mask: Mask) -> str | None:
    away = np.logical_not(binary_dilation(mask[..., 0] > 0, np.ones((3, 3)), AWAY))
    median = float(np.median(np.abs(image[away]))) if away.any() else 0.0
    if median <= BACKGROUND:
        return None
    return f"it has radiance {median:.3g} (median) where no object is, expected a premultiplied picture, black there"
