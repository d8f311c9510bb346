"""A bowl, half of a sphere, under an even light L: radiosity in closed form.

From every point of a sphere's inside each part of the sphere takes the part's share of its area. Of a white bowl whose
opening is the share f of the sphere, d is f L all over, and after k bounces the radiance is (1 - (1 - f)^k) L.
"""

import dataclasses

import numpy as np
import pytest

from unirender_reference.passes import TRUTH_BATCHES, Counters, mean_estimate, render_passes
from unirender_reference.render import DIRECT_DEPTH, Renderer
from unirender_reference.shapes import MeshObject

SIZE, RINGS, SECTORS = 16, 48, 96
RADIANCE = 2.0
LIGHT = np.full((8, 16, 3), RADIANCE, np.float32)


def bowl() -> MeshObject:
    """Open towards the camera; normals and faces look outwards, away from what is seen."""
    theta, phi = np.linspace(0, np.pi / 2, RINGS), np.arange(SECTORS) * 2 * np.pi / SECTORS
    theta, phi = (grid.ravel() for grid in np.meshgrid(theta, phi, indexing="ij"))
    points = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), -np.cos(theta)], -1).astype(np.float32)
    corner = np.arange(RINGS * SECTORS).reshape(RINGS, SECTORS)
    a, b, c, d = corner[:-1], np.roll(corner, -1, 1)[:-1], corner[1:], np.roll(corner, -1, 1)[1:]
    faces = np.concatenate([np.stack([a, b, d], -1), np.stack([a, d, c], -1)]).reshape(-1, 3).astype(np.int32)
    return MeshObject("bowl", "mesh", points, faces, points.copy(), None, np.ones(3, np.float32))


def inside(renderer: Renderer) -> np.ndarray:
    """Pixels that the bowl covers wholly."""
    return renderer.geometry(64).require("mask")["mask"][..., 0] == 1


@pytest.mark.parametrize("turned", ["nothing", "faces", "normals"])
def test_a_bowl_sees_the_light_through_its_opening(turned: str) -> None:
    obj = bowl()
    if turned == "faces":
        obj = dataclasses.replace(obj, faces=np.ascontiguousarray(obj.faces[:, ::-1]))
    if turned == "normals":
        obj = dataclasses.replace(obj, normals=-obj.normals)
    renderer = Renderer(obj, resolution=SIZE)
    diffuse = renderer.diffuse(LIGHT, 256).mean[inside(renderer)]
    assert diffuse.mean() == pytest.approx(RADIANCE / 2, rel=0.01)
    assert diffuse.std() < 0.03 * RADIANCE  # all over: at the rim as on the ground


def test_three_bounces_in_a_white_bowl_add_up() -> None:
    renderer = Renderer(bowl(), resolution=SIZE)
    scene = renderer.lit("white", {}, LIGHT)
    passes = render_passes(scene, DIRECT_DEPTH + 2, 256, 0, TRUTH_BATCHES, Counters())
    found = mean_estimate(*passes, TRUTH_BATCHES).mean[inside(renderer)][:, :3]
    expected = [RADIANCE * (1 - 0.5**k) for k in (3, 4)]
    assert found.mean() == pytest.approx(expected[0], rel=0.01)
    assert found.mean() != pytest.approx(expected[1], rel=0.03)  # the twin: one bounce more
