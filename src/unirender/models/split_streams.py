"""The ablation `without_unified` (paper Sec. 4.3): two dual-stream networks, one per direction, that share no weight.

`p(image | attributes)` and `p(attributes | image)` each have a network with both encoders and only the decoder of what
they predict; nothing in either waits for a gradient that never comes. Every row of a batch goes to the network of the
stream that is asked for, so that in training each sees its direction's rows only, under either rule of timesteps; a row
that is noisy in both streams (Algorithm 1) goes to both.
"""

import functools
from typing import Any

from diffusers.models.modeling_utils import ModelMixin  # noqa: F401 - by it diffusers knows that this module has models
from jaxtyping import Float, Int
from torch import Tensor, nn

from unirender.models.dual_stream import ALL_ROWS, DualStreamModel, DualStreamOutput, Encoded
from unirender.models.unet import remove_decoder


class SplitDualStreamModel(DualStreamModel):
    """A `DualStreamModel` that only renders, and carries another, `inverse`, that only inverse-renders.

    It is built, called, saved and loaded as a `DualStreamModel` is; the widths are those of each network.
    """

    @functools.wraps(DualStreamModel.__init__)  # the config's entries are its arguments' names
    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.inverse = DualStreamModel(*args, **kwargs)
        self.image_to_attributes = nn.ModuleList()
        remove_decoder(self.attribute_unet)
        self.inverse.attributes_to_image = nn.ModuleList()
        remove_decoder(self.inverse.image_unet)

    def forward(
        self,
        attributes: Float[Tensor, "b ca h w"] | Encoded,
        image: Float[Tensor, "b ci h w"] | Encoded,
        attributes_timestep: Int[Tensor, " b"],
        image_timestep: Int[Tensor, " b"],
        attribute_extra: Float[Tensor, "b ea h w"] | None = None,
        image_extra: Float[Tensor, "b ei h w"] | None = None,
        image_prior: Float[Tensor, "b ci h w"] | None = None,
        attribute_rows: slice | None = ALL_ROWS,
        image_rows: slice | None = ALL_ROWS,
    ) -> DualStreamOutput:
        """As `DualStreamModel.forward`: attributes by the one network, images by the other."""
        inputs = (attributes, image, attributes_timestep, image_timestep, attribute_extra, image_extra, image_prior)

        def rows_of(rows: slice) -> list[Any]:
            return [x if x is None else x[rows] for x in inputs]

        inverse = rendered = DualStreamOutput()
        if attribute_rows is not None:
            inverse = self.inverse(*rows_of(attribute_rows), image_rows=None)
        if image_rows is not None:
            rendered = super().forward(*rows_of(image_rows), attribute_rows=None)
        return DualStreamOutput(inverse.attributes, rendered.image, rendered.encoded_attributes, inverse.encoded_image)
