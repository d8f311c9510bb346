"""Tiles: they cover, their cameras keep the rays, what is local comes back exactly, and no seam shows."""

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
import torch
from tiny_models import SIZE, counted_rows, make_pipeline

from unirender.camera import Camera
from unirender.command_line.remarks import frame_remarks
from unirender.intrinsics import Intrinsics
from unirender.pipelines.framing import Frame
from unirender.pipelines.masked_maps import divide, unit_normal
from unirender.pipelines.tiling import TILED, TILES_AT_ONCE, add_detail, blend_tiles, tiles, tiles_of, window

TILE = 16
SIZES = [(37, 91), (75, 50), (64, 64), (9, 40)]


def picture(height: int, width: int) -> tuple[np.ndarray, np.ndarray]:
    """A premultiplied picture with detail at every scale, and an ellipse as its mask, one pixel soft."""
    rng = np.random.default_rng(0)
    y, x = np.mgrid[0:height, 0:width]
    radius = np.hypot((x + 0.5 - width / 2) / (0.45 * width), (y + 0.5 - height / 2) / (0.45 * height))
    mask = np.clip((1 - radius) * min(height, width) / 2 + 0.5, 0, 1)[..., None].astype(np.float32)
    image = np.clip(0.5 + 0.3 * np.sin(x / 7 + y / 5)[..., None] + rng.uniform(-0.2, 0.2, (height, width, 3)), 0, 1)
    return (image * mask).astype(np.float32), mask


def local_maps(image: np.ndarray, mask: np.ndarray) -> dict[str, np.ndarray]:
    """A network without any context: each map is the colour of the pixel itself."""
    colour = divide(image, mask)
    return {"albedo": colour, "normal": np.concatenate([colour[..., :2] - 0.5, np.ones_like(mask)], axis=-1)}


def predict_locally(images: Sequence[Any], masks: Sequence[Any], cameras: Sequence[Camera]) -> list:
    assert len(images) == len(masks) == len(cameras)
    return [[local_maps(image, mask)] for image, mask in zip(images, masks, strict=True)]


@pytest.mark.parametrize("size", SIZES)
def test_tiles_cover_every_pixel_and_overlap_by_half(size: tuple[int, int]) -> None:
    found = list(tiles(*size, TILE))
    count = np.zeros(size, dtype=int)
    for tile in found:
        assert tile.top >= 0
        assert tile.left >= 0
        count[tile.slices] += 1
    assert count.min() >= 1
    for starts, length in ((sorted({t.top for t in found}), size[0]), (sorted({t.left for t in found}), size[1])):
        assert starts[-1] == max(0, length - TILE)
        assert all(b - a <= TILE // 2 for a, b in pairwise(starts))


def test_the_camera_of_a_tile_keeps_the_rays() -> None:
    height, width, camera = 37, 91, Camera(fov_deg=50, principal=(0.4, 0.7))
    rays = camera.rays(height, width)
    for tile in tiles(height, width, TILE):
        own = tile.camera(camera, height, width).rays(TILE, TILE)
        np.testing.assert_allclose(own, tile.crop(rays), rtol=0, atol=1e-5)
    first = next(tiles(height, width, TILE))
    assert np.abs(Camera(fov_deg=50).rays(TILE, TILE) - first.crop(rays)).max() > 0.1  # the twin


def test_a_tile_larger_than_the_picture_is_padded() -> None:
    image, _ = picture(9, 40)
    tile = next(tiles(9, 40, TILE))
    cropped = tile.crop(image)
    assert cropped.shape == (TILE, TILE, 3)
    assert np.array_equal(cropped[:9], image[:, :TILE])
    assert not cropped[9:].any()


@pytest.mark.parametrize("size", SIZES)
def test_what_is_local_is_exact(size: tuple[int, int]) -> None:
    """The pass over the whole picture loses the detail; the tiles bring it back, whatever their windows."""
    image, mask = picture(*size)
    camera, frame, batches = Camera(), Frame(*size, TILE), list[int]()

    def predict(images: Sequence[Any], masks: Sequence[Any], cameras: Sequence[Camera]) -> list:
        batches.append(len(images))
        return predict_locally(images, masks, cameras)

    (blended,) = blend_tiles(image, mask, camera, TILE, predict)
    assert sum(batches) == len(tiles_of(mask, TILE)), "each tile once"
    assert max(batches) <= TILES_AT_ONCE
    truth = local_maps(image, mask)
    inside = mask[..., 0] > 1e-2
    for name in TILED:
        np.testing.assert_allclose(blended[name][inside], truth[name][inside], rtol=0, atol=1e-5)
    coarse = local_maps(frame.enter(image), frame.enter(mask))
    maps: dict[str, Any] = {name: frame.leave_map(value, mask) for name, value in coarse.items()}
    whole = Intrinsics(mask=mask, albedo=maps["albedo"], normal=unit_normal(maps["normal"]))
    detailed = add_detail(whole, blended, frame).require("albedo", "normal")
    longer = add_detail(whole, blended | {"normal": 2 * blended["normal"]}, frame).require("normal")["normal"]
    np.testing.assert_allclose(longer, detailed["normal"], atol=1e-5)  # of a normal the direction counts
    np.testing.assert_allclose(detailed["albedo"][inside], truth["albedo"][inside], rtol=0, atol=1e-4)
    assert np.abs(maps["albedo"] - truth["albedo"])[inside].mean() > 0.02  # the twin: without tiles
    assert not detailed["albedo"][mask[..., 0] == 0].any()
    normal = unit_normal(truth["normal"])
    angle = np.degrees(np.arccos(np.clip((detailed["normal"] * normal).sum(axis=-1)[inside], -1, 1)))
    assert angle.mean() < 3  # unit vectors: their mean is no unit vector
    before = np.degrees(np.arccos(np.clip((unit_normal(maps["normal"]) * normal).sum(axis=-1)[inside], -1, 1)))
    assert angle.mean() < 0.6 * before.mean()


def biased(images: Sequence[Any], masks: Sequence[Any], cameras: Sequence[Camera]) -> list:
    """A network that is wrong by another amount in each tile, and worst along the tile's border."""
    axis = np.abs(np.arange(TILE) - (TILE - 1) / 2) / (TILE / 2)
    border = np.maximum(axis[:, None], axis)[..., None].astype(np.float32)
    found = []
    for mask, camera in zip(masks, cameras, strict=True):
        bias = 0.2 * np.sin(9 * camera.principal[0] + 5 * camera.principal[1]) * (1 + border)
        flat = np.broadcast_to(0.5 + bias, (*mask.shape[:2], 3)).astype(np.float32)
        found.append([{"albedo": flat, "normal": flat}])
    return found


def test_no_seams() -> None:
    """Along the tiles' borders the blend changes no more than elsewhere; tiles laid side by side do."""
    height, width = 64, 80
    image, mask = np.full((height, width, 3), 0.5, np.float32), np.ones((height, width, 1), np.float32)
    (blended,) = blend_tiles(image, mask, Camera(), TILE, biased)
    pasted = np.zeros((height, width, 3), np.float32)
    for tile in tiles(height, width, TILE):
        ((maps,),) = biased([image], [tile.crop(mask)], [tile.camera(Camera(), height, width)])
        pasted[tile.slices] = maps["albedo"]
    starts = sorted({tile.left for tile in tiles(height, width, TILE)})
    borders = np.array([x - 1 for start in starts for x in (start, start + TILE) if 0 < x < width])
    steps = {
        name: np.abs(np.diff(value, axis=1)).mean(axis=(0, 2))
        for name, value in (("blended", blended["albedo"]), ("pasted", pasted))
    }
    between = np.setdiff1d(np.arange(width - 1), borders)
    assert steps["blended"][borders].max() <= steps["blended"][between].max()
    assert steps["pasted"][borders].max() > 2 * steps["blended"].max()  # the twin


def test_the_window_fades_at_its_border() -> None:
    weight = window(TILE)
    assert weight.shape == (TILE, TILE, 1)
    assert weight.min() > 0
    assert weight[0].max() < 0.02
    assert np.array_equal(weight, weight[::-1, ::-1])


@pytest.mark.parametrize("size", [(37, 91), (SIZE, SIZE), (20, 30)])
def test_the_pipeline_gives_tiles_of_any_picture(size: tuple[int, int]) -> None:
    pipeline = make_pipeline()
    image, mask = picture(*size)
    maps: dict[str, Any] = {"image_srgb": divide(image, mask), "mask": mask, "closed": False}
    plain, tiled = (pipeline.decompose(**maps, tile=tile).intrinsics for tile in (False, True))
    assert (tiled.height, tiled.width) == size
    for name, value in tiled.maps.items():
        same = np.array_equal(value, plain.maps[name])
        assert same == (name not in TILED or max(size) <= SIZE), name
    outside = mask[..., 0] == 0
    assert not tiled.require("albedo")["albedo"][outside].any()
    np.testing.assert_allclose(np.linalg.norm(tiled.require("normal")["normal"], axis=-1)[~outside], 1, atol=1e-4)


def test_tiles_of_samples_follow_the_seed_whatever_the_batch() -> None:
    pipeline = make_pipeline()
    pictures = [picture(*size) for size in ((37, 50), (64, 40))]
    images, masks = [divide(*p) for p in pictures], [p[1] for p in pictures]
    settings: dict[str, Any] = {"mode": "sample", "num_inference_steps": 2, "num_samples": 2, "tile": True}
    settings["closed"] = False
    both = pipeline.decompose_batch(images, masks, generator=[seeded(0), seeded(1)], **settings)
    alone = pipeline.decompose(images[1], masks[1], generator=seeded(1), **settings)
    for name in TILED:
        np.testing.assert_allclose(
            both[1].intrinsics.maps[name], alone.intrinsics.maps[name], rtol=0, atol=2e-3, err_msg=name
        )
    other = pipeline.decompose(images[1], masks[1], generator=seeded(0), **settings)
    assert np.abs(other.intrinsics.maps["albedo"] - alone.intrinsics.maps["albedo"]).max() > 2e-2


def seeded(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def test_tiles_without_the_object_are_not_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    pipeline = make_pipeline()
    rows = counted_rows(monkeypatch)
    image = np.full((4 * SIZE, 4 * SIZE, 3), 0.5, dtype=np.float32)
    mask = np.zeros((4 * SIZE, 4 * SIZE, 1), dtype=np.float32)
    mask[:SIZE, :SIZE] = 1
    pipeline.decompose(image, mask, tile=True, closed=False)
    assert rows == [1, 4]  # the whole picture; and of 49 tiles those that see the corner


def test_many_tiles_are_told() -> None:
    mask = np.zeros((800, 1000, 1), np.float32)
    mask[:, :500] = 1
    count = len(tiles_of(mask, 32))
    assert count == len([tile for tile in tiles(800, 1000, 32) if tile.left < 500])
    assert frame_remarks(mask, 32, tile=True)["tile"].startswith(f"--tile: {count} tiles of 32 pixels")
    assert not frame_remarks(mask, 32, tile=False)
    assert not frame_remarks(mask[:200], 32, tile=True)
    whole = np.ones((33, 32, 1), np.float32)
    assert "adds nothing" in frame_remarks(whole[:32], 32, tile=True)["tile"]  # of the network's own size
    assert not frame_remarks(whole, 32, tile=True)
