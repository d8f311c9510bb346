"""Transport matrices against Mitsuba's renders of the same light."""

import appearance_cases as cases
import numpy as np
import pytest

from unirender.camera import Camera
from unirender_reference.multiview import orbit
from unirender_reference.optimize.surface.points import blocker, trace_points
from unirender_reference.optimize.transport.light_grid import LightGrid
from unirender_reference.optimize.transport.material_mix import Lobes, mixed
from unirender_reference.optimize.transport.matrices import light_transport, refined
from unirender_reference.optimize.transport.pixel_fit import Appearance, PixelFit, observe
from unirender_reference.optimize.views import View
from unirender_reference.render import Renderer

GRID = LightGrid(8, 16)
COLOUR = np.array([0.5, 0.3, 0.2], np.float32)


@pytest.fixture(scope="module")
def problem():
    """Points, matrices, and a light without edges that the grid cannot hold."""
    from dataclasses import replace

    obj = replace(cases.bare(), albedo=COLOUR)
    camera, poses = Camera(), orbit(3, Camera())
    blank = np.zeros((cases.SIZE, cases.SIZE, 3), np.float32)
    views = [View(blank, np.ones((cases.SIZE, cases.SIZE, 1), np.float32), camera, pose) for pose in poses]
    scene = blocker(obj)
    points = trace_points(scene, views, 16, 0)
    transport = light_transport(scene, points, GRID, 0)
    y, x = np.mgrid[:32, :64]
    fine = np.exp(1.5 * np.sin(np.pi * y / 31) * np.cos(2 * np.pi * (x + 0.5) / 64 - 1))[..., None]
    light = (fine * np.array([1, 0.8, 0.5])).astype(np.float32)
    return obj, points, transport, light, poses


def modelled(problem, roughness: float, metallic: float) -> np.ndarray:
    _obj, points, transport, light, _ = problem
    count = len(points)
    blank = np.zeros((count, 3), np.float32)
    seen = observe(blank, np.ones(count), np.arange(count), np.zeros(blank.shape, bool))
    fit = PixelFit(transport, seen, np.ones_like(blank), 0.5)
    cells = cases.averages(GRID, light)
    mixed = fit.mixed(Appearance(np.log(cells), np.full(count, float(roughness)), np.full(count, float(metallic))))
    return COLOUR * (mixed.u @ cells) + mixed.v @ cells


@pytest.mark.parametrize(("roughness", "metallic"), [(0.2, 1.0), (0.6, 0.0)])
def test_matrices_times_light_are_the_direct_image(problem, roughness: float, metallic: float) -> None:
    """Visibility, all lobes, interpolation between nodes; the twin is another material."""
    obj, points, _, light, poses = problem
    renderer = Renderer(obj, Camera(), cases.SIZE)
    images = [renderer.image(light, roughness, metallic, 256, depth=2, pose=pose).mean[..., :3] for pose in poses]
    truth = points.of(images)
    error = modelled(problem, roughness, metallic) - truth
    assert abs(error.mean()) < 0.03 * truth.mean()
    assert np.sqrt((error**2).mean()) < 0.08 * np.sqrt((truth**2).mean())
    off = modelled(problem, min(roughness + 0.2, 1), metallic - 0.3 if metallic > 0.5 else metallic + 0.3) - truth
    assert np.sqrt((off**2).mean()) > 1.5 * np.sqrt((error**2).mean())


def test_all_materials_are_alike_at_grazing_angles_and_show_f0_or_their_colour_at_none() -> None:
    """There W is G: the Fresnel term is 1 whatever the surface; and 0."""
    rng = np.random.default_rng(1)
    diffuse, gloss = rng.uniform(0, 1, (2, 3, 5)).astype(np.float32)
    nothing, metallic = 0 * gloss, np.array([0, 0.3, 1])
    grazing = mixed(Lobes(nothing, gloss, gloss), metallic)
    np.testing.assert_allclose(grazing.v, gloss, rtol=1e-6)
    assert not grazing.u.any()
    straight, m = mixed(Lobes(diffuse, gloss, nothing), metallic), metallic[:, None]
    np.testing.assert_allclose(straight.v, (1 - m) * 0.04 * gloss, rtol=1e-6)
    np.testing.assert_allclose(straight.u, (1 - m) * diffuse + m * gloss, rtol=1e-6)


def test_a_coarse_light_has_the_same_image(problem) -> None:
    _, _, transport, light, _ = problem
    coarse = transport.coarse()
    cells = cases.averages(coarse.grid, light)
    for whole, part in ((transport.diffuse[0], coarse.diffuse[0]), (transport.gloss[3], coarse.gloss[3])):
        np.testing.assert_allclose(part @ cells, whole @ refined(cells, coarse.grid), rtol=1e-4, atol=1e-6)


def test_blocked_light_counts_nothing(problem) -> None:
    """Against matrices without the mesh in the way: never more, and somewhere less."""
    from unirender_reference.backend import mitsuba

    _, points, transport, _, _ = problem
    mi = mitsuba()
    far = mi.load_dict({"type": "scene", "s": {"type": "sphere", "center": [0, 0, 100], "radius": 0.1}})
    free = light_transport(far, points, GRID, 0)
    assert (transport.diffuse[0] <= free.diffuse[0] + 1e-6).all()
    assert transport.diffuse[0].sum() < 0.97 * free.diffuse[0].sum()
