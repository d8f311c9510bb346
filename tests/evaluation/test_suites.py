"""Suites: stratification, the suite file, the truth file's hash, what a task hands out."""

import re
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from tiny_suites import write_suite

from unirender.color import srgb_decode
from unirender.errors import UnirenderError
from unirender_evaluation.suites.spec import read_spec, suite_path
from unirender_evaluation.suites.stratification import stratified_materials
from unirender_evaluation.suites.suite import Suite, load_suite, material_key
from unirender_evaluation.task import PROTOCOLS
from unirender_evaluation.tasks import scene_ids, tasks


def test_tiny_materials_are_stratified_and_independent() -> None:
    spec = read_spec("tiny")
    materials = spec.materials()
    flat = np.array([m for scene in materials for m in scene])
    assert flat.shape == (240, 2)
    np.testing.assert_allclose(((flat - 0.5) ** 2).mean(axis=0), 0.1, rtol=0, atol=1e-12)
    for values in flat.T:
        counts = Counter(values)
        assert len(counts) == 11
        assert set(counts.values()) <= {21, 22}
    assert abs(np.corrcoef(flat.T)[0, 1]) < 0.02
    metallic = np.sort(np.array(materials)[..., 0], axis=1)
    assert (metallic[:, :-1].max(axis=0) <= metallic[:, 1:].min(axis=0)).all(), "one from each fifth"
    assert abs(np.corrcoef(metallic[:, 0], metallic[:, 1])[0, 1]) < 0.6  # 4 standard errors
    assert materials == spec.materials(), "the assignment is a pure function of the suite file"
    assert all(len(set(scene)) == 5 for scene in materials)


@pytest.mark.parametrize(("scenes", "per_scene"), [(6, 2), (20, 2), (40, 2), (60, 5)])
def test_the_constant_scores_alike_on_suites_of_every_size(scenes: int, per_scene: int) -> None:
    """Of a few objects a random share of the grid is not even: seed 1 of the first size gave 0.0875 and 0.1258."""
    for seed in range(4):
        materials = np.array(stratified_materials(scenes, per_scene, levels=11, seed=seed))
        np.testing.assert_allclose(((materials - 0.5) ** 2).mean(axis=(0, 1)), 0.1, rtol=0, atol=0.00201)


@pytest.mark.parametrize(("scenes", "per_scene", "levels"), [(4, 2, 11), (48, 5, 11), (10, 3, 5), (12, 3, 2)])
def test_every_size_has_different_materials_in_a_scene(scenes: int, per_scene: int, levels: int) -> None:
    materials = stratified_materials(scenes, per_scene, levels, seed=1)
    assert [len(set(row)) for row in materials] == [per_scene] * scenes


def test_a_material_is_named_in_percent() -> None:
    """The nearest: 0.29 times 100 is a little less than 29."""
    assert material_key((0.29, 0.57)) == "m029_r057"


def test_changed_truth_is_refused(tmp_path: Path) -> None:
    path = write_suite(tmp_path)
    load_suite(path)
    tar = tmp_path / "ball.tar"
    data = bytearray(tar.read_bytes())
    data[len(data) // 2] ^= 1
    tar.write_bytes(bytes(data))
    with pytest.raises(UnirenderError, match="was changed"):
        load_suite(path)
    tar.unlink()
    with pytest.raises(UnirenderError, match="has no truth file"):
        load_suite(path)


def test_broken_suite_files_are_named(tmp_path: Path) -> None:
    with pytest.raises(UnirenderError, match="expected one of paper, standard, tiny, or"):
        suite_path("no-such-suite")
    with pytest.raises(UnirenderError, match="no suite file"):
        read_spec(tmp_path / "none.toml")
    for text in ("name = ", f"name = {'9' * 5000}", f"name = {'[' * 3000}"):
        (tmp_path / "broken.toml").write_text(text)
        with pytest.raises(UnirenderError, match="is not TOML"):
            read_spec(tmp_path / "broken.toml")
    (tmp_path / "marked.toml").write_bytes((suite_path("tiny").read_text().replace("\n", "\r\n")).encode("utf-8-sig"))
    assert read_spec(tmp_path / "marked.toml") == read_spec("tiny"), "as editors on Windows write it"
    (tmp_path / "short.toml").write_text('name = "x"\nwrong = 1\n')
    with pytest.raises(UnirenderError, match=r"missing keys: .*unknown keys: wrong"):
        read_spec(tmp_path / "short.toml")
    good = suite_path("tiny").read_text()
    for name, wrong, message in (
        ("split", '"both"', "split is 'both'"),
        ("specular_roughness", "[0.3]", r"specular_roughness is \[0.3\], expected some of"),
        ("ceiling_scenes", "[[0, 2]]", r"ceiling_scenes has \[\(0, 2\)\], expected pairs"),
    ):
        broken = tmp_path / f"{name}.toml"
        broken.write_text(re.sub(rf"^{name} = .*$", f"{name} = {wrong}", good, flags=re.MULTILINE))
        with pytest.raises(UnirenderError, match=message):
            read_spec(broken)


def test_methods_see_eight_bits_and_nothing_else(suite: Suite) -> None:
    """No leakage: every input is the quantised picture, mask, camera and what the protocol gives away."""
    allowed = {
        "from-image": {"edit": {"image_srgb", "mask", "camera", "metallic", "roughness"}},
        "single-image": {"decompose": {"image_srgb", "mask", "camera"}},
        "from-image-sd": {
            "decompose": {"image_srgb", "mask", "camera"},
            "relight": {"image_srgb", "mask", "camera", "specular", "diffuse"},
        },
        "from-image-hdri": {
            "decompose": {"image_srgb", "mask", "camera"},
            "relight": {"image_srgb", "mask", "camera", "environment"},
        },
        "light-from-image": {"decompose": {"image_srgb", "mask", "camera"}},
        "given": {"render": {"intrinsics"}},
        "given-light": {"render": {"intrinsics"}},
    }
    seen = 0
    for table, protocol in PROTOCOLS:
        for task in tasks(suite, table, protocol, list(suite.scenes)):
            for capability, inputs in task.inputs.items():
                assert set(inputs) <= allowed[protocol][capability]
                if "image_srgb" in inputs:
                    picture = inputs["image_srgb"]
                    np.testing.assert_allclose(picture * 255, np.round(picture * 255), rtol=0, atol=1e-4)
                    assert np.all(picture[task.mask[..., 0] == 0] == 0)
                    seen += 1
            if protocol == "given":
                assert task.inputs["render"]["intrinsics"].environment is None
            if protocol == "given-light":
                assert set(task.inputs["render"]["intrinsics"].present).isdisjoint({"specular", "diffuse"})
            if table == "relighting":  # the light of the answer, not of the question
                own = suite.intrinsics(task.scene, suite.spec.base)
                given = task.inputs["relight"]
                assert given.get("environment") is None or np.abs(given["environment"] - own.environment).max() > 0.1
    assert seen > 0


def test_an_unquantised_picture_would_be_caught(suite: Suite) -> None:
    """Twin of the leakage test: the linear truth itself has more than 8 bits."""
    truth = suite.image(suite.scenes[0], suite.spec.base)
    task = next(tasks(suite, "rendering", "from-image", list(suite.scenes)))
    seen = task.inputs["edit"]["image_srgb"]
    assert np.abs(seen * 255 - np.round(seen * 255)).max() < 1e-4
    assert np.abs(truth * 255 - np.round(truth * 255)).max() > 0.3
    assert np.abs(srgb_decode(seen) * task.mask - truth).max() < 0.01


def test_what_a_suite_keeps_cannot_be_written_into(suite: Suite) -> None:
    scene = suite.scenes[0]
    with pytest.raises(ValueError, match="read-only"):
        suite.mask(scene)[...] = 0
    for array in (suite.image(scene, suite.spec.base), suite.environment(scene)):
        array[...] = 0
    again = load_suite(suite.spec.path)
    assert np.array_equal(suite.image(scene, suite.spec.base), again.image(scene, suite.spec.base))
    assert np.array_equal(suite.environment(scene), again.environment(scene))


def test_limited_runs_take_scenes_evenly(suite: Suite) -> None:
    assert len(scene_ids(suite, None)) == 4
    assert [s.key for s in scene_ids(suite, 2)] == [suite.scenes[0].key, suite.scenes[-1].key]
    with pytest.raises(UnirenderError, match="at least 1"):
        scene_ids(suite, 0)


def test_a_material_that_a_suite_does_not_store_is_told_with_those_that_it_does(suite: Suite) -> None:
    scene = suite.scenes[0]
    said = r"got \(metallic, roughness\) \(0\.15, 0\.3\), expected one of ball-0_l0: \(0\.5, 0\.5\), "
    for picture in (suite.image, suite.image_variance):
        with pytest.raises(UnirenderError, match=said):
            picture(scene, (0.15, 0.3))


def test_scenes_have_twins_where_the_suite_says(suite: Suite) -> None:
    first, second = suite.scenes[:2]
    base, rough = suite.spec.base, suite.spec.base[1]
    for material in (base, *suite.spec.edits):
        twin, image = suite.ceiling_image(first, material), suite.image(first, material)
        assert twin is not None
        assert 0 < np.abs(twin - image).max() < 0.02 * image.max()
        assert suite.ceiling_image(second, material) is None
    assert suite.ceiling_image(first, first.materials[0]) is None
    for twin, true in (
        (suite.ceiling_diffuse(first), suite.intrinsics(first, base).diffuse),
        (suite.ceiling_specular(first, rough), suite.intrinsics(first, base).specular),
    ):
        assert twin is not None
        assert true is not None
        assert 0 < np.abs(twin - true).max() < 0.02 * true.max()
    assert suite.ceiling_diffuse(second) is None
    assert suite.ceiling_specular(second, rough) is None
