"""Levenberg-Marquardt over light and material: derivatives, and what it recovers."""

from dataclasses import replace

import appearance_cases as cases
import numpy as np
import pytest

from unirender_reference.optimize.surface.points import SurfacePoints, blocker, trace_points
from unirender_reference.optimize.transport import light_solve, pixel_fit
from unirender_reference.optimize.transport.light_grid import LightGrid
from unirender_reference.optimize.transport.light_solve import LightPrior, evaluate, solve_light
from unirender_reference.optimize.transport.material_search import search_materials
from unirender_reference.optimize.transport.matrices import light_transport
from unirender_reference.optimize.transport.pixel_fit import Appearance, PixelFit, observe, patches
from unirender_reference.optimize.views import View, Views

GRID = LightGrid(8, 16)
PRIOR = LightPrior(smooth=0.3, neutral=0.3)


def made(points: SurfacePoints, fit: PixelFit, base: np.ndarray, truth: Appearance) -> PixelFit:
    """The fit whose pixels show what the matrices themselves make of a truth: exact but for rounding."""
    mixed = fit.mixed(truth)
    radiance = base * (mixed.u @ truth.radiance) + mixed.v @ truth.radiance
    radiance = np.minimum(radiance, 1)
    seen = observe(radiance, np.ones(len(points)), fit.seen.patch, radiance >= 1 - 1e-3)
    return replace(fit, seen=seen)


@pytest.fixture(scope="module")
def problem():
    """A fit of 6 views, its truth (light, one material), and the true base colour of two colours."""
    from unirender.camera import Camera
    from unirender_reference.multiview import orbit

    camera, obj = Camera(), cases.bare()
    mask = np.ones((cases.SIZE, cases.SIZE, 1), np.float32)
    views = Views(
        tuple(View(np.zeros((cases.SIZE, cases.SIZE, 3), np.float32), mask, camera, p) for p in orbit(6, camera))
    )
    scene = blocker(obj)
    points = trace_points(scene, views.seen, 4, 0)
    transport = light_transport(scene, points, GRID, 0)
    position = points.mean_position()
    patch = patches(position, 0.12)
    blank = np.zeros((len(points), 3), np.float32)
    fit = PixelFit(
        transport, observe(blank, np.ones(len(points)), patch, np.zeros(blank.shape, bool)), np.ones_like(blank), 0.4
    )
    middle = fit.seen.sums @ position[:, 1] / (fit.seen.sums @ np.ones(len(points), np.float32))
    base = np.where(middle[patch][:, None] > 0, [[0.6, 0.2, 0.1]], [[0.1, 0.3, 0.5]]).astype(np.float32)
    count = len(points)
    cells = cases.averages(GRID, cases.coarse_light(1)) * 0.6
    truth = Appearance(np.log(cells), np.full(count, 0.35), np.full(count, 0.3))
    return points, made(points, fit, base, truth), truth, base


def flat(fit: PixelFit, roughness: float, metallic: float) -> Appearance:
    count = len(fit.seen.patch)
    level = np.log(float(fit.seen.radiance.mean()) / 0.4)
    return Appearance(np.full((GRID.count, 3), level), np.full(count, roughness), np.full(count, metallic))


def test_gradient_is_the_derivative_of_the_cost(problem) -> None:
    """Central differences along random directions, the scales chosen anew at each end; the twin is a tenth off."""
    _, fit, truth, _ = problem
    rng = np.random.default_rng(0)
    start = replace(
        truth, light=truth.light + 0.05 * rng.standard_normal(truth.light.shape), metallic=truth.metallic + 0.05
    )
    squares = (evaluate(fit, start, PRIOR).prediction.robust > 0).astype(np.float64)  # Huber's bound out of the way
    solved = evaluate(fit, start, PRIOR, squares)
    solved = replace(solved, prediction=replace(solved.prediction, robust=squares))
    _, gradient = light_solve._normal_equations(fit, solved, PRIOR)
    step, length = 1e-3, float(np.linalg.norm(gradient))

    def cost(along: np.ndarray, by_material: np.ndarray) -> float:
        moved = replace(
            start,
            light=start.light + along,
            roughness=start.roughness + by_material[0],
            metallic=start.metallic + by_material[1],
        )
        found = evaluate(fit, moved, PRIOR, squares)
        tie = pixel_fit.SCALE_SPREAD**-2 * ((found.prediction.scale - fit.scale_prior) ** 2).sum()
        return float((found.prediction.residual**2 * squares).sum() + tie) + PRIOR.cost(fit, moved.light)

    for _ in range(4):
        along, by_material = rng.standard_normal(truth.light.shape), rng.standard_normal(2)
        finite = (cost(step * along, step * by_material) - cost(-step * along, -step * by_material)) / (2 * step)
        analytic = 2 * float(gradient @ np.concatenate([along.T.ravel(), by_material]))
        assert analytic == pytest.approx(finite, rel=0.02, abs=0.01 * length)
        unprojected = analytic + 0.1 * length
        assert unprojected != pytest.approx(finite, rel=0.02, abs=0.01 * length)


def test_the_priors_are_in_the_normal_equations(problem) -> None:
    """They are quadratic in the light's logarithm: gradient and Hessian give their change over any step."""
    _, fit, truth, _ = problem
    rng = np.random.default_rng(0)
    tinted = replace(truth, light=truth.light + 0.5 * rng.standard_normal(truth.light.shape))
    solved, prior = evaluate(fit, tinted, PRIOR), LightPrior(smooth=2, neutral=3)
    with_priors, without = (light_solve._normal_equations(fit, solved, p) for p in (prior, LightPrior(0, 0)))
    hessian, gradient = (a - b for a, b in zip(with_priors, without, strict=True))
    along = rng.standard_normal(truth.light.shape)
    step = np.concatenate([along.T.ravel(), [0, 0]])
    change = prior.cost(fit, tinted.light + along) - prior.cost(fit, tinted.light)
    assert 2 * gradient @ step + step @ hessian @ step == pytest.approx(change, rel=1e-3)


@pytest.mark.parametrize(("roughness", "metallic"), [(0.7, 0.8), (0.2, 0.1)])
def test_light_and_material_are_found_from_a_flat_start(problem, roughness: float, metallic: float) -> None:
    """What descent by gradients stalls on: all of light, base colour, roughness and metallic unknown."""
    _, fit, truth, base = problem
    solved = solve_light(fit, flat(fit, roughness, metallic), PRIOR, 25, tolerance=1e-5)
    found = solved.appearance
    assert abs(found.roughness[0] - truth.roughness[0]) < 0.03
    assert abs(found.metallic[0] - truth.metallic[0]) < 0.05
    error = solved.prediction.base - base
    assert np.sqrt((error**2).mean()) < 0.05
    start = evaluate(fit, flat(fit, roughness, metallic), PRIOR)
    assert np.sqrt(((start.prediction.base - base) ** 2).mean()) > 0.08


def test_clipped_pixels_say_at_least(problem) -> None:
    """A model brighter than a pixel that shows 255 is not wrong; one that is darker is."""
    _, fit, truth, _ = problem
    assert fit.seen.clipped.any()
    mixed = fit.mixed(truth)
    for factor, wrong in ((3.0, False), (0.3, True)):
        residual = fit.predict(mixed, truth.radiance * np.float32(factor)).residual[fit.seen.clipped]
        assert (np.abs(residual) > 0).mean() > 0.5 if wrong else (np.abs(residual) > 0).mean() < 0.2


def test_two_materials_are_told_apart(problem) -> None:
    """Under the true light; an object of one material stays one."""
    points, fit, truth, base = problem
    position = points.mean_position()
    upper = base[:, 0] > base[:, 2]
    mixed = replace(truth, roughness=np.where(upper, 0.2, 0.7), metallic=np.where(upper, 1.0, 0.0))
    two = made(points, fit, base, mixed)
    found = search_materials(two, truth, position)
    assert ((found.metallic > 0.5) == upper).mean() > 0.85
    assert found.roughness[upper].mean() + 0.2 < found.roughness[~upper].mean()
    same = search_materials(fit, truth, position)
    assert (np.abs(same.metallic - truth.metallic) < 0.11).mean() > 0.9
