"""Textures by least squares."""

import appearance_cases as cases
import numpy as np
import pytest

from unirender.camera import Camera
from unirender_reference.multiview import orbit
from unirender_reference.optimize.surface.points import blocker, trace_points
from unirender_reference.optimize.surface.textures import best_smoothness, fit_texels, footprint, spread
from unirender_reference.optimize.views import View

SIZE = 32


def test_a_footprint_reads_a_texture_as_mitsuba_does() -> None:
    """The base-colour buffer of a textured object, pixel by pixel."""
    from unirender_reference.backend import mitsuba

    mi = mitsuba()
    texture = np.random.default_rng(0).random((SIZE, SIZE, 3)).astype(np.float32)
    bitmap = mi.load_dict({"type": "bitmap", "bitmap": mi.Bitmap(texture), "raw": True, "wrap_mode": "repeat"})
    import drjit as dr

    obj, camera = cases.bare(texture_size=SIZE), Camera()
    blank = np.zeros((16, 16, 3), np.float32)
    points = trace_points(
        blocker(obj), [View(blank, np.ones((16, 16, 1), np.float32), camera, orbit(1, camera)[0])], 4, 0
    )
    looked = dr.zeros(mi.SurfaceInteraction3f, points.hit.size)
    looked.uv = mi.Point2f(np.ascontiguousarray(points.uv.reshape(-1, 2).T))
    values = np.array(bitmap.eval(looked)).T.reshape(*points.hit.shape, 3)
    mean = (values * points.hit[..., None]).sum(axis=1) / points.hit.sum(axis=1)[:, None]
    found = footprint(points, SIZE) @ texture.reshape(-1, 3)
    np.testing.assert_allclose(found, mean, atol=2e-5)
    shifted = footprint(points, SIZE) @ np.roll(texture, 1, axis=0).reshape(-1, 3)
    assert np.abs(shifted - mean).max() > 0.1


def test_texels_are_found_under_uneven_light() -> None:
    obj, camera = cases.bare(texture_size=SIZE), Camera()
    mask = np.ones((64, 64, 1), np.float32)
    views = [View(np.zeros((64, 64, 3), np.float32), mask, camera, pose) for pose in orbit(8, camera)]
    points = trace_points(blocker(obj), views, 4, 0)
    seen, rng = footprint(points, SIZE), np.random.default_rng(1)
    y, x = np.mgrid[:SIZE, :SIZE] / SIZE
    texture = np.stack([0.5 + 0.4 * np.sin(9 * x), 0.5 + 0.4 * np.cos(7 * y), 0.3 + 0.2 * np.sin(5 * (x + y))], axis=-1)
    texels = texture.reshape(-1, 3)
    gain = rng.uniform(0.3, 2, (len(points), 3))
    weight = np.ones_like(gain)
    start = spread(np.full_like(gain, 0.5), np.ones(len(points), np.float32), seen)
    found = fit_texels(seen, gain, gain * (seen @ texels), weight, start, 0.05)
    read = np.asarray(seen.sum(axis=0)).ravel() > 1
    assert read.sum() > 300
    assert np.sqrt(((found - texels)[read] ** 2).mean()) < 0.03
    blurred = fit_texels(seen, gain, gain * (seen @ texels), weight, start, 20.0)
    assert np.sqrt(((blurred - texels)[read] ** 2).mean()) > 0.1


def test_unseen_texels_are_the_mean_of_the_seen_ones() -> None:
    obj, camera = cases.bare(texture_size=SIZE), Camera()
    mask = np.ones((16, 16, 1), np.float32)
    points = trace_points(
        blocker(obj), [View(np.zeros((16, 16, 3), np.float32), mask, camera, orbit(1, camera)[0])], 4, 0
    )
    seen = footprint(points, SIZE)
    values = np.random.default_rng(2).random((len(points), 2)).astype(np.float32)
    texels = spread(values, np.ones(len(points), np.float32), seen)
    unseen = np.asarray(seen.sum(axis=0)).ravel() == 0
    assert unseen.any()
    np.testing.assert_allclose(texels[unseen], np.broadcast_to(values.mean(axis=0), texels[unseen].shape), rtol=1e-5)


@pytest.mark.parametrize(
    ("texture", "noise", "smooth"), [pytest.param("plain", 0.3, 60, marks=pytest.mark.long), ("checks", 0.01, 15)]
)
def test_held_out_pixels_tell_how_smooth_a_texture_is(texture: str, noise: float, smooth: float) -> None:
    """Noise on one colour asks for more smoothness than a clean pattern does, and gets it."""
    obj, camera = cases.bare(texture_size=SIZE), Camera()
    mask = np.ones((64, 64, 1), np.float32)
    views = [View(np.zeros((64, 64, 3), np.float32), mask, camera, pose) for pose in orbit(8, camera)]
    points = trace_points(blocker(obj), views, 4, 0)
    seen, rng = footprint(points, SIZE), np.random.default_rng(1)
    checks = np.indices((SIZE, SIZE)).sum(axis=0) // 2 % 2
    texels = 0.2 + 0.5 * np.repeat((checks * (texture == "checks")).reshape(-1, 1), 3, axis=1)
    gain, weight = np.ones((len(points), 3)), np.full((len(points), 3), 1 / noise)
    target = seen @ texels + noise * rng.standard_normal(gain.shape)
    start = spread(target, np.ones(len(points), np.float32), seen)
    found = best_smoothness(seen, gain, target, weight, start)
    assert found >= smooth if texture == "plain" else found <= smooth
