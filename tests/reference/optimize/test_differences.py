"""Neighbours, their differences, and texture lookups as sparse matrices."""

import numpy as np
import pytest

from unirender_reference.optimize.numerics.differences import difference_matrix, side_by_side
from unirender_reference.optimize.surface.textures import texel_weights


@pytest.mark.parametrize("around", [False, True])
def test_differences_are_those_of_the_picture(around: bool) -> None:
    values = np.random.default_rng(0).random((4, 5))
    matrix = difference_matrix(side_by_side(np.arange(20).reshape(4, 5), around), 20)
    beside = values - np.roll(values, -1, axis=1)
    expected = [beside if around else beside[:, :-1], values[:-1] - values[1:]]
    np.testing.assert_allclose(matrix @ values.ravel(), np.concatenate([part.ravel() for part in expected]))


def test_differences_are_weighted() -> None:
    pairs = side_by_side(np.arange(6).reshape(2, 3))
    weight = np.arange(1.0, pairs.shape[1] + 1)
    values = np.random.default_rng(1).random(6)
    found = difference_matrix(pairs, 6, weight) @ values
    np.testing.assert_allclose(found, weight * (difference_matrix(pairs, 6) @ values))


def test_lookups_are_those_of_mitsubas_bitmap() -> None:
    """Between texels and across the border; the twin reads u for v."""
    from unirender_reference.backend import mitsuba

    mi = mitsuba()
    rng, size, count = np.random.default_rng(2), 5, 200
    texture, uv = rng.random((size, size, 1)).astype(np.float32), rng.uniform(-0.3, 1.3, (count, 2)).astype(np.float32)
    plugin = mi.load_dict({"type": "bitmap", "bitmap": mi.Bitmap(texture), "raw": True, "wrap_mode": "repeat"})
    import drjit as dr

    point = dr.zeros(mi.SurfaceInteraction3f, count)
    point.uv = mi.Point2f(np.ascontiguousarray(uv.T))
    expected = np.array(plugin.eval_1(point))
    np.testing.assert_allclose(texel_weights(uv, size) @ texture.ravel(), expected, rtol=0, atol=1e-5)
    assert np.abs(texel_weights(uv[:, ::-1], size) @ texture.ravel() - expected).max() > 0.1
