"""The rows that need no network: known values, capabilities, anchoring, plug-ins."""

import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from unirender.camera import Camera
from unirender.color import srgb_decode
from unirender.errors import UnirenderError
from unirender.intrinsics import Intrinsics
from unirender_evaluation.claims import SHADOWED
from unirender_evaluation.engine import Prediction, answer, method_jobs, score
from unirender_evaluation.methods import method as methods
from unirender_evaluation.methods.composite import Composite, CompositeOf, SplitSum, with_derived_light
from unirender_evaluation.methods.trivial import (
    ConstantMaterial,
    InputAsAlbedo,
    MeanAlbedo,
    MeanNormal,
    SphereNormal,
    UneditedInput,
)
from unirender_evaluation.physics.rows import _record
from unirender_evaluation.physics.stage import Stage
from unirender_evaluation.report.pictures import Pictures
from unirender_evaluation.rows import check_rows, make_row, slug, trivial_rows
from unirender_evaluation.suites.suite import Suite
from unirender_evaluation.task import PROTOCOLS
from unirender_evaluation.tasks import tasks
from unirender_evaluation.training_statistics import training_statistics
from unirender_evaluation.versions import LPIPS, Versions


def test_constant_half_scores_the_spread_of_the_materials(suite: Suite) -> None:
    values: list[float] = []
    expected: list[float] = []
    for task in tasks(suite, "inverse", "single-image", list(suite.scenes)):
        maps = ConstantMaterial().decompose(**task.inputs["decompose"])
        values.append(score(task, Prediction(maps=maps), ())["metallic.mse@masked"])
        metallic = float(task.sample.split("_m")[1][:3]) / 100
        expected.append((metallic - 0.5) ** 2)
    np.testing.assert_allclose(values, expected, rtol=0, atol=2e-4)  # half floats in the file


def test_unedited_input_is_the_input(suite: Suite) -> None:
    task = next(tasks(suite, "rendering", "from-image", list(suite.scenes)))
    image = UneditedInput().edit(**task.inputs["edit"])
    base = suite.image(task.scene, suite.spec.base)
    np.testing.assert_allclose(image, np.minimum(base, 1), rtol=0, atol=0.01)
    assert score(task, Prediction(image=image), ())["edit_metallic.psnr@masked-srgb-raw"] < 40


def test_composite_is_exact_where_the_truth_is_a_composite(suite: Suite) -> None:
    """Given s and d: limited by half floats only. Given light: derived s and d are this suite's truth. A wrong albedo
    is seen."""
    for protocol in ("given", "given-light"):
        for task in tasks(suite, "rendering", protocol, list(suite.scenes)[:2]):
            maps = task.inputs["render"]["intrinsics"]
            key = f"{task.quantity}.psnr@masked-srgb-raw"
            good = score(task, Prediction(image=Composite().render(maps)), ())[key]
            wrong = Composite().render(maps.replace(albedo=0.9 * maps.albedo))
            assert good > 55
            assert score(task, Prediction(image=wrong), ())[key] < 45


def test_composite_derives_the_one_that_it_was_not_given(suite: Suite) -> None:
    maps = next(tasks(suite, "rendering", "given-light", list(suite.scenes))).inputs["render"]["intrinsics"]
    derived, outside = with_derived_light(maps), maps.require("mask")["mask"] == 0
    for name in ("specular", "diffuse"):
        assert not (derived.require(name)[name] * outside).any()
        np.testing.assert_array_equal(
            Composite().render(derived.replace(**{name: None})), Composite().render(maps), err_msg=name
        )


def test_split_sum_adds_the_angle_of_the_fresnel_term(suite: Suite) -> None:
    """On both protocols; the truth of this suite has no angle, so that here it is the brighter and the worse row."""
    row = next(row for row in trivial_rows() if row.info.key == "composite-split-sum")
    for protocol in ("given", "given-light"):
        for task in tasks(suite, "rendering", protocol, [suite.scenes[0]]):
            assert row.answers(task, list(suite.scenes))
            maps = task.inputs["render"]["intrinsics"]
            split, plain = (method.render(maps) for method in (row.method, Composite()))
            assert np.all(split >= plain - 1e-6)
            assert 1.005 < split.sum() / plain.sum() < 1.3
    for table, protocol in (("rendering", "from-image"), ("inverse", "single-image")):
        assert not row.answers(next(tasks(suite, table, protocol, [suite.scenes[0]])), list(suite.scenes))


def test_split_sum_with_seen_shadows(suite: Suite) -> None:
    """Only where s and d have to be derived; a bowl's walls hide light, a ball's hide none."""
    row = next(row for row in trivial_rows() if row.info.key == SHADOWED)
    for protocol, expected in (("given-light", True), ("given", False)):
        assert row.answers(next(tasks(suite, "rendering", protocol, [suite.scenes[0]])), list(suite.scenes)) == expected
    task = next(tasks(suite, "rendering", "given-light", [suite.scenes[0]]))
    ball = task.inputs["render"]["intrinsics"]
    bowl = ball.replace(normal=ball.normal * np.array([-1, -1, 1], np.float32))
    shares = [row.method.render(maps).sum() / SplitSum().render(maps).sum() for maps in (ball, bowl)]
    assert shares[0] == pytest.approx(1, abs=0.02)
    assert 0.3 < shares[1] < 0.9


def test_input_as_albedo_and_constants(suite: Suite) -> None:
    task = next(tasks(suite, "inverse", "single-image", list(suite.scenes)))
    inputs = task.inputs["decompose"]
    albedo = InputAsAlbedo().decompose(**inputs).require("albedo")["albedo"]
    np.testing.assert_allclose(albedo, srgb_decode(inputs["image_srgb"]), rtol=0, atol=1e-6)
    mean = MeanAlbedo().decompose(**inputs).require("albedo")["albedo"]
    inside = task.mask[..., 0] > 0
    np.testing.assert_allclose(
        mean[inside][0], srgb_decode(np.array(training_statistics()["albedo_srgb"], np.float32)), rtol=0, atol=1e-6
    )
    assert np.all(mean[~inside] == 0)
    assert "training" in training_statistics()["provenance"]


def test_sphere_normal_is_exact_on_a_sphere(suite: Suite) -> None:
    task = next(tasks(suite, "inverse", "single-image", list(suite.scenes)))
    sphere = score(task, Prediction(maps=SphereNormal().decompose(**task.inputs["decompose"])), ())
    flat = score(task, Prediction(maps=MeanNormal().decompose(**task.inputs["decompose"])), ())
    assert sphere["normal.cosine"] > 0.99
    assert flat["normal.cosine"] < 0.75


class TrueMaps:
    """A decomposition oracle: knows the truth of one scene."""

    name = "truth"
    config: dict[str, Any] = {"oracle": 1}  # noqa: RUF012 - a constant of the test

    def __init__(self, maps: Intrinsics) -> None:
        self.maps = maps

    def decompose(self, image_srgb: np.ndarray, mask: np.ndarray, camera: Camera) -> Intrinsics:
        del image_srgb, mask, camera
        return self.maps


def test_composite_of_a_perfect_decomposition_edits_perfectly(suite: Suite) -> None:
    """Metallic exactly; roughness by the ratio of lobes, better than leaving the picture alone."""
    for task in tasks(suite, "rendering", "from-image", [suite.scenes[1]]):
        oracle = TrueMaps(suite.intrinsics(task.scene, suite.spec.base))
        key = f"{task.quantity}.psnr@masked-srgb-raw"
        unedited = score(task, Prediction(image=UneditedInput().edit(**task.inputs["edit"])), ())[key]
        for anchored in (False, True):
            image = CompositeOf(oracle, anchored).edit(**task.inputs["edit"])
            found = score(task, Prediction(image=image), ())[key]
            assert found > max(unedited + 2, 45 if task.quantity == "edit_metallic" else 0)


def test_relighting_with_true_maps(suite: Suite) -> None:
    for protocol in ("from-image-sd", "from-image-hdri"):
        task = next(tasks(suite, "relighting", protocol, [suite.scenes[0]]))
        oracle = TrueMaps(suite.intrinsics(task.scene, suite.spec.base))
        image = CompositeOf(oracle, anchored=False).relight(**task.inputs["relight"])
        assert score(task, Prediction(image=image), ())["relit.psnr@masked-srgb-raw"] > 55


def test_who_can_do_one_of_the_things_that_are_asked_takes_part(suite: Suite) -> None:
    task = next(tasks(suite, "relighting", "from-image-sd", [suite.scenes[0]]))
    assert task.asks == ("relight", "decompose")
    for method, expected in ((UneditedInput(), True), (ConstantMaterial(), True), (Composite(), False)):
        assert make_row(method, "baseline").answers(task, list(suite.scenes)) == expected


def test_capabilities_are_checked() -> None:
    assert methods.capabilities(UneditedInput()) == ("edit", "relight")
    assert methods.capabilities(Composite()) == ("render",)

    class Empty:
        name = "empty"
        config: dict[str, Any] = {}  # noqa: RUF012 - a constant of the test

    with pytest.raises(UnirenderError, match="is not a method"):
        methods.check_method(Empty())


def test_arguments_of_other_names_are_refused_before_a_run() -> None:
    """They are passed by name: a run failed at its first question, after the truth check."""

    class Renamed:
        name = "renamed"
        config: dict[str, Any] = {}  # noqa: RUF012 - a constant of the test

        def render(self, maps: Intrinsics) -> np.ndarray | None:
            return None

    class Loose:
        name = "loose"
        config: dict[str, Any] = {}  # noqa: RUF012 - a constant of the test

        def render(self, **given: Any) -> np.ndarray | None:
            return None

    with pytest.raises(UnirenderError, match=r"Renamed.render takes \(maps: .*, expected the arguments intrinsics,"):
        methods.check_method(Renamed())
    methods.check_method(Loose())
    for trivial in (UneditedInput(), InputAsAlbedo(), Composite()):
        methods.check_method(trivial)


class Careless:
    """A stranger's method whose properties fail, or are slow: what they say is read once, and a failure named."""

    def __init__(self, **raised: Exception) -> None:
        self.raised, self.read = raised, 0

    @property
    def name(self) -> str:
        return self._said("name", "careless")

    @property
    def config(self) -> dict[str, Any]:
        self.read += 1
        return self._said("config", {})

    def _said(self, attribute: str, value: Any) -> Any:
        if attribute in self.raised:
            raise self.raised[attribute]
        return value

    def decompose(self, image_srgb: np.ndarray, mask: np.ndarray, camera: Camera) -> None:
        return None


@pytest.mark.parametrize("attribute", ["name", "config"])
@pytest.mark.parametrize("error", [RuntimeError("no weights"), AttributeError("no attribute 'weights'")])
def test_a_property_that_fails_is_named(attribute: str, error: Exception) -> None:
    method = Careless(**{attribute: error})
    methods.check_method(method)  # it is there
    with pytest.raises(UnirenderError, match=f"Careless: reading its `{attribute}` failed: {type(error).__name__}: no"):
        make_row(method, "external")


def test_a_config_is_read_once(suite: Suite) -> None:
    """It may take the sha256 of weights."""
    method, scenes = Careless(), list(suite.scenes)
    row = make_row(method, "external")
    assert any(row.answers(task, scenes) for what in PROTOCOLS for task in tasks(suite, *what, scenes))
    assert method.read == 1


def test_rows_are_unique_and_named() -> None:
    rows = check_rows(trivial_rows())
    assert {row.info.key for row in rows} >= {
        "unedited-input",
        "input-as-albedo",
        "mean-albedo",
        "mean-normal",
        "constant-0-5",
    }
    assert slug("Ours (mean, anchored)") == "ours-mean-anchored"
    with pytest.raises(UnirenderError, match="occur twice"):
        check_rows([*rows, rows[0]])


def test_answer_asks_only_for_what_a_method_can(suite: Suite) -> None:
    row = make_row(InputAsAlbedo(), "trivial")
    edit = next(tasks(suite, "rendering", "from-image", list(suite.scenes)))
    assert not row.answers(edit, list(suite.scenes))
    inverse = next(tasks(suite, "inverse", "single-image", list(suite.scenes)))
    prediction = answer(row, inverse)
    assert prediction.image is None
    assert prediction.maps is not None
    assert prediction.maps.present == ("albedo", "mask")


def test_predictions_folder_is_needed(tmp_path: Path) -> None:
    from unirender_evaluation.predictions.folder import PredictionFolder

    with pytest.raises(UnirenderError, match="has no subfolders, expected one per picture"):
        PredictionFolder(tmp_path)
    with pytest.raises(UnirenderError, match="nowhere: no such folder"):
        PredictionFolder(tmp_path / "nowhere")


class Silent(Careless):
    """Has no answer to any question, and counts them."""

    def __init__(self) -> None:
        super().__init__()
        self.asked = 0

    def decompose(self, image_srgb: np.ndarray, mask: np.ndarray, camera: Camera) -> None:
        self.asked += 1

    def edit(self, image_srgb: np.ndarray, mask: np.ndarray, camera: Camera, **_: Any) -> None:
        return None

    relight = edit

    def render(self, intrinsics: Intrinsics) -> None:
        return None


def test_none_is_no_answer(suite: Suite, tmp_path: Path) -> None:
    """To any question: a record without values, and no picture in the report."""
    method, scenes = Silent(), [suite.scenes[0]]
    row = make_row(method, "external")
    pictures = Pictures(tmp_path, suite, scenes)
    jobs = list(method_jobs(suite, [row], scenes, scenes[0], Versions("test", {LPIPS: "1"}), (), pictures))
    records = [job.make() for job in jobs]
    assert {(record.table, record.protocol) for record in records} == set(PROTOCOLS)
    assert not any(record.values for record in records)
    shown = {task.inputs["decompose"]["image_srgb"].tobytes() for what in PROTOCOLS
             for task in tasks(suite, *what, scenes) if "decompose" in task.asks}  # fmt: skip
    assert method.asked == len(shown)
    physics = _record(Stage(suite, scenes[0]), row, "key")
    assert not physics.values
    assert method.asked == len(shown)


class Patient:
    """Takes its time to decompose, and counts how often it has to."""

    name = "patient"
    config: dict[str, Any] = {}  # noqa: RUF012 - as strangers write it

    def __init__(self) -> None:
        self.asked = 0

    def decompose(self, image_srgb: np.ndarray, mask: np.ndarray, camera: Camera) -> Intrinsics:
        self.asked += 1
        time.sleep(0.05)
        return Intrinsics(albedo=srgb_decode(image_srgb), mask=mask, camera=camera)


def test_a_strangers_method_decomposes_a_picture_once(suite: Suite) -> None:
    """Relighting and light ask for the picture of the base material; each answer's seconds hold the decomposition's."""
    method, scene = Patient(), suite.scenes[0]
    row = make_row(method, "external")
    asking = [task for what in PROTOCOLS for task in tasks(suite, *what, [scene]) if "decompose" in task.asks]
    answers = [answer(row, task) for task in asking]
    pictures = {(task.inputs["decompose"]["image_srgb"].tobytes()) for task in asking}
    assert method.asked == len(pictures) == len(asking) - 1
    assert all(found.seconds is not None and found.seconds >= 0.05 for found in answers)
    for task, found in zip(asking, answers, strict=True):
        assert found.maps is not None
        np.testing.assert_array_equal(found.maps.albedo, srgb_decode(task.inputs["decompose"]["image_srgb"]))
