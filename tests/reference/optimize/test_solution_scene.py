"""A solution's pictures against the reference renderer's of the same object."""

import dataclasses

import numpy as np
import refine_problems as problems

from unirender.camera import Camera
from unirender_reference.multiview import orbit
from unirender_reference.optimize.solution_scene import solution_images
from unirender_reference.optimize.views import View
from unirender_reference.render import Renderer


def test_the_pictures_are_the_renderers() -> None:
    """Textures, normal map, light and cameras; the twin is the other camera's picture."""
    solution, camera, spp = problems.solution(), Camera(), 400
    tilted = np.zeros((4, 4, 3), np.float32)
    tilted[..., 0], tilted[..., 2] = 0.6, 0.8
    solution = dataclasses.replace(solution, obj=dataclasses.replace(solution.obj, normal_map=tilted))
    views = problems.blank_views(2)
    found = solution_images(solution, views, spp)
    renderer = Renderer(solution.obj, camera, problems.SIDE)
    expected = renderer.images([view.pose for view in views], solution.environment, None, None, spp)
    error = [np.abs(image - one.mean).mean() for image, one in zip(found, expected, strict=True)]
    other = [np.abs(image - one.mean).mean() for image, one in zip(found[::-1], expected, strict=True)]
    assert max(error) < 0.3 * min(other)


def test_pictures_may_be_wide() -> None:
    """The middle columns of a wide picture are the square picture."""
    solution, camera = problems.solution(), Camera()
    pose = orbit(1, camera)[0]
    side = problems.SIDE
    wide, square = (
        solution_images(solution, [View(np.zeros((side, w, 3)), np.zeros((side, w, 1)), camera, pose)], 256)[0]
        for w in (2 * side, side)
    )
    middle = wide[:, side // 2 : side // 2 + side]
    assert np.abs(middle - square).mean() < 0.2 * np.abs(wide[:, :side] - square).mean()
