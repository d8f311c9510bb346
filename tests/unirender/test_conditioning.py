"""Maps to channels and back; the extra inputs; the torch twins of `unirender.color`."""

import numpy as np
import pytest
import torch
from tiny_models import make_batch, make_model

from unirender import color
from unirender.camera import Camera
from unirender.composite import composite
from unirender.errors import UnirenderError
from unirender.intrinsics import Intrinsics
from unirender.models import conditioning as c
from unirender.models import packing
from unirender.models.priors import PRIORS


@pytest.fixture(scope="module")
def cond() -> c.Conditioning:
    return make_model()[1]


def test_round_trip_of_all_maps(cond: c.Conditioning) -> None:
    batch = make_batch()
    back = cond.decode_attributes(cond.encode_attributes(batch))
    for name, value in back.items():
        torch.testing.assert_close(value, batch[name], rtol=1e-4, atol=1e-5, msg=name)
    torch.testing.assert_close(
        cond.decode_image(cond.encode_image(batch["image"])), batch["image"].clamp(0, 1), rtol=1e-4, atol=1e-5
    )


def test_round_trip_twin_fails_with_another_curve(cond: c.Conditioning) -> None:
    batch = make_batch()
    other = packing.Packing(cond.packing.curves | {"specular": color.HdrCurve(9.0, 20.0)})
    back = other.unpack(cond.packing.pack(batch))
    assert (back["specular"] - batch["specular"]).abs().max() > 1e-2


def test_layout_is_six_pictures_in_order(cond: c.Conditioning) -> None:
    batch = make_batch(1)
    pictures = cond.packing.pack(batch)[0]
    assert torch.equal(pictures[0], 2 * batch["metallic"][0, 0] - 1)
    assert torch.equal(pictures[2], 2 * batch["mask"][0, 0] - 1)
    assert torch.equal(pictures[6:9], batch["normal"][0])
    latents = cond.encode_attributes(batch)
    n = cond.codec.channels
    assert torch.equal(latents[:, 2 * n : 3 * n], cond.codec.encode(batch["normal"]))


@pytest.mark.parametrize("size", [(32, 32), (64, 64), (64, 96)])
def test_light_spreads_and_gathers_back(cond: c.Conditioning, size: tuple[int, int]) -> None:
    light = torch.randn(2, 3, 16, 32)
    torch.testing.assert_close(cond.packing.gather(cond.packing.spread(light, size)), light, rtol=0, atol=1e-6)


def test_light_on_a_grid_that_does_not_fit(cond: c.Conditioning) -> None:
    with pytest.raises(UnirenderError, match="multiples of"):
        cond.packing.spread(torch.zeros(1, 3, 16, 32), (48, 48))
    with pytest.raises(UnirenderError, match="resample it first"):
        cond.packing.spread(torch.zeros(1, 3, 8, 16), (64, 64))


def test_twins_agree_with_the_numpy_functions() -> None:
    x = np.linspace(0, 4, 1001).astype(np.float32)
    y = np.linspace(0, 1.2, 1001).astype(np.float32)
    curve = color.HdrCurve(10.0, 20.0)
    pairs = [
        (packing.srgb_encode(torch.from_numpy(x)), color.srgb_encode(x)),
        (packing.srgb_decode(torch.from_numpy(y)), color.srgb_decode(y)),
        (packing.curve_encode(curve, torch.from_numpy(x)), curve.encode(x)),
        (packing.curve_decode(curve, torch.from_numpy(y)), curve.decode(y)),
    ]
    for torch_value, numpy_value in pairs:
        np.testing.assert_allclose(torch_value.numpy(), numpy_value, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("name", sorted(PRIORS))
def test_gradients_are_finite_at_black_and_beyond_the_range(cond: c.Conditioning, name: str) -> None:
    pictures = torch.linspace(-1.5, 1.5, 18 * 32 * 32).reshape(1, 18, 32, 32).requires_grad_()
    maps = cond.packing.unpack(pictures)
    c.prior_picture(PRIORS[name], maps, torch.ones(1, 1, 32, 32), Camera()).sum().backward()
    assert pictures.grad is not None
    assert torch.isfinite(pictures.grad).all()
    assert pictures.grad.abs().max() > 0


def test_hdr_values_above_the_range_are_not_clipped(cond: c.Conditioning) -> None:
    batch = make_batch(1)
    batch["specular"] = batch["specular"] * 100
    assert cond.packing.curves["specular"].overflow(batch["specular"].numpy()) > 0
    back = cond.packing.unpack(cond.packing.pack(batch))["specular"]
    torch.testing.assert_close(back, batch["specular"], rtol=1e-3, atol=1e-4)


def test_stray_predictions_become_maps_of_their_ranges(cond: c.Conditioning) -> None:
    """However far from [-1, 1]: no radiance is negative, or above that of twice the curve's value at x_max."""
    maps = cond.packing.unpack(20 * torch.randn(1, 18, 32, 32, generator=torch.Generator().manual_seed(0)))
    for name in ("albedo", "roughness", "metallic", "mask"):
        assert (float(maps[name].min()), float(maps[name].max())) == (0, pytest.approx(1)), name
    for name, curve in cond.packing.curves.items():
        most = ((1 + curve.k * curve.x_max) ** 2 - 1) / curve.k
        assert (float(maps[name].min()), float(maps[name].max())) == (0, pytest.approx(most, rel=1e-3)), name


def test_extras_hold_flags_mask_rays_and_prior() -> None:
    _, cond = make_model(physics_prior="composite")
    batch = make_batch(2)
    given = torch.tensor([[True] * 6, [True, True, True, False, True, True]])
    extras = cond.extras(batch["mask"], given, batch)
    assert (extras.attributes.shape[1], extras.image.shape[1]) == cond.extra_channels
    assert torch.equal(extras.attributes[:, :6, 0, 0], given.float())
    expected = cond.codec.encode(
        2
        * packing.srgb_encode(
            (composite(*(batch[k] for k in ("albedo", "metallic", "diffuse", "specular"))) * batch["mask"]).clamp(0, 1)
        )
        - 1
    )
    assert extras.prior is not None
    torch.testing.assert_close(extras.prior[0], expected[0])
    assert not extras.prior[1].any()  # s is not given: no composite
    assert torch.equal(extras.image[:, -1, 0, 0], torch.tensor([1.0, 0.0]))


def test_rays_turn_with_the_camera(cond: c.Conditioning) -> None:
    mask, given = torch.ones(1, 1, 32, 32), torch.zeros(1, 6, dtype=torch.bool)
    wide = cond.extras(mask, given, camera=Camera(fov_deg=90.0)).attributes[0, -2:]
    narrow = cond.extras(mask, given).attributes[0, -2:]
    assert wide[0, 0, -1] > narrow[0, 0, -1] > 0 > narrow[1, -1, 0] > wide[1, -1, 0]


def test_plain_model_has_no_prior() -> None:
    _, plain = make_model(physics_prior="none")
    batch = make_batch(1)
    extras = plain.extras(batch["mask"], torch.ones(1, 6, dtype=torch.bool), batch)
    assert extras.prior is None
    assert extras.image.shape == extras.attributes.shape


@pytest.mark.parametrize("name", sorted(PRIORS))
def test_priors_agree_with_their_numpy_originals(name: str) -> None:
    camera = Camera(fov_deg=50.0)
    batch = make_batch(1)
    batch["normal"] = torch.nn.functional.normalize(torch.randn(1, 3, 32, 32), dim=1)  # also facing away
    maps = {key: value[0].permute(1, 2, 0).numpy() for key, value in batch.items() if key != "image"}
    expected = PRIORS[name].image(Intrinsics(camera=camera, **maps))
    found = PRIORS[name].radiance(batch, camera) * batch["mask"]
    np.testing.assert_allclose(found[0].permute(1, 2, 0).numpy(), expected, rtol=1e-4, atol=1e-5)


def test_an_unknown_prior_is_refused(cond: c.Conditioning) -> None:
    config = {"hdr_curves": None, "environment_size": (16, 32), "physics_prior": "phong"}
    with pytest.raises(UnirenderError, match="physics_prior: got 'phong'"):
        c.Conditioning.of(config, cond.codec)
