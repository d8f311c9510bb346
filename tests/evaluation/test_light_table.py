"""The light table: balls under a light, the rows that a found light must beat, and lights from folders."""

import io
import json
import tarfile
import tomllib
from pathlib import Path

import numpy as np
import pytest
from tiny_suites import make_suite

from unirender.camera import Camera
from unirender.color import srgb_decode
from unirender.errors import UnirenderError
from unirender.exr import exr_bytes, image_channels, write_environment, write_exr
from unirender.intrinsics import Intrinsics
from unirender.light.environment import environment_directions, mean_radiance
from unirender.light.resampling import resample_environment
from unirender_evaluation.bounds import TRUE_LIGHT, ceiling_jobs
from unirender_evaluation.claims import light_claims
from unirender_evaluation.engine import answer, score
from unirender_evaluation.light_balls import GLOSSY_BALL, MATTE_BALL, ball_mask, ball_values, balls
from unirender_evaluation.methods.light import MeanLight, UniformLight
from unirender_evaluation.methods.mitsuba import mitsuba_jobs
from unirender_evaluation.metrics import LOG_EPSILON, metric_key
from unirender_evaluation.predictions.check import PredictionError, check_predictions
from unirender_evaluation.predictions.folder import PredictionFolder
from unirender_evaluation.records import MethodInfo, Record, RunInfo
from unirender_evaluation.results.verdict import claims_table
from unirender_evaluation.rows import make_row, prediction_rows, trivial_rows
from unirender_evaluation.suites.suite import Suite
from unirender_evaluation.table_list import ALL_TABLES
from unirender_evaluation.tables.build import build_table
from unirender_evaluation.task import Task
from unirender_evaluation.tasks import tasks
from unirender_evaluation.training_statistics import light_statistics, measure
from unirender_evaluation.verdict import findings
from unirender_reference.lights.light import area_resampled

RAW, ALIGNED = f"{MATTE_BALL}.rmse_relative@raw", f"{MATTE_BALL}.rmse_relative@aligned"
GLOSSY_ALIGNED = f"{GLOSSY_BALL}.rmse_relative@aligned"


@pytest.fixture(scope="module")
def suite(tmp_path_factory: pytest.TempPathFactory) -> Suite:
    return make_suite(tmp_path_factory.mktemp("lights"), objects=1)


def first(suite: Suite) -> Task:
    return next(tasks(suite, "light", "light-from-image", list(suite.scenes)))


def lamp(x: float, y: float, z: float, sharpness: float = 30.0) -> np.ndarray:
    """A dim light with one round lamp in that direction."""
    towards = np.array([x, y, z]) / np.linalg.norm([x, y, z])
    cosine = environment_directions(16, 32) @ towards
    return (0.05 + 10 * np.exp(sharpness * (cosine - 1)))[..., None].repeat(3, axis=-1).astype(np.float32)


def test_balls_in_uniform_light_are_uniform() -> None:
    """The matte one has the light's radiance; the glossy one lacks what a lobe sends below its horizon."""
    made = balls(np.full((16, 32, 3), 0.7, np.float32), 24)
    inside = ball_mask(24)[..., 0] > 0
    np.testing.assert_allclose(made[MATTE_BALL][inside], 0.7, rtol=2e-3)
    assert np.all(made[GLOSSY_BALL][inside] < 0.701)
    assert made[GLOSSY_BALL][12, 12, 0] == pytest.approx(
        0.7 * 0.915, rel=0.01
    )  # A + B of roughness 0.5 seen head on (Karis 2013)
    assert not made[MATTE_BALL][~inside].any()


@pytest.mark.parametrize(("direction", "axis"), [((1, 0, 0.3), 0), ((-1, 0, 0.3), 0), ((0, 1, 0.3), 1)])
def test_a_lamp_lights_its_own_side(direction: tuple[float, float, float], axis: int) -> None:
    """By the contract's axes: +x is right, +y is up, as on the object in the picture."""
    y, x = 1 - np.indices((32, 32)) / 15.5
    for ball in balls(lamp(*direction), 32).values():
        place = ((-x, y)[axis] * ball[..., 0]).sum() / ball[..., 0].sum()
        assert place * direction[axis] > 0.3


def test_a_lamp_at_the_viewer_lights_the_middle_and_one_behind_the_rim() -> None:
    front, behind = (balls(lamp(0, 0, z), 32) for z in (1.0, -1.0))
    for name in (MATTE_BALL, GLOSSY_BALL):
        assert front[name][16, 16, 0] > 5 * behind[name][16, 16, 0]
    aside = balls(lamp(-0.8, 0, -0.6), 32)[GLOSSY_BALL]  # behind, on the left: reflected by the left rim alone
    assert aside[16, 1, 0] > 5 * aside[16, 16, 0]
    assert aside[16, 1, 0] > 5 * aside[16, 30, 0]


def test_the_balls_errors_by_hand() -> None:
    uniform = np.ones((16, 32, 3), np.float32)
    same = ball_values(uniform, uniform)
    assert set(same.values()) == {0.0}
    twice = ball_values(2 * uniform, uniform)
    assert twice[RAW] == pytest.approx(1, abs=2e-3)  # |2 t - t| / t
    assert twice[ALIGNED] == pytest.approx(0, abs=1e-6)
    tinted = ball_values(uniform * np.array([1.3, 1, 0.7], np.float32), uniform)
    assert tinted[ALIGNED] > 0.1
    assert tinted[f"{MATTE_BALL}.rmse_relative@aligned_rgb"] == pytest.approx(0, abs=1e-6)


def test_the_further_the_lamp_the_worse() -> None:
    true = lamp(0, 0.3, 1)
    errors = [ball_values(lamp(x, 0.3, 1), true) for x in (0.0, 0.2, 0.6, 1.5)]
    for key in (ALIGNED, GLOSSY_ALIGNED):
        assert [error[key] for error in errors] == sorted(error[key] for error in errors)
        assert errors[0][key] == 0
    # A matte ball hardly tells lamps that a glossy one tells.
    assert errors[1][GLOSSY_ALIGNED] > 2 * errors[1][ALIGNED]


def test_the_question_gives_the_picture_and_keeps_the_light(suite: Suite) -> None:
    asked = list(tasks(suite, "light", "light-from-image", list(suite.scenes)))
    assert [task.sample for task in asked] == [f"{scene.key}_m050_r050" for scene in suite.scenes]
    task = asked[0]
    assert set(task.inputs["decompose"]) == {"image_srgb", "mask", "camera"}
    assert task.truth_maps is not None
    assert task.truth_maps.present == ("environment", "mask")
    assert not task.scores_picture


def test_the_true_light_scores_nothing_and_a_wrong_one_something(suite: Suite) -> None:
    from unirender_evaluation.engine import Prediction

    task = first(suite)
    truth = suite.environment(task.scene)
    exact = score(task, Prediction(maps=Intrinsics(environment=truth)), ())
    assert exact[RAW] == exact[GLOSSY_ALIGNED] == exact["environment.peak_deg"] == 0
    assert exact["environment.log_rmse_scaled"] < 1e-3
    turned = score(task, Prediction(maps=Intrinsics(environment=truth[::-1].copy())), ())
    assert turned["environment.log_rmse_scaled"] > 0.05
    assert turned[RAW] > 0.003
    assert score(task, Prediction(maps=Intrinsics(albedo=np.ones((8, 8, 3)))), ()) == {}  # no light found
    ringing = np.where(truth > np.median(truth), truth, np.float32(-5e-4))  # counts as 0
    cut = score(task, Prediction(maps=Intrinsics(environment=np.maximum(ringing, 0))), ())
    assert score(task, Prediction(maps=Intrinsics(environment=ringing)), ()) == cut


def test_rows_that_a_light_must_beat(suite: Suite) -> None:
    task = first(suite)
    scenes = list(suite.scenes)
    chosen = {row.info.key for row in trivial_rows() if row.answers(task, scenes)}
    assert chosen == {"uniform-light", "mean-light"}
    inverse = next(tasks(suite, "inverse", "single-image", scenes))
    assert not {row.info.key for row in trivial_rows() if row.answers(inverse, scenes)} & chosen
    grey = np.full((8, 8, 3), 0.5, np.float32)
    mask = np.zeros((8, 8, 1), np.float32)
    mask[2:5] = 1
    found = UniformLight().decompose(grey, mask, Camera()).environment
    assert found is not None
    np.testing.assert_allclose(found, srgb_decode(grey).mean() / 0.25, rtol=1e-5)
    mean = MeanLight().decompose(grey, mask, Camera()).environment
    assert mean is not None
    assert mean.shape == (16, 32, 3)
    assert np.ptp(mean, axis=1).max() == 0  # the same all around
    assert mean[:6].mean() > mean[-6:].mean() > 0  # light comes from above
    assert "training" in light_statistics()["provenance"]


def test_the_trivial_rows_constants_are_measured(tmp_path: Path) -> None:
    covered = np.zeros((8, 8), np.float32)
    covered[2:5] = 1
    shared = {"mask.Y": covered, **{f"albedo.{c}": covered * np.float32(0.25) for c in "RGB"}}
    shared |= {f"normal.{axis}": covered * np.float32(n) for axis, n in zip("XYZ", (0.6, 0, 0.8), strict=True)}
    files = {"a.shared.exr": exr_bytes(shared, half=False)}
    lights = [np.full((16, 32, 3), 0.2, np.float32) for _ in range(2)]
    lights[1][:8] = 0.8
    for i, light in enumerate(lights):
        channels = {c: light[..., k] for k, c in enumerate("RGB")}
        files[f"a.l{i}.environment.exr"] = exr_bytes(channels, half=False)
    with tarfile.open(tmp_path / "shard-000000.tar", "w") as tar:
        for name, content in files.items():
            info = tarfile.TarInfo(name)
            info.size = len(content)
            tar.addfile(info, io.BytesIO(content))
    (tmp_path / "manifest.json").write_text(json.dumps({"config": {"split": "train", "seed": 3, "resolution": 32}}))
    of_objects, of_lights = map(tomllib.loads, measure(tmp_path).values())
    np.testing.assert_allclose(of_objects["albedo_srgb"], 0.5371, rtol=0, atol=1e-4)  # 0.25, encoded
    assert of_objects["normal"] == [0.6, 0.0, 0.8]
    assert "1 training groups (split train, seed 3, 32 px)" in of_objects["provenance"]
    rows = np.array(of_lights["rows"], np.float32)
    upper = np.sqrt((0.2 + LOG_EPSILON) * (0.8 + LOG_EPSILON)) - LOG_EPSILON
    np.testing.assert_allclose(rows[:8] / rows[8:], upper / 0.2, rtol=2e-3)
    bright = mean_radiance(np.repeat(rows[:, None], 32, axis=1))
    np.testing.assert_allclose(bright, np.mean([mean_radiance(light) for light in lights], axis=0), rtol=2e-3)
    assert "2 lights" in of_lights["provenance"]
    empty = tmp_path / "empty"
    empty.mkdir()
    with pytest.raises(UnirenderError, match="no shard"):
        measure(empty)


def test_a_light_from_a_folder(suite: Suite, tmp_path: Path) -> None:
    task = first(suite)
    folder = tmp_path / "mine" / task.folder
    folder.mkdir(parents=True)
    truth = suite.environment(task.scene)
    write_environment(folder / "environment.exr", truth)
    rows = prediction_rows({"mine": tmp_path / "mine"})
    check_predictions(rows, suite)
    assert rows[0].answers(task, list(suite.scenes))
    assert score(task, answer(rows[0], task), ())[RAW] == 0
    inverse = next(tasks(suite, "inverse", "single-image", list(suite.scenes)))
    assert not rows[0].answers(inverse, list(suite.scenes))
    before = rows[0].info.config["predictions"]
    # A map from elsewhere: its pixels are areas, its rows lie half a texel from the poles.
    write_exr(folder / "environment.exr", image_channels(resample_environment(truth, (32, 64))), half=False)
    rows = prediction_rows({"mine": tmp_path / "mine"})
    assert rows[0].info.config["predictions"] != before
    assert 0 < score(task, answer(rows[0], task), ())[RAW] < 0.1


@pytest.mark.parametrize(("height", "row", "column"), [(8, 2, 3), (16, 5, 6), (24, 8, 30)])
def test_a_coarse_map_of_areas_keeps_its_lamps(tmp_path: Path, height: int, row: int, column: int) -> None:
    """On its own number of rows a lamp of 8 x 16 pixels was smeared: its glossy ball was 37 % off, of 16 x 32 8 %."""
    pixels = np.ones((height, 2 * height, 3), np.float32)
    pixels[row, column] = 100
    (tmp_path / "a").mkdir()
    write_exr(tmp_path / "a" / "environment.exr", image_channels(pixels), half=False)
    found = PredictionFolder(tmp_path).read_light(tmp_path / "a" / "environment.exr")
    true = area_resampled(pixels.repeat(16, axis=0).repeat(16, axis=1), (256, 512))
    assert ball_values(found, true)[f"{GLOSSY_BALL}.rmse_relative@raw"] < 0.01
    assert ball_values(area_resampled(pixels, pixels.shape[:2]), true)[RAW] > ball_values(found, true)[RAW]


@pytest.mark.parametrize(
    ("name", "light", "message"),
    [
        ("environment.exr", np.zeros((16, 32, 3)), "black"),
        ("environment.exr", np.ones((16, 16, 3)), "twice as wide as high"),
        ("environment.exr", np.full((16, 32, 3), 1e31), "limit them"),
        ("environment.png", np.ones((16, 32, 3)), "display values are no light, expected environment.exr or"),
    ],
)
def test_lights_that_cannot_be_scored_are_named(
    suite: Suite, tmp_path: Path, name: str, light: np.ndarray, message: str
) -> None:
    folder = tmp_path / "mine" / first(suite).folder
    folder.mkdir(parents=True)
    write_exr(folder / name, image_channels(light.astype(np.float32)), half=False)
    with pytest.raises(PredictionError, match=message) as caught:
        check_predictions(prediction_rows({"mine": tmp_path / "mine"}), suite)
    assert str(folder / name) in str(caught.value)


def test_an_hdr_file_is_read_too(suite: Suite, tmp_path: Path) -> None:
    """Four bytes a pixel, by the letter of the format: mantissas and a common exponent."""
    task = first(suite)
    folder = tmp_path / "mine" / task.folder
    folder.mkdir(parents=True)
    pixels = np.array([128, 64, 32, 129], np.uint8)  # 128 / 256 x 2^(129 - 128) = 1.0, 0.5, 0.25
    header = b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 4 +X 8\n"
    (folder / "environment.hdr").write_bytes(header + np.tile(pixels, 32).tobytes())
    rows = prediction_rows({"mine": tmp_path / "mine"})
    check_predictions(rows, suite)
    maps = answer(rows[0], task).maps
    assert maps is not None
    assert maps.environment is not None
    np.testing.assert_allclose(maps.environment, np.broadcast_to([1.0, 0.5, 0.25], (64, 128, 3)), rtol=0.01)


def test_lights_beside_pictures_that_do_not_ask_are_left_alone(suite: Suite, tmp_path: Path) -> None:
    """`unirender decompose` leaves one beside every picture."""
    inverse = next(tasks(suite, "inverse", "single-image", list(suite.scenes)))
    for folder in (first(suite).folder, inverse.folder):
        (tmp_path / "mine" / folder).mkdir(parents=True, exist_ok=True)
    write_environment(tmp_path / "mine" / first(suite).folder / "environment.exr", lamp(0, 1, 0))
    (tmp_path / "mine" / inverse.folder / "environment.exr").write_text("not looked at")
    (tmp_path / "mine" / inverse.folder / "environment.hdr").write_text("not looked at")
    check_predictions(prediction_rows({"mine": tmp_path / "mine"}), suite)


class Light:
    """Says the same light of every picture."""

    name = "same light"
    config: dict[str, int] = {"light": 1}  # noqa: RUF012 - a constant of the test

    def __init__(self, light: np.ndarray) -> None:
        self.light = light

    def decompose(self, image_srgb: np.ndarray, mask: np.ndarray, camera: Camera) -> Intrinsics:
        del image_srgb
        return Intrinsics(environment=self.light, mask=mask, camera=camera)


@pytest.mark.parametrize(
    "light",
    [np.ones((2, 2, 3)), np.ones((4, 7, 3)), np.zeros((4, 8, 3)), np.full((4, 8, 3), 2e30)],
)
def test_a_plug_in_whose_light_cannot_be_scored_is_named(suite: Suite, light: np.ndarray) -> None:
    row = make_row(Light(light.astype(np.float32)), "external")
    with pytest.raises(UnirenderError, match=r"method 'same light', decompose \(light/.*2 height"):
        answer(row, first(suite))
    inverse = next(tasks(suite, "inverse", "single-image", list(suite.scenes)))
    assert answer(row, inverse).maps is not None  # where no light is asked for, nobody looks at it
    assert answer(make_row(Light(lamp(0, 1, 0)), "external"), first(suite)).maps is not None


def test_the_verdict_says_which_numbers_of_a_light_are_aligned() -> None:
    records = []
    for i in range(3):
        for key, x in (("ours-mean", 0.2), ("mean-light", 0.5)):
            values = {RAW: x + 0.01 * i, ALIGNED: x / 2 + 0.01 * i}
            records.append(Record("light", "light-from-image", key, f"o{i}_l0", f"o{i}", values))
    lines = [str(finding) for finding in findings(records, light_claims("ours-mean"))]
    aligned = next(line for line in lines if "ball_matte error (aligned)" in line and "mean-light" in line)
    raw = next(line for line in lines if "ball_matte error (raw)" in line and "mean-light" in line)
    assert aligned.startswith("HOLDS")
    assert raw.startswith("stated")
    methods = (MethodInfo("ours-mean", "Ours (mean)", "ours"), MethodInfo("mean-light", "mean light", "trivial"))
    (claims,) = claims_table(RunInfo("t", "h", 64, methods), records, {}).sections
    numbers = [name.partition(": ")[2] for name, *_ in claims]
    assert numbers == ["Matte ball (aligned) error", "Matte ball error"], "as the columns of the table are called"
    assert "-0.3 " in raw


def test_two_lights_for_one_picture_are_refused(suite: Suite, tmp_path: Path) -> None:
    folder = tmp_path / "mine" / first(suite).folder
    folder.mkdir(parents=True)
    write_environment(folder / "environment.exr", lamp(0, 1, 0))
    (folder / "environment.hdr").write_text("#?RADIANCE")
    with pytest.raises(PredictionError, match=r"environment.exr and environment.hdr are both there"):
        check_predictions(prediction_rows({"mine": tmp_path / "mine"}), suite)


def test_bounds_of_the_light(suite: Suite) -> None:
    """A row for the true light at our resolution; none for Mitsuba, which is given the light."""
    scene = suite.scenes[0]

    def key_of(what: str, info: object, uses: object) -> str:
        return what

    jobs = [job for job in ceiling_jobs(suite, scene, key_of, ()) if job.key.startswith("light/")]
    assert [job.label for job in jobs] == [TRUE_LIGHT.label]
    record = jobs[0].make()
    assert record.values[metric_key(MATTE_BALL, "rmse_relative")] < 0.05
    asked = [job.key for job in mitsuba_jobs(suite, [scene], scene, key_of, (), None)]
    assert asked
    assert not [key for key in asked if key.startswith("light/")]


def test_the_table_names_its_columns(suite: Suite) -> None:
    values = ball_values(lamp(0, 1, 0), lamp(0, 1, 1))
    record = Record("light", "light-from-image", TRUE_LIGHT.key, "s", "o", values)
    run = RunInfo("tiny", "0" * 64, 64, (TRUE_LIGHT,))
    table = build_table(ALL_TABLES["light"], [record], run, protocol="light-from-image")
    assert [column.group for column in table.columns] == [
        "Matte ball",
        "Matte ball (aligned)",
        "Glossy ball",
        "Glossy ball (aligned)",
    ]
    assert all(cell.measured is not None for cell in table.rows[0].cells)
    said = dict(table.protocol)
    assert {"variant", "mask", "colour", "coverage", "LPIPS"}.isdisjoint(said)  # of pictures in a frame
    assert said["given"] == "one image and its mask"
    assert table.heading == "Light: from the image"
