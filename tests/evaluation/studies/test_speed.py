"""`unirender bench speed`: what is timed is what is said, ratios are those of the seconds, refused options."""

import dataclasses
import json
import math
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from rich.console import Console
from synthetic_shards import write_dataset
from tiny_models import SIZE, TRAIN, make_batch, make_model, make_pipeline

from unirender.errors import UnirenderError
from unirender.training.config import RunConfig, TrainConfig
from unirender.training.loop.trainer import Trainer
from unirender.training.presets import get_preset
from unirender_evaluation.studies.speed import network
from unirender_evaluation.studies.speed.bare import BarePasses, Rows, cut_batch
from unirender_evaluation.studies.speed.command import BenchSpeed
from unirender_evaluation.studies.speed.mitsuba import (
    EqualQuality,
    equal_quality,
    fewest_samples,
    is_sample_count,
    mitsuba_table,
)
from unirender_evaluation.studies.speed.overfit import (
    Point,
    as_intrinsics,
    both_directions,
    one_pair,
    overfit,
    overfit_config,
    overfit_table,
    picture_errors,
    reached,
)
from unirender_evaluation.studies.speed.run import run
from unirender_evaluation.studies.speed.start import SPLIT, cold_starts, run_process, start_table
from unirender_evaluation.studies.speed.timing import Part, Timing, medians, timed
from unirender_evaluation.studies.speed.training import throughput, training_table
from unirender_evaluation.suites.suite import Suite
from unirender_evaluation.tables.text import TextTable
from unirender_reference.sample_counts import SAMPLES_PER_PASS, pass_count

CPU = torch.device("cpu")
PLAIN = dataclasses.replace(TRAIN, model=dataclasses.replace(TRAIN.model, physics_prior="none"))


@pytest.fixture(scope="module")
def shards(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Pictures of the tiny model's size."""
    return write_dataset(tmp_path_factory.mktemp("data"), shards=1, groups=2, size=SIZE)


def test_timing_leaves_the_warm_up_out() -> None:
    waits = iter([0.2, 0.01, 0.01, 0.01])
    found = timed(lambda: time.sleep(next(waits)), repeats=3)
    assert len(found.seconds) == 3
    assert 0.01 <= found.median < 0.15
    assert Timing((3.0, 1.0, 2.0)).median == 2
    assert medians([{"a": 1.0, "b": 5.0}, {"a": 3.0, "b": 1.0}, {"a": 2.0, "b": 2.0}]) == {"a": 2.0, "b": 2.0}


def test_the_network_is_timed_per_picture(suite: Suite, monkeypatch: pytest.MonkeyPatch) -> None:
    """A pipeline that takes 20 ms a step and call, whatever the batch."""
    monkeypatch.setattr(network, "STEPS", (1, 2))
    monkeypatch.setattr(network, "BATCHES", (1, 4))
    asked = []

    def answer(*_: Any, **how: Any) -> None:
        asked.append((how["num_inference_steps"], how["num_samples"]))
        time.sleep(0.02 * how["num_inference_steps"])

    pipeline = SimpleNamespace(decompose=answer, render=answer)
    found = network.network_times(pipeline, suite, suite.scenes[0], repeats=2)
    assert len(asked) == 3 * len(found)
    by_key = {(t.what, t.batch, t.steps): t.milliseconds for t in found}
    assert by_key.keys() == {
        *((what, 1, steps) for what in (network.DECOMPOSE, network.CLOSED, network.RENDER) for steps in (1, 2)),
        *((what, 4, steps) for what in (network.DECOMPOSE, network.RENDER) for steps in (1, 2)),
    }
    assert by_key[network.DECOMPOSE, 1, 1] >= 20
    assert by_key[network.RENDER, 1, 2] >= 40
    assert network.NetworkTime(network.RENDER, 2, 4, Timing((0.04, 1.0, 0.01))).milliseconds == pytest.approx(10)
    table = network.network_table(found, SIZE, 2)
    assert table.columns[1:] == ("batch 1, 1 step", "batch 1, 2 steps", "batch 4, 1 step", "batch 4, 2 steps")
    assert table.sections[0][1][3:] == ("-", "-"), "closed: batch 1 alone"


def test_a_real_pipeline_is_timed(suite: Suite, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(network, "STEPS", (1, 2))
    monkeypatch.setattr(network, "BATCHES", (2,))
    part = network.network_part(make_pipeline(), suite, suite.scenes[0], 1)
    assert part.data["resolution"] == SIZE
    assert all(entry["ms_per_picture"] == pytest.approx(500 * entry["median_s"]) for entry in part.data["times"])


def test_mitsuba_gets_no_more_samples_than_it_needs() -> None:
    """A renderer whose error falls as its samples grow: 20 dB at 1, 3 dB more for each doubling."""
    tried = []

    def psnr_at(spp: int) -> float:
        tried.append(spp)
        return 20 + 10 * math.log10(spp)

    def any_count(spp: int) -> bool:
        return spp > 0

    assert fewest_samples(psnr_at, 31.0, 64, any_count) == (13, pytest.approx(31.14, abs=0.01))
    assert tried == [1, 2, 4, 8, 16, 12, 14, 13]
    spp, reached = fewest_samples(psnr_at, 60.2, 1 << 14, any_count) or (0, 0.0)
    assert 60.2 <= reached < 60.2 + 10 * math.log10(17 / 16)
    assert 10472 <= spp < 10472 * 17 / 16
    assert fewest_samples(psnr_at, 20.0, 64, any_count) == (1, 20.0)
    assert fewest_samples(psnr_at, 39.0, 64, any_count) is None
    even = fewest_samples(psnr_at, 31.0, 64, lambda spp: spp % 2 == 0)
    assert even == (14, pytest.approx(31.46, abs=0.01))


def test_only_sample_counts_that_render_are_tried() -> None:
    """22 in one batch are no few full grids."""
    allowed = [spp for spp in range(1, 300) if is_sample_count(spp, 64)]
    assert 22 not in allowed
    assert {1 << power for power in range(9)} <= set(allowed)
    assert len([pass_count(spp, 1, SAMPLES_PER_PASS // 64**2) for spp in allowed]) > 50  # none is refused


def test_mitsuba_is_timed_on_the_scene_of_the_suite(suite: Suite) -> None:
    """A model that renders nothing is reached at once; one of the truth itself never is."""
    scene = suite.scenes[0]
    black = SimpleNamespace(render=lambda maps: np.zeros((SIZE, SIZE, 3), np.float32))
    found = equal_quality(black, suite, scene, repeats=1, most=4)
    assert [one.given for one in found] == ["given", "given light"]
    for one in found:
        assert one.spp == 1
        assert one.warm_s is not None
        assert one.loading_s is not None
        assert one.ratio == pytest.approx(one.warm_s / one.model_s)
        assert one.loading_ratio == pytest.approx(one.loading_s / one.model_s)
        assert one.mitsuba_psnr is not None
        assert one.mitsuba_psnr >= one.psnr
    seen = []

    def perfect(maps: Any) -> np.ndarray:
        seen.append(maps.present)
        return suite.image(scene, suite.spec.edits[0])

    never = equal_quality(SimpleNamespace(render=perfect), suite, scene, repeats=1, most=1)
    assert {(one.spp, one.ratio) for one in never} == {(None, None)}
    assert "environment" not in seen[0]
    assert "specular" in seen[0]
    assert "environment" in seen[-1]
    assert not {"specular", "diffuse"} & set(seen[-1])


def test_the_table_has_the_mean_of_the_ratios() -> None:
    def one(scene: str, warm: float | None) -> EqualQuality:
        return EqualQuality(scene, "given", 30.0, 0.01, 4, 31.0, warm, warm)

    table = mitsuba_table([one("a", 0.02), one("b", 0.08)], 3)
    assert [row[-2] for row in table.sections[0]] == ["2.00", "8.00"]
    assert "given: Mitsuba, warm, takes 4.00 times the model's time (geometric mean of 2 scenes)." in table.notes
    assert "given light: no ratio." in table.notes
    assert mitsuba_table([one("a", None)], 3).sections[0][0][-2:] == ("-", "-")


@pytest.mark.long
def test_cold_start_is_split_into_what_it_is(suite: Suite) -> None:
    (row,) = cold_starts(suite, suite.scenes[0], None, ("--device", "cpu", "--dtype", "float32"), 1)
    assert set(row) == {"torch", "command", *SPLIT, "interpreter"}
    assert min(row.values()) > 0
    assert row["command"] > row["torch"] * 0.8, "it imports torch, too"
    assert row["import"] > row["torch"] * 0.4
    whole = sum(row[name] for name in (*SPLIT, "interpreter"))
    assert 0.4 < whole / row["command"] < 2.5, "the timed run is the same command"


def test_a_process_that_fails_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(UnirenderError, match="ended with 3: something"):
        run_process(["-c", "import sys; print('something', file=sys.stderr); sys.exit(3)"], tmp_path)
    assert run_process(["-c", "import time; time.sleep(0.2)"], tmp_path) > 0.2


def test_the_start_table_compares_with_a_bare_import() -> None:
    middle = {"torch": 2.0, "command": 6.0, "import": 4.0, "load": 0.5, "run": 1.0, "interpreter": 0.5}
    table = start_table(middle, SIZE, 3)
    assert table.sections[0][1] == ("unirender decompose", "6.00", "3.00")
    assert table.notes[1] == "Aim: unirender decompose / import torch <= 2.5: 3.00, not met."
    assert start_table(middle | {"command": 4.0}, SIZE, 3).notes[1].endswith("2.00, met.")


def test_a_batch_is_cut_as_training_cuts_it() -> None:
    config = dataclasses.replace(TRAIN, batch_size=11, p_render=0.4)
    assert cut_batch(config, 2) == [Rows(2, 4, 2), Rows(2, 3, 2)]
    assert cut_batch(dataclasses.replace(config, batch_size=2, p_render=0.5), 8) == [Rows(1, 0, 0), Rows(0, 1, 0)]
    no_cycle = dataclasses.replace(config, loss=dataclasses.replace(config.loss, cycle=0.0))
    assert cut_batch(no_cycle, 1) == [Rows(4, 7, 0)]
    with pytest.raises(UnirenderError, match="got the timestep rule 'algorithm1'"):
        cut_batch(dataclasses.replace(config, timestep_rule="algorithm1"), 1)


def calls(model: torch.nn.Module, action: Any) -> list[tuple[int, range, range]]:
    """(rows, rows whose attributes are decoded, rows whose image is decoded) of every forward pass, sorted."""
    found = []

    def watch(_: Any, given: tuple[Any, ...], named: dict[str, Any]) -> None:
        count = len(given[0] if given else named["attributes"])
        wanted = (named.get(name, slice(None)) for name in ("attribute_rows", "image_rows"))
        found.append((count, *(range(0) if rows is None else range(*rows.indices(count)) for rows in wanted)))

    with model.register_forward_pre_hook(watch, with_kwargs=True):
        action()
    return sorted(found, key=str)


@pytest.mark.parametrize("into_renderer", [False, True])
def test_the_bare_passes_are_those_of_training(into_renderer: bool, tmp_path: Path) -> None:
    """The same forward passes over as many rows, decoded in the same streams."""
    loss = dataclasses.replace(TRAIN.loss, cycle_into_renderer=into_renderer)
    config = dataclasses.replace(TRAIN, loss=loss, batch_size=8)
    trainer = Trainer(config, RunConfig(tmp_path, steps=10, parallel=2), CPU, torch.float32)
    _, conditioning = make_model()
    bare = BarePasses(trainer.model, conditioning, config, 2, torch.float32)
    trained = calls(trainer.model, lambda: trainer.train_step(make_batch(8)))
    assert len(trained) == 4, "a pass and a cycle in each of two parts"
    assert calls(trainer.model, bare) == trained
    bare.close()


def test_throughput_is_measured_side_by_side(shards: Path) -> None:
    rows, parallel = throughput(shards, TRAIN, CPU, torch.float32, steps=1, turns=2)
    assert parallel == torch.get_num_threads()
    assert len(rows) == 2
    for row in rows:
        assert row["ratio"] == pytest.approx(row["trained"] / row["bare"])
        assert min(row.values()) > 0
    about = {"preset": "p", "batch": 4, "size": SIZE, "dtype": "float32", "device": "cpu", "parallel": parallel}
    about |= {"least": 0.8, "largest": 1.0}
    table = training_table({"trained": 9.0, "bare": 10.0, "ratio": 0.9}, about, 2, 2)
    assert table.sections[0][2] == ("ratio", "0.90")
    assert "between 0.80 and 1.00" in table.notes[0]
    assert table.notes[1] == "Aim: training / bare >= 0.85: 0.90, met."


@pytest.mark.long
def test_overfitting_gets_better_in_both_directions(shards: Path) -> None:
    pair = one_pair(shards, SIZE)
    assert len(pair["image"]) == 1
    config = overfit_config(PLAIN)
    assert config.model == PLAIN.model
    for minutes in (0.08, 0.4, 2.0):  # it trains by the clock: on a busy machine a short time is a handful of steps
        points = overfit(pair, config, minutes, CPU, torch.float32)
        assert points[0].minutes == 0 == points[0].samples
        assert points[-1].minutes >= minutes
        assert points[-1].samples > 0
        gains = [points[-1].psnr[name] - points[0].psnr[name] for name in ("render", "inverse", "albedo")]
        if min(gains) > 1:
            break
    assert min(gains) > 1
    table = overfit_table(points, minutes)
    assert len(table.sections[0]) == len(points)
    assert table.sections[0][-1][2] == f"{points[-1].psnr['render']:.2f}"


def test_the_preset_is_the_plain_model() -> None:
    config = overfit_config()
    assert config.model == get_preset("tiny_plain").model
    assert config.model.physics_prior == "none"
    assert isinstance(config, TrainConfig)


def test_the_aim_is_reached_at_the_first_measure_above_it() -> None:
    points = [Point(0.5 * i, i, {"render": 30.0 + 2 * i, "inverse": 20.0}) for i in range(5)]
    assert reached(points, "render") == 1.5
    assert reached(points, "inverse") is None


def test_a_perfect_answer_has_no_error_and_a_wrong_map_shows_in_its_own_picture(shards: Path) -> None:
    pair, pipeline = one_pair(shards, SIZE), make_pipeline()
    truth, image = as_intrinsics(pair)

    class Oracle:
        conditioning = pipeline.conditioning

        def render(self, maps: Any) -> np.ndarray:
            return image

        def decompose(self, *_: Any, **__: Any) -> Any:
            return SimpleNamespace(intrinsics=truth)

    assert set(both_directions(Oracle(), pair).values()) == {math.inf}
    packing = pipeline.conditioning.packing
    mask = truth.require("mask")["mask"]
    wrong = truth.replace(roughness=np.clip(truth.require("roughness")["roughness"] + 0.1, 0, 1) * (mask > 0))
    errors = picture_errors(packing, wrong, truth)
    assert errors.pop("material") == pytest.approx(0.01 / 2, rel=1e-3), "half of its two channels"
    assert set(errors.values()) == {0.0}


def test_a_run_writes_what_it_has_after_every_part(tmp_path: Path) -> None:
    table = TextTable("A title", ("a", "b"), ((("x", "1"),),))
    console = Console(file=(tmp_path / "out.txt").open("w+"), width=200)

    def fails() -> Part:
        raise UnirenderError("broken")

    with pytest.raises(UnirenderError, match="broken"):
        run(
            tmp_path / "speed",
            {"network": lambda: Part("network", (table,), {"x": 1}), "start": fails},
            (("cores", "2"),),
            console,
        )
    content = json.loads((tmp_path / "speed" / "speed.json").read_text())
    assert content == {"protocol": {"cores": "2"}, "network": {"x": 1}}
    text = (tmp_path / "speed" / "speed.md").read_text()
    assert table.markdown() in text
    assert "Protocol: cores: 2." in text


def test_parts_follow_the_data(tmp_path: Path) -> None:
    assert BenchSpeed().check() == ("network", "mitsuba", "start")
    assert BenchSpeed(data=tmp_path).check() == ("network", "mitsuba", "start", "training", "overfit")
    assert BenchSpeed(data=tmp_path, parts=("overfit",)).check() == ("overfit",)


def test_a_data_folder_that_is_not_there_is_an_error_before_anything_is_measured(tmp_path: Path) -> None:
    with pytest.raises(UnirenderError, match="no such data folder"):
        BenchSpeed(out=tmp_path / "out", data=tmp_path / "nothing").run()
    assert not (tmp_path / "out").exists()
