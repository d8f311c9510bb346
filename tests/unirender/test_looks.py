"""Looks at a picture: each can be undone, their mean keeps what a network predicts alike for all, and the pipeline's is
the mean of what it says of each."""

import numpy as np
import pytest
import torch
from tiny_models import SIZE, make_pipeline

from unirender.camera import Camera
from unirender.color import image_srgb
from unirender.errors import UnirenderError
from unirender.models.packing import Packing
from unirender.pipelines.looks import AS_IT_IS, LOOKS, MATERIAL, check_looks, mean_of_looks
from unirender.pipelines.unirender_pipeline import UniRenderPipeline

COLOURS = ("albedo", "specular", "diffuse", "environment")


@pytest.fixture(scope="module")
def pipeline() -> UniRenderPipeline:
    return make_pipeline()


@pytest.fixture
def packing(pipeline: UniRenderPipeline) -> Packing:
    return pipeline.conditioning.packing


def predicted(packing: Packing, seed: int = 0) -> dict[str, np.ndarray]:
    """Maps as a network gives them."""
    rng = np.random.default_rng(seed)
    channels = {name: 3 for name in (*COLOURS, "normal")} | {name: 1 for name in (*MATERIAL, "mask")}
    sizes = {name: (SIZE, SIZE) for name in channels} | {"environment": packing.environment_size}
    maps = {name: rng.uniform(0.05, 0.95, (*sizes[name], n)).astype(np.float32) for name, n in channels.items()}
    return maps | {"normal": maps["normal"] * 2 - 1}


def seeded(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def picture() -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(1)
    mask = np.zeros((SIZE, SIZE, 1), np.float32)
    mask[4:-6, 3:-9] = 1
    return rng.uniform(0.1, 0.9, (SIZE, SIZE, 3)).astype(np.float32), mask


@pytest.mark.parametrize("look", LOOKS)
def test_a_look_is_undone(look, packing):
    maps = predicted(packing)
    seen = look.of(maps)
    assert all(np.array_equal(look.undo(seen)[name], maps[name]) for name in maps)
    camera = Camera(40.0, (0.25, 0.5))
    assert look.camera(look.camera(camera)) == camera
    assert look.camera(camera).principal[0] == pytest.approx(0.75 if look.mirrored else 0.25)


def test_all_looks_differ_and_the_first_is_the_picture(packing):
    maps = predicted(packing)
    assert all(np.array_equal(LOOKS[0].of(maps)[name], maps[name]) for name in maps)
    assert len({look.of(maps)["albedo"].tobytes() for look in LOOKS}) == len(LOOKS) == 12


@pytest.mark.parametrize("count", [1, 2, 5, 12])
def test_what_is_predicted_alike_for_all_looks_stays(count, packing):
    maps = predicted(packing)
    mean = mean_of_looks([look.of(maps) for look in LOOKS[:count]], packing)
    assert set(mean) == set(maps)
    for name in maps:
        np.testing.assert_allclose(mean[name], maps[name], rtol=2e-5, atol=1e-6, err_msg=name)


def test_materials_are_the_mean_of_all_and_colours_of_those_in_order(packing):
    found = [predicted(packing, seed) for seed in range(4)]
    mean = mean_of_looks(found, packing)
    own = [look.undo(maps) for look, maps in zip(LOOKS, found, strict=False)]
    for name in MATERIAL:
        np.testing.assert_allclose(mean[name], np.mean([maps[name] for maps in own], axis=0), atol=1e-6)
    in_order = [maps for look, maps in zip(LOOKS, own, strict=False) if look.order == AS_IT_IS]
    assert len(in_order) == 2
    np.testing.assert_allclose(mean["normal"], np.mean([maps["normal"] for maps in in_order], axis=0), atol=1e-6)
    display = np.mean([image_srgb(maps["albedo"]) for maps in in_order], axis=0)
    np.testing.assert_allclose(image_srgb(mean["albedo"]), display, atol=1e-5)
    curve = packing.curves["environment"]
    encoded = np.mean([curve.encode(maps["environment"]) for maps in in_order], axis=0)
    np.testing.assert_allclose(curve.encode(mean["environment"]), encoded, atol=1e-5)


def test_two_looks_are_the_mean_of_the_picture_and_its_mirror_image(pipeline):
    image, mask = picture()
    camera, drawn = Camera(36.0, (0.4, 0.5)), seeded()
    options = {"closed": False, "material": "map"}
    both = pipeline.decompose(image, mask, camera=camera, looks=2, generator=seeded(), **options).intrinsics
    first = pipeline.decompose(image, mask, camera=camera, generator=drawn, **options).intrinsics
    other = Camera(36.0, (0.6, 0.5))
    flipped = pipeline.decompose(image[:, ::-1], mask[:, ::-1], camera=other, generator=drawn, **options).intrinsics
    for name in MATERIAL:
        mean = (getattr(first, name) + getattr(flipped, name)[:, ::-1]) / 2
        np.testing.assert_allclose(getattr(both, name), mean, atol=1e-5)
    albedo = (image_srgb(first.albedo) + image_srgb(flipped.albedo[:, ::-1])) / 2
    np.testing.assert_allclose(image_srgb(both.albedo), albedo, atol=1e-5)
    assert not np.allclose(both.albedo, first.albedo, atol=1e-3)


def test_a_batch_gives_each_picture_what_it_gets_alone(pipeline):
    image, mask = picture()
    pictures, masks = [image, 1 - image, image[:, ::-1]], [mask, mask, mask[:, ::-1]]
    batch = pipeline.decompose_batch(pictures, masks, looks=3)
    for found, own, cover in zip(batch, pictures, masks, strict=True):
        alone = pipeline.decompose(own, cover, looks=3)
        np.testing.assert_allclose(found.intrinsics.albedo, alone.intrinsics.albedo, atol=1e-4)
        assert found.roughness == pytest.approx(alone.roughness, abs=1e-5)


def test_an_edit_takes_looks_and_tiles_have_one(pipeline):
    image, mask = picture()
    edited = pipeline.edit(image, mask, roughness=0.2, looks=2)
    at_hand = pipeline.decompose(image, mask, looks=2)
    assert np.array_equal(edited.decomposition.intrinsics.albedo, at_hand.intrinsics.albedo)
    wide = np.repeat(np.repeat(image, 2, axis=0), 2, axis=1), np.repeat(np.repeat(mask, 2, axis=0), 2, axis=1)
    assert np.isfinite(pipeline.decompose(*wide, looks=2, tile=True).intrinsics.albedo).all()
    with pytest.raises(UnirenderError, match="looks: got 3 beside a decomposition"):
        pipeline.edit(image, mask, roughness=0.2, looks=3, decomposition=at_hand)


@pytest.mark.parametrize("looks", [0, 13, -1, 2.0, True, "6", None])
def test_another_number_of_looks_is_refused(looks):
    with pytest.raises(UnirenderError, match=r"looks: got .*, expected a whole number from 1 to 12"):
        check_looks(looks, "mean")


def test_samples_have_one_look_each(pipeline):
    with pytest.raises(UnirenderError, match="looks: got 2 in mode sample"):
        pipeline.decompose(*picture(), looks=2, mode="sample")
    with pytest.raises(UnirenderError, match="looks: got 13"):
        pipeline.decompose_batch([picture()[0]], looks=13)
