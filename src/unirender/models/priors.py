"""What the image stream's output is added to: the closed-form images of `unirender.composite`, as torch twins.

Each twin is held against its numpy original by a test; gradients flow to the maps.

Notation: b batch, H W image size.
"""

import functools
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from unirender.camera import Camera
from unirender.composite import composite, composite_image, fresnel, lobes, split_sum_image
from unirender.environment_brdf import environment_brdf_tables
from unirender.intrinsics import Intrinsics
from unirender.models.packing import Maps

SHORT = 0.1  # predicted normals below this length have no direction; keeps the gradient of the rest finite


@dataclass(frozen=True)
class Prior:
    """A closed-form image.

    Attributes:
        triplets: the pictures that it is made of.
        radiance: maps and camera -> linear radiance [b 3 H W], not multiplied by the mask.
        image: the numpy original: linear and premultiplied.
    """

    triplets: tuple[str, ...]
    radiance: Callable[[Maps, Camera], Float[Tensor, "b 3 H W"]]
    image: Callable[[Intrinsics], Float[np.ndarray, "h w 3"]]


def composite_radiance(maps: Maps, camera: Camera) -> Float[Tensor, "b 3 H W"]:
    """The composite; it does not depend on the camera."""
    del camera
    return composite(maps["albedo"], maps["metallic"], maps["diffuse"], maps["specular"])


def split_sum_radiance(maps: Maps, camera: Camera) -> Float[Tensor, "b 3 H W"]:
    """The split-sum composite, n.v along the camera's rays; predicted normals are normalised."""
    metallic, roughness = maps["metallic"], maps["roughness"]
    view = torch.from_numpy(camera.view_directions(*roughness.shape[-2:])).to(roughness).permute(2, 0, 1)
    n_v = (F.normalize(maps["normal"], dim=1, eps=SHORT) * view).sum(dim=1, keepdim=True)
    a, b = _environment_brdf(n_v, roughness).chunk(2, dim=1)
    reflectance = (fresnel(maps["albedo"], metallic) * a + b) / (a + b)
    return lobes(maps["albedo"], metallic, maps["diffuse"], maps["specular"], reflectance)


PRIORS = {
    "composite": Prior(("material", "albedo", "specular", "diffuse"), composite_radiance, composite_image),
    "split_sum": Prior(("material", "albedo", "normal", "specular", "diffuse"), split_sum_radiance, split_sum_image),
}


def _environment_brdf(n_v: Float[Tensor, "b 1 H W"], roughness: Float[Tensor, "b 1 H W"]) -> Float[Tensor, "b 2 H W"]:
    """Torch twin of `unirender.environment_brdf.environment_brdf`: A and B, bilinear in the same tables."""
    tables = _tables().to(n_v).expand(len(n_v), -1, -1, -1)
    at = torch.cat([roughness, n_v], dim=1).permute(0, 2, 3, 1)  # grid_sample: x runs along the last axis
    return F.grid_sample(tables, 2 * at - 1, mode="bilinear", padding_mode="border", align_corners=True)


@functools.cache
def _tables() -> Float[Tensor, "1 2 n r"]:
    return torch.stack([torch.from_numpy(table) for table in environment_brdf_tables()])[None]
