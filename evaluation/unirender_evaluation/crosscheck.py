"""Our PSNR, SSIM, LPIPS and CIEDE2000 against other implementations: the largest difference of each, over random
pictures and over real ones.

    PSNR        scikit-image; torchmetrics
    SSIM        scikit-image; torchmetrics, inside the border that it averages too and scikit-image and we leave out
    CIEDE2000   scikit-image; colour-science, its own way from display values, of which we use the formula alone
    LPIPS       values that the official package (`lpips` 0.1.4) printed for a stated pattern

Differences are absolute, in the metric's unit. A tolerance says what is left where both are right: rounding, and for
CIEDE2000 the digits to which the matrix from sRGB to XYZ is rounded. (The example pair of LPIPS' own repository is in
no package, and which values belong to it could not be verified: it is not among the checks.)
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from unirender.color import srgb_decode
from unirender.errors import UnirenderError
from unirender_evaluation import lpips, metrics
from unirender_evaluation.lpips import Backbone
from unirender_evaluation.lpips_convert import GOLDEN, pattern
from unirender_evaluation.methods.method import quantise
from unirender_evaluation.rows import evenly
from unirender_evaluation.ssim import SSIM_SIGMA, crop_border, ssim
from unirender_evaluation.suites.suite import Suite
from unirender_evaluation.versions import installed_version

Picture = Float[np.ndarray, "_ _ 3"]  # display values in [0, 1], float64; pairs differ in size
Pair = tuple[Picture, Picture]
Compare = Callable[[Picture, Picture], tuple[float, float]]  # (prediction, truth) -> ours, theirs

SIZES = ((32, 32), (64, 48), (300, 280))  # SSIM blurs in another way beyond 256 pixels
# (backbone, side of `lpips_convert.pattern`) -> the official package's distance.
OFFICIAL: dict[tuple[Backbone, int], float] = {
    ("alex", 64): GOLDEN["alex"],
    ("alex", 100): 0.4982200860977173,
    ("vgg", 64): GOLDEN["vgg"],
}


@dataclass(frozen=True)
class Agreement:
    """One metric against one other implementation."""

    metric: str  # its label
    against: str  # the other implementation, with its version
    pairs: int  # how many pairs of pictures
    largest: float  # absolute difference, in the metric's unit
    tolerance: float  # what it may be

    @property
    def holds(self) -> bool:
        return self.largest <= self.tolerance


def random_pairs(count: int, seed: int) -> Iterator[Pair]:
    """`count` pairs of noise of each size, from nearly alike to unrelated."""
    rng = np.random.default_rng(seed)
    for height, width in SIZES:
        for distance in np.geomspace(0.01, 1.0, count):
            truth, other = rng.random((2, height, width, 3))
            yield (1 - distance) * truth + distance * other, truth


def real_pairs(suite: Suite, scenes: int) -> Iterator[Pair]:
    """Pictures of a suite before and after an edit of the material."""
    for scene in evenly(suite.scenes, scenes):
        mask = suite.mask(scene)
        before, *after = (quantise(suite.image(scene, m), mask) for m in (suite.spec.base, *suite.spec.edits))
        yield from ((picture.astype(np.float64), before.astype(np.float64)) for picture in after)


def agreements(pairs: Sequence[Pair]) -> Iterator[Agreement]:
    """Every metric against every other implementation of it.

    Raises:
        UnirenderError: torchmetrics, which only this check needs, is not installed.
    """
    for metric, distribution, tolerance, compare in _checks():
        found = [compare(*pair) for pair in pairs]
        largest = max(abs(ours - theirs) for ours, theirs in found)
        against = f"{distribution} {installed_version(distribution)}"
        yield Agreement(metrics.METRICS[metric].label, against, len(pairs), largest, tolerance)
    for backbone in lpips.BACKBONES:
        sides = [side for name, side in OFFICIAL if name == backbone]
        if backbone in lpips.available():
            network = lpips.load(backbone)
            largest = max(abs(float(network.distance(*pattern(s))[0]) - OFFICIAL[backbone, s]) for s in sides)
            yield Agreement(metrics.METRICS[network.metric].label, "lpips 0.1.4 (printed)", len(sides), largest, 1e-5)


def _checks() -> list[tuple[str, str, float, Compare]]:
    """(metric, distribution, tolerance, how both are computed)."""
    try:
        import torchmetrics  # noqa: F401 - whether it is there
    except ImportError:
        raise UnirenderError(
            "crosscheck: torchmetrics is not installed, expected it as the second implementation of PSNR and SSIM; "
            "`pip install torchmetrics`"
        ) from None
    return [
        ("psnr", "scikit-image", 1e-9, _psnr_scikit_image),
        ("psnr", "torchmetrics", 1e-5, _psnr_torchmetrics),  # its logarithm is in single precision
        ("ssim", "scikit-image", 1e-9, _ssim_scikit_image),
        ("ssim", "torchmetrics", 1e-9, _ssim_torchmetrics),
        ("ciede2000", "scikit-image", 0.01, _ciede2000_scikit_image),
        ("ciede2000", "colour-science", 0.01, _ciede2000_colour),
    ]


def _psnr_scikit_image(p: Picture, t: Picture) -> tuple[float, float]:
    from skimage.metrics import peak_signal_noise_ratio

    return metrics.psnr(p, t), float(peak_signal_noise_ratio(t, p, data_range=1))


def _psnr_torchmetrics(p: Picture, t: Picture) -> tuple[float, float]:
    from torchmetrics.functional.image import peak_signal_noise_ratio

    return metrics.psnr(p, t), float(peak_signal_noise_ratio(_tensor(p), _tensor(t), data_range=1.0))


def _ssim_scikit_image(p: Picture, t: Picture) -> tuple[float, float]:
    from skimage.metrics import structural_similarity

    scikit_image: Any = structural_similarity  # what it returns depends on its options, which its types do not know
    options = {"gaussian_weights": True, "sigma": SSIM_SIGMA, "use_sample_covariance": False}
    return ssim(p, t), float(scikit_image(t, p, channel_axis=-1, data_range=1.0, **options))


def _ssim_torchmetrics(p: Picture, t: Picture) -> tuple[float, float]:
    from torchmetrics.functional.image import structural_similarity_index_measure

    options: Any = {"data_range": 1.0, "sigma": SSIM_SIGMA, "return_full_image": True}
    _, maps = structural_similarity_index_measure(_tensor(p), _tensor(t), **options)
    return ssim(p, t), float(crop_border(maps[0].mean(dim=0).numpy()).mean())


def _ciede2000_scikit_image(p: Picture, t: Picture) -> tuple[float, float]:
    from skimage.color import deltaE_ciede2000, rgb2lab

    return _ciede2000(p, t), float(deltaE_ciede2000(rgb2lab(t), rgb2lab(p)).mean())


def _ciede2000_colour(p: Picture, t: Picture) -> tuple[float, float]:
    import colour

    white = colour.RGB_COLOURSPACES["sRGB"].whitepoint
    labs = [colour.XYZ_to_Lab(np.asarray(colour.sRGB_to_XYZ(x)), white) for x in (p, t)]
    return _ciede2000(p, t), float(np.mean(colour.delta_E(labs[0], labs[1], method="CIE 2000")))


def _ciede2000(p: Picture, t: Picture) -> float:
    return metrics.ciede2000(srgb_decode(p), srgb_decode(t), np.ones((*p.shape[:2], 1)))


def _tensor(x: Picture) -> Any:
    import torch

    return torch.from_numpy(np.ascontiguousarray(x)).permute(2, 0, 1)[None]
