"""The pipeline with an untrained model: shapes, sizes, seeds, anchoring, errors. Scores are the benchmark's task."""

import inspect
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from accelerate import cpu_offload
from diffusers.pipelines.pipeline_utils import DiffusionPipeline
from PIL import Image
from tiny_models import SIZE, counted_rows, make_pipeline

from unirender.camera import Camera
from unirender.color import image_srgb, srgb_decode
from unirender.command_line.options import DecompositionOptions
from unirender.composite import split_sum_image
from unirender.diffusion.schedule import NUM_TIMESTEPS
from unirender.diffusion.steps import MOST_STEPS
from unirender.errors import UnirenderError
from unirender.intrinsics import Intrinsics
from unirender.models.dual_stream import DualStreamModel, DualStreamOutput
from unirender.pipelines.closure import close_decomposition
from unirender.pipelines.derived_light import derived_diffuse, derived_specular
from unirender.pipelines.editing import (
    LOBE_FLOOR,
    SMALL_CHANGE,
    TRUST_WIDER,
    anchor,
    specular_for_roughness,
    specular_share,
    trust,
    under_light,
)
from unirender.pipelines.framing import Frame
from unirender.pipelines.masked_maps import constant_map
from unirender.pipelines.settings import TAKING_APART
from unirender.pipelines.unirender_pipeline import UniRenderPipeline


@pytest.fixture(scope="module")
def pipeline() -> UniRenderPipeline:
    return make_pipeline()


def seeded(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def get(intrinsics: Intrinsics, name: str) -> np.ndarray:
    return intrinsics.require(name)[name]


def picture(height: int = SIZE, width: int = SIZE) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    y, x = np.mgrid[0:height, 0:width]
    mask = ((x - width / 2) ** 2 + (y - height / 2) ** 2 < (0.45 * min(height, width)) ** 2)[..., None]
    image = np.clip(rng.uniform(0.2, 0.8, 3) + 0.2 * np.sin(x / 5.0)[..., None], 0, 1)
    return image.astype(np.float32), mask.astype(np.float32)


def example() -> tuple[np.ndarray, np.ndarray]:
    """The picture of README."""
    rgba = np.asarray(Image.open(Path(__file__).parents[2] / "docs/_static/example.png"), np.float32) / 255
    return rgba[..., :3], rgba[..., 3:]


def scene(size: int = SIZE) -> Intrinsics:
    _, mask = picture(size, size)
    axis = (np.arange(size) + 0.5) / size * 2 - 1
    x, y = np.meshgrid(axis, -axis)
    normal = np.stack([x, y, np.sqrt(np.maximum(1 - x**2 - y**2, 0.05))], axis=-1)
    normal = normal / np.linalg.norm(normal, axis=-1, keepdims=True) * mask
    environment = np.random.default_rng(1).uniform(0.2, 1.5, (16, 32, 3)).astype(np.float32)
    maps: dict[str, Any] = {
        "albedo": 0.5 * mask.repeat(3, axis=-1),
        "normal": normal,
        "mask": mask,
        "environment": environment,
    }
    lit: dict[str, Any] = {"specular": 0.6 * mask.repeat(3, axis=-1), "diffuse": 0.8 * mask.repeat(3, axis=-1)}
    return Intrinsics(**maps, **lit, roughness=0.5 * mask, metallic=0.3 * mask)


@pytest.mark.parametrize("size", [(SIZE, SIZE), (50, 37), (20, 90), (130, 128)])
def test_decompose_any_size(pipeline: UniRenderPipeline, size: tuple[int, int]) -> None:
    image, mask = picture(*size)
    result = pipeline.decompose(image, mask, generator=seeded())
    maps = result.intrinsics
    assert maps.present == ("albedo", "normal", "roughness", "metallic", "specular", "diffuse", "environment", "mask")
    assert (maps.height, maps.width) == size
    assert maps.environment is not None
    assert maps.environment.shape == (16, 32, 3)
    for name, value in maps.require("albedo", "normal", "roughness", "metallic", "specular", "diffuse").items():
        assert not value[mask[..., 0] == 0].any(), name
    lengths = np.linalg.norm(get(maps, "normal"), axis=-1)[mask[..., 0] > 0]
    np.testing.assert_allclose(lengths, 1, atol=1e-5)
    assert result.std is None
    assert result.samples == ()


@pytest.mark.parametrize("size", [(37, 91), (300, 200)])
def test_another_size_of_the_network_gives_the_pictures_size(
    pipeline: UniRenderPipeline, size: tuple[int, int]
) -> None:
    image, mask = picture(*size)
    own, larger = (pipeline.decompose(image, mask, size=side).intrinsics for side in (None, 2 * SIZE))
    assert (larger.height, larger.width) == size
    assert np.array_equal(get(larger, "mask"), mask)
    assert get(larger, "environment").shape == (16, 32, 3)
    assert not np.allclose(get(own, "albedo"), get(larger, "albedo"), atol=1e-3)
    np.testing.assert_array_equal(
        get(pipeline.decompose(image, mask, size=SIZE).intrinsics, "albedo"), get(own, "albedo")
    )
    images = [pipeline.render(own, size=side) for side in (None, 2 * SIZE)]
    assert images[1].shape == (*size, 3)
    assert not np.array_equal(images[0], images[1])


@pytest.mark.parametrize("size", [0, -32, 16, 48, 65])
def test_a_size_that_the_network_cannot_take_is_refused(pipeline: UniRenderPipeline, size: int) -> None:
    assert pipeline.size_multiple == 32  # of the light's 32 columns; the levels alone need 4
    with pytest.raises(UnirenderError, match=f"size: got {size}, expected a multiple of 32, like {SIZE}"):
        pipeline.decompose(*picture(), size=size)


def test_a_batch_is_one_pass_and_each_picture_is_what_it_is_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    pipeline = make_pipeline()
    rows = counted_rows(monkeypatch)
    pictures = [picture(), picture(50, 37), picture(20, 90)]
    images, masks = [p[0] for p in pictures], [p[1] for p in pictures]
    cameras = [Camera(), Camera(fov_deg=60.0), Camera(principal=(0.4, 0.6))]
    assert len(pipeline.decompose_batch(images, masks, cameras=cameras, closed=False)) == 3
    assert rows == [3]
    closed = pipeline.decompose_batch(images, masks, cameras=cameras)
    assert rows == [3, 3, 3]  # and one more to close them
    rows.clear()
    alone = pipeline.decompose(images[1], masks[1], camera=cameras[1], closed=False)
    assert rows == [1]  # mode mean: one pass
    alone = pipeline.decompose(images[1], masks[1], camera=cameras[1])
    for name, value in alone.intrinsics.maps.items():
        np.testing.assert_allclose(closed[1].intrinsics.maps[name], value, rtol=0, atol=2e-3, err_msg=name)
    as_first = pipeline.decompose(images[1], masks[1], camera=cameras[0])
    assert np.abs(get(as_first.intrinsics, "albedo") - get(alone.intrinsics, "albedo")).max() > 1e-2  # the twin
    sampling: dict[str, Any] = {"mode": "sample", "num_inference_steps": 2, "num_samples": 2, "closed": False}
    several = pipeline(images, masks, generator=[seeded(i) for i in range(3)], **sampling)
    assert isinstance(several, list)
    own = pipeline.decompose(images[2], masks[2], generator=seeded(2), **sampling)
    np.testing.assert_allclose(get(several[2].intrinsics, "albedo"), get(own.intrinsics, "albedo"), rtol=0, atol=2e-3)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"images_srgb": []}, "got 0 pictures"),
        ({"masks": [None]}, "2 pictures, 1 masks"),
        ({"cameras": [Camera()] * 3}, "3 cameras"),
        ({"generator": [torch.Generator()] * 3}, "got 3 for 2 pictures"),
        ({"images_srgb": picture()[0]}, "images_srgb: got one array of shape"),
        ({"masks": picture()[1]}, "masks: got one array of shape"),
    ],
)
def test_a_batch_that_does_not_fit_is_refused(pipeline: UniRenderPipeline, change: dict, words: str) -> None:
    arguments: dict[str, Any] = {"images_srgb": [picture()[0]] * 2} | change
    with pytest.raises(UnirenderError, match=words):
        pipeline.decompose_batch(**arguments)


def test_materials_are_scalars_or_maps(pipeline: UniRenderPipeline) -> None:
    image, mask = picture()
    scalar = pipeline.decompose(image, mask, generator=seeded())
    per_pixel = pipeline.decompose(image, mask, generator=seeded(), material="map")
    inside = mask[..., 0] > 0
    assert np.ptp(get(scalar.intrinsics, "roughness")[inside]) < 1e-6
    assert np.ptp(get(per_pixel.intrinsics, "roughness")[inside]) > 1e-3
    assert scalar.roughness == pytest.approx(per_pixel.roughness, abs=1e-5)


def test_the_commands_have_every_setting_of_a_decomposition() -> None:
    assert asdict(DecompositionOptions()) == TAKING_APART


def test_seed_decides(pipeline: UniRenderPipeline) -> None:
    image, mask = picture()
    first, again, other = (pipeline.decompose(image, mask, generator=seeded(s)).intrinsics for s in (0, 0, 1))
    assert np.array_equal(get(first, "albedo"), get(again, "albedo"))
    assert not np.array_equal(get(first, "albedo"), get(other, "albedo"))


def test_samples_have_a_mean_and_a_spread(pipeline: UniRenderPipeline) -> None:
    image, mask = picture()
    sampling: dict[str, Any] = {"mode": "sample", "num_inference_steps": 2, "generator": seeded()}
    result = pipeline.decompose(image, mask, num_samples=3, **sampling)
    assert result.std is not None
    assert len(result.samples) == 3
    albedos = np.stack([get(s, "albedo") for s in result.samples])
    np.testing.assert_allclose(get(result.intrinsics, "albedo"), albedos.mean(axis=0), atol=1e-6)
    np.testing.assert_allclose(result.std["albedo"], albedos.std(axis=0), atol=1e-6)
    sampling["generator"] = seeded()
    alone = pipeline.decompose(image, mask, num_samples=1, **sampling)
    np.testing.assert_allclose(get(alone.intrinsics, "albedo"), albedos[0], atol=1e-5)  # whatever the batch


def test_each_sample_is_closed_with_the_same_noise(pipeline: UniRenderPipeline) -> None:
    image, mask = picture()
    sampling: dict[str, Any] = {"mode": "sample", "num_inference_steps": 2, "num_samples": 2}
    closed, plain = (
        pipeline.decompose(image, mask, generator=seeded(), closed=on, **sampling).samples for on in (True, False)
    )
    for sample, own in zip(closed, plain, strict=True):
        again = close_decomposition(own, srgb_decode(image) * mask, pipeline.render(own))
        np.testing.assert_allclose(get(sample, "albedo"), get(again, "albedo"), rtol=0, atol=1e-5)


def test_light_beyond_the_networks_range_is_kept_counted_and_reported_once(caplog: pytest.LogCaptureFixture) -> None:
    pipeline, given = make_pipeline(), scene()
    assert pipeline.overflow(given) == {}
    pipeline.render(given)
    assert not caplog.records
    specular = get(given, "specular").copy()
    specular[16, 16] = 25.0
    bright = given.replace(specular=specular)
    over = pipeline.overflow(bright)
    assert set(over) == {"specular"}
    assert (over["specular"].count, over["specular"].x_max) == (3, 20.0)
    assert over["specular"].share == pytest.approx(3 / specular.size)
    images = [pipeline.render(x) for x in (bright, bright, given.replace(specular=np.minimum(specular, 20)))]
    assert [record.getMessage().split(":")[0] for record in caplog.records] == ["specular"]
    assert np.array_equal(images[0], images[1])
    assert not np.array_equal(images[0], images[2])  # not clipped
    light = np.full((64, 128, 3), 0.5, dtype=np.float32)
    light[20:28, 40:52] = 1e4  # a sun, counted at the size at which the network sees it
    assert set(pipeline.overflow(given.replace(environment=light))) == {"environment"}


def test_pil_pictures_bring_their_alpha(pipeline: UniRenderPipeline) -> None:
    image, mask = picture()
    rgba = np.concatenate([image, mask], axis=-1)
    pil = Image.fromarray((255 * rgba + 0.5).astype(np.uint8), "RGBA")
    result = pipeline(pil, generator=seeded())
    np.testing.assert_allclose(get(result.intrinsics, "mask"), mask)
    opaque = pipeline(pil.convert("RGB"), generator=seeded())
    assert opaque.intrinsics.mask is not None
    assert opaque.intrinsics.mask.min() == 1


def test_untrained_prior_renders_the_split_sum() -> None:
    """With the image stream's last convolution at zero the render is the closed form."""
    pipeline = make_pipeline()
    for p in pipeline.dual_stream.image_unet.conv_out.parameters():
        torch.nn.init.zeros_(p)
    given = scene()
    np.testing.assert_allclose(
        image_srgb(pipeline.render(given)), image_srgb(split_sum_image(given)), rtol=0, atol=1e-4
    )
    large = scene(80)
    np.testing.assert_allclose(
        image_srgb(pipeline.render(large)), image_srgb(split_sum_image(large)), rtol=0, atol=1e-4
    )


@pytest.mark.parametrize("size", [SIZE, 75])
def test_render_any_size(pipeline: UniRenderPipeline, size: int) -> None:
    image = pipeline.render(scene(size), generator=seeded())
    assert image.shape == (size, size, 3)
    assert image.min() >= 0
    assert image.max() <= 1


def test_missing_light_is_derived_or_left_to_the_model(pipeline: UniRenderPipeline) -> None:
    given = scene()
    derived = pipeline.render(given.replace(specular=None, diffuse=None), generator=seeded())
    free = pipeline.render(given.replace(specular=None, diffuse=None, environment=None), generator=seeded())
    without_albedo = pipeline.render(given.replace(albedo=None), generator=seeded())
    assert not np.allclose(derived, free)
    assert np.isfinite(without_albedo).all()
    with pytest.raises(UnirenderError, match="normal missing"):
        pipeline.render(given.replace(normal=None))


def test_the_light_of_a_closed_decomposition_agrees_with_it_and_edits_keep_the_networks() -> None:
    image, mask = example()
    pipeline = UniRenderPipeline.from_pretrained()
    closed, plain = (pipeline.decompose(image, mask, closed=on) for on in (True, False))
    assert plain.network_light is None
    assert plain.with_network_light is plain.intrinsics
    assert closed.network_light is not None
    np.testing.assert_allclose(closed.network_light, get(plain.intrinsics, "environment"), rtol=0, atol=1e-5)
    assert closed.with_network_light.environment is closed.network_light
    d = get(closed.intrinsics, "diffuse")
    ratio = {
        name: float(derived_diffuse(closed.intrinsics, light).sum() / d.sum())
        for name, light in (("own", get(closed.intrinsics, "environment")), ("network", closed.network_light))
    }
    assert 0.85 < ratio["own"] < 1.1, ratio
    assert ratio["network"] < 0.8, ratio  # the twin: a mean in log radiance is too dark
    own = closed.intrinsics.replace(environment=2 * get(closed.intrinsics, "environment"))
    given = replace(closed, intrinsics=own)
    assert given.with_network_light is own  # a light that somebody puts there counts
    first, second = (pipeline.edit(image, mask, metallic=1.0, decomposition=found) for found in (closed, given))
    assert np.array_equal(get(first.intrinsics, "environment"), get(closed.intrinsics, "environment"))
    assert 0 < np.abs(first.image_linear - second.image_linear).max() < 0.05  # what the network is told, little by much


def test_edit_changes_what_was_asked_for(pipeline: UniRenderPipeline) -> None:
    image, mask = picture(48, 40)
    base = pipeline.decompose(image, mask, generator=seeded())
    result = pipeline.edit(image, mask, metallic=1.0, decomposition=base, generator=seeded())
    edited, before = result.intrinsics, base.intrinsics
    assert result.image_linear.shape == (48, 40, 3)
    assert get(edited, "metallic")[mask > 0].min() == 1
    for name in ("albedo", "normal", "roughness", "specular", "diffuse", "environment"):
        assert np.array_equal(getattr(edited, name), getattr(before, name)), name
    rougher = pipeline.edit(image, mask, roughness=0.9, decomposition=base, generator=seeded())
    assert not np.array_equal(get(rougher.intrinsics, "specular"), get(before, "specular"))


def test_anchored_edit_without_a_change_is_the_input(pipeline: UniRenderPipeline) -> None:
    image, mask = picture()
    base = pipeline.decompose(image, mask, generator=seeded(), material="map")
    same = pipeline.edit(image, mask, metallic=get(base.intrinsics, "metallic"), decomposition=base, generator=seeded())
    np.testing.assert_allclose(same.image_linear, srgb_decode(image) * mask, rtol=0, atol=1e-6)
    plain = pipeline.edit(
        image, mask, metallic=get(base.intrinsics, "metallic"), decomposition=base, anchored=False, generator=seeded()
    )
    assert np.abs(plain.image_linear - same.image_linear).max() > 1e-2  # the twin


def test_relight_takes_any_light(pipeline: UniRenderPipeline) -> None:
    image, mask = picture()
    base = pipeline.decompose(image, mask, generator=seeded())
    light = np.random.default_rng(0).uniform(0, 3, (40, 80, 3)).astype(np.float32)
    kept = pipeline.relight(image, light, mask, exposure="keep", decomposition=base)
    assert kept.intrinsics.environment is not None
    assert kept.intrinsics.environment.shape == (40, 80, 3)
    auto, brighter = (pipeline.relight(image, k * light, mask, decomposition=base) for k in (1.0, 5.0))
    np.testing.assert_allclose(
        get(auto.intrinsics, "diffuse"), get(brighter.intrinsics, "diffuse"), rtol=1e-4, atol=1e-6
    )
    target = 0.3 * mask.repeat(3, axis=-1)
    given = pipeline.relight(image, None, mask, specular=target, diffuse=target, decomposition=base)
    assert np.array_equal(get(given.intrinsics, "diffuse"), target)


def test_relight_by_the_light_that_was_found_gives_the_light_of_the_decomposition(pipeline: UniRenderPipeline) -> None:
    image, mask = picture()
    found = pipeline.decompose(image, mask, generator=seeded())
    own = get(found.intrinsics, "environment")
    relit = pipeline.relight(image, own, mask, exposure="keep", decomposition=found).intrinsics
    bare = under_light(found.with_network_light, own, "keep", mirrors=False)
    for name in ("specular", "diffuse"):
        new, old = (np.abs(get(maps, name) - get(found.intrinsics, name)).mean() for maps in (relit, bare))
        assert new < 0.7 * old
    unknown = replace(found, intrinsics=found.intrinsics.replace(specular=None, environment=None))
    assert pipeline.relight(image, own, mask, decomposition=unknown, anchored=False).image_linear.shape == image.shape


def test_anchor_closed_forms() -> None:
    shape = (1, 1, 3)
    image, before, after = (np.full(shape, v, dtype=np.float32) for v in (0.4, 0.5, 0.25))
    exact = 0.4 + (0.42 / 0.52) * (0.25 - 0.5)
    np.testing.assert_allclose(anchor(image, before, after), exact, rtol=1e-5)
    dark = np.zeros(shape, dtype=np.float32)  # bounded: the difference form with at most twice the gain
    np.testing.assert_allclose(anchor(image, dark, after), 0.4 + 2 * 0.25, rtol=1e-5)
    assert anchor(dark, before, dark).min() >= 0


def test_specular_for_the_same_roughness_is_unchanged_and_constant_light_stays_constant() -> None:
    given = scene()
    roughness = get(given, "roughness")
    same, held = specular_for_roughness(given, roughness)
    np.testing.assert_allclose(same, get(given, "specular"), rtol=1e-5)
    assert held == 0
    mask = get(given, "mask")
    light = np.ones((16, 32, 3), dtype=np.float32)
    uniform = given.replace(environment=light, specular=derived_specular(given, light))
    for target in (0.2, 0.9):
        new = derived_specular(uniform.replace(roughness=constant_map(target, mask)), light)
        old = get(uniform, "specular")
        changed, _ = specular_for_roughness(uniform, constant_map(target, mask))
        middle = (slice(12, 20), slice(12, 20))
        believed = trust(roughness, constant_map(target, mask), specular_share(uniform))
        expected = old * ((new + LOBE_FLOOR) / (old + LOBE_FLOOR)) ** believed
        np.testing.assert_allclose(changed[middle], expected[middle], rtol=0.01)


def test_a_wider_lobe_is_trusted_whatever_shows_of_s() -> None:
    """That it reflects less is known of every light."""
    old = np.full((1, 1, 1), 0.5, dtype=np.float32)
    assert trust(old, old, 1.0).item() == 0
    for share in (0.0, 0.3, 1.0):
        assert 0.8 < trust(old, old + 0.4, share).item() < 1
        np.testing.assert_allclose(trust(old, old + SMALL_CHANGE, share).item(), 0.5 * TRUST_WIDER, rtol=1e-5)


def test_a_sharper_lobe_is_trusted_less_the_sharper_it_is_and_the_less_shows_of_s() -> None:
    old = np.full((1, 1, 1), 0.95, dtype=np.float32)
    believed = {
        (new, share): trust(old, np.full_like(old, new), share).item()
        for new in (0.1, 0.3, 0.5)
        for share in (0.0, 0.2, 0.4)
    }
    for new in (0.1, 0.3, 0.5):
        assert believed[new, 0.0] == 0
        assert believed[new, 0.4] > 1.9 * believed[new, 0.2] > 0
    assert 1.9 * believed[0.1, 0.4] < believed[0.3, 0.4] < believed[0.5, 0.4] < 1
    assert trust(old, np.full_like(old, 0.5), 1.0).item() <= 1


def test_the_share_of_s_is_that_of_the_composite() -> None:
    one = np.ones((2, 2, 1), dtype=np.float32)
    gray = Intrinsics(
        albedo=0.5 * np.ones((2, 2, 3), np.float32),
        metallic=0.2 * one,
        specular=np.full((2, 2, 3), 2, np.float32),
        diffuse=np.ones((2, 2, 3), np.float32),
        mask=one,
    )
    lit, reflected = 0.8 * 0.5 * 1, (0.04 * 0.8 + 0.5 * 0.2) * 2
    np.testing.assert_allclose(specular_share(gray), reflected / (lit + reflected), rtol=1e-5)
    assert specular_share(gray.replace(metallic=one)) == 1
    assert specular_share(gray.replace(albedo=0 * gray.require("albedo")["albedo"], metallic=one)) == 0


@pytest.mark.parametrize("size", [(32, 32), (48, 20), (33, 65)])
def test_frame_keeps_constants_and_rays(size: tuple[int, int]) -> None:
    frame = Frame(*size, SIZE)
    mask = picture(*size)[1]
    value = 0.7 * (mask > 0)
    there = frame.enter_map(value.astype(np.float32), mask)
    np.testing.assert_allclose(there[frame.enter(mask) > 1e-2], 0.7, rtol=1e-4)
    back = frame.leave_map(there, mask)
    np.testing.assert_allclose(back[frame.leave(frame.enter(mask)) * mask > 1e-2], 0.7, rtol=1e-3)
    camera = Camera()
    padded = frame.camera(camera).rays(frame.side, frame.side)
    top, left = frame.corner
    inner = padded[-top : size[0] - top, -left : size[1] - left]
    np.testing.assert_allclose(inner, camera.rays(*size), rtol=0, atol=1e-5)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"image_srgb": np.zeros((32, 32), dtype=np.float32)}, r"expected \[height, width, 3\]"),
        ({"image_srgb": np.zeros((32, 32, 3), dtype=np.uint8)}, "divide by 255"),
        ({"image_srgb": np.full((32, 32, 3), np.nan, dtype=np.float32)}, "NaN"),
        ({"image_srgb": np.full((32, 32, 3), 7.0, dtype=np.float32)}, r"expected \[0, 1\]"),
        ({"image_srgb": np.zeros((4, 4, 3), dtype=np.float32)}, "at least 8"),
        ({"mask": np.zeros((32, 32, 1), dtype=np.float32)}, "no pixel is covered"),
        ({"mask": np.ones((16, 32, 1), dtype=np.float32)}, "size of the picture"),
        ({"mode": "mean", "num_samples": 3}, "gives 1 sample"),
        ({"mode": "fast"}, "'sample'"),
        ({"material": "texture"}, "'scalar' or 'map'"),
        ({"sampler": "unipc"}, "takes one step and no sampler"),
    ],
)
def test_bad_input_is_refused_with_a_reason(pipeline: UniRenderPipeline, change: dict, words: str) -> None:
    image, mask = picture()
    arguments: dict[str, Any] = {"image_srgb": image, "mask": mask} | change
    with pytest.raises(UnirenderError, match=words):
        pipeline.decompose(**arguments)


def test_bad_edits_are_refused(pipeline: UniRenderPipeline) -> None:
    image, mask = picture()
    with pytest.raises(UnirenderError, match="nothing to change"):
        pipeline.edit(image, mask)
    with pytest.raises(UnirenderError, match=r"expected \[0, 1\]"):
        pipeline.edit(image, mask, roughness=1.5)
    with pytest.raises(UnirenderError, match="no light"):
        pipeline.relight(image, None, mask)
    with pytest.raises(UnirenderError, match="the light is black"):
        pipeline.relight(image, np.zeros((4, 8, 3), dtype=np.float32), mask)


def test_diffusers_conventions(pipeline: UniRenderPipeline, tmp_path: Path) -> None:
    pipeline.save_pretrained(tmp_path)
    assert not list(tmp_path.rglob("*.bin"))
    loaded = UniRenderPipeline.from_pretrained(tmp_path)
    loaded.set_progress_bar_config(disable=True)
    weights = [p for p in loaded.dual_stream.parameters() if p.ndim == 4]
    assert weights
    assert all(p.is_contiguous(memory_format=torch.channels_last) for p in weights)
    loaded.save_pretrained(tmp_path / "again")
    again = UniRenderPipeline.from_pretrained(tmp_path / "again")
    for p, q in zip(weights, (q for q in again.dual_stream.parameters() if q.ndim == 4), strict=True):
        assert torch.equal(p, q)
    image, mask = picture()
    first, second = (p.decompose(image, mask, generator=seeded()).intrinsics for p in (pipeline, loaded))
    np.testing.assert_allclose(get(first, "albedo"), get(second, "albedo"), atol=1e-5)
    half = UniRenderPipeline.from_pretrained(tmp_path, torch_dtype=torch.bfloat16).to("cpu")
    assert half.dtype == torch.bfloat16
    rough = half.decompose(image, mask, generator=seeded()).intrinsics
    assert np.abs(get(rough, "albedo") - get(first, "albedo")).mean() < 0.05
    with pytest.raises(UnirenderError, match="no pipeline folder"):
        UniRenderPipeline.from_pretrained(tmp_path / "missing")
    with pytest.raises(AttributeError, match="no attribute UniRenderPipeline"):  # docs/model.md says so
        DiffusionPipeline.from_pretrained(tmp_path)
    part = DualStreamModel.from_pretrained(tmp_path, subfolder="dual_stream")
    assert all(torch.equal(p, q) for p, q in zip(part.parameters(), pipeline.dual_stream.parameters(), strict=True))


def test_a_pipeline_of_anothers_components_is_the_same() -> None:
    pipeline = make_pipeline()
    pipeline.register_to_config(material="map", calibration={"roughness": [0.5, 0.3]})
    image, mask = picture()
    expected = get(pipeline.decompose(image, mask).intrinsics, "roughness")
    for again in (UniRenderPipeline(**pipeline.components), UniRenderPipeline.from_pipe(pipeline)):
        again.set_progress_bar_config(disable=True)
        np.testing.assert_array_equal(get(again.decompose(image, mask).intrinsics, "roughness"), expected)


def test_a_network_that_is_exchanged_is_asked_as_in_its_own_pipeline() -> None:
    pipeline, other = make_pipeline(), make_pipeline(1, resolution=2 * SIZE, physics_prior="none", derived_light=True)
    pipeline.dual_stream = other.dual_stream
    image, mask = picture(2 * SIZE, 2 * SIZE)
    first, second = (p.edit(image, mask, roughness=0.8) for p in (pipeline, other))
    np.testing.assert_array_equal(first.image_linear, second.image_linear)


def test_offloaded_weights_give_the_same(pipeline: UniRenderPipeline, monkeypatch: pytest.MonkeyPatch) -> None:
    # accelerate makes an output anew, from a dict
    monkeypatch.setattr(DualStreamOutput, "__init__", inspect.unwrap(DualStreamOutput.__init__))
    offloaded = make_pipeline()
    cpu_offload(offloaded.dual_stream, torch.device("cpu"))  # what `enable_sequential_cpu_offload` does
    assert offloaded.device.type == "meta"
    image, mask = picture()
    first, second = (p.edit(image, mask, roughness=0.8) for p in (pipeline, offloaded))
    np.testing.assert_array_equal(second.image_linear, first.image_linear)
    np.testing.assert_array_equal(pipeline.render(scene()), offloaded.render(scene()))


def test_the_folder_of_a_run_names_its_pipeline(tmp_path: Path) -> None:
    make_pipeline().save_pretrained(tmp_path / "pipeline")
    with pytest.raises(UnirenderError, match=r"folder of a training run; its pipeline is .*pipeline"):
        UniRenderPipeline.from_pretrained(tmp_path)


def test_more_steps_than_timesteps_are_refused() -> None:
    assert MOST_STEPS < NUM_TIMESTEPS
    with pytest.raises(UnirenderError, match="num_inference_steps: got 501, expected 1 to 500"):
        make_pipeline().decompose(*picture(), mode="sample", num_inference_steps=MOST_STEPS + 1)
