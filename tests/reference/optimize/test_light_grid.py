"""The light's cells: areas, directions, differences."""

import numpy as np
import pytest

from unirender.errors import UnirenderError
from unirender_reference.backend import mitsuba
from unirender_reference.optimize.transport.light_grid import LightGrid

GRID = LightGrid(8, 12)


def test_solid_angles_fill_the_sphere() -> None:
    assert GRID.solid_angles.sum() * GRID.columns == pytest.approx(4 * np.pi)


def test_a_direction_in_a_cell_is_found_in_it() -> None:
    mi = mitsuba()
    import drjit as dr

    cells = np.repeat(np.arange(GRID.count), 50).astype(np.uint32)
    rng = np.random.default_rng(0)
    u, v = rng.uniform(0.01, 0.99, (2, len(cells))).astype(np.float32)
    towards = GRID.direction(mi.UInt32(cells), mi.Float(u), mi.Float(v))
    np.testing.assert_allclose(np.array(dr.norm(towards)), 1, atol=1e-5)
    assert np.array_equal(np.array(GRID.cell_of(towards)), cells)


def test_one_bright_texel_is_one_bright_cell() -> None:
    """The cell around a texel of Mitsuba's `envmap` is where Mitsuba sees it: at the texel's direction."""
    mi = mitsuba()
    environment = np.full((GRID.rows, GRID.columns, 3), 1e-3, np.float32)
    environment[3, 5] = 1
    light = mi.load_dict({"type": "envmap", "bitmap": mi.Bitmap(environment)})
    towards = GRID.direction(mi.UInt32(np.arange(GRID.count)), mi.Float(0.5), mi.Float(0.5))
    import drjit as dr

    looking = dr.zeros(mi.SurfaceInteraction3f, GRID.count)
    looking.wi = -towards
    radiance = np.array(light.eval(looking)).T[:, 0]
    assert int(radiance.argmax()) == 3 * GRID.columns + 5


def test_differences_vanish_for_a_constant_light_only() -> None:
    assert np.abs(GRID.differences @ np.ones(GRID.count)).max() < 1e-12
    wrapped = np.zeros((GRID.rows, GRID.columns))
    wrapped[4, 0] = 1  # differs from the last column, too
    assert np.count_nonzero(GRID.differences @ wrapped.ravel()) == 4


def test_too_small_grids_are_refused() -> None:
    with pytest.raises(UnirenderError, match="at least 4 x 4"):
        LightGrid(3, 8)


def test_smoothness_does_not_know_up_from_down() -> None:
    """Bright rows at the nadir cost what they cost at the zenith."""
    light = np.zeros((GRID.rows, GRID.columns))
    light[:3] = 1

    def cost(cells: np.ndarray) -> float:
        return float(((GRID.differences @ cells.ravel()) ** 2).sum())

    assert cost(light) == pytest.approx(cost(light[::-1]), rel=1e-9)
    assert cost(light) != pytest.approx(cost(np.roll(light, 2, axis=0)), rel=1e-2)
