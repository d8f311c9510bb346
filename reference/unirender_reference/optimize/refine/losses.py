"""How far rendered pictures are from the given ones: value and derivative, each in closed form.

Notation: x is the rendered and t the given radiance of a pixel, linear and premultiplied; c is the pixel's coverage.
A loss is the mean of e(x, t) over covered pixels and channels:

    log     |T(x) - T(t)|, T(x) = srgb(log(1 + x)): NvDiffRec's (Munkberg et al. 2022, sec. 4)
    srgb    (srgb(x) - srgb(t))^2
    linear  (x - t)^2
    slope   (srgb'(t) (x - t))^2

x is a Monte Carlo estimate. Where the derivative of e is linear in x (linear, slope) the expected gradient is that of
the noise-free picture; the others are biased, most where x is noisiest. `slope` is `srgb` to first order.

A display value of 1 says that the radiance was 1 *or more*. `one_sided`: there, an x above t is no error.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float

from unirender.color import srgb_encode
from unirender_reference.optimize.numerics.robust import cauchy
from unirender_reference.optimize.numerics.tone import tone_slope
from unirender_reference.optimize.refine.config import LossKind
from unirender_reference.optimize.views import View, Views

LEAST_ERROR = 0.002  # display values: half a step of 8 bits; of the scale of errors

Images = Float[np.ndarray, "n h w 3"]


class ImageLoss:
    """The loss of pictures against views.

    Args:
        views: the pictures; premultiplied linear radiance is made of them once.
        chosen: which of them; all that are seen if None.
        kind: see the module.
        one_sided: whether more light than a display shows is no error.
    """

    def __init__(
        self, views: Views, kind: LossKind = "slope", one_sided: bool = True, chosen: tuple[View, ...] | None = None
    ) -> None:
        pictures = views.seen if chosen is None else chosen
        self.kind: LossKind = kind
        self.target = np.stack([views.linear(view) for view in pictures])
        self.coverage = np.stack([view.mask for view in pictures])
        self._count = float(self.coverage.sum() * 3)
        self._share: Images = np.ones_like(self.target)
        self.saturated: Bool[np.ndarray, "n h w 3"] = np.zeros(self.target.shape, bool)
        if one_sided:
            self.saturated = np.stack([views.saturated(view) for view in pictures]) & (self.coverage > 0)

    def __call__(self, images: Images) -> tuple[float, Images]:
        """Value, and derivative with respect to the images.

        Args:
            images: premultiplied linear radiance.
        """
        error, slope = pixel_loss(images, self.target, self.kind)
        counted = (self.coverage > 0) & ~(self.saturated & (images > self.target))
        value = float((self._share * error).sum(where=counted, dtype=np.float64)) / self._count
        return value, (np.where(counted, self._share * slope, 0) / self._count).astype(np.float32)

    def weigh(self, images: Images) -> None:
        """From now on pixels count by how well these images explain them: Cauchy's weights at the errors' own scale.

        They are held fixed, so that a loss whose derivative is linear in x keeps its unbiased gradient.

        Args:
            images: premultiplied linear radiance, with little noise.
        """
        error = np.abs(tone_slope(self.target) * (images - self.target))
        counted = (self.coverage > 0) & ~(self.saturated & (images > self.target))
        if counted.any():
            weight = cauchy(error[counted], LEAST_ERROR).weight(error)
            self._share = (weight / weight[counted].mean()).astype(np.float32)

    def psnr(self, images: Images, other: Images | None = None) -> float:
        """Of display values over covered pixels, in dB.

        Args:
            images: premultiplied linear radiance.
            other: the same with other samples. The product of both errors is free of the samples' variance, which the
                square of one contains; None: the square.
        """

        def shown(values: Images) -> Images:
            return srgb_encode(np.clip(values / np.maximum(self.coverage, 1e-3), 0, 1))

        given = shown(self.target)
        product = (shown(images) - given) * (shown(images if other is None else other) - given)
        mse = float((product * self.coverage).sum(dtype=np.float64)) / self._count
        return float(-10 * np.log10(max(mse, 1e-12)))


def psnr_db(
    views: Views,
    chosen: Sequence[View],
    found: Float[np.ndarray, "n h w 4"],
    other: Float[np.ndarray, "n h w 4"] | None = None,
) -> float:
    """Of display values over covered pixels; of linear views, of what a display would show.

    Args:
        views: what the pictures belong to.
        chosen: some of the views.
        found: a picture for each of them.
        other: the same with other samples: without the noise of both (`ImageLoss.psnr`).
    """
    return ImageLoss(views, chosen=tuple(chosen)).psnr(found[..., :3], None if other is None else other[..., :3])


def pixel_loss(x: Images, t: Images, kind: LossKind) -> tuple[Images, Images]:
    """e(x, t) and its derivative with respect to x, for each pixel and channel."""
    x = np.maximum(x, 0)
    match kind:
        case "log":
            shown = np.log1p(x)
            difference = srgb_encode(shown) - srgb_encode(np.log1p(t))
            slope = tone_slope(shown) / (1 + x)
            return np.abs(difference), (np.sign(difference) * slope).astype(np.float32)
        case "srgb":
            difference = srgb_encode(x) - srgb_encode(t)
            return difference**2, (2 * difference * tone_slope(x)).astype(np.float32)
        case "linear":
            return (x - t) ** 2, 2 * (x - t)
        case "slope":
            weight = (tone_slope(t) ** 2).astype(np.float32)
            return weight * (x - t) ** 2, 2 * weight * (x - t)
