"""Both directions of a trained network: p(attributes | image) and p(image | attributes).

    (t_attributes, t_image) = (0, t~) when rendering, (t~, 0) when inverse             (Eq. 3)

The stream that is given is clean (its timestep is 0) and is encoded once; the other one is sampled from T downwards
(`unirender.diffusion.sampling`), in one step or in many: t~ is the timestep of the step. Gradients flow through both,
to what is given and to the weights; who needs none calls under `torch.no_grad()`.
"""

from collections.abc import Sequence
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from unirender.camera import Camera
from unirender.diffusion.sampling import Generators, Progress, StepEnd, denoise, draw_noise
from unirender.models.conditioning import Conditioning, Extras
from unirender.models.dual_stream import DualStreamModel, Encoded
from unirender.models.packing import TRIPLETS, Maps

Cameras = Camera | Sequence[Camera] | None


def infer_attributes(
    model: DualStreamModel,
    conditioning: Conditioning,
    scheduler: Any,
    image_linear: Float[Tensor, "b 3 H W"],
    mask: Float[Tensor, "b 1 H W"],
    *,
    steps: int = 1,
    generator: Generators = None,
    camera: Cameras = None,
    progress: Progress = iter,
    step_end: StepEnd | None = None,
) -> Maps:
    """Inverse rendering: p(attributes | image), with (t_attributes, t_image) = (t~, 0).

    Args:
        model: the two streams.
        conditioning: maps <-> latents, the model's own.
        scheduler: of diffusers, as for `denoise`.
        image_linear: premultiplied, linear; clipped to [0, 1] as a camera does.
        mask: coverage.
        steps: of the scheduler.
        generator: of the noise; see `draw_noise`.
        camera: of all rows, or one for each.
        progress: wraps the iteration over timesteps.
        step_end: as for `denoise`.

    Returns:
        Maps as `Packing.unpack` gives them: float32, in physical units.
    """
    image = conditioning.encode_image(image_linear).to(model.dtype)
    given = torch.zeros(len(image), len(TRIPLETS), dtype=torch.bool, device=image.device)
    extras = extras_by_camera(conditioning, mask, given, None, camera).to(image)
    zero = torch.zeros(len(image), dtype=torch.long, device=image.device)
    condition: Tensor | Encoded = image

    def predict(x_t: Tensor, t: Tensor) -> Tensor:
        nonlocal condition
        output = model(
            attributes=x_t.to(image),
            image=condition,
            attributes_timestep=t,
            image_timestep=zero,
            attribute_extra=extras.attributes,
            image_extra=extras.image,
            image_rows=None,
        )
        condition = output.encoded_image  # the same at every step
        return output.attributes.to(x_t)

    noise = draw_noise((len(image), conditioning.attribute_channels, *image.shape[-2:]), image_linear, generator)
    return conditioning.decode_attributes(denoise(predict, noise, scheduler, steps, progress, step_end).float())


def infer_image(
    model: DualStreamModel,
    conditioning: Conditioning,
    scheduler: Any,
    maps: Maps,
    given: Bool[Tensor, "b 6"],
    *,
    steps: int = 1,
    generator: Generators = None,
    camera: Cameras = None,
    progress: Progress = iter,
    derived: Bool[Tensor, "b 6"] | None = None,
    step_end: StepEnd | None = None,
) -> Float[Tensor, "b 3 H W"]:
    """Rendering: p(image | attributes), with (t_attributes, t_image) = (0, t~).

    Args:
        model: the two streams.
        conditioning: maps <-> latents, the model's own.
        scheduler: of diffusers, as for `denoise`.
        maps: all maps; those not `given` may hold anything and are replaced by noise.
        given: which of the six pictures are known; the mask in `maps` always is.
        steps: of the scheduler.
        generator: of the noise; see `draw_noise`.
        camera: of all rows, or one for each.
        progress: wraps the iteration over timesteps.
        derived: which of them were derived from a light, without shadows; None: none.
        step_end: as for `denoise`.

    Returns:
        Premultiplied linear image in [0, 1].
    """
    latents = conditioning.encode_attributes(maps)
    # Both noises of a row at once: neither depends on how many rows follow.
    channels = (latents.shape[1], conditioning.codec.channels)
    noise = draw_noise((len(latents), sum(channels), *latents.shape[-2:]), latents, generator)
    unknown, x_T = noise.split(channels, dim=1)
    shown = conditioning.by_triplet(given)
    attributes = torch.where(shown, latents, unknown).to(model.dtype)
    extras = extras_by_camera(conditioning, maps["mask"], given, maps, camera, derived).to(attributes)
    zero = torch.zeros(len(attributes), dtype=torch.long, device=attributes.device)
    condition: Tensor | Encoded = attributes

    def predict(x_t: Tensor, t: Tensor) -> Tensor:
        nonlocal condition
        output = model(
            attributes=condition,
            image=x_t.to(attributes),
            attributes_timestep=zero,
            image_timestep=t,
            attribute_extra=extras.attributes,
            image_extra=extras.image,
            image_prior=extras.prior,
            attribute_rows=None,
        )
        condition = output.encoded_attributes  # the same at every step
        return output.image.to(x_t)

    return conditioning.decode_image(denoise(predict, x_T, scheduler, steps, progress, step_end).float())


def extras_by_camera(
    conditioning: Conditioning,
    mask: Float[Tensor, "b 1 H W"],
    given: Bool[Tensor, "b 6"],
    maps: Maps | None,
    camera: Cameras,
    derived: Bool[Tensor, "b 6"] | None = None,
) -> Extras:
    """The extra inputs of rows that are seen through one camera, or each through its own.

    Raises:
        ValueError: another number of cameras than rows.
    """
    if camera is None or isinstance(camera, Camera):
        return conditioning.extras(mask, given, maps, camera, derived)
    if len(camera) != len(mask):
        raise ValueError(f"{len(camera)} cameras for {len(mask)} rows, expected one each")
    if len(set(camera)) == 1:
        return conditioning.extras(mask, given, maps, camera[0], derived)
    rows = [
        conditioning.extras(
            mask[i : i + 1],
            given[i : i + 1],
            None if maps is None else {name: value[i : i + 1] for name, value in maps.items()},
            own,
            None if derived is None else derived[i : i + 1],
        )
        for i, own in enumerate(camera)
    ]
    priors = [row.prior for row in rows if row.prior is not None]
    return Extras(
        torch.cat([row.attributes for row in rows]),
        torch.cat([row.image for row in rows]),
        torch.cat(priors) if priors else None,
    )
