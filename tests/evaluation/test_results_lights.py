"""The lights of samples: from the suite where a file does not name them, and what is read from them."""

from dataclasses import replace

import pytest
from small_results import small_results

from unirender.errors import UnirenderError
from unirender_evaluation.comparisons import Selection, difference_over_lights, over_lights
from unirender_evaluation.results.lights import lights_of, sample_lights
from unirender_evaluation.results.merge import merged_lights
from unirender_evaluation.suites.suite import load_suite, material_key

PSNR = "albedo.psnr@masked-srgb-raw"


def test_a_sample_has_the_light_of_its_scene_and_that_which_it_is_relit_by() -> None:
    suite = load_suite("tiny")
    lights, first = sample_lights(suite), suite.scenes[0]
    other = suite.other_light(first)
    assert other.light != first.light
    assert lights[f"{first.key}_{material_key(first.materials[0])}"] == (first.light,)
    assert lights[f"{first.key}_to_{other.key.rpartition('_')[2]}"] == (first.light, other.light)
    assert lights[other.key] == (other.light, first.light), "what is asked of a scene as a whole relights it, too"


def test_of_a_file_without_lights_those_of_its_suite_count() -> None:
    suite = load_suite("tiny")
    scene = suite.scenes[0]
    of_tiny = small_results(suite="tiny", suite_hash=suite.sha256, resolution=64, methods=("ours-mean",))
    record = replace(of_tiny.records[0], sample=f"{scene.key}_{material_key(scene.materials[0])}", object=scene.object)
    unnamed = replace(of_tiny, records=(record,), lights={})
    assert lights_of([unnamed]) == sample_lights(suite)
    elsewhere = replace(unnamed, run=replace(unnamed.run, suite_hash="0" * 64))
    assert lights_of([elsewhere]) == {}, "of another truth nothing is known"


def test_values_of_samples_whose_lights_are_not_named_have_no_interval_over_them() -> None:
    results = small_results()
    albedo = Selection("inverse", "single-image").of(results.records)
    found = difference_over_lights(albedo, PSNR, "ours-mean", "input-as-albedo", merged_lights([results]))
    assert (found.mean, found.n, found.clusters) == (8, 4, 3)
    with pytest.raises(UnirenderError, match="the lights of 'ball-0_l0' and 1 more samples are not named, and"):
        over_lights({"ball-0_l0": 1.0, "ball-2_l0": 2.0}, albedo, {})
