"""What the pipeline refuses besides a bad picture: lights, several pictures at once; and where an edit cannot say."""

import copy
import dataclasses
import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from diffusers.schedulers.scheduling_ddim import DDIMScheduler
from diffusers.schedulers.scheduling_ddpm import DDPMScheduler
from diffusers.schedulers.scheduling_dpmsolver_multistep import DPMSolverMultistepScheduler
from diffusers.schedulers.scheduling_euler_discrete import EulerDiscreteScheduler
from diffusers.schedulers.scheduling_unipc_multistep import UniPCMultistepScheduler
from PIL import Image, ImageOps
from tiny_models import SIZE, make_pipeline

from unirender.camera import Camera
from unirender.diffusion.schedule import make_scheduler
from unirender.errors import UnirenderError
from unirender.intrinsics import Intrinsics
from unirender.pipelines.inputs import as_list, as_picture
from unirender.pipelines.settings import Sampling
from unirender.pipelines.unirender_pipeline import UniRenderPipeline

LIGHT = np.ones((16, 32, 3), np.float32)


@pytest.fixture(scope="module")
def pipeline() -> UniRenderPipeline:
    return make_pipeline()


def picture() -> tuple[np.ndarray, np.ndarray]:
    """A grey square on nothing."""
    mask = np.zeros((SIZE, SIZE, 1), np.float32)
    mask[8:-8, 8:-8] = 1
    return np.full((SIZE, SIZE, 3), 0.5, np.float32), mask


def surface() -> Intrinsics:
    """Maps of a plate that faces the camera, but for s and d."""
    mask = picture()[1]
    return Intrinsics(
        albedo=0.5 * np.repeat(mask, 3, -1),
        normal=mask * np.array([0, 0, 1], np.float32),
        roughness=0.5 * mask,
        metallic=0 * mask,
        mask=mask,
    )


@pytest.mark.parametrize(
    ("light", "words"),
    [
        (LIGHT[..., :2], r"got shape \(16, 32, 2\), expected a lat-long map"),
        (-LIGHT, "negative radiance"),
        (np.where(np.arange(32)[:, None] == 3, np.nan, LIGHT), "NaN"),
    ],
)
def test_a_light_that_is_none_is_refused(pipeline: UniRenderPipeline, light: np.ndarray, words: str) -> None:
    image, mask = picture()
    with pytest.raises(UnirenderError, match=f"environment: .*{words}"):
        pipeline.relight(image, light.astype(np.float32), mask)


@pytest.mark.parametrize("shape", [(64, 64), (16, 24), (18, 32)])
def test_a_light_that_is_no_whole_sphere_is_refused(pipeline: UniRenderPipeline, shape: tuple[int, int]) -> None:
    """A light probe was taken for a lat-long map; the commands refuse its file by the same rule."""
    image, mask = picture()
    light = np.ones((*shape, 3), np.float32)
    words = f"environment: got {shape[1]}x{shape[0]}, expected a lat-long map twice as wide as high; unwrap a light"
    with pytest.raises(UnirenderError, match=words):
        pipeline.relight(image, light, mask)
    with pytest.raises(UnirenderError, match=words):
        pipeline.render(surface().replace(environment=light))


def test_a_light_with_equal_steps_between_its_poles_is_one(pipeline: UniRenderPipeline) -> None:
    image, mask = picture()
    assert pipeline.relight(image, np.ones((17, 32, 3), np.float32), mask).image_linear.shape == image.shape


def test_an_unknown_exposure_is_refused(pipeline: UniRenderPipeline) -> None:
    image, mask = picture()
    with pytest.raises(UnirenderError, match="exposure: got 'bright', expected 'auto' or 'keep'"):
        pipeline.relight(image, LIGHT, mask, exposure="bright")
    assert pipeline.relight(image, LIGHT, mask, exposure="keep").image_linear.shape == image.shape


def test_several_pictures_are_not_one(pipeline: UniRenderPipeline) -> None:
    maps = surface().replace(environment=LIGHT)
    several: dict[str, Any] = {name: np.stack([value, value]) for name, value in maps.maps.items()}
    with pytest.raises(UnirenderError, match=r"render: got maps of shape \(2, .* expected one picture"):
        pipeline.render(Intrinsics(**several))
    assert pipeline.render(maps).shape == (SIZE, SIZE, 3)


def test_what_is_no_array_is_refused() -> None:
    with pytest.raises(UnirenderError, match="image: got str, expected a numpy array"):
        as_picture("mug.png", None)
    with pytest.raises(UnirenderError, match=r"got Tensor, .*permute\(1, 2, 0\)"):
        as_picture(torch.zeros(3, SIZE, SIZE), None)
    with pytest.raises(UnirenderError, match="mask: got str, expected a numpy array"):
        as_picture(picture()[0], "mask.png")
    with pytest.raises(UnirenderError, match=r"mask: .*divide an 8-bit mask by 255"):
        as_picture(picture()[0], 255 * picture()[1])


@pytest.mark.parametrize(
    ("shape", "words"),
    [
        ((2, SIZE, SIZE, 3), "decompose_batch"),
        ((3, SIZE, SIZE), "channels come last"),
        ((SIZE, SIZE), "repeat grey"),
        ((SIZE, SIZE, 1), "repeat grey"),
        ((SIZE, SIZE, 4), "pass alpha as the mask"),
    ],
)
def test_a_picture_of_another_shape_is_told_how_to_fit(shape: tuple[int, ...], words: str) -> None:
    with pytest.raises(UnirenderError, match=rf"image: got shape .* expected \[height, width, 3\]; .*{words}"):
        as_picture(np.zeros(shape, np.float32))


def test_one_picture_is_no_batch() -> None:
    one = Image.new("RGB", (SIZE, SIZE), "grey")
    with pytest.raises(UnirenderError, match="masks: got one Image, expected a list, one for each picture"):
        as_list("masks", one, 1)
    assert as_list("masks", (one, None), 1) == [one, None]
    with pytest.raises(UnirenderError, match="images_srgb: got one str, expected a list"):
        as_list("images_srgb", "photos", 3)


@pytest.mark.parametrize(("shape", "channels"), [((9, 8, 3), 3), ((9, 8), 3), ((), 3), ((9, 8, 1), 1), ((9, 8), 1)])
def test_one_array_is_no_batch(shape: tuple[int, ...], channels: int) -> None:
    with pytest.raises(UnirenderError, match=r"maps: got one array of shape .*; one picture goes to `decompose`"):
        as_list("maps", np.zeros(shape, np.float32), channels)


@pytest.mark.parametrize(("shape", "channels"), [((2, 9, 8, 3), 3), ((2, 9, 8, 1), 1), ((2, 9, 8), 1)])
def test_an_array_of_pictures_or_masks_is_a_batch(shape: tuple[int, ...], channels: int) -> None:
    batch = np.arange(np.prod(shape), dtype=np.float32).reshape(shape)
    np.testing.assert_array_equal(as_list("maps", batch, channels), batch)
    unlike = np.empty(2, object)
    unlike[:] = [batch[0], batch[0, 1:]]
    assert as_list("maps", unlike, channels) == list(unlike)


def test_a_turned_photograph_is_said_to_be_so(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    photograph = Image.new("RGB", (2 * SIZE, SIZE), "grey")
    as_picture(photograph)
    assert not caplog.records
    photograph.getexif()[0x0112] = 6
    as_picture(photograph)
    assert "EXIF orientation is not applied" in caplog.text
    caplog.clear()
    assert as_picture(ImageOps.exif_transpose(photograph))[0].shape == (2 * SIZE, SIZE, 3)
    photograph.save(tmp_path / "a.tif", exif=photograph.getexif())
    caplog.clear()
    assert as_picture(Image.open(tmp_path / "a.tif"))[0].shape == (2 * SIZE, SIZE, 3), "Pillow turns it"
    assert not caplog.text
    damaged = Image.new("RGB", (2 * SIZE, SIZE), "grey")
    damaged.info["exif"] = b"Exif\0\0no TIFF"
    assert as_picture(damaged)[0].shape == (SIZE, 2 * SIZE, 3)
    assert not caplog.records


def test_a_number_of_samples_and_generators_must_fit() -> None:
    with pytest.raises(UnirenderError, match="num_samples: got 0, expected a whole number, at least 1"):
        Sampling.of("sample", None, 0, None)
    several = Sampling.of("sample", 2, 2, [torch.Generator(), torch.Generator()])
    with pytest.raises(UnirenderError, match="generator: got 2 for 1 pictures"):
        several.draw_seed()


def test_a_material_is_a_number_or_a_map(pipeline: UniRenderPipeline) -> None:
    image, mask = picture()
    decomposition = pipeline.decompose(image, mask)
    same = [0.2, np.full((SIZE, SIZE, 1), 0.2)]
    first, *others = (pipeline.edit(image, mask, metallic=each, decomposition=decomposition) for each in same)
    for other in others:
        np.testing.assert_array_equal(other.image_linear, first.image_linear)


def test_with_a_decomposition_at_hand_settings_are_looked_at_too(pipeline: UniRenderPipeline) -> None:
    image, mask = picture()
    known: dict[str, Any] = {"decomposition": pipeline.decompose(image, mask)}
    with pytest.raises(TypeError, match="unexpected keyword argument 'clozed'"):
        pipeline.edit(image, mask, metallic=1.0, clozed=False, **known)
    with pytest.raises(TypeError, match="unexpected keyword argument 'steps'"):
        pipeline.relight(image, LIGHT, mask, steps=3, **known)
    lit: dict[str, Any] = {name: np.repeat(mask, 3, -1) for name in ("specular", "diffuse")}
    with pytest.raises(UnirenderError, match="exposure: got 'bright', expected 'auto' or 'keep'"):
        pipeline.relight(image, None, mask, exposure="bright", **lit, **known)


def test_a_mask_that_nothing_is_lit_by_is_refused() -> None:
    """The exposure of a light is that of pixels covered by more than one half: with none of them there is none."""
    with pytest.raises(UnirenderError, match="mask: no pixel is covered by more than one half"):
        as_picture(picture()[0], 0.5 * picture()[1])


@pytest.mark.parametrize(
    ("made", "words"),
    [
        (lambda config: DDIMScheduler(), "got a DDIMScheduler with prediction_type 'epsilon', expected 'sample'"),
        (EulerDiscreteScheduler.from_config, "got EulerDiscreteScheduler, expected one of DDIMScheduler"),
        (DDPMScheduler.from_config, "got .*DDPMScheduler"),
        (
            lambda config: DPMSolverMultistepScheduler.from_config(config, algorithm_type="sde-dpmsolver++"),
            "got DPMSolverMultistepScheduler, expected one of",
        ),
        (
            lambda config: DDIMScheduler(prediction_type="sample"),
            "got a DDIMScheduler with clip_.*leading",
        ),
        (
            lambda config: DDIMScheduler.from_config(config, clip_sample=True),
            "got a DDIMScheduler with clip_",
        ),
        (
            lambda config: DDIMScheduler.from_config(config, rescale_betas_zero_snr=False, trained_betas=None),
            "got a DDIMScheduler with rescale_betas_zero_snr=False",
        ),
        (
            lambda config: DPMSolverMultistepScheduler(
                prediction_type="sample", rescale_betas_zero_snr=True, timestep_spacing="trailing"
            ),
            "got a DPMSolverMultistepScheduler with another noise schedule",  # that of DDPM
        ),
        (
            # betas of all 1000 timesteps are kept, of which 500 are taken
            lambda config: DDIMScheduler.from_config(config, num_train_timesteps=500),
            "got a DDIMScheduler with num_train_timesteps=500, expected 1000",
        ),
        (
            lambda config: DDIMScheduler.from_config(config, trained_betas=config["trained_betas"][:500]),
            "got a DDIMScheduler with 500 betas, expected 1000",
        ),
        (
            lambda config: make_scheduler(500),
            "got a DDIMScheduler with num_train_timesteps=500, expected 1000",
        ),
        (
            lambda config: UniPCMultistepScheduler.from_config(config, solver_type="bh1"),
            "got a UniPCMultistepScheduler with solver_type='bh1', expected 'bh2': .*answers NaN",
        ),
        (
            lambda config: DPMSolverMultistepScheduler.from_config(config, final_sigmas_type="sigma_min"),
            "got a DPMSolverMultistepScheduler with final_sigmas_type='sigma_min', expected 'zero'",
        ),
    ],
)
def test_a_scheduler_that_would_give_wrong_maps_is_refused(made: Callable[[Any], Any], words: str) -> None:
    pipeline: Any = make_pipeline()
    pipeline.scheduler = made(pipeline.scheduler.config)
    with pytest.raises(UnirenderError, match=f"scheduler: {words}"):
        pipeline.decompose(*picture(), mode="sample", num_inference_steps=3, num_samples=1)


def test_one_step_asks_for_the_network_s_timesteps_too() -> None:
    """The network knows pure noise by its timestep, 999: told 499, it answered other maps without a word."""
    pipeline: Any = make_pipeline()
    own = pipeline.scheduler.config
    pipeline.scheduler = DDIMScheduler.from_config(own, num_train_timesteps=500)
    with pytest.raises(UnirenderError, match="num_train_timesteps=500, expected 1000"):
        pipeline.decompose(*picture())
    pipeline.scheduler = EulerDiscreteScheduler.from_config(own)
    pipeline.decompose(*picture(), closed=False)  # takes no part in one step


def test_a_network_that_answers_nan_is_refused_in_both_directions() -> None:
    """Maps have a contract; a picture was handed out as it was."""
    pipeline = make_pipeline()
    maps = pipeline.decompose(*picture(), closed=False).intrinsics
    with torch.no_grad():
        for unet in (pipeline.dual_stream.attribute_unet, pipeline.dual_stream.image_unet):
            unet.conv_out.weight.fill_(torch.nan)
    with pytest.raises(UnirenderError, match="values are NaN or infinite, expected finite values"):
        pipeline.decompose(*picture(), closed=False)
    with pytest.raises(UnirenderError, match="values of the network's picture are NaN or infinite, expected"):
        pipeline.render(maps)


def test_a_frame_without_a_mask_is_told_once(caplog: pytest.LogCaptureFixture) -> None:
    pipeline, (image, mask) = make_pipeline(), picture()
    pipeline.decompose(image, mask)
    pipeline.decompose(image, np.ones_like(mask))  # asked for
    assert "mask" not in caplog.text
    pipeline.edit(image, metallic=1.0)
    pipeline.decompose(image)
    assert caplog.text.count("mask: not given, and no pixel is transparent: the whole frame is taken") == 1


def test_normals_of_other_axes_are_told(pipeline: UniRenderPipeline, caplog: pytest.LogCaptureFixture) -> None:
    image, mask = picture()
    maps = pipeline.decompose(image, mask).intrinsics
    normal = np.zeros_like(maps.require("normal")["normal"])
    for z in (1, -1):
        caplog.clear()
        normal[..., 2] = z
        pipeline.render(maps.replace(normal=normal))
        assert ("100% of the object's normals face away from the camera" in caplog.text) == (z < 0)


def test_an_edit_says_where_the_predicted_light_is_too_coarse(pipeline: UniRenderPipeline) -> None:
    """A light of 16 x 32 has no reflection as sharp as roughness 0.1; without a new roughness there is no question."""
    image, mask = picture()
    decomposition = pipeline.decompose(image, mask)
    sharp = pipeline.edit(image, mask, roughness=0.1, decomposition=decomposition)
    assert sharp.coarse is not None
    assert (sharp.coarse == (mask > 0)).all()
    assert sharp.coarse_share == 1
    own = decomposition.intrinsics.require("roughness")["roughness"]
    left = np.arange(SIZE)[None, :, None] < SIZE // 2
    half = pipeline.edit(image, mask, roughness=np.where(left, own, 0.1), decomposition=decomposition)
    assert half.coarse_share == 0.5
    metal = pipeline.edit(image, mask, metallic=1.0, decomposition=decomposition)
    assert metal.coarse is None
    assert (metal.coarse_share, metal.bounded) == (0, 0)


@pytest.mark.parametrize("task", ["edit", "relight"])
def test_a_decomposition_at_hand_must_be_of_this_picture(pipeline: UniRenderPipeline, task: str) -> None:
    image, mask = picture()
    found = pipeline.decompose(image, mask)

    def changed(image: np.ndarray, mask: np.ndarray, **given: Any) -> np.ndarray:
        if task == "edit":
            return pipeline.edit(image, mask, metallic=1.0, **given).image_linear
        return pipeline.relight(image, LIGHT, mask, **given).image_linear

    same = changed(image, mask, decomposition=found)
    rounded = np.round(254.4 * mask) / 255
    own = {"camera": found.intrinsics.camera, "tile": False, "closed": True, "material": None}
    np.testing.assert_array_equal(changed(image, mask, decomposition=found, **own), same)
    assert changed(image, rounded.astype(np.float32), decomposition=found).shape == same.shape
    with pytest.raises(UnirenderError, match=r"decomposition: its mask differs from this one by up to 1, expected the"):
        changed(image, np.roll(mask, 3, axis=0), decomposition=found)
    with pytest.raises(
        UnirenderError, match=r"decomposition: is of a picture of \(.*\) pixels, expected \(.*\) like this"
    ):
        changed(image[:-2], mask[:-2], decomposition=found)
    other = image.copy()
    other[8:16, 8:16] += 0.2
    with pytest.raises(UnirenderError, match="decomposition: is of another picture, whose display values differ"):
        changed(other, mask, decomposition=found)
    with pytest.raises(UnirenderError, match="is of another picture"):
        changed(other, mask, decomposition=pickle.loads(pickle.dumps(copy.deepcopy(found))))
    eight_bits = (np.round(255 * image + 0.2 * np.sin(np.arange(SIZE))[:, None, None]) / 255).astype(np.float32)
    behind = np.where(mask > 0, eight_bits, 1.0).astype(np.float32)
    by_hand = dataclasses.replace(found, thumbnail=None, made_with=None)
    for taken, own_picture in ((found, behind), (dataclasses.replace(found, roughness=0.1), image), (by_hand, other)):
        assert changed(own_picture, mask, decomposition=taken).shape == same.shape
    wrong: list[tuple[str, Any, str]] = [
        ("camera", Camera(80.0), r"camera: got Camera\(fov_deg=80.0.*, expected Camera\(fov_deg=36.0"),
        ("tile", True, "tile: got True beside a decomposition, which is taken as it is"),
        ("closed", False, "closed: got False beside a decomposition"),
        ("material", "map", "material: got 'map' beside a decomposition"),
        ("flat", True, "flat: got True beside a decomposition"),
    ]
    for name, value, words in wrong:
        for of_it in (found, by_hand):
            with pytest.raises(UnirenderError, match=words):
                changed(image, mask, decomposition=of_it, **{name: value})


def test_settings_beside_a_decomposition_are_those_that_it_was_made_with(pipeline: UniRenderPipeline) -> None:
    image, mask = picture()
    settings: dict[str, Any] = {"looks": 2, "closed": False, "material": "map", "tile": False}
    found = pipeline.decompose(image, mask, **settings)
    same = pipeline.edit(image, mask, metallic=1.0, decomposition=found)
    again = pipeline.edit(image, mask, metallic=1.0, decomposition=found, **settings)
    np.testing.assert_array_equal(again.image_linear, same.image_linear)
    with pytest.raises(
        UnirenderError, match="looks: got 1 beside a decomposition, which is taken as it is, expected 2"
    ):
        pipeline.edit(image, mask, metallic=1.0, decomposition=found, looks=1)


def test_results_are_told_apart_and_shown_in_short(pipeline: UniRenderPipeline) -> None:
    image, mask = picture()
    found = pipeline.decompose(image, mask, mode="sample", num_inference_steps=2, num_samples=2)
    other, edited = copy.deepcopy(found), pipeline.edit(image, mask, metallic=1.0, decomposition=found)
    assert len({found, other, found.intrinsics, other.intrinsics}) == 4
    assert found != other
    assert f"Intrinsics(albedo [{SIZE}, {SIZE}, 3] in [0, " in repr(found)
    assert "array(" not in repr(found) + repr(edited)
