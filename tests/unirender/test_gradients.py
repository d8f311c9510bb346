"""A renderer of one's own fits: gradients flow through the network to the maps and to the light."""

import torch
from tiny_models import make_batch, make_model

from unirender.diffusion.inference import infer_attributes, infer_image
from unirender.diffusion.schedule import make_scheduler

STEP = 1e-2


def test_the_gradient_of_a_rendering_is_that_of_finite_differences() -> None:
    model, conditioning = make_model()
    batch = make_batch(1)
    for name in ("albedo", "diffuse", "environment"):
        direction = torch.rand(batch[name].shape, generator=torch.Generator().manual_seed(1))

        def brightness(shift: torch.Tensor, name: str = name, direction: torch.Tensor = direction) -> torch.Tensor:
            maps = batch | {name: batch[name] + shift * direction}
            seed = torch.Generator().manual_seed(0)
            given = torch.ones(1, 6, dtype=torch.bool)
            image = infer_image(model, conditioning, make_scheduler(), maps, given, generator=seed, steps=2)
            return (image * batch["mask"]).sum()

        shift = torch.zeros((), requires_grad=True)
        (slope,) = torch.autograd.grad(brightness(shift), shift)
        with torch.no_grad():
            apart = brightness(torch.tensor(STEP)) - brightness(torch.tensor(-STEP))
        assert abs(float(slope)) > 0.1, name
        torch.testing.assert_close(slope, apart / (2 * STEP), rtol=0.03, atol=0)


def test_a_decomposition_has_a_gradient_to_the_picture_and_to_the_weights() -> None:
    model, conditioning = make_model()
    batch = make_batch(1)
    picture = batch["image"].requires_grad_()
    maps = infer_attributes(model, conditioning, make_scheduler(), picture, batch["mask"])
    maps["albedo"].mean().backward()
    assert picture.grad is not None
    assert picture.grad.abs().max() > 0
    assert model.attribute_unet.conv_out.weight.grad is not None
