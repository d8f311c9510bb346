"""Objects moved in the frame: what a quarter turn, a shift by whole pixels and a zoom must give."""

import math

import numpy as np
import pytest
import torch
from synthetic_shards import own_picture
from torch import Tensor

from unirender.errors import UnirenderError
from unirender.light.environment import mean_radiance, rotate_environment
from unirender.light.resampling import resample_environment
from unirender.light.surface_light import diffuse_light
from unirender.light.symmetries import quarter_turn
from unirender.training.augmentations.augment import to_maps
from unirender.training.augmentations.moving import Move, moved, rolled_environment

STILL = Move(0.0, 1.0, (0.0, 0.0))
SIZE = 32


@pytest.fixture(scope="module")
def maps() -> dict[str, np.ndarray]:
    image, intrinsics = own_picture(3, SIZE)
    light = np.broadcast_to(np.linspace(2, 0.2, 16, dtype=np.float32)[:, None, None], (16, 32, 3))  # from above
    d = diffuse_light(intrinsics.require("normal")["normal"], light)
    return to_maps(image[..., :3], intrinsics) | {"environment": light, "diffuse": d}


def batch(maps: dict[str, np.ndarray], count: int = 1) -> dict[str, Tensor]:
    stacked = {
        name: np.moveaxis(value, -1, 0).astype(np.float32)[None].repeat(count, 0) for name, value in maps.items()
    }
    return {name: torch.from_numpy(np.ascontiguousarray(value)) for name, value in stacked.items()}


def test_who_stays_is_untouched_and_a_move_of_nothing_changes_nothing(maps: dict[str, np.ndarray]) -> None:
    before = batch(maps, 3)
    after = moved(before, [None, STILL, Move(0.3, 1.1, (0.02, 0.0))])
    for name, value in after.items():
        assert torch.equal(value[0], before[name][0]), name
        atol = 1e-4 if name in ("normal", "environment") else 1e-5
        torch.testing.assert_close(value[1], before[name][1], rtol=1e-4, atol=atol)
        assert not torch.allclose(value[2], before[name][2], atol=1e-2) or name in ("roughness", "metallic"), name
    assert moved(before, [None] * 3) is before


@pytest.mark.parametrize("turns", [1, 2, 3])
def test_a_roll_by_quarters_is_the_quarter_turn(maps: dict[str, np.ndarray], turns: int) -> None:
    rolled = moved(batch(maps), [Move(turns * math.pi / 2, 1.0, (0.0, 0.0))])
    expected = batch(quarter_turn(maps, turns))
    for name, value in expected.items():
        atol = 0.15 if name == "environment" else 1e-3  # texels by the poles are spread over their neighbours
        torch.testing.assert_close(
            rolled[name], value, rtol=1e-3, atol=atol, msg=lambda text, name=name: f"{name}: {text}"
        )
    wrong = batch(quarter_turn(maps, turns + 1))
    assert (rolled["albedo"] - wrong["albedo"]).abs().max() > 0.05  # the twin


def test_a_shift_by_whole_pixels_moves_pixels(maps: dict[str, np.ndarray]) -> None:
    before = batch(maps)
    after = moved(before, [Move(0.0, 1.0, (2 / SIZE, -3 / SIZE))])  # two to the right, three up
    for name in ("image", "albedo", "mask", "specular", "normal"):
        torch.testing.assert_close(
            after[name][..., 3:-3, 2:], before[name].roll((-3, 2), (2, 3))[..., 3:-3, 2:], rtol=1e-4, atol=1e-4
        )
    torch.testing.assert_close(after["environment"], before["environment"], rtol=0, atol=1e-4)


def test_a_zoom_enlarges_about_the_middle(maps: dict[str, np.ndarray]) -> None:
    before = batch(maps)
    larger, smaller = (moved(before, [Move(0.0, zoom, (0.0, 0.0))])["mask"].sum() for zoom in (1.15, 1 / 1.15))
    own = before["mask"].sum()
    assert larger / own == pytest.approx(1.15**2, rel=0.06)
    assert smaller / own == pytest.approx(1 / 1.15**2, rel=0.06)


def test_the_shift_is_of_the_frame_whatever_the_roll_and_the_zoom(maps: dict[str, np.ndarray]) -> None:
    """Rolled and nearer first, then moved by whole pixels: two to the right, three up."""
    roll, zoom = 0.5, 1.1
    stays, goes = (moved(batch(maps), [Move(roll, zoom, by)]) for by in ((0.0, 0.0), (2 / SIZE, -3 / SIZE)))
    for name in ("image", "albedo", "mask", "normal"):
        there = stays[name].roll((-3, 2), (2, 3))
        torch.testing.assert_close(goes[name][..., 3:-3, 2:], there[..., 3:-3, 2:], rtol=1e-4, atol=1e-4)


def test_the_light_turns_with_the_object(maps: dict[str, np.ndarray]) -> None:
    """d of the rolled object is what its rolled normals receive from the rolled light, and not from the old one."""
    after = moved(batch(maps), [Move(0.6, 1.0, (0.0, 0.0))])
    normal, light, d, mask = (
        after[n][0].permute(1, 2, 0).numpy() for n in ("normal", "environment", "diffuse", "mask")
    )
    whole = mask[..., 0] == 1
    error, unturned = (
        np.abs(diffuse_light(normal, np.ascontiguousarray(lit)) - d)[whole].mean()
        for lit in (light, maps["environment"])
    )
    assert error < 0.02
    assert unturned > 2 * error


def rolled(light: np.ndarray, angle: float) -> np.ndarray:
    made = rolled_environment(torch.from_numpy(np.ascontiguousarray(light)).permute(2, 0, 1)[None], [angle])
    return made[0].permute(1, 2, 0).numpy()


@pytest.mark.parametrize("angle", [-0.4, 0.25, math.pi / 2])
def test_lights_turn_as_the_reference_turns_them(angle: float) -> None:
    smooth = np.random.default_rng(0).uniform(0, 2, (5, 8, 3)).astype(np.float32)
    smooth[0], smooth[-1] = smooth[0].mean(axis=0), smooth[-1].mean(axis=0)  # one radiance at a pole
    fine = resample_environment(smooth, (61, 120))
    light, (cosine, sine) = resample_environment(fine, (16, 32)), (math.cos(angle), math.sin(angle))
    rotation = np.array([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1]], np.float32)
    expected = resample_environment(rotate_environment(fine, rotation), (16, 32))
    off, unturned = (np.abs(one - expected)[1:-1] for one in (rolled(light, angle), light))
    assert off.mean() < 0.025
    assert off.max() < 0.25
    assert unturned.mean() > 3 * 0.025  # the twin


@pytest.mark.parametrize("row", [0, 1, 2, 7, 15])
def test_a_roll_keeps_the_energy_of_a_light_in_one_texel(row: int) -> None:
    """Sampled at the texels' directions, one by a pole lost all of it or became four times as bright."""
    for column, angle in ((0, 0.3), (9, -0.43), (22, 0.01)):
        light = np.zeros((16, 32, 3), np.float32)
        light[row, column] = 100
        np.testing.assert_allclose(mean_radiance(rolled(light, angle)), mean_radiance(light), rtol=1e-5)
    even = rolled(np.ones((16, 32, 3), np.float32), 0.3)
    np.testing.assert_allclose(even, 1, atol=0.05)
    assert np.abs(even[2:-2] - 1).max() < 0.01


def test_frames_that_are_not_square_are_refused(maps: dict[str, np.ndarray]) -> None:
    wide = {name: value[..., :-4, :] for name, value in batch(maps).items() if name != "environment"}
    with pytest.raises(UnirenderError, match="expected square ones"):
        moved(wide, [STILL])
