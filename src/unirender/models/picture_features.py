"""What ImageNet knows of a picture: frozen VGG-16 features beside the image stream's own.

A clean image, the condition of inverse rendering, also enters through the first four stages of VGG-16 (Simonyan and
Zisserman 2015), whose weights were learned on 1.3 million photographs; a few thousand objects cannot teach that. Each
stage's last activation, normalised over its channels, is added by a zero-initialised 1x1 convolution to the level of
the image stream's encoder that has its size. Their mean and deviation over the object's pixels, the *summary*, is added
to the time embedding of the attribute stream's decoder: how rough or metallic an object is can be seen of the whole of
it better than at a pixel. A noisy image has no features, so that rendering is as it is without them.

    x_s = relu(conv(... pool(x_{s-1}))),   y_s = x_s / rms_c(x_s),   h_l <- h_l + W_l y_s,   s = l + log2(patch)
    e <- e + V [mean_object(y_s), deviation_object(y_s)]_s

The kernels are buffers: saved with the network, seen by no optimiser and no average.

Notation: b batch, H W image size, s stage, l level, c channels.
"""

import itertools
from collections.abc import Mapping, Sequence
from pathlib import Path

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from safetensors import SafetensorError
from safetensors.torch import load_file
from torch import Tensor, nn

from unirender.errors import UnirenderError
from unirender.models.added import Added
from unirender.paths import cache_dir

STAGES = ((64, 64), (128, 128), (256, 256, 256), (512, 512, 512))  # output channels of each stage's 3x3 convolutions
MEAN, DEVIATION = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)  # of ImageNet's pictures, sRGB in [0, 1]
BLACK = -1 + 1 / 255  # of packed pictures
EPSILON = 1e-3  # beside the root mean square of an activation: where nothing is seen nothing is amplified


class PictureFeatures(nn.Module):
    """Stages of VGG-16, and their way into a network.

    Args:
        widths: channels that come into each of the encoder's levels, from the finest down.
        patch: image pixels per pixel of the finest level, one way; a power of two.
        embedding_width: of the time embedding.
    """

    def __init__(self, widths: Sequence[int], patch: int, embedding_width: int) -> None:
        super().__init__()
        first = patch.bit_length() - 1
        if patch != 1 << first or first >= len(STAGES):
            raise ValueError(f"picture features: got patch {patch}, expected 1, 2, 4 or 8")
        taken = range(first, min(len(STAGES), first + len(widths)))
        channels = [3, *(width for stage in STAGES[: taken.stop] for width in stage)]
        for n, (c_in, c_out) in enumerate(itertools.pairwise(channels)):
            self.register_buffer(f"kernel_{n}", torch.zeros(c_out, c_in, 3, 3))
            self.register_buffer(f"bias_{n}", torch.zeros(c_out))
        self.taken = taken
        adapters = (nn.Conv2d(STAGES[s][-1], width, 1) for s, width in zip(taken, widths, strict=False))
        self.adapters = nn.ModuleList(adapters)
        self.summary = nn.Linear(2 * sum(STAGES[s][-1] for s in taken), embedding_width, bias=False)
        for parameter in self.parameters():
            nn.init.zeros_(parameter)

    def forward(self, picture: Float[Tensor, "b 3 H W"], known: Bool[Tensor, " b"]) -> Added:
        """Finds the features of pictures.

        Args:
            picture: packed images, in [-1, 1]; those that are not known are not looked at.
            known: which are clean.

        Raises:
            ValueError: the kernels are missing.
        """
        rows = known.nonzero()[:, 0]
        stages = self.stages(picture[rows])

        def in_place(x: Tensor) -> Tensor:
            return x.new_zeros(len(picture), *x.shape[1:]).index_copy(0, rows, x)

        levels = [in_place(adapter(x)) for x, adapter in zip(stages, self.adapters, strict=True)]
        moments = statistics(stages, picture[rows])
        return Added(levels, in_place(self.summary(moments.to(self.summary.weight))))

    @torch.no_grad()
    def stages(self, picture: Float[Tensor, "n 3 H W"]) -> list[Tensor]:
        """The taken stages' last activations, with a root mean square of about 1 over the channels of each pixel.

        Raises:
            ValueError: the kernels have not been loaded.
        """
        if not self.get_buffer("kernel_0").any():
            raise ValueError("picture features: the kernels of VGG-16 are missing; load them with load_vgg")
        mean, deviation = (picture.new_tensor(values)[:, None, None] for values in (MEAN, DEVIATION))
        x = ((0.5 * picture + 0.5 - mean) / deviation).contiguous(memory_format=torch.channels_last)
        found, n = [], 0
        for stage, widths in enumerate(STAGES[: self.taken.stop]):
            x = F.max_pool2d(x, 2) if stage else x
            for _ in widths:
                x = F.relu(F.conv2d(x, self.get_buffer(f"kernel_{n}"), self.get_buffer(f"bias_{n}"), padding=1))
                n += 1
            if stage in self.taken:
                found.append(x / (x.float().square().mean(dim=1, keepdim=True).sqrt() + EPSILON).to(x))
        return found

    @torch.no_grad()
    def load_vgg(self, weights: Mapping[str, Tensor]) -> None:
        """Takes the kernels from a state dict with the entries `convs.<n>.weight` and `convs.<n>.bias`.

        Raises:
            UnirenderError: entries are missing, or of another network.
        """
        for n in range(sum(map(len, STAGES[: self.taken.stop]))):
            for own, other in ((f"kernel_{n}", f"convs.{n}.weight"), (f"bias_{n}", f"convs.{n}.bias")):
                buffer, value = self.get_buffer(own), weights.get(other)
                if value is None or value.shape != buffer.shape:
                    got = "nothing" if value is None else str(tuple(value.shape))
                    raise UnirenderError(
                        f"weights of VGG-16: got {got} as {other}, expected {tuple(buffer.shape)}; "
                        "convert them again with `python -m unirender_evaluation.lpips_convert vgg`"
                    )
                buffer.copy_(value)


@torch.no_grad()
def statistics(stages: Sequence[Tensor], picture: Float[Tensor, "n 3 H W"]) -> Float[Tensor, "n c"]:
    """Mean and standard deviation of each channel of each stage over the object: what is not black, as all around."""
    seen = (picture.amax(dim=1, keepdim=True) > BLACK).float()
    found: list[Tensor] = []
    for x in (stage.float() for stage in stages):
        weight = F.adaptive_avg_pool2d(seen, (x.shape[-2], x.shape[-1]))
        weight = weight / weight.sum(dim=(2, 3), keepdim=True).clamp_min(EPSILON)
        mean = (weight * x).sum(dim=(2, 3), keepdim=True)
        found += [mean, (weight * (x - mean).square()).sum(dim=(2, 3), keepdim=True).sqrt()]
    return torch.cat(found, dim=1).flatten(1)


def read_vgg() -> dict[str, Tensor]:
    """The weights of VGG-16 in the user's cache, which LPIPS reads too.

    Raises:
        UnirenderError: they are not there, or cannot be read.
    """
    path: Path = cache_dir() / "lpips" / "lpips_vgg.safetensors"
    if not path.is_file():
        raise UnirenderError(
            f"weights of VGG-16: no {path}, which this preset's network begins with; run `python -m "
            "unirender_evaluation.lpips_convert vgg`, or begin with a network that has them (--init)"
        )
    try:
        return load_file(path)
    except (SafetensorError, OSError) as error:
        raise UnirenderError(
            f"weights of VGG-16: {path} cannot be read ({error}); delete it and convert it again with `python -m "
            "unirender_evaluation.lpips_convert vgg`"
        ) from error
