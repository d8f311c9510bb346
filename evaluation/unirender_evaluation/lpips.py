"""LPIPS, the official metric (v0.1): AlexNet and VGG-16 feature stacks written out, with the published weights.

    d(a, b) = sum_l mean_hw sum_c w_lc (f_lc(a)/|f_l(a)| - f_lc(b)/|f_l(b)|)^2          (Zhang et al. 2018, eq. 1)

over the activations f_l after the ReLUs that the authors tap, with their learned non-negative heads w_l. `torchvision`
is not needed. AlexNet's weights ship with the package; VGG's (59 MB) are converted into the user's cache by
`python -m unirender_evaluation.lpips_convert vgg`. Where a backbone's weights are absent its cells say n/a: there is no
stand-in. At 64 px AlexNet's last three maps are 3 x 3: still the official definition, and coarse, which is why every
table prints its resolution beside the backbone.
"""

import hashlib
from functools import lru_cache
from pathlib import Path
from typing import Literal, get_args

import numpy as np
import torch
from jaxtyping import Float
from safetensors.torch import load_file
from torch import Tensor, nn

from unirender.errors import UnirenderError
from unirender.system.paths import cache_dir

Backbone = Literal["alex", "vgg"]
BACKBONES: tuple[Backbone, ...] = get_args(Backbone)

SHIFT, SCALE = (-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)  # the ScalingLayer of v0.1, on images in [-1, 1]
KEPT_TRUTHS = 4  # feature lists kept for reuse; 2 MB each for VGG at 64 px
KEPT_PIXELS = 2**16  # of a truth whose features are kept
BATCH, PIXELS_AT_ONCE = 32, 2**20  # most pictures of a forward pass, and their pixels where there are several
EPSILON = 1e-10  # added to the feature norm, as the authors do
SMALLEST = {"alex": 31, "vgg": 16}  # smallest side (pixels) that leaves at least one value in the last map

# Stages of each stack; a stage ends at a tapped ReLU. A layer is a convolution (channels in, channels out, kernel,
# stride, padding) or a max pooling (size, stride).
Conv = tuple[int, int, int, int, int]
Layer = Conv | tuple[int, int]
STAGES: dict[Backbone, tuple[tuple[Layer, ...], ...]] = {
    "alex": (
        ((3, 64, 11, 4, 2),),
        ((3, 2), (64, 192, 5, 1, 2)),
        ((3, 2), (192, 384, 3, 1, 1)),
        ((384, 256, 3, 1, 1),),
        ((256, 256, 3, 1, 1),),
    ),
    "vgg": (
        ((3, 64, 3, 1, 1), (64, 64, 3, 1, 1)),
        ((2, 2), (64, 128, 3, 1, 1), (128, 128, 3, 1, 1)),
        ((2, 2), (128, 256, 3, 1, 1), *[(256, 256, 3, 1, 1)] * 2),
        ((2, 2), (256, 512, 3, 1, 1), *[(512, 512, 3, 1, 1)] * 2),
        ((2, 2), *[(512, 512, 3, 1, 1)] * 3),
    ),
}


def weights_path(backbone: Backbone) -> Path:
    """Where the weights of a backbone are expected: in the package (alex) or in the user's cache (vgg)."""
    if backbone == "alex":
        return Path(__file__).parent / "data" / "lpips_alex.safetensors"
    return cache_dir() / "lpips" / "lpips_vgg.safetensors"


def available() -> tuple[Backbone, ...]:
    """Backbones whose weights are on this machine."""
    return tuple(name for name in BACKBONES if weights_path(name).is_file())


class LpipsNetwork(nn.Module):
    """Feature stack and heads of one backbone; state dict names are `convs.<i>` and `heads.<l>`."""

    def __init__(self, backbone: Backbone) -> None:
        super().__init__()
        self.stages = STAGES[backbone]
        shapes = [layer for stage in self.stages for layer in stage if len(layer) == 5]
        self.convs = nn.ModuleList(nn.Conv2d(i, o, k, s, p) for i, o, k, s, p in shapes)
        widths = [stage[-1][1] for stage in self.stages]  # a stage ends with a convolution
        self.heads = nn.ParameterList(nn.Parameter(torch.empty(1, width, 1, 1)) for width in widths)

    def features(self, x: Float[Tensor, "b 3 h w"]) -> list[Float[Tensor, "b c hl wl"]]:
        """Tapped activations, each with unit length over channels. `x` is sRGB in [0, 1]."""
        x = (2 * x - 1 - x.new_tensor(SHIFT)[:, None, None]) / x.new_tensor(SCALE)[:, None, None]
        taps, convs = [], iter(self.convs)
        for stage in self.stages:
            for layer in stage:
                x = nn.functional.max_pool2d(x, layer[0], layer[1]) if len(layer) == 2 else next(convs)(x).relu()
            taps.append(x / (x.square().sum(dim=1, keepdim=True).sqrt() + EPSILON))
        return taps

    def forward(self, a: Float[Tensor, "b 3 h w"], b: Float[Tensor, "m 3 h w"]) -> Float[Tensor, " b"]:
        """LPIPS distance of pairs of sRGB images in [0, 1]; m is b, or 1: one image that all are compared with."""
        return self.compare(self.features(a), self.features(b))

    def compare(self, f: list[Tensor], g: list[Tensor]) -> Float[Tensor, " b"]:
        """Distance from the features of two batches."""
        levels = zip(f, g, self.heads, strict=True)
        distances = [nn.functional.conv2d((x - y).square(), w).mean(dim=(1, 2, 3)) for x, y, w in levels]
        return torch.stack(distances).sum(dim=0)


class Lpips:
    """LPIPS on numpy images.

    Args:
        backbone: "alex" or "vgg".

    Raises:
        UnirenderError: if the weights are not on this machine.
    """

    def __init__(self, backbone: Backbone = "alex") -> None:
        path = weights_path(backbone)
        if not path.is_file():
            raise UnirenderError(
                f"LPIPS-{backbone}: no weights at {path}; run `python -m unirender_evaluation.lpips_convert {backbone}`"
            )
        self.backbone: Backbone = backbone
        self.network = LpipsNetwork(backbone)
        self.network.load_state_dict(load_file(path))
        self.network.eval().requires_grad_(False)
        self._kept: dict[tuple[torch.Size, bytes], list[Tensor]] = {}

    @property
    def metric(self) -> str:
        """Name of the metric in `metrics.METRICS`."""
        return f"lpips_{self.backbone}"

    def distance(
        self, a_srgb: Float[np.ndarray, "n h w 3"], b_srgb: Float[np.ndarray, "m h w 3"]
    ) -> Float[np.ndarray, " n"]:
        """Distances of n pairs of display images in [0, 1]; m is n, or 1: one image that all are compared with.

        Raises:
            UnirenderError: if shapes differ, values leave [0, 1], or the images are too small for the backbone.
        """
        same = a_srgb.shape[1:] == b_srgb.shape[1:] and len(b_srgb) in (1, len(a_srgb))
        if not same or a_srgb.ndim != 4 or a_srgb.shape[-1] != 3:
            raise UnirenderError(f"LPIPS: got shapes {a_srgb.shape} and {b_srgb.shape}, expected (n, h, w, 3) twice")
        if min(a_srgb.shape[1:3]) < SMALLEST[self.backbone]:
            raise UnirenderError(
                f"LPIPS-{self.backbone}: got {a_srgb.shape[1]} x {a_srgb.shape[2]} pixels, expected at least "
                f"{SMALLEST[self.backbone]} a side; score at a higher resolution"
            )
        for name, value in (("first", a_srgb), ("second", b_srgb)):
            if not (value.min() >= -1e-4 and value.max() <= 1 + 1e-4):
                raise UnirenderError(
                    f"LPIPS: {name} images span [{value.min():.4g}, {value.max():.4g}], expected display values in "
                    "[0, 1]; encode with unirender.color.image_srgb"
                )
        first, second = self._batches(a_srgb), self._batches(b_srgb)
        with torch.inference_mode():
            if len(b_srgb) == 1:
                truth = self._features_once(second[0])
                found = [self.network.compare(self.network.features(a), truth) for a in first]
            else:
                found = [self.network(a, b) for a, b in zip(first, second, strict=True)]
            return np.concatenate([distances.numpy() for distances in found])

    def _features_once(self, image: Float[Tensor, "1 3 h w"]) -> list[Tensor]:
        """Features of a truth; the last few are kept if small: many methods are scored on one truth after another."""
        if image.shape[-2] * image.shape[-1] > KEPT_PIXELS:
            return self.network.features(image)
        key = image.shape, hashlib.sha256(image.contiguous().numpy().tobytes()).digest()
        if key not in self._kept:
            while len(self._kept) >= KEPT_TRUTHS:
                del self._kept[next(iter(self._kept))]
            self._kept[key] = self.network.features(image)
        return self._kept[key]

    def _batches(self, images: Float[np.ndarray, "n h w 3"]) -> list[Tensor]:
        tensor = torch.from_numpy(np.ascontiguousarray(images, dtype=np.float32)).permute(0, 3, 1, 2)
        most = max(PIXELS_AT_ONCE // (images.shape[1] * images.shape[2]), 1)
        return list(tensor.split(min(BATCH, most)))


@lru_cache(maxsize=2)
def load(backbone: str) -> Lpips:
    """`Lpips(backbone)`, loaded once per process.

    Raises:
        UnirenderError: there is no such backbone, or its weights are not here.
    """
    for name in BACKBONES:
        if name == backbone:
            return Lpips(name)
    raise UnirenderError(f"LPIPS: got backbone {backbone!r}, expected one of {', '.join(BACKBONES)}")
