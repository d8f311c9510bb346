"""Maps <-> the pictures in [-1, 1] that a codec turns into latents.

The attributes are six pictures, the paper's layout (Sec. 3.2, "Latent Preparation") with the HDR light as the sixth:

    material [metallic, roughness, mask], albedo, normal, specular, diffuse, environment

Albedo is sRGB-encoded. Normals enter as they are. s, d and the light go through `log1p(k x) / log1p(k x_max)`. The
image is premultiplied and sRGB-encoded. The torch twins of `unirender.color` stand here; a test compares them with it.

Notation: b batch, H W image size, eh ew size of the light.
"""

import math
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from unirender.color import HdrCurve
from unirender.errors import UnirenderError

Maps = dict[str, Tensor]  # by the names of `unirender.intrinsics.MAPS`, in physical units [b c H W]

TRIPLETS = ("material", "albedo", "normal", "specular", "diffuse", "environment")
HDR_CURVES: dict[str, tuple[float, float]] = {
    "specular": (10.0, 20.0),
    "diffuse": (10.0, 2.0),
    "environment": (20.0, 200.0),
}


def srgb_encode(linear: Float[Tensor, "..."]) -> Float[Tensor, "..."]:
    """Torch twin of `unirender.color.srgb_encode`, finite gradients everywhere."""
    power = 1.055 * linear.clamp(min=0.0031308) ** (1 / 2.4) - 0.055
    return torch.where(linear <= 0.0031308, 12.92 * linear, power)


def srgb_decode(srgb: Float[Tensor, "..."]) -> Float[Tensor, "..."]:
    """Torch twin of `unirender.color.srgb_decode`."""
    power = ((srgb.clamp(min=0.04045) + 0.055) / 1.055) ** 2.4
    return torch.where(srgb <= 0.04045, srgb / 12.92, power)


def curve_encode(curve: HdrCurve, x: Float[Tensor, "..."]) -> Float[Tensor, "..."]:
    """Torch twin of `HdrCurve.encode`; values above x_max map above 1."""
    return torch.log1p(curve.k * x) / math.log1p(curve.k * curve.x_max)


def curve_decode(curve: HdrCurve, y: Float[Tensor, "..."]) -> Float[Tensor, "..."]:
    """Torch twin of `HdrCurve.decode`."""
    return torch.expm1(y * math.log1p(curve.k * curve.x_max)) / curve.k


@dataclass(frozen=True)
class Packing:
    """Maps <-> pictures in [-1, 1].

    Attributes:
        curves: tone curve of each HDR map.
        environment_size: rows and columns of the light.
    """

    curves: dict[str, HdrCurve]
    environment_size: tuple[int, int] = (16, 32)

    def pack(self, maps: Maps) -> Float[Tensor, "b 18 H W"]:
        """Maps (linear, not premultiplied, [b c H W]; environment at its own size) -> six pictures, in order."""
        size = (maps["mask"].shape[-2], maps["mask"].shape[-1])
        material = torch.cat([maps["metallic"], maps["roughness"], maps["mask"]], dim=1)
        pictures = [2 * material - 1, 2 * srgb_encode(maps["albedo"]) - 1, maps["normal"]]
        pictures += [2 * curve_encode(self.curves[name], maps[name]) - 1 for name in ("specular", "diffuse")]
        return torch.cat([*pictures, self.spread(self.pack_light(maps["environment"]), size)], dim=1)

    def pack_light(self, environment: Float[Tensor, "b 3 eh ew"]) -> Float[Tensor, "b 3 eh ew"]:
        """The light in [-1, 1]."""
        return 2 * curve_encode(self.curves["environment"], environment) - 1

    def unpack_light(self, picture: Float[Tensor, "b 3 H W"]) -> Float[Tensor, "b 3 eh ew"]:
        """The sixth picture -> light in physical units, as `unpack` gives it."""
        return self._hdr("environment", self.gather(picture))

    def unpack(self, pictures: Float[Tensor, "b 18 H W"]) -> Maps:
        """Six pictures -> maps in physical units, brought into their ranges; differentiable inside them."""
        material, albedo, normal, specular, diffuse, light = pictures.chunk(6, dim=1)
        metallic, roughness, mask = (0.5 * material + 0.5).clamp(0, 1).chunk(3, dim=1)
        return {
            "albedo": srgb_decode((0.5 * albedo + 0.5).clamp(0, 1)),
            "normal": normal,
            "roughness": roughness,
            "metallic": metallic,
            "mask": mask,
            "specular": self._hdr("specular", specular),
            "diffuse": self._hdr("diffuse", diffuse),
            "environment": self.unpack_light(light),
        }

    def spread(self, light: Float[Tensor, "b 3 eh ew"], size: tuple[int, int]) -> Float[Tensor, "b 3 H W"]:
        """The light on the image's grid by repetition, which `gather` undoes to rounding.

        Raises:
            UnirenderError: the light has another size than `environment_size`, or the grid is no multiple of it.
        """
        rows, columns = self.environment_size
        if tuple(light.shape[-2:]) != (rows, columns):
            raise UnirenderError(
                f"environment: got {tuple(light.shape[-2:])}, expected {self.environment_size}; resample it first"
            )
        if size[0] % rows or size[1] % columns:
            raise UnirenderError(f"model size: got {tuple(size)}, expected multiples of {self.environment_size}")
        return light.repeat_interleave(size[0] // rows, dim=2).repeat_interleave(size[1] // columns, dim=3)

    def gather(self, picture: Float[Tensor, "b 3 H W"]) -> Float[Tensor, "b 3 eh ew"]:
        """The mean over the pixels of each texel."""
        return F.adaptive_avg_pool2d(picture, self.environment_size)

    def _hdr(self, name: str, x: Float[Tensor, "b 3 h w"]) -> Float[Tensor, "b 3 h w"]:
        # exp(8) of a stray prediction is no light: twice the curve's range is far above any value it was taught
        return curve_decode(self.curves[name], (0.5 * x + 0.5).clamp(0, 2))


def pack_image(image_linear: Float[Tensor, "b 3 H W"]) -> Float[Tensor, "b 3 H W"]:
    """Premultiplied linear image -> what the image stream denoises: clipped, sRGB-encoded, [-1, 1]."""
    return 2 * srgb_encode(image_linear.clamp(0, 1)) - 1


def unpack_image(picture: Float[Tensor, "b 3 H W"]) -> Float[Tensor, "b 3 H W"]:
    """Inverse of `pack_image`: premultiplied linear image in [0, 1]."""
    return srgb_decode((0.5 * picture + 0.5).clamp(0, 1))
