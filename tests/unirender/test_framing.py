"""How a picture of any size comes into the network's square: small objects are cut out."""

import math
import tracemalloc
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from tiny_models import make_pipeline

from unirender import blocks
from unirender.camera import Camera
from unirender.intrinsics import Intrinsics
from unirender.light.environment import mean_radiance
from unirender.pipelines.framing import FAINT, FILL, LARGE, Frame, resize, visible_parts
from unirender.pipelines.unirender_pipeline import UniRenderPipeline

SIZE = 32


def disc(height: int, width: int, row: float, column: float, radius: float) -> np.ndarray:
    y, x = np.mgrid[0:height, 0:width] + 0.5
    return np.clip(radius + 0.5 - np.hypot(y - row, x - column), 0, 1).astype(np.float32)[..., None]


@pytest.mark.parametrize(
    ("size", "where"), [((100, 100), (50, 50)), ((90, 200), (20, 170)), ((200, 60), (6, 5)), ((40, 300), (36, 290))]
)
def test_a_small_object_is_cut_out_and_put_back(size: tuple[int, int], where: tuple[int, int]) -> None:
    mask = disc(*size, *where, 9)
    frame = Frame.around(mask, SIZE)
    assert frame.side < 30
    square = frame.enter(mask)
    assert square[[0, -1]].max() == square[:, [0, -1]].max() == 0, "nothing touches the border"
    assert square.sum() == pytest.approx(mask.sum() * (SIZE / frame.side) ** 2, rel=0.05)
    value = 0.7 * (mask > 0).astype(np.float32)
    back = frame.leave_map(frame.enter_map(value, mask), mask)
    np.testing.assert_allclose(back[mask > 0], 0.7, rtol=1e-3)
    assert not back[mask == 0].any()
    camera = Camera(50, (0.4, 0.6))
    top, left = frame.corner
    rows, columns = slice(max(top, 0), size[0]), slice(max(left, 0), size[1])
    whole, cut = camera.rays(*size)[rows, columns], frame.camera(camera).rays(frame.side, frame.side)
    inside = cut[max(-top, 0) :, max(-left, 0) :][: whole.shape[0], : whole.shape[1]]
    np.testing.assert_allclose(inside, whole[: inside.shape[0], : inside.shape[1]], atol=1e-5)


def test_what_fills_the_picture_or_has_the_networks_size_is_left_as_it_is() -> None:
    assert Frame.around(disc(64, 64, 32, 32, 25), SIZE) == Frame(64, 64, SIZE)
    assert Frame.around(disc(SIZE, SIZE, 16, 16, 4), SIZE).identity
    assert Frame.around(np.zeros((64, 64, 1), np.float32), SIZE) == Frame(64, 64, SIZE)
    for side, cut in ((33, True), (34, False)):  # 0.8 of a square of 42, and of 43 pixels: two thirds of 64 are 42.7
        box = np.zeros((64, 64, 1), np.float32)
        box[3 : 3 + side, 9:20] = 1
        assert (Frame.around(box, SIZE).cut is not None) == cut


def test_a_picture_that_is_no_square_is_in_the_middle_of_one() -> None:
    wide = np.ones((20, 50, 1), np.float32)
    for picture, corner in ((wide, (-15, 0)), (wide.transpose(1, 0, 2), (0, -15))):
        frame, rows = Frame(*picture.shape[:2], size=50), np.zeros((50, 50), bool)
        rows[15:35] = True
        assert frame.corner == corner
        np.testing.assert_array_equal(frame.enter(picture)[..., 0], rows if corner[0] else rows.T)
        np.testing.assert_array_equal(frame.leave(frame.enter(picture)), picture)


def test_a_cut_out_object_is_reduced_and_not_enlarged() -> None:
    mask = disc(400, 400, 200, 200, 20)
    frame = Frame.reduced(mask, 256)
    assert frame.size == frame.side < 60
    assert Frame.reduced(mask, 32).size == 32
    np.testing.assert_allclose(frame.leave(frame.enter(mask)), mask, atol=1e-6)


def test_what_enters_the_square_has_unit_normals_and_the_same_light() -> None:
    """Averages of normals are shorter and are mended; a light of fewer texels is as bright."""
    rng, mask = np.random.default_rng(0), disc(100, 60, 50, 30, 25)
    bumpy = (rng.normal(size=(100, 60, 3)) + np.array([0, 0, 2])) * (mask > 0)
    normal = (bumpy / np.maximum(np.linalg.norm(bumpy, axis=-1, keepdims=True), 1e-6)).astype(np.float32)
    light = rng.random((40, 80, 3), np.float32) ** 8
    given = Intrinsics(normal=normal, roughness=0.7 * mask, mask=mask, environment=light)
    square = Frame.around(mask, SIZE).enter_intrinsics(given, (16, 32)).require("normal", "mask", "environment")
    covered = square["mask"][..., 0] > 1e-3
    length = np.linalg.norm(square["normal"], axis=-1)
    np.testing.assert_allclose(length[covered], 1, rtol=1e-5)
    assert not length[~covered].any()
    assert square["environment"].shape == (16, 32, 3)
    np.testing.assert_allclose(mean_radiance(square["environment"]), mean_radiance(light), rtol=2e-3)


def test_haze_and_stray_pixels_are_left_out_only_where_they_hardly_count() -> None:
    mask = disc(128, 128, 64, 64, 20)
    cut = Frame.around(mask, SIZE)
    for haze in (1e-4, 1 / 255, FAINT):
        assert Frame.around(np.maximum(mask, np.float32(haze)), SIZE) == cut
    assert Frame.around(np.maximum(mask, np.float32(FAINT + 0.01)), SIZE) == Frame(128, 128, SIZE, (-16, -16, 160))
    stray = mask.copy()
    stray[0, 0] = 1
    assert Frame.around(stray, SIZE) == cut
    stray[127, 5] = stray[126, 6] = 1  # they touch at a corner: a part of two
    assert Frame.around(stray, SIZE).cut is None
    np.testing.assert_array_equal(visible_parts(stray)[[0, 127, 126], [0, 5, 6]], [False, True, True])


def test_what_is_left_out_is_no_part_of_the_object() -> None:
    """It has coverage, and neither a surface nor a say in the material of the whole."""
    mask = disc(128, 128, 64, 64, 20)
    haze, stray = np.maximum(mask, np.float32(1 / 255)), mask.copy()
    stray[0, 0] = 1
    picture = np.full((128, 128, 3), 0.5, np.float32)
    pipeline = make_pipeline()
    ways: list[dict[str, Any]] = [{}, {"tile": True, "size": 32, "closed": False}, {"material": "map", "closed": False}]
    for settings in ways:
        clean = pipeline.decompose(picture, mask, **settings)
        for given, tolerance in ((stray, 1e-5), (haze, 0.2)):  # haze in the square adds some background to what is seen
            found = pipeline.decompose(picture, given, **settings)
            assert found.roughness == pytest.approx(clean.roughness, rel=max(tolerance / 10, 1e-4))
            assert found.metallic == pytest.approx(clean.metallic, rel=max(tolerance / 10, 1e-4))
            for name in ("albedo", "normal"):
                value = getattr(found.intrinsics, name)
                assert not value[0].any()
                inside = mask[..., 0] == 1
                np.testing.assert_allclose(value[inside], getattr(clean.intrinsics, name)[inside], atol=tolerance)


def test_one_pixel_in_a_corner_is_seen() -> None:
    mask = np.zeros((300, 200, 1), np.float32)
    mask[299, 0] = 1
    frame = Frame.around(mask, SIZE)
    assert frame.side == 8
    assert frame.enter(mask).max() > 0.5
    assert frame.leave_map(np.ones((SIZE, SIZE, 1), np.float32), mask)[299, 0] == pytest.approx(1)


def test_a_small_object_is_what_it_is_when_somebody_cuts_it_out_before() -> None:
    """The picture of README in one of four times its size, and the object of it alone, seen by the same camera."""
    rgba = np.asarray(Image.open(Path(__file__).parents[2] / "docs/_static/example.png"), np.float32) / 255
    height, width = rgba.shape[:2]
    canvas = np.zeros((4 * height, 4 * width, 4), np.float32)
    canvas[height : 2 * height, 2 * width : 3 * width] = rgba
    camera = Camera(60, (0.4, 0.45))
    cut = Frame.around(canvas[..., 3:], 64)
    top, left = cut.corner
    inner = np.s_[top : top + cut.side, left : left + cut.side]
    pipeline = UniRenderPipeline.from_pretrained("tiny")
    alone = pipeline.decompose(canvas[inner][..., :3], canvas[inner][..., 3:], camera=cut.camera(camera)).intrinsics
    found = pipeline.decompose(canvas[..., :3], canvas[..., 3:], camera=camera).intrinsics
    for name, value in alone.maps.items():
        there = getattr(found, name)
        np.testing.assert_allclose(there if name == "environment" else there[inner], value, rtol=1e-3, atol=1e-3)
    again = pipeline.render(found)
    np.testing.assert_allclose(again[inner], pipeline.render(alone), atol=1e-3)
    assert not again[canvas[..., 3] == 0].any()


@pytest.mark.parametrize("size", [(90, 60), (33, 120), (120, 1), (64, 64)])
def test_the_square_is_never_there_as_a_whole_and_its_bytes_are_the_same(
    monkeypatch: pytest.MonkeyPatch, size: tuple[int, int]
) -> None:
    monkeypatch.setattr(blocks, "BLOCK", 500)
    rng, frame, side = np.random.default_rng(0), Frame(*size, SIZE), max(size)
    picture, mask = (rng.random((*size, channels), np.float32) for channels in (3, 1))
    square = np.zeros((side, side, 3), np.float32)
    top, left = -frame.corner[0], -frame.corner[1]
    there = np.s_[top : top + size[0], left : left + size[1]]
    square[there] = picture * mask
    small = resize(square, (SIZE, SIZE))
    assert frame.enter(picture, mask).tobytes() == frame.enter(picture * mask).tobytes() == small.tobytes()
    assert frame.leave(small).tobytes() == resize(small, (side, side))[there].tobytes()


def test_a_panorama_takes_the_memory_of_its_own_pixels() -> None:
    picture = np.ones((8, 4000, 3), np.float32)
    frame = Frame(8, 4000, SIZE)
    tracemalloc.start()
    frame.enter(picture)
    taken = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert taken < 8 * picture.nbytes, "its square would be 500 times as large"


def test_one_column_is_resampled_like_several() -> None:
    column = np.arange(8, dtype=np.float32).reshape(8, 1, 1)
    np.testing.assert_array_equal(resize(column, (4, 1)), resize(np.repeat(column, 3, axis=1), (4, 3))[:, :1])
    assert resize(column, (16, 4)).shape == (16, 4, 1)


@pytest.mark.parametrize(("height", "width"), [(SIZE, SIZE), (100, 100), (60, 100)])
def test_an_object_that_fills_the_picture_is_surrounded(height: int, width: int) -> None:
    """The network knows no object without a background around it."""
    mask = np.ones((height, width, 1), np.float32)
    frame = Frame.around(mask, SIZE)
    assert frame.side == math.ceil(max(height, width) / FILL)
    assert frame.shown == max(height, width)  # so that tiles add nothing to one of the network's size
    assert Frame.reduced(mask, SIZE).cut is None  # what is computed of the maps needs no margin
    inside = frame.enter(mask)
    assert inside[[0, -1]].max() == inside[:, [0, -1]].max() == 0
    assert inside.sum() == pytest.approx(SIZE**2 * FILL**2 * height * width / max(height, width) ** 2, rel=0.05)
    np.testing.assert_allclose(frame.leave_map(np.ones_like(inside), mask), mask, rtol=0, atol=1e-5)
    mask[:, : math.ceil(width * (1 - LARGE))] = mask[: math.ceil(height * (1 - LARGE))] = 0
    assert Frame.around(mask, SIZE).cut is None


def test_the_margin_grows_with_the_object() -> None:
    """From one picture of a film to the next nothing jumps."""
    sides = []
    for extent in range(180, 201):
        mask = np.zeros((200, 200, 1), np.float32)
        mask[:, :extent] = 1
        mask[extent:] = 0
        sides.append(Frame.around(mask, SIZE).side)
    assert sides[0] == 200
    assert sides[-1] == 250
    assert 0 <= np.diff(sides).min() <= np.diff(sides).max() <= 6
