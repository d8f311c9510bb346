"""RGB-to-X as a method: its conversions against a stated answer, its sampling against diffusers' nearest pipeline."""

import itertools
import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from diffusers.pipelines.stable_diffusion.pipeline_stable_diffusion_instruct_pix2pix import (
    StableDiffusionInstructPix2PixPipeline,
)
from diffusers.schedulers.scheduling_ddim import DDIMScheduler
from tiny_adapter_folders import ANSWER, APPEARANCE, SCHEDULE, SIZE, TRAILING, of_inside, write_intrinsics, write_rgbx

from unirender.camera import Camera
from unirender.color import srgb_decode
from unirender.errors import UnirenderError
from unirender_evaluation.adapters.conditioned import ConditionedDiffusion, fit
from unirender_evaluation.adapters.rgbx import PROMPTS, RgbToX


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_rgbx(tmp_path_factory.mktemp("rgbx") / "rgb-to-x")


@pytest.fixture(scope="module")
def seen() -> dict[str, Any]:
    """A picture, its mask and camera."""
    mask = np.zeros((*SIZE, 1), np.float32)
    mask[4:-4, 3:-3] = 1
    image = np.random.default_rng(0).uniform(0, 1, (*SIZE, 3)).astype(np.float32) * mask
    return {"image_srgb": image, "mask": mask, "camera": Camera()}


def test_each_map_is_converted_from_a_stated_answer(tmp_path: Path, seen: dict[str, Any]) -> None:
    """Albedo is linear already, roughness and metallic are the first channel, normals are unit."""
    answered = write_rgbx(tmp_path / "a", ANSWER)
    maps = RgbToX(answered, steps=1, resolution=16).decompose(**seen)
    assert maps.present == ("albedo", "normal", "roughness", "metallic", "mask")
    found = {name: of_inside(value, seen) for name, value in maps.maps.items()}
    np.testing.assert_allclose(found["albedo"], [0.8, 0.5, 0.4], atol=1e-5)
    unit = np.array(ANSWER) / np.linalg.norm(ANSWER)
    np.testing.assert_allclose(found["normal"], unit, atol=1e-5)
    np.testing.assert_allclose(found["roughness"], 0.8, atol=1e-5)
    np.testing.assert_allclose(found["metallic"], 0.8, atol=1e-5)
    twin = RgbToX(answered, steps=1, resolution=16, normal_axes="+x-z-y", roughness="alpha").decompose(**seen)
    np.testing.assert_allclose(of_inside(twin.maps["normal"], seen), [unit[0], -unit[2], 0], atol=1e-5)
    np.testing.assert_allclose(of_inside(twin.maps["roughness"], seen), np.sqrt(0.8), atol=1e-5)


def test_sampling_is_that_of_diffusers_nearest_pipeline(folder: Path) -> None:
    """Its editing pipeline without guidance, handed the picture's latent, denoises the same way from the same noise."""
    network = RgbToX(folder).network
    pipeline: Any = StableDiffusionInstructPix2PixPipeline.from_pretrained(folder, local_files_only=True)
    pipeline.set_progress_bar_config(disable=True)
    pipeline.scheduler = DDIMScheduler(**(SCHEDULE | TRAILING))
    picture = torch.rand(1, 3, 32, 24, generator=torch.Generator().manual_seed(1)) * 2 - 1
    condition = network.encode(picture)
    expected_latent = pipeline.vae.encode(picture).latent_dist.mean * 0.18215
    torch.testing.assert_close(condition, expected_latent, rtol=0, atol=1e-5)

    def ours(prompt: str, seed: int = 5, steps: int = 3) -> torch.Tensor:
        return network.denoise(condition, network.words(prompt), steps, torch.Generator().manual_seed(seed))

    def edited() -> torch.Tensor:
        options = {"num_inference_steps": 3, "guidance_scale": 1.0, "output_type": "pt"}
        generator = torch.Generator().manual_seed(5)
        return pipeline(prompt=PROMPTS["albedo"], image=condition, generator=generator, **options).images

    theirs = edited()
    found = (ours(PROMPTS["albedo"]) / 2 + 0.5).clamp(0, 1)
    assert found.std() > 0.01
    torch.testing.assert_close(found, theirs, rtol=0, atol=1e-4)
    for twin in (ours(PROMPTS["roughness"]), ours(PROMPTS["albedo"], seed=6), ours(PROMPTS["albedo"], steps=2)):
        assert ((twin / 2 + 0.5).clamp(0, 1) - theirs).abs().max() > 1e-3
    pipeline.scheduler = DDIMScheduler(**SCHEDULE)  # as the file has it
    as_filed = edited()
    assert (found - as_filed).abs().max() > 1e-3


def test_the_scheduler_that_the_folder_names_does_not_matter(folder: Path, tmp_path: Path) -> None:
    """Only its noise schedule does."""
    other = Path(shutil.copytree(folder, tmp_path / "other"))
    path = other / "scheduler" / "scheduler_config.json"
    config = json.loads(path.read_text())
    path.write_text(json.dumps(config | {"_class_name": "PNDMScheduler"}))
    one, two = (RgbToX(place).network.scheduler for place in (folder, other))
    assert type(one) is type(two) is DDIMScheduler
    torch.testing.assert_close(one.alphas_cumprod, two.alphas_cumprod)
    path.write_text(json.dumps(config | {"beta_end": 0.02}))
    assert not torch.equal(RgbToX(other).network.scheduler.alphas_cumprod, one.alphas_cumprod)


def test_a_picture_of_any_size_goes_there_and_back() -> None:
    rows, columns = np.mgrid[:30, :21].astype(np.float32)
    ramp = torch.from_numpy(np.stack([rows / 30, columns / 21, rows * 0]))[None]
    for resolution, inner in ((0, (32, 24)), (60, (64, 48)), (16, (16, 16))):
        fitted, way = fit(ramp, resolution, 8)
        assert fitted.shape[-2:] == inner
        back = way.back(fitted)
        assert back.shape == ramp.shape
        assert (back - ramp)[..., 4:-4, 4:-4].abs().max() < (1e-6 if resolution == 0 else 0.02)
    fitted, way = fit(ramp, 0, 8)
    stretched = torch.nn.functional.interpolate(fitted, (30, 21), mode="bilinear")  # without cutting the padding off
    assert (stretched - ramp)[..., 4:-4, 4:-4].abs().max() > 0.02


def test_the_picture_is_encoded_as_linear_values(folder: Path) -> None:
    method = RgbToX(folder, resolution=0)
    image = np.random.default_rng(2).uniform(0, 1, (16, 24, 3)).astype(np.float32)
    condition, way = method.condition(image, np.ones((16, 24, 1), np.float32))
    assert way.size == (16, 24)

    def latent(picture: np.ndarray) -> torch.Tensor:
        return method.network.encode(torch.from_numpy(2 * picture - 1).movedim(-1, 0)[None])

    torch.testing.assert_close(condition, latent(srgb_decode(image)), rtol=0, atol=1e-5)
    assert (condition - latent(image)).abs().max() > 1e-2


def test_the_maps_follow_the_picture_and_the_seed(folder: Path, seen: dict[str, Any]) -> None:
    method = RgbToX(folder, steps=1, resolution=16)
    first = method.decompose(**seen)
    assert first.maps["albedo"].shape == (*SIZE, 3)
    np.testing.assert_array_equal(method.decompose(**seen).maps["albedo"], first.maps["albedo"])
    dark = method.decompose(**(seen | {"image_srgb": 0.5 * seen["image_srgb"]}))
    assert np.abs(dark.maps["albedo"] - first.maps["albedo"]).max() > 1e-4
    other = RgbToX(folder, steps=1, resolution=16, seed=1).decompose(**seen)
    assert np.abs(other.maps["albedo"] - first.maps["albedo"]).max() > 1e-3
    two = RgbToX(folder, steps=1, resolution=16, ensemble=2).decompose(**seen)
    assert np.abs(two.maps["albedo"] - first.maps["albedo"]).max() > 1e-3


def test_answers_are_cut_to_their_range_before_their_mean(
    folder: Path, seen: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    method, level = RgbToX(folder, steps=1, resolution=16, ensemble=2), itertools.cycle((3.0, -0.5))
    rows, columns = method.condition(seen["image_srgb"], seen["mask"])[0].shape[2:]
    size = (1, 3, method.network.factor * rows, method.network.factor * columns)
    monkeypatch.setattr(ConditionedDiffusion, "denoise", lambda *_: torch.full(size, next(level)))
    found = method.decompose(**seen).maps["albedo"]
    np.testing.assert_allclose(of_inside(found, seen), 0.625, atol=1e-6)  # of the mean of 1 and -0.5


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"normal_axes": "xyz"}, "normal_axes: got 'xyz', expected x, y and z once each"),
        ({"normal_axes": "+x+y+y"}, "normal_axes"),
        ({"roughness": "gloss"}, "roughness: got 'gloss', expected perceptual or alpha"),
    ],
)
def test_settings_that_mean_nothing(folder: Path, options: dict[str, Any], message: str) -> None:
    with pytest.raises(UnirenderError, match=message):
        RgbToX(folder, **options)


def test_a_network_of_another_kind(tmp_path: Path) -> None:
    with pytest.raises(UnirenderError, match="unet: got 12 input and 8 output channels, expected 8 and 4"):
        RgbToX(write_intrinsics(tmp_path / "a", APPEARANCE))
