"""The light's own encoder: a lat-long map in camera axes becomes tokens for the cross-attention of both streams.

A pixel of the sixth attribute picture lies at no place of the light, so that a renderer has to learn where each
direction is. Here it asks by attention instead, and every token knows its direction by a learned position.

Notation: b batch, eh ew rows and columns of the light, k tokens.
"""

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

CHANNELS = 4  # red, green, blue as the packing has them, in [-1, 1]; whether the light is given
WIDTH = 64
HALVINGS = 2  # 16 x 32 texels -> 4 x 8 tokens


class LightEncoder(nn.Module):
    """Convolutions on the sphere's grid, then one token for each cell of what is left of it.

    The last layer starts at zero: a network's first output is the same for every light, given or not. It is not that of
    the network without the encoder, since tokens of zeros, too, take their share of a softmax.

    Args:
        size: rows and columns of the light.
        token_width: of the prompt embedding beside which the tokens stand.
    """

    def __init__(self, size: tuple[int, int], token_width: int) -> None:
        super().__init__()
        cell = 2**HALVINGS
        if size[0] % cell or size[1] % cell:
            raise ValueError(f"light encoder: got a light of {size}, expected multiples of {cell} both ways")
        self.first = nn.Conv2d(CHANNELS, WIDTH, 3)
        self.halvings = nn.ModuleList(nn.Conv2d(WIDTH, WIDTH, 3, stride=2) for _ in range(HALVINGS))
        self.position = nn.Parameter(0.5 * torch.randn(1, WIDTH, size[0] // cell, size[1] // cell))
        self.last = nn.Linear(WIDTH, token_width)
        nn.init.zeros_(self.last.weight)
        nn.init.zeros_(self.last.bias)

    def forward(self, light: Float[Tensor, "b 4 eh ew"]) -> Float[Tensor, "b k width"]:
        """Tokens of a light that `unirender.models.packing` packed; zeros for one that is not given."""
        features = self.features(light) + self.position
        return self.last(F.silu(features).flatten(2).transpose(1, 2))

    def features(self, light: Float[Tensor, "b 4 eh ew"]) -> Float[Tensor, "b c kh kw"]:
        """What the convolutions see; it turns about the vertical axis with the light, by whole tokens."""
        features = self.first(pad_sphere(light))
        for halve in self.halvings:
            features = halve(pad_sphere(F.silu(features)))
        return features


def pad_sphere(latlong: Float[Tensor, "b c rows columns"]) -> Float[Tensor, "b c rows+2 columns+2"]:
    """One texel more on each side: round in longitude; over a pole to the opposite longitude.

    The light's first and last rows are the poles themselves, so that beyond a pole lies the row next to it. Of smaller
    grids that is nearly so.
    """
    half = latlong.shape[-1] // 2
    beyond_top, beyond_bottom = (latlong[..., row, :].roll(half, dims=-1)[..., None, :] for row in (1, -2))
    return F.pad(torch.cat([beyond_top, latlong, beyond_bottom], dim=-2), (1, 1, 0, 0), mode="circular")
