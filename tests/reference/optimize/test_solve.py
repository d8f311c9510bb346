"""The global start: pictures of a known mesh in, textures and light out."""

from dataclasses import replace

import appearance_cases as cases
import numpy as np
import pytest

from unirender.camera import Camera
from unirender_reference.multiview import orbit
from unirender_reference.optimize.solution_scene import solution_images
from unirender_reference.optimize.surface.points import blocker, trace_points
from unirender_reference.optimize.transport.config import TransportConfig
from unirender_reference.optimize.transport.pixel_fit import patches
from unirender_reference.optimize.transport.progress import solve_shares
from unirender_reference.optimize.transport.solve import (
    FINE,
    LEAST_SIDE,
    STARTS,
    _footprint_edge,
    _Work,
    shrunk,
    solve_appearance,
    start_solution,
)
from unirender_reference.optimize.views import View, Views

CONFIG = TransportConfig(iterations=6, rounds=1, correction_spp=64)
TEXELS, ROWS = 32, 8


@pytest.fixture(scope="module")
def views() -> Views:
    return cases.pictures(cases.two_colours(cases.bare()), cases.coarse_light(1), 0.4, 0.2, count=6)


@pytest.fixture(scope="module")
def found(views):
    steps = []
    solution = solve_appearance(
        views, cases.bare(), CONFIG, lambda step: steps.append(step) or True, texture_size=TEXELS, light_rows=ROWS
    )
    return solution, steps


def shown_error(solution, views: Views) -> float:
    """Root mean square of the difference in the pictures, premultiplied radiance up to what they can show."""
    images = solution_images(solution, views.seen, 64, 5)[..., :3]
    pairs = zip(images, views.seen, strict=True)
    errors = [(np.minimum(image, view.mask) - views.linear(view)) ** 2 for image, view in pairs]
    return float(np.sqrt(np.mean(errors)))


def test_the_solution_explains_the_pictures(views, found) -> None:
    grey = start_solution(views, cases.bare(), texture_size=TEXELS, light_rows=ROWS)
    assert shown_error(found[0], views) < 0.4 * shown_error(grey, views)


def test_materials_are_near_the_truth(found) -> None:
    obj = found[0].obj
    assert abs(np.median(obj.roughness) - 0.4) < 0.12
    assert abs(np.median(obj.metallic) - 0.2) < 0.12


def test_every_solve_is_a_step(found) -> None:
    steps = found[1]
    assert len(steps) == len(solve_shares(CONFIG, len(STARTS)))  # what the estimate of the time expects
    assert [step.iteration for step in steps] == list(range(1, len(steps) + 1))
    assert all(step.stage == "transport" and np.isfinite(list(step.values.values())).all() for step in steps)


@pytest.mark.long
def test_equal_seeds_give_equal_solutions(views, found) -> None:
    def solved(seed: int) -> list[np.ndarray]:
        again = solve_appearance(views, cases.bare(), CONFIG, texture_size=TEXELS, light_rows=ROWS, seed=seed)
        return parts(again)

    def parts(solution) -> list[np.ndarray]:
        return [solution.environment, solution.obj.albedo, solution.obj.roughness, solution.obj.metallic]

    for again, first, other in zip(solved(0), parts(found[0]), solved(1), strict=True):
        np.testing.assert_allclose(again, first, rtol=1e-5, atol=1e-6)
        assert not np.allclose(other, first, rtol=1e-3, atol=1e-4)


@pytest.mark.long
def test_highlights_that_no_light_can_make_are_outvoted(views) -> None:
    """A white disc stands at another place of every picture: `sharpen` keeps it out of light and materials."""
    rng = np.random.default_rng(3)
    rows, columns = np.mgrid[: views.height, : views.width]

    def spoiled(view: View) -> View:
        y, x = rng.uniform(0.35, 0.65, 2) * views.height
        disc = ((rows - y) ** 2 + (columns - x) ** 2 < (0.12 * views.height) ** 2)[..., None]
        return replace(view, image=np.where(disc & (view.mask > 0), np.float32(0.97), view.image))

    wrong = replace(views, seen=tuple(spoiled(view) for view in views.seen))

    def error(sharpen: bool) -> float:
        config = replace(CONFIG, rounds=0, sharpen=sharpen)
        return shown_error(solve_appearance(wrong, cases.bare(), config, texture_size=TEXELS, light_rows=ROWS), views)

    assert error(True) < 0.9 * error(False)


def test_switched_off_it_is_a_flat_start(views) -> None:
    solution = solve_appearance(
        views, cases.bare(), replace(CONFIG, enabled=False), texture_size=TEXELS, light_rows=ROWS
    )
    assert np.ptp(solution.environment) == np.ptp(solution.obj.albedo) == 0
    assert (solution.obj.roughness == 0.5).all()
    shown = np.sum([image.sum() for image in solution_images(solution, views.seen, 16, 0)[..., :3]])
    seen = np.sum([views.linear(view).sum() for view in views.seen])
    assert shown == pytest.approx(seen, rel=0.5)


def blank(size: int, count: int, width: int | None = None) -> Views:
    """Views of a disc that fills half of a square, which lies in the middle of a picture."""
    width = size if width is None else width
    rows, columns = np.mgrid[:size, :width] + 0.5
    mask = (np.hypot(rows - size / 2, columns - width / 2) < size * 0.4)[..., None].astype(np.float32)
    image = mask * np.full(3, 0.5, np.float32)
    return Views(tuple(View(image, mask, Camera(), pose) for pose in orbit(count, Camera())))


def test_pixels_of_large_pictures_still_share_places_of_the_surface() -> None:
    """Drawn from all of them, each would show a place of its own, of which any base colour is right."""
    large, most, shared = blank(192, 8), 9000, []
    for views in (shrunk(large, most), large):
        points = trace_points(blocker(cases.bare()), views.seen, 1, 0, most)
        patch = patches(points.mean_position(), _footprint_edge(views))
        seen_by = np.bincount(np.unique(np.stack([patch, points.view]), axis=1)[0])
        shared.append(float((seen_by[patch] > 1).mean()))
    assert shared[0] > 0.5
    assert shared[1] < 0.3, f"the twin: {shared[1]:.0%} of the large pictures' pixels show what another view does"


def test_pictures_with_few_pixels_or_small_sides_stay_as_they_are() -> None:
    small = blank(127, 4)
    assert shrunk(small, 100) is small  # 64 pixels tell metallic, fewer do not
    large = blank(256, 4)
    covered = sum(int((view.mask > 0).sum()) for view in large.seen)
    assert shrunk(large, covered // 4 + 1) is large  # less than twice as many along a side
    assert shrunk(large, covered // 4).height == 128
    assert shrunk(large, covered // 9).height == 85
    assert shrunk(large, 100).height == LEAST_SIDE
    wide = shrunk(blank(128, 4, width=512), 100)
    assert (wide.height, wide.width) == (LEAST_SIDE, 4 * LEAST_SIDE), "the shorter side, in which the object lies"
    assert shrunk(blank(192, 4, width=194), 100).height == LEAST_SIDE
    low = blank(96, 4, width=512)
    assert shrunk(low, 100) is low


def test_large_pictures_are_solved_at_a_smaller_size() -> None:
    large, config = blank(192, 2), replace(CONFIG, pixels=100)
    work = _Work(large, cases.bare(), config, lambda step: True, TEXELS, ROWS, seed=0)
    small = shrunk(large, config.pixels)
    assert len(work.points) == config.pixels
    np.testing.assert_array_equal(work.shown, work.points.of([small.linear(view) for view in small.seen]))


def test_it_stops_when_told(views) -> None:
    steps = []
    solve_appearance(
        views,
        cases.bare(),
        replace(CONFIG, rounds=3),
        lambda step: steps.append(step) or False,
        texture_size=TEXELS,
        light_rows=ROWS,
    )
    assert len(steps) == len(STARTS) + 1  # none of the materials' and the corrections' solves


@pytest.mark.long
def test_a_mirror_gets_a_finer_light() -> None:
    """Its pictures are explained better than by a light of 16 rows."""
    sharp = cases.coarse_light(1, rows=32)
    views = cases.pictures(cases.bare(), sharp, 0.1, 0.9, count=8, spp=64, size=56)
    config = TransportConfig(iterations=3, rounds=0, fine_pixels=4000, materials="one")
    fine, coarse = (
        solve_appearance(views, cases.bare(), replace(config, fine_below=below), texture_size=TEXELS, light_rows=16)
        for below in (0.4, 0.0)
    )
    assert [len(solution.environment) for solution in (fine, coarse)] == [FINE.rows, 16]
    assert shown_error(fine, views) < 0.95 * shown_error(coarse, views)
