"""Denoising: closer to a converged render than what goes in; its guides, its mark, its errors."""

import importlib.util
import sys
from types import SimpleNamespace

import numpy as np
import pytest
from reference_scenes import environment

from unirender.color import image_srgb, unpremultiply
from unirender.errors import UnirenderError
from unirender_reference import denoise
from unirender_reference.render import Renderer
from unirender_reference.shapes import make_object

needs_oidn = pytest.mark.skipif(
    importlib.util.find_spec("mitsuba_oidn") is None, reason="mitsuba-oidn is not installed (extra `denoise`)"
)


def decibels(a: np.ndarray, b: np.ndarray, mask: np.ndarray) -> float:
    error = np.square(image_srgb(a) - image_srgb(b))
    return float(-10 * np.log10((mask * error).sum() / (3 * mask.sum())))


@needs_oidn
@pytest.mark.parametrize("kind", ["image", "diffuse"])
def test_a_denoised_render_is_closer_to_the_converged_one(kind: str) -> None:
    """By 3 dB at least at 8 samples per pixel; the twin, guided by maps turned upside down, is worse."""
    renderer, light = Renderer(make_object(1001, "train"), resolution=48), environment(1)
    geometry = renderer.geometry(64)
    maps = geometry.require("albedo", "normal", "mask")
    albedo, normal, mask = maps["albedo"], maps["normal"], maps["mask"]
    is_image = kind == "image"

    def render(spp: int, seed: int) -> np.ndarray:
        if is_image:
            return renderer.image(light, 0.4, 0.3, spp, seed, batches=1).mean
        return renderer.diffuse(light, spp, seed, batches=1).mean

    noisy, converged = render(8, 1), render(1024, 2)
    guide = albedo if is_image else None
    clean = denoise.denoise(noisy, guide, normal, mask, premultiplied=is_image)
    wrong = denoise.denoise(noisy, guide if guide is None else guide[::-1], normal[::-1], mask, premultiplied=is_image)

    def score(picture: np.ndarray) -> float:
        shown, true = (unpremultiply(x[..., :3], mask) if is_image else x for x in (picture, converged))
        return decibels(shown, true, mask)

    scores = score(noisy), score(clean), score(wrong)
    assert scores[1] > scores[0] + 3, scores
    assert scores[2] < scores[1] - 1, scores
    assert clean.min() >= 0
    assert clean.dtype == np.float32
    np.testing.assert_array_equal(clean[..., 3:], noisy[..., 3:])
    again = denoise.denoise(noisy, guide, normal, mask, premultiplied=is_image)
    np.testing.assert_array_equal(again, clean)


def test_picture_and_guides_are_handed_on_times_the_mask(monkeypatch: pytest.MonkeyPatch) -> None:
    """The picture once, whether it was before or not; and it comes back as it went in, with its alpha."""
    handed = list[tuple[np.ndarray, ...]]()
    package = SimpleNamespace(denoise=lambda *pictures, hdr, clean_aux: handed.append(pictures) or pictures[0])
    monkeypatch.setattr(denoise, "_package", lambda: package)
    rng = np.random.default_rng(0)
    picture, albedo, normal = rng.uniform(0.1, 1, (3, 4, 5, 3)).astype(np.float32)
    mask = rng.uniform(0.2, 1, (4, 5, 1)).astype(np.float32)
    straight = denoise.denoise(picture, albedo, normal, mask, premultiplied=False)
    premultiplied = denoise.denoise(np.concatenate([picture * mask, mask], axis=-1), None, normal, mask)
    np.testing.assert_allclose(straight, picture, rtol=1e-6)
    np.testing.assert_array_equal(premultiplied, np.concatenate([picture * mask, mask], axis=-1))
    for pictures, guide in zip(handed, (albedo, 1), strict=True):
        for found, expected in zip(pictures, (picture * mask, guide * mask * np.ones(3), normal * mask), strict=True):
            np.testing.assert_allclose(found, expected, rtol=1e-6)


@needs_oidn
def test_the_mark_names_what_denoised() -> None:
    mark = denoise.marking()["denoised"]
    assert mark.startswith("mitsuba-oidn ")
    assert "Open Image Denoise 2." in mark


@needs_oidn
@pytest.mark.parametrize("value", [np.nan, np.inf, -1.0])
def test_radiance_that_is_none_is_refused(value: float) -> None:
    maps = np.ones((16, 16, 3), np.float32)
    image = maps.copy()
    image[3, 4, 1] = value
    with pytest.raises(UnirenderError, match="expected finite RGB or RGBA"):
        denoise.denoise(image, maps, maps, maps[..., :1])


def test_a_missing_package_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "mitsuba_oidn", None)
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(UnirenderError, match=r"pip install 'unirender\[denoise\]'"):
        denoise.version()
