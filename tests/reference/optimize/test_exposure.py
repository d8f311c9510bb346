"""Linear pictures of any scale: the same materials, a light of their scale, and nothing to see is refused."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
from optimizer_runs import CONFIG, flat_start, rendered_views, truth

from unirender.errors import UnirenderError
from unirender.exr import channels_rgb, read_exr
from unirender_reference.optimize.exposure import divided_views, exposure_of_views, lit
from unirender_reference.optimize.multiview.config import OptimizeConfig
from unirender_reference.optimize.multiview.run import _plan, _Run, optimize
from unirender_reference.optimize.solution import Solution
from unirender_reference.optimize.views import View, Views


@pytest.fixture(scope="module")
def views() -> Views:
    return rendered_views(truth(), seen=4, held_out=1, side=20, hdr=True)


def brighter(views: Views, factor: float) -> Views:
    def times(view: View) -> View:
        return dataclasses.replace(view, image=view.image * np.float32(factor))

    return dataclasses.replace(views, seen=tuple(map(times, views.seen)), held_out=tuple(map(times, views.held_out)))


def materials_error(one: Solution, other: Solution) -> float:
    """The largest difference of any texel."""
    pairs = [(getattr(one.obj, name), getattr(other.obj, name)) for name in ("albedo", "roughness", "metallic")]
    return max(float(np.abs(a - b).max()) for a, b in pairs)


def test_exposure_has_the_scale_of_the_pictures(views: Views):
    exposure = exposure_of_views(views)
    for factor in (100.0, 0.01):
        assert exposure_of_views(brighter(views, factor)) == pytest.approx(factor * exposure, rel=1e-6)
    near = divided_views(views, exposure)
    assert exposure_of_views(near) == pytest.approx(1, rel=1e-6)
    np.testing.assert_allclose(near.held_out[0].image * exposure, views.held_out[0].image, rtol=1e-6)
    display = rendered_views(truth(), seen=1, held_out=0)
    assert exposure_of_views(display) == 1
    assert divided_views(display, 2.0) is display


def test_one_bright_picture_hardly_moves_the_exposure(views: Views):
    """A highlight of a thousand times the light in a thousandth of the pixels."""
    image = views.seen[0].image.copy()
    row, column = np.argwhere(views.seen[0].mask[..., 0] == 1)[0]
    image[row, column] = 1000 * views.seen[0].image.mean()
    lamp = dataclasses.replace(views, seen=(dataclasses.replace(views.seen[0], image=image), *views.seen[1:]))
    assert exposure_of_views(lamp) == pytest.approx(exposure_of_views(views), rel=0.1)
    assert image.mean() > 3 * views.seen[0].image.mean()  # the mean is another


@pytest.mark.long
def test_the_scale_of_linear_pictures_does_not_matter(views: Views):
    """Equal materials, up to the rounding of float32, and the light times the factor; not so without the exposure."""
    start, factor = flat_start(truth().obj), 100.0
    found = optimize(views, None, CONFIG, init=start, threads=1)
    other = optimize(brighter(views, factor), None, CONFIG, init=lit(start, factor), threads=1)
    assert materials_error(found, other) < 1e-3
    np.testing.assert_allclose(other.environment, factor * found.environment, rtol=5e-3)
    run = _Run(brighter(views, factor), CONFIG, None, lambda report: None, _plan(None, start, CONFIG))
    twin = run.solution(None, lit(start, factor))
    assert materials_error(found, twin) > 0.01


@pytest.mark.long
def test_figures_are_those_at_the_exposure_and_files_have_the_scale_of_the_pictures(views: Views, tmp_path: Path):
    start = flat_start(truth().obj)
    optimize(views, None, CONFIG, tmp_path / "one", init=start, threads=1, pictures=False)
    optimize(brighter(views, 128), None, CONFIG, tmp_path / "more", init=lit(start, 128), threads=1, pictures=False)
    one, more = (json.loads((tmp_path / name / "solution.json").read_text()) for name in ("one", "more"))
    assert one["figures"] == more["figures"]
    assert more["inputs"]["exposure"] == 128 * one["inputs"]["exposure"]
    one, more = (channels_rgb(read_exr(tmp_path / name / "environment.exr")[0]) for name in ("one", "more"))
    np.testing.assert_array_equal(more, 128 * one)


@pytest.mark.slow
def test_the_solve_does_not_see_the_scale(views: Views):
    config = OptimizeConfig(refine=dataclasses.replace(CONFIG.refine, enabled=False), texture_size=16, light_rows=8)
    found = optimize(views, truth().obj, config, threads=1)
    other = optimize(brighter(views, 0.01), truth().obj, config, threads=1)
    assert materials_error(found, other) < 1e-2
    np.testing.assert_allclose(100 * other.environment, found.environment, rtol=1e-2, atol=1e-4)


def test_black_pictures_are_refused_before_anything_is_written(views: Views, tmp_path: Path):
    for given in (brighter(views, 0.0), rendered_views(lit(truth(), 1e-9), seen=2, held_out=0)):
        with pytest.raises(UnirenderError, match="black wherever their masks cover them"):
            optimize(given, truth().obj, CONFIG, tmp_path / "out")
    assert not (tmp_path / "out").exists()
