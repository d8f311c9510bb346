"""Space carving: a cup is hollow, what agrees stays, and pictures decide between two solutions."""

import dataclasses

import numpy as np
import pytest
from posed_spheres import blank_views
from reference_scenes import environment, sphere

from unirender.color import image_srgb
from unirender_reference.exposure import scene_exposure
from unirender_reference.optimize.multiview.config import OptimizeConfig
from unirender_reference.optimize.multiview.run import _Run
from unirender_reference.optimize.shape.cameras import Cameras
from unirender_reference.optimize.shape.carve import carve, carved_object
from unirender_reference.optimize.shape.config import ShapeConfig
from unirender_reference.optimize.shape.coverage import masks_of
from unirender_reference.optimize.shape.hull import visual_hull
from unirender_reference.optimize.shape.measure import score_shape
from unirender_reference.optimize.shape.reconstruct import reconstruct
from unirender_reference.optimize.solution import Solution
from unirender_reference.optimize.views import View, Views
from unirender_reference.render import Renderer
from unirender_reference.shapes import MeshObject
from unirender_reference.shapes.generator import make_object

CELLS, VIEWS, SIZE = 48, 16, 48


def pictures(obj: MeshObject, roughness: float, metallic: float, count: int = VIEWS) -> Views:
    """8-bit pictures from all around."""
    renderer, light = Renderer(obj, resolution=SIZE), environment(3)
    light = light * scene_exposure(renderer, light, 0)

    def picture(index: int, blank: View) -> View:
        rgba = renderer.image(light, roughness, metallic, 64, seed=index, pose=blank.pose).mean
        mask = np.clip(rgba[..., 3:], 0, 1)
        straight = np.where(mask > 0, rgba[..., :3] / np.maximum(mask, 1e-6), 0)
        return dataclasses.replace(blank, image=np.round(image_srgb(straight) * 255) / 255, mask=mask)

    return Views(tuple(picture(k, view) for k, view in enumerate(blank_views(count, SIZE))))


def cup() -> MeshObject:
    """A spotted bowl, open on one side."""
    return make_object(23, "test")


@pytest.mark.long
def test_a_cup_is_hollow() -> None:
    views, config = pictures(cup(), 1.0, 0.3), ShapeConfig(cells=CELLS)
    other = Cameras(blank_views(5, SIZE))
    hull = reconstruct(views, config)
    hollow = carved_object(views, hull, config)
    assert hollow is not None
    closed, opened = (score_shape(obj, cup(), other) for obj in (hull, hollow))
    assert opened.normal_cosine > closed.normal_cosine + 0.01
    assert opened.mask_iou > 0.98


def test_what_agrees_stays() -> None:
    """A grey ball looks the same from all sides; pictures of which every other one is darker do not fit together."""
    views = Views(tuple(dataclasses.replace(view, image=np.full_like(view.image, 0.5)) for view in _ball().seen))
    assert carved_object(views, sphere(), ShapeConfig(cells=24)) is None
    masks, cameras = masks_of(views.seen), Cameras(views.seen)
    hull = visual_hull(masks, cameras, 24)
    images = np.stack([view.image for view in views.seen])
    same, left = carve(hull, images, masks, cameras, 0.03)
    assert left == 1
    np.testing.assert_array_equal(same > 0, hull > 0)
    odd = images * np.where(np.arange(len(images)) % 2, 0.5, 1)[:, None, None, None]  # neighbours contradict each other
    assert carve(hull, odd.astype(np.float32), masks, cameras, 0.03)[1] < 0.5


def test_two_pictures_take_nothing_away() -> None:
    seen = _ball().seen
    hull = visual_hull(masks_of(seen), Cameras(seen), 24)
    two = seen[:2]
    images = np.stack([np.full_like(view.image, value) for view, value in zip(two, (0.2, 0.8), strict=True)])
    assert carve(hull, images, masks_of(two), Cameras(two), 0.03)[1] == 1


def test_a_point_is_not_seen_through_the_object() -> None:
    """One side red, the other green: no point is asked to be both."""
    views = _ball()
    masks, cameras = masks_of(views.seen), Cameras(views.seen)
    centers, images = cameras.center, np.full((len(masks), SIZE, SIZE, 3), 0.5, np.float32)
    y, x = np.meshgrid(np.arange(SIZE) + 0.5, np.arange(SIZE) + 0.5, indexing="ij")
    for view in range(len(masks)):
        rays = cameras.rays(np.stack([x, y], axis=-1).reshape(-1, 2), np.full(SIZE * SIZE, view))
        along = -rays @ centers[view]
        nearest = (
            centers[view]
            + rays * (along - np.sqrt(np.maximum(along**2 - centers[view] @ centers[view] + 1, 0)))[:, None]
        )
        images[view] = np.clip(0.5 + 0.5 * nearest[:, :1], 0, 1).reshape(SIZE, SIZE, 1)  # painted on the unit sphere
    assert np.abs(np.ptp(images[0])) > 0.2
    assert carve(visual_hull(masks, cameras, 32), images, masks, cameras, 0.06)[1] > 0.97
    turned = images[np.roll(np.arange(len(images)), 3)]  # twin: the same pictures from wrong places
    assert carve(visual_hull(masks, cameras, 32), turned, masks, cameras, 0.06)[1] < 0.9


@pytest.mark.long
def test_pictures_decide_between_solutions() -> None:
    obj, light = sphere(), environment(3)
    views = _ball()
    size = (4, 4)
    one, other = (
        Solution(
            dataclasses.replace(
                obj,
                uv=np.full((len(obj.vertices), 2), 0.5, np.float32),
                albedo=np.full((*size, 3), albedo, np.float32),
                roughness=np.full(size, 0.5, np.float32),
                metallic=np.full(size, 0.0, np.float32),
            ),
            light,
        )
        for albedo in (0.1, 0.9)
    )
    dark = Views(tuple(dataclasses.replace(view, image=np.full_like(view.image, 0.2)) for view in views.seen))
    run = _Run(dark, OptimizeConfig(), None, lambda report: None, [])
    assert run._better(one, other) is one
    assert run._better(other, one) is one


def _ball() -> Views:
    """Grey views of the unit sphere, with its outlines."""
    renderer = Renderer(sphere(), resolution=SIZE)

    def outlined(blank: View) -> View:
        mask = renderer.image(environment(3), 0.5, 0.0, 16, pose=blank.pose).mean[..., 3:]
        return dataclasses.replace(blank, image=np.full((SIZE, SIZE, 3), 0.5, np.float32), mask=np.clip(mask, 0, 1))

    return Views(tuple(outlined(view) for view in blank_views(12, SIZE)))
