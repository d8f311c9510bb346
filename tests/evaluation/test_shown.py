"""How objects show themselves in a notebook: by names, shapes and ranges, however many numbers they hold."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from reference_scenes import light, sphere
from small_results import small_records, small_results
from synthetic_shards import write_dataset

from unirender.camera import Camera
from unirender.intrinsics import Intrinsics
from unirender.pictures import Picture
from unirender.pipelines.results import Decomposition, EditResult
from unirender.shown import in_short
from unirender.training.data.dataset import GroupDataset
from unirender_evaluation.runs.benchmark import BenchResult
from unirender_evaluation.suites.suite import load_suite
from unirender_evaluation.tables.build import build_tables
from unirender_reference.optimize.views import View
from unirender_reference.passes import Estimate
from unirender_reference.render import Renderer, Sample, SceneSpec
from unirender_reference.shade import Gradients

IMAGE, MASK = np.linspace(0, 1, 16 * 16 * 3, dtype=np.float32).reshape(16, 16, 3), np.ones((16, 16, 1), np.float32)
MAPS = Intrinsics(albedo=IMAGE, mask=MASK)
FOUND = Decomposition(MAPS, 0.123456, 0.5, samples=(MAPS, MAPS))
SCENE = SceneSpec(sphere(subdivisions=3), light(), 0.3, None, resolution=8)
CASES: list[tuple[Any, str]] = [
    (Picture(IMAGE, None, "a.png", remarks={"dark": "it is dark"}), "Picture(image_srgb [16, 16, 3] in [0, 1], name="),
    (MAPS, "Intrinsics(albedo [16, 16, 3] in [0, 1], mask [16, 16, 1] in [1, 1], Camera("),
    (FOUND, "Decomposition(roughness=0.123, metallic=0.5, 2 samples, Intrinsics("),
    (EditResult(2 * IMAGE, MAPS, FOUND), "EditResult(image_linear [16, 16, 3] in [0, 2], bounded=0, coarse_share=0, "),
    (SCENE.obj, f"MeshObject(name={SCENE.obj.name!r}, family={SCENE.obj.family!r}, vertices ["),
    (SCENE.light, f"Light(name={SCENE.light.name!r}, environment [16, 32, 3] in ["),
    (SCENE, f"SceneSpec({SCENE.obj.name}, {SCENE.light.name}, roughness=0.3, metallic=None, Camera("),
    (Renderer(SCENE.obj, resolution=8), f"Renderer({SCENE.obj.name}, Camera(fov_deg=36.0, "),
    (Sample(IMAGE, MAPS, {"image": IMAGE}, {"spp": "8"}), "Sample(image_linear [16, 16, 3] in [0, 1], intrinsics=Int"),
    (Estimate(IMAGE, None), "Estimate(mean [16, 16, 3] in [0, 1], nan_pixels=0)"),
    (Gradients(roughness=MASK), "Gradients(roughness [16, 16, 1] in [1, 1])"),
    (View(IMAGE, MASK, Camera(), np.eye(4)), "View(image [16, 16, 3] in [0, 1], mask [16, 16, 1] in [1, 1], camera="),
    (small_results(), "Results(a: suite "),
    (small_results().run, "RunInfo(suite "),
    (build_tables(small_results().records, small_results().run)[0], "Table(Inverse rendering: from the image"),
    (BenchResult(tuple(small_records()), small_results().run, (), "", {}, 2, 1), "BenchResult(suite "),
    (load_suite("tiny"), "Suite(tiny, 48 scenes at 64 px)"),
]


@pytest.mark.parametrize(("shown", "begins"), CASES, ids=[type(case[0]).__name__ for case in CASES])
def test_an_object_shows_itself_in_a_line(shown: object, begins: str) -> None:
    assert repr(shown).startswith(begins)
    assert "\n" not in repr(shown)
    assert len(repr(shown)) < 400


def test_results_and_data_sets_show_how_much_they_hold(tmp_path: Path) -> None:
    assert f"{len(small_records())} records)" in repr(small_results())
    write_dataset(tmp_path, shards=1, groups=2)
    assert repr(GroupDataset(tmp_path)) == f"GroupDataset({tmp_path}, 2 groups of 16 x 16 px)"


def test_arrays_in_short() -> None:
    assert in_short(np.zeros((0, 3))) == "[0, 3]"
    assert in_short(np.array([True, False])) == "[2] in [0, 1]"
    assert in_short(np.array([7, 12345], np.int32)) == "[2] in [7, 1.23e+04]"
