"""Where Mitsuba's principled BSDF and environment light could make NaN: pinned, so that another version is noticed."""

import itertools
from typing import Any

import numpy as np
import pytest

from unirender_reference import materials
from unirender_reference.backend import mitsuba

ENDS = np.array([0.0, 2.0**-32, 0.25, 0.5, 0.75, 1 - 2.0**-24, 1.0], np.float32)  # the multi-jittered sampler reaches 1
COSINES = (1.0, 0.9, 0.5, 1e-3, 1e-6, 1e-20)


def sampled(wi: np.ndarray, lobe: np.ndarray, disc: np.ndarray, roughness: float, metallic: float) -> tuple[Any, Any]:
    """`bsdf.sample` of the principled surface: the sample and its weight."""
    mi = mitsuba()
    import drjit as dr

    bsdf = mi.load_dict(materials.principled_bsdf(np.array([0.7, 0.4, 0.2], np.float32), roughness, metallic))
    interaction = dr.zeros(mi.SurfaceInteraction3f, len(wi))
    interaction.wi = mi.Vector3f(np.ascontiguousarray(wi.T))
    interaction.n = mi.Normal3f(0, 0, 1)
    interaction.sh_frame = mi.Frame3f(mi.Normal3f(0, 0, 1))
    return bsdf.sample(mi.BSDFContext(), interaction, mi.Float(lobe), mi.Point2f(np.ascontiguousarray(disc.T)))


@pytest.mark.parametrize(("roughness", "metallic"), [(0.001, 0.5), (0.3, 0.001), (0.3, 0.999), (1.0, 0.5)])
def test_ends_of_the_unit_interval_give_no_nan_weight(roughness: float, metallic: float) -> None:
    grid = np.array(list(itertools.product(ENDS, ENDS, ENDS, COSINES, (0.0, 0.7, np.pi / 2))), np.float32)
    sine = np.sqrt(np.maximum(1 - grid[:, 3] ** 2, 0))
    wi = np.stack([sine * np.cos(grid[:, 4]), sine * np.sin(grid[:, 4]), grid[:, 3]], axis=-1)
    drawn, weight = sampled(wi, grid[:, 0], grid[:, 1:3], roughness, metallic)
    assert np.isfinite(np.array(weight)).all()
    assert np.isfinite(np.array(drawn.pdf)).all()
    assert np.array(weight).min() >= 0


def test_direction_is_nan_at_normal_incidence_on_the_border_of_the_disc_and_weighs_nothing() -> None:
    """The one NaN that was found; a direction half-way to the horizon has none."""
    disc = np.array([[0.0, 0.3]], np.float32).repeat(2, axis=0)
    wi = np.array([[0.0, 0.0, 1.0], [0.6, 0.0, 0.8]], np.float32)
    drawn, weight = sampled(wi, np.full(2, 0.9, np.float32), disc, 0.3, 0.9)
    assert np.isnan(np.array(drawn.wo)).all(axis=0).tolist() == [True, False]
    assert not np.array(weight).any()
    assert not np.array(drawn.pdf)[0]


def test_light_gives_no_nan_at_its_poles() -> None:
    mi = mitsuba()
    import drjit as dr

    bitmap = mi.Bitmap(np.random.default_rng(0).random((16, 32, 3)).astype(np.float32))
    scene = mi.load_dict({"type": "scene", "light": {"type": "envmap", "bitmap": bitmap}, "shape": {"type": "sphere"}})
    grid = np.array(list(itertools.product(ENDS, ENDS)), np.float32)
    point = dr.zeros(mi.SurfaceInteraction3f, len(grid))
    point.p = mi.Point3f(0, 0, 2)
    drawn, weight = scene.emitters()[0].sample_direction(point, mi.Point2f(np.ascontiguousarray(grid.T)))
    assert np.isfinite(np.array(weight)).all()
    assert np.isfinite(np.array(drawn.pdf)).all()
    assert (np.array(drawn.pdf) == 0).sum() >= 1  # exactly at a pole
