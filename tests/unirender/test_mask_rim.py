"""The rim of a mask: a background that is mixed into it is found and taken away, straight colours stay."""

from pathlib import Path

import numpy as np
import pytest
from jaxtyping import Float
from PIL import Image
from tiny_models import make_pipeline

from unirender.color import image_srgb, srgb_decode
from unirender.command_line.input_picture import read_input
from unirender.picture_files.mask_rim import (
    BACKGROUND,
    MIXED,
    mixture_explains,
    outline_is_background,
    without_background,
)

SIDE = 48


def disc() -> Float[np.ndarray, "h w 1"]:
    """Coverage of a disc, a pixel wide at its rim."""
    rows, columns = np.mgrid[:SIDE, :SIDE] + 0.5 - SIDE / 2
    return np.clip(16.3 - np.hypot(rows, columns), 0, 1)[..., None].astype(np.float32)


def ball() -> Float[np.ndarray, "h w 3"]:
    """Straight display values that change over the picture."""
    rows, columns = np.mgrid[:SIDE, :SIDE] / SIDE
    return np.stack([0.3 + 0.4 * columns, 0.5 - 0.2 * rows, 0.2 + 0 * rows], axis=-1).astype(np.float32)


def over(background: float, linear: bool) -> Float[np.ndarray, "h w 3"]:
    """The ball with a background behind it, mixed in display values or in linear light."""
    mask, straight = disc(), ball()
    if not linear:
        return mask * straight + (1 - mask) * np.float32(background)
    return image_srgb(mask * srgb_decode(straight) + (1 - mask) * srgb_decode(np.full_like(straight, background)))


@pytest.mark.parametrize("linear", [False, True])
@pytest.mark.parametrize("background", [1.0, 0.75])
def test_a_background_is_found_and_taken_away(background: float, linear: bool) -> None:
    picture, mask, straight = over(background, linear), disc(), ball()
    assert mixture_explains(picture, mask) > MIXED
    cleaned = without_background(picture, mask)
    rim = (mask[..., 0] > 0.01) & (mask[..., 0] < 0.95)
    assert np.abs(picture - straight)[rim].max() > 0.3
    np.testing.assert_allclose(cleaned[rim], straight[rim], rtol=0, atol=0.05)
    np.testing.assert_array_equal(cleaned[~rim], picture[~rim])
    assert mixture_explains(cleaned, mask) <= 0


@pytest.mark.parametrize("beside", [0.0, 0.2, 0.5, 1.0])
@pytest.mark.parametrize("darkens", ["nowhere", "outwards", "at its outline"])
def test_straight_colours_are_no_mixture(darkens: str, beside: float) -> None:
    """A lamp at the camera leaves the rim of a ball as dark as a mixture with black would."""
    mask, colours = disc(), ball()
    rows, columns = np.mgrid[:SIDE, :SIDE] + 0.5 - SIDE / 2
    r = np.hypot(rows, columns)[..., None] / 16.8
    if darkens == "outwards":
        colours = image_srgb(srgb_decode(colours) * np.clip(1 - r**2, 0, 1).astype(np.float32))
    elif darkens == "at its outline":
        colours = np.where(r > 15.8 / 16.8, np.float32(0), colours)
    assert mixture_explains(np.where(mask > 0, colours, np.float32(beside)), mask) < MIXED - 0.1


def test_nothing_is_told_without_a_rim_or_of_a_background_of_the_same_colour() -> None:
    mask = disc()
    assert mixture_explains(over(1.0, False), (mask > 0.5).astype(np.float32)) == 0
    assert mixture_explains(np.full((SIDE, SIDE, 3), 0.5, np.float32), mask) == 0


def test_a_soft_matte_stays_as_it_is() -> None:
    mask = np.full((SIDE, SIDE, 1), 0.5, np.float32)
    mask[:, :8] = 1
    picture = over(1.0, False)
    cleaned = without_background(picture, mask)
    np.testing.assert_array_equal(cleaned[:, 10:], picture[:, 10:])
    np.testing.assert_array_equal(cleaned[:, 9], picture[:, 7])


def test_the_nearest_pixel_of_the_object_may_be_the_pictures_last() -> None:
    mask, image = np.zeros((8, 8, 1), np.float32), np.full((8, 8, 3), 0.9, np.float32)
    mask[-2], mask[-1], image[-1] = 0.5, 1, 0.2
    for turns in range(4):  # the last row, the last column, and the first of both
        turned = without_background(np.rot90(image, turns).copy(), np.rot90(mask, turns).copy())
        assert (np.rot90(turned, -turns)[-2:] == np.float32(0.2)).all()


def hard(radius: float) -> Float[np.ndarray, "h w 1"]:
    """All 0 or 1."""
    rows, columns = np.mgrid[:SIDE, :SIDE] + 0.5 - SIDE / 2
    return (np.hypot(rows, columns) < radius)[..., None].astype(np.float32)


@pytest.mark.parametrize("linear", [False, True])
@pytest.mark.parametrize("background", [0.0, 0.75, 1.0])
def test_a_mask_that_is_too_large_is_told_from_one_that_fits(background: float, linear: bool) -> None:
    picture = over(background, linear)  # of a disc of radius 15.8
    for larger in (17.0, 18.0):
        assert outline_is_background(picture, hard(larger)) > BACKGROUND
    for fits in (disc(), hard(15.8), hard(15.0), hard(14.0)):
        assert outline_is_background(picture, fits) < BACKGROUND - 0.2


def test_nothing_is_told_of_an_outline_where_object_and_background_are_alike_or_out_of_the_frame() -> None:
    assert outline_is_background(np.full((SIDE, SIDE, 3), 0.5, np.float32), hard(17.0)) == 0
    assert outline_is_background(over(1.0, False), np.ones((SIDE, SIDE, 1), np.float32)) == 0
    assert outline_is_background(over(1.0, False), hard(2.0)) == 0


def test_a_command_says_that_the_mask_is_too_large(tmp_path: Path) -> None:
    rgb = (255 * over(0.9, False) + 0.5).astype(np.uint8)
    Image.fromarray(rgb).save(tmp_path / "a.png")
    alpha = (255 * hard(17.0) + 0.5).astype(np.uint8)
    Image.fromarray(np.concatenate([rgb, alpha], axis=-1)).save(tmp_path / "rgba.png")
    for name, radius in {"large": 17.0, "fits": 15.8}.items():
        Image.fromarray((255 * hard(radius)[..., 0]).astype(np.uint8)).save(tmp_path / f"{name}.png")
    _, remarks = read_input(tmp_path / "a.png", tmp_path / "large.png")
    assert remarks.keys() == {"outline"}
    assert remarks["outline"].startswith("the outline of the mask shows the background")
    assert not read_input(tmp_path / "a.png", tmp_path / "fits.png")[1]
    assert not read_input(tmp_path / "rgba.png", tmp_path / "large.png")[1]  # whose colours are straight


def test_a_command_takes_the_background_out_of_the_rim_and_says_so(tmp_path: Path) -> None:
    mask, straight = disc(), ball()
    for name, values in {
        "a": over(1.0, True),
        "m": mask.repeat(3, axis=-1),
        "s": np.where(mask > 0, straight, 0),
    }.items():
        Image.fromarray((255 * values + 0.5).astype(np.uint8)).save(tmp_path / f"{name}.png")
    rim = (mask[..., 0] > 0.02) & (mask[..., 0] < 0.94)
    picture, remarks = read_input(tmp_path / "a.png", tmp_path / "m.png")
    assert "background is mixed into the rim" in remarks["rim"]
    np.testing.assert_allclose(picture.image_srgb[rim], straight[rim], rtol=0, atol=0.05)
    picture, remarks = read_input(tmp_path / "s.png", tmp_path / "m.png")
    assert "rim" not in remarks
    np.testing.assert_allclose(picture.image_srgb[rim], straight[rim], rtol=0, atol=0.003)


def test_colours_beside_an_alpha_channel_are_straight(tmp_path: Path) -> None:
    rgba = np.concatenate([over(1.0, False), disc()], axis=-1)
    Image.fromarray((255 * rgba + 0.5).astype(np.uint8)).save(tmp_path / "a.png")
    Image.fromarray((255 * disc()[..., 0] + 0.5).astype(np.uint8)).save(tmp_path / "m.png")
    for given in (None, tmp_path / "m.png"):
        picture, remarks = read_input(tmp_path / "a.png", given)
        assert "rim" not in remarks
        np.testing.assert_allclose(picture.image_srgb, rgba[..., :3], rtol=0, atol=0.003)


def test_the_pipeline_tells_of_it(caplog: pytest.LogCaptureFixture) -> None:
    pipeline = make_pipeline()
    pipeline.decompose(np.where(disc() > 0, ball(), 0), disc(), closed=False)
    assert "rim of the mask" not in caplog.text
    pipeline.decompose(over(1.0, False), disc(), closed=False)
    assert "a background is mixed into the rim of the mask" in caplog.text
