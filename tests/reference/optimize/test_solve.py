"""The global start: pictures of a known mesh in, textures and light out."""

from dataclasses import replace

import appearance_cases as cases
import numpy as np
import pytest

from unirender_reference.optimize.solve import STARTS, render_solution, solve_appearance, start_solution
from unirender_reference.optimize.transport_config import TransportConfig
from unirender_reference.optimize.views import Views

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
    images = render_solution(solution, views, 64, 5)
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
    assert [step.iteration for step in steps] == list(range(1, len(steps) + 1))
    assert all(step.stage == "transport" and np.isfinite(list(step.values.values())).all() for step in steps)


def test_equal_seeds_give_equal_solutions(views, found) -> None:
    again = solve_appearance(views, cases.bare(), CONFIG, texture_size=TEXELS, light_rows=ROWS)
    np.testing.assert_allclose(again.environment, found[0].environment, rtol=1e-2)
    np.testing.assert_allclose(again.obj.albedo, found[0].obj.albedo, atol=2e-2)


def test_switched_off_it_is_a_flat_start(views) -> None:
    solution = solve_appearance(
        views, cases.bare(), replace(CONFIG, enabled=False), texture_size=TEXELS, light_rows=ROWS
    )
    assert np.ptp(solution.environment) == np.ptp(solution.obj.albedo) == 0
    assert (solution.obj.roughness == 0.5).all()
    shown = np.sum([image.sum() for image in render_solution(solution, views, 16, 0)])
    seen = np.sum([views.linear(view).sum() for view in views.seen])
    assert shown == pytest.approx(seen, rel=0.5)


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
