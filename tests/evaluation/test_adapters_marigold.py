"""Marigold's pipelines as methods: each conversion against a stated answer, the whole against diffusers' own call."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from diffusers.pipelines.marigold.pipeline_marigold_intrinsics import MarigoldIntrinsicsPipeline
from diffusers.schedulers.scheduling_lcm import LCMScheduler
from tiny_adapter_folders import (
    ANSWER,
    APPEARANCE,
    LIGHTING,
    LINEAR,
    SCHEDULE,
    SIZE,
    of_inside,
    write_intrinsics,
    write_normals,
)

from unirender.camera import Camera
from unirender.color import image_srgb, srgb_decode
from unirender.errors import UnirenderError
from unirender_evaluation.adapters.folder import on_background
from unirender_evaluation.adapters.marigold import MarigoldIntrinsics, MarigoldNormals
from unirender_evaluation.adapters.marigold_maps import check_properties, decoded_targets, target_maps


@pytest.fixture(scope="module")
def appearance(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_intrinsics(tmp_path_factory.mktemp("marigold") / "appearance", APPEARANCE)


@pytest.fixture(scope="module")
def seen() -> dict[str, Any]:
    """A picture, its mask and camera."""
    rng = np.random.default_rng(0)
    mask = np.zeros((*SIZE, 1), np.float32)
    mask[4:-4, 3:-3] = 1
    mask[4] = 0.5
    image = (np.round(rng.uniform(0, 1, (*SIZE, 3)) * 255) / 255 * (mask > 0)).astype(np.float32)
    return {"image_srgb": image, "mask": mask, "camera": Camera()}


def test_each_map_is_what_the_folder_says_of_it(tmp_path: Path, seen: dict[str, Any]) -> None:
    """Through the real pipeline: albedo is decoded, roughness and metallicity are the first channels as they are."""
    maps = MarigoldIntrinsics(write_intrinsics(tmp_path / "a", APPEARANCE, ANSWER)).decompose(**seen)
    assert maps.present == ("albedo", "roughness", "metallic", "mask")
    np.testing.assert_allclose(of_inside(maps.maps["albedo"], seen), srgb_decode(np.array([0.8, 0.5, 0.4])), atol=1e-5)
    np.testing.assert_allclose(of_inside(maps.maps["roughness"], seen), 0.8, atol=1e-5)
    np.testing.assert_allclose(of_inside(maps.maps["metallic"], seen), 0.5, atol=1e-5)
    material = {"prediction_space": "stack", "sub_target_names": [None, "metallicity", "roughness"]}
    other = APPEARANCE | {"albedo": LINEAR, "material": material}
    twin = MarigoldIntrinsics(write_intrinsics(tmp_path / "b", other, ANSWER)).decompose(**seen)
    np.testing.assert_allclose(of_inside(twin.maps["albedo"], seen), [0.8, 0.5, 0.4], atol=1e-5)
    np.testing.assert_allclose(of_inside(twin.maps["roughness"], seen), 0.4, atol=1e-5)


def lit(seen: dict[str, Any], clip: bool) -> tuple[np.ndarray, dict[str, np.ndarray], dict[str, Any]]:
    """Targets of the lighting model and the picture (display values) that their equation makes with known factors."""
    rng = np.random.default_rng(1)
    prediction = rng.uniform(0.2, 0.6, (3, *SIZE, 3)).astype(np.float32)
    targets = decoded_targets(prediction, LIGHTING)
    linear = 1.7 * targets["albedo"] * targets["shading"] + 0.4 * targets["residual"]
    if clip:
        linear[::2] = 5
    return image_srgb(linear), targets, LIGHTING


@pytest.mark.parametrize("clip", [False, True])
def test_the_scale_of_the_shading_is_the_pictures(seen: dict[str, Any], clip: bool) -> None:
    """d is the shading by the factor that its equation has; pixels at display white do not count."""
    image, targets, properties = lit(seen, clip)
    maps = target_maps(targets, properties, image, seen["mask"])
    assert sorted(maps) == ["albedo", "diffuse"], "a residual is no map of ours"
    inside = seen["mask"][..., 0] > 0
    np.testing.assert_allclose(maps["diffuse"][inside], 1.7 * targets["shading"][inside], rtol=1e-3)
    np.testing.assert_allclose(maps["albedo"][inside], targets["albedo"][inside])
    alone = target_maps({k: v for k, v in targets.items() if k != "residual"}, properties, image, seen["mask"])
    assert np.abs(alone["diffuse"] / np.maximum(maps["diffuse"], 1e-3) - 1)[inside].min() > 0.05, "the residual matters"
    known = target_maps(targets, properties | {"shading": LINEAR}, image, seen["mask"])
    np.testing.assert_allclose(known["diffuse"][inside], targets["shading"][inside])
    unfixed = target_maps(targets, properties | {"albedo": LIGHTING["shading"]}, image, seen["mask"])
    assert "diffuse" not in unfixed, "albedo up to a scale leaves the shading's open"


def test_normals_are_in_the_contracts_axes(tmp_path: Path, seen: dict[str, Any]) -> None:
    """To the right and the viewer: the first channel is +x, the third +z; unit, whatever the decoder's length."""
    maps = MarigoldNormals(write_normals(tmp_path / "n", (0.3, 0.0, 0.4))).decompose(**seen)
    assert maps.present == ("normal", "mask")
    np.testing.assert_allclose(of_inside(maps.maps["normal"], seen), [0.6, 0, 0.8], atol=1e-5)
    up = MarigoldNormals(write_normals(tmp_path / "u", (0.0, 0.3, 0.4))).decompose(**seen)
    np.testing.assert_allclose(of_inside(up.maps["normal"], seen), [0, 0.6, 0.8], atol=1e-5)


def test_the_answer_is_that_of_diffusers_own_call(appearance: Path, seen: dict[str, Any]) -> None:
    """Loaded by diffusers itself, shown the picture on white: the same values at the picture's size."""
    method = MarigoldIntrinsics(appearance, seed=3, steps=1, resolution=16)
    maps = method.decompose(**seen)
    pipeline: Any = MarigoldIntrinsicsPipeline.from_pretrained(appearance, local_files_only=True)
    pipeline.set_progress_bar_config(disable=True)
    shown = torch.from_numpy(on_background(seen["image_srgb"], seen["mask"], "white")).movedim(-1, 0)[None]

    def theirs(seed: int, picture: torch.Tensor) -> np.ndarray:
        """Their albedo."""
        answer = pipeline(
            picture,
            num_inference_steps=1,
            processing_resolution=16,
            generator=torch.Generator().manual_seed(seed),
        )
        return srgb_decode(answer.prediction[0]) * (seen["mask"] > 0)

    assert maps.maps["albedo"].shape == (*SIZE, 3)
    assert np.ptp(maps.maps["albedo"]) > 0.05
    np.testing.assert_allclose(maps.maps["albedo"], theirs(3, shown), atol=1e-5)
    assert np.abs(maps.maps["albedo"] - theirs(4, shown)).max() > 1e-2
    assert np.abs(maps.maps["albedo"] - theirs(3, 0 * shown)).max() > 1e-3
    again = method.decompose(**seen)
    np.testing.assert_array_equal(again.maps["albedo"], maps.maps["albedo"])


def test_the_background_is_mixed_in_linear_light_and_seen(appearance: Path, seen: dict[str, Any]) -> None:
    half = np.full((1, 1, 1), 0.5, np.float32)
    black = np.zeros((1, 1, 3), np.float32)
    np.testing.assert_allclose(on_background(black, half, "white"), 0.7353570, atol=1e-5)  # sRGB of 0.5, and not 0.5
    np.testing.assert_allclose(on_background(black, 0 * half, "grey"), 0.5, atol=1e-5)
    np.testing.assert_allclose(on_background(black + 0.25, 0 * half + 1, "white"), 0.25, atol=1e-5)
    on = {name: MarigoldIntrinsics(appearance, background=name) for name in ("white", "black")}
    inner = [on[name].decompose(**seen).maps["albedo"][8:-8, 8:-8] for name in on]
    assert np.abs(inner[0] - inner[1]).max() > 1e-4
    assert on["white"].config != on["black"].config


def test_several_predictions_are_one(appearance: Path, seen: dict[str, Any]) -> None:
    one, three = (MarigoldIntrinsics(appearance, ensemble=n).decompose(**seen) for n in (1, 3))
    assert np.abs(one.maps["albedo"] - three.maps["albedo"]).max() > 1e-3


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (None, "got None, expected the names and properties"),
        ({"target_names": "albedo"}, "expected the names and properties"),
        ({"albedo": {"prediction_space": "log"}}, "albedo is 'log', expected one of srgb, linear, stack"),
        ({"material": {"prediction_space": "stack"}}, "material stacks None, expected three names"),
        ({"roughness": {"prediction_space": "stack"}}, "roughness is 'stack', expected srgb or linear"),
        ({"albedo": "srgb"}, "got 'srgb' as a target, expected names, each with a table"),
        ({"target_names": [["albedo"]]}, r"got \['albedo'\] as a target, expected names"),
        ({"roughness": 1}, "got 1 as a target, expected names, each with a table"),
        ({"target_names": ["depth"]}, "names depth, expected some of albedo, roughness, metallicity, shading"),
    ],
)
def test_properties_that_cannot_be_obeyed(changes: dict[str, Any] | None, message: str) -> None:
    check_properties(APPEARANCE, Path("folder"))
    check_properties(LIGHTING, Path("folder"))
    with pytest.raises(UnirenderError, match=f"folder/model_index.json: target_properties: .*{message}"):
        check_properties(None if changes is None else APPEARANCE | changes, Path("folder"))


def test_a_folder_of_another_kind(appearance: Path) -> None:
    with pytest.raises(UnirenderError, match="'MarigoldIntrinsicsPipeline', expected 'MarigoldNormalsPipeline'"):
        MarigoldNormals(appearance)
    with pytest.raises(UnirenderError, match="resolution: got 18, expected a multiple of 4, or 0"):
        MarigoldIntrinsics(appearance, resolution=18)


def test_the_schedulers_of_all_published_folders(tmp_path: Path, seen: dict[str, Any]) -> None:
    """DDIM, and LCM of the distilled folders, whose steps add noise; entries that the pipeline does not know are left
    out, as diffusers does it."""
    folder = write_normals(tmp_path / "n")
    ddim = MarigoldNormals(folder).decompose(**seen).maps["normal"]
    index = folder / "model_index.json"
    index.write_text(json.dumps(json.loads(index.read_text()) | {"note": "of another version"}))
    np.testing.assert_array_equal(MarigoldNormals(folder).decompose(**seen).maps["normal"], ddim)
    LCMScheduler(**SCHEDULE).save_pretrained(folder / "scheduler")
    lcm = MarigoldNormals(folder).decompose(**seen).maps["normal"]
    assert np.abs(lcm - ddim).max() > 1e-2
    np.testing.assert_array_equal(MarigoldNormals(folder).decompose(**seen).maps["normal"], lcm)


def test_steps_at_which_diffusers_ends_in_noise_are_refused(tmp_path: Path) -> None:
    """Of 61 steps it makes 62, the last at index -1, where DDIM begins anew; LCM takes up to 50."""
    folder = write_normals(tmp_path / "n")
    MarigoldNormals(folder, steps=60)
    with pytest.raises(UnirenderError, match="steps: got 61, of which DDIMScheduler makes 62 timesteps"):
        MarigoldNormals(folder, steps=61)
    LCMScheduler(**SCHEDULE).save_pretrained(folder / "scheduler")
    with pytest.raises(UnirenderError, match="steps: got 51, which LCMScheduler does not take: "):
        MarigoldNormals(folder, steps=51)
