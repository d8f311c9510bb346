"""From maps to everything that the two streams see, and back.

`unirender.models.packing` says what the six attribute pictures are. Whatever else a stream sees (presence flags, mask,
rays, prior) enters as *extra* channels, beside the latents.

Notation: b batch, H W image size, h w latent size, c latent channels of one picture, n = 6 pictures.
"""

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from unirender.camera import Camera
from unirender.color import HdrCurve
from unirender.errors import UnirenderError
from unirender.models.codec import Codec
from unirender.models.packing import HDR_CURVES, TRIPLETS, Maps, Packing, pack_image, unpack_image
from unirender.models.priors import PRIORS, Prior

DERIVED_FLAG = 0.5  # between given and not given
RAY_SCALE = 3.0  # brings the default camera's ray slopes to about [-1, 1]


def prior_picture(prior: Prior, maps: Maps, mask: Float[Tensor, "b 1 H W"], camera: Camera) -> Float[Tensor, "b 3 H W"]:
    """The closed-form image of the maps, packed like an image."""
    return pack_image(prior.radiance(maps, camera) * mask)


@dataclass(frozen=True)
class Extras:
    """Additional inputs of the network.

    Attributes:
        attributes: of the attribute stream.
        image: of the image stream.
        prior: latents to which the image stream's output is added.
    """

    attributes: Float[Tensor, "b ea h w"]
    image: Float[Tensor, "b ei h w"]
    prior: Float[Tensor, "b c h w"] | None

    def to(self, like: Tensor) -> "Extras":
        """In dtype and on the device of `like`, but for the prior: the sum keeps its precision."""
        return Extras(self.attributes.to(like), self.image.to(like), self.prior)


@dataclass(frozen=True)
class Conditioning:
    """Everything between maps and a `DualStreamModel`.

    Attributes:
        codec: pictures <-> latents.
        packing: maps <-> pictures.
        physics_prior: the closed-form image that the image stream corrects.
        derived_light: whether the network is told which of s and d were derived from a light, without shadows.
    """

    codec: Codec
    packing: Packing
    physics_prior: Prior | None
    derived_light: bool = False

    @classmethod
    def of(cls, config: dict, codec: Codec) -> "Conditioning":
        """The conditioning that a model's config describes.

        Raises:
            UnirenderError: an unknown physics prior, or other maps with a tone curve.
        """
        if set(config["hdr_curves"] or HDR_CURVES) != set(HDR_CURVES):
            got = ", ".join(config["hdr_curves"])
            raise UnirenderError(f"hdr_curves: got {got}, expected one of each of: {', '.join(HDR_CURVES)}")
        curves = {name: HdrCurve(*value) for name, value in (config["hdr_curves"] or HDR_CURVES).items()}
        packing = Packing(curves, tuple(config["environment_size"]))
        name = config["physics_prior"]
        if name != "none" and name not in PRIORS:
            raise UnirenderError(f"physics_prior: got {name!r}, expected 'none' or one of: {', '.join(PRIORS)}")
        return cls(codec, packing, PRIORS.get(name), config["derived_light"])

    @property
    def attribute_channels(self) -> int:
        return len(TRIPLETS) * self.codec.channels

    @property
    def extra_channels(self) -> tuple[int, int]:
        """Extra channels of the attribute and of the image stream."""
        common = len(TRIPLETS) + self.codec.factor**2 + 2
        return common, common + (self.codec.channels + 1 if self.physics_prior else 0)

    def check_channels(self, config: dict) -> None:
        """Looks whether a network's channels are those of what it is shown.

        Raises:
            UnirenderError: others.
        """
        names = ("attribute_channels", "image_channels", "attribute_extra_channels", "image_extra_channels")
        shown = (self.attribute_channels, self.codec.channels, *self.extra_channels)
        for name, expected in zip(names, shown, strict=True):
            if config[name] != expected:
                raise UnirenderError(
                    f"{name}: got {config[name]}, expected {expected} with this codec, patch and physics_prior; change "
                    "the network's configuration"
                )

    def encode_attributes(self, maps: Maps) -> Float[Tensor, "b nc h w"]:
        """Maps -> latents of the attribute stream."""
        pictures = self.packing.pack(maps)
        latents = self.codec.encode(pictures.reshape(-1, 3, *pictures.shape[-2:]))
        return latents.reshape(len(pictures), -1, *latents.shape[-2:])

    def decode_attributes(self, latents: Float[Tensor, "b nc h w"]) -> Maps:
        """Latents of the attribute stream -> maps."""
        pictures = self.codec.decode(latents.reshape(-1, self.codec.channels, *latents.shape[-2:]))
        return self.packing.unpack(pictures.reshape(len(latents), -1, *pictures.shape[-2:]))

    def decode_given(self, latents: Float[Tensor, "b nc h w"]) -> Maps | None:
        """Of the maps that `extras` makes something of, those in clean latents; None: it needs none.

        No more than that: an autoencoder decodes slowly.
        """
        return self.decode_attributes(latents) if self.physics_prior else None

    def encode_image(self, image_linear: Float[Tensor, "b 3 H W"]) -> Float[Tensor, "b c h w"]:
        """Premultiplied linear image -> latents of the image stream."""
        return self.codec.encode(pack_image(image_linear))

    def decode_image(self, latents: Float[Tensor, "b c h w"]) -> Float[Tensor, "b 3 H W"]:
        """Latents of the image stream -> premultiplied linear image in [0, 1]."""
        return unpack_image(self.codec.decode(latents))

    def by_triplet(self, flags: Bool[Tensor, "b 6"]) -> Bool[Tensor, "b nc 1 1"]:
        """Flags of the six pictures -> flags of their latent channels."""
        return flags.repeat_interleave(self.codec.channels, dim=1)[..., None, None]

    def extras(
        self,
        mask: Float[Tensor, "b 1 H W"],
        given: Bool[Tensor, "b 6"],
        maps: Maps | None = None,
        camera: Camera | None = None,
        derived: Bool[Tensor, "b 6"] | None = None,
    ) -> Extras:
        """Builds the extra inputs.

        Args:
            mask: coverage; always known.
            given: which of the six pictures are given clean as a condition (none in inverse rendering).
            maps: the given maps, from which the physics prior is made where `given` has all that it needs.
            camera: gives the rays; the contract's default if None.
            derived: which of the given pictures were derived from a light, without shadows: their flag is 1/2, if the
                network is told. None: none was.
        """
        spatial = F.pixel_unshuffle(mask, self.codec.factor)
        b, _, h, w = spatial.shape
        camera = camera or Camera()
        rays = torch.from_numpy(camera.rays(h, w)[..., :2].copy()).to(mask) * RAY_SCALE
        flags = given.to(mask)
        if derived is not None and self.derived_light:
            flags = torch.where(derived, DERIVED_FLAG * flags, flags)
        flags = flags[..., None, None].expand(-1, -1, h, w)
        common = torch.cat([flags, spatial, rays.permute(2, 0, 1).expand(b, -1, -1, -1)], dim=1)
        if not self.physics_prior:
            return Extras(common, common, None)
        known = given[:, [TRIPLETS.index(name) for name in self.physics_prior.triplets]].all(dim=1)
        prior = self._prior(self.physics_prior, known, maps, mask, camera)
        flag = known.to(mask)[:, None, None, None].expand(-1, -1, h, w)
        return Extras(common, torch.cat([common, prior, flag], dim=1), prior)

    def _prior(
        self, prior: Prior, known: Bool[Tensor, " b"], maps: Maps | None, mask: Float[Tensor, "b 1 H W"], camera: Camera
    ) -> Float[Tensor, "b c h w"]:
        """Latents of the closed-form image in the rows that are known, made for those alone; zeros in the others."""
        factor = self.codec.factor
        latents = mask.new_zeros(len(mask), self.codec.channels, mask.shape[-2] // factor, mask.shape[-1] // factor)
        rows = known.nonzero()[:, 0]
        if not len(rows):
            return latents
        if maps is None:
            raise ValueError("extras: the flags say that the maps of the prior are given, but maps is None")
        of_rows = {name: value[rows] for name, value in maps.items()}
        encoded = self.codec.encode(prior_picture(prior, of_rows, mask[rows], camera))
        return latents.index_copy(0, rows, encoded.to(latents))
