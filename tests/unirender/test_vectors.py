"""Vectors along the last axis: what numpy's reductions give, to the bit."""

from collections.abc import Callable

import numpy as np
import pytest

from unirender.vectors import dots, lengths, nonzero


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("layout", [np.ascontiguousarray, np.asfortranarray])
def test_they_are_numpys_reductions_to_the_bit(dtype: type, layout: Callable[[np.ndarray], np.ndarray]) -> None:
    a, b = np.random.default_rng(0).normal(size=(2, 30, 40, 3)).astype(dtype)
    a[:2], a[2:4], a[4, :, 1:], a[5] = 0, -0.0, 0, a[5] * 1e-25
    a, b = layout(a), layout(b)
    assert dots(a, b).tobytes() == np.sum(a * b, axis=-1, keepdims=True).tobytes()
    assert lengths(a).tobytes() == np.linalg.norm(a, axis=-1, keepdims=True).tobytes()
    assert lengths(a).dtype == dots(a, b).dtype == dtype
    assert np.array_equal(nonzero(a), np.any(a != 0, axis=-1))
