"""A pipeline folder is read whole, or refused in one sentence: damage of each kind that a copy or an edit can do."""

import dataclasses
import json
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from diffusers.models.autoencoders.autoencoder_kl import AutoencoderKL
from diffusers.training_utils import EMAModel
from safetensors.numpy import load_file, save_file
from tiny_models import MODEL, make_pipeline
from tiny_stable_diffusion import tiny_vae

from unirender.diffusion.schedule import make_scheduler
from unirender.errors import UnirenderError
from unirender.models.build import build_model
from unirender.pipelines.loading import reading
from unirender.pipelines.unirender_pipeline import UniRenderPipeline

WEIGHTS = "dual_stream/diffusion_pytorch_model.safetensors"
CONFIG = "dual_stream/config.json"


@pytest.fixture(scope="module")
def saved(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("saved")
    make_pipeline().save_pretrained(folder)
    return folder


@pytest.fixture
def folder(saved: Path, tmp_path: Path) -> Path:
    return shutil.copytree(saved, tmp_path / "mine")


def halve(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def lose_a_weight(path: Path) -> None:
    weights = load_file(path)
    del weights[sorted(weights)[0]]
    save_file(weights, path)


def widen(path: Path) -> None:
    config = json.loads(path.read_text())
    config["block_out_channels"] = [2 * width for width in config["block_out_channels"]]
    path.write_text(json.dumps(config))


@pytest.mark.parametrize(
    ("damaged", "damage", "says"),
    [
        (WEIGHTS, halve, "Unable to load weights"),
        (WEIGHTS, Path.unlink, "no file named"),
        (WEIGHTS, lambda path: path.write_text("version https://git-lfs.github.com/spec/v1\n"), "git-lfs"),
        (CONFIG, halve, "not a valid JSON file"),
        (CONFIG, Path.unlink, r"no file named config\.json"),
        ("scheduler/scheduler_config.json", Path.unlink, r"no file named scheduler_config\.json"),
        ("model_index.json", halve, r"model_index\.json: "),
        (
            "model_index.json",
            lambda path: path.write_text("[]"),
            r"model_index\.json: got list, expected a JSON object",
        ),
    ],
)
def test_a_damaged_folder_is_refused_by_name(
    folder: Path, damaged: str, damage: Callable[[Path], object], says: str
) -> None:
    damage(folder / damaged)
    with pytest.raises(
        UnirenderError, match=rf"mine: cannot be read as a checkpoint \(.*{says}.*copy the folder again"
    ):
        UniRenderPipeline.from_pretrained(folder)


@pytest.mark.parametrize("quickly", [True, False])
def test_weights_that_are_missing_are_refused(folder: Path, quickly: bool) -> None:
    lose_a_weight(folder / WEIGHTS)
    with pytest.raises(UnirenderError, match=r"dual_stream: 1 weights are missing, the first is attribute_.*copy the"):
        UniRenderPipeline.from_pretrained(folder, low_cpu_mem_usage=quickly)


def test_a_pipeline_keeps_its_weights_when_the_files_are_written_anew(folder: Path) -> None:
    pipeline = UniRenderPipeline.from_pretrained(folder)
    before = {name: value.clone() for name, value in pipeline.dual_stream.state_dict().items()}
    file = folder / WEIGHTS
    with file.open("r+b") as written:
        written.write(bytes(file.stat().st_size))
    for name, value in pipeline.dual_stream.state_dict().items():
        assert torch.equal(value, before[name]), name


def test_what_is_saved_again_is_the_same_wherever_it_lay(folder: Path, tmp_path: Path) -> None:
    tiny_vae().save_pretrained(tmp_path / "vae")
    vae = AutoencoderKL.from_pretrained(tmp_path / "vae")  # as that of a Stable Diffusion folder
    model, _ = build_model(dataclasses.replace(MODEL, codec="kl", patch=4, physics_prior="none"), vae)
    UniRenderPipeline(model, make_scheduler(), vae).save_pretrained(tmp_path / "kl")
    for first in (folder, tmp_path / "kl"):
        again = tmp_path / "again" / first.name
        UniRenderPipeline.from_pretrained(first).save_pretrained(again)
        files = {path.relative_to(first) for path in first.rglob("*") if path.is_file()}
        assert files == {path.relative_to(again) for path in again.rglob("*") if path.is_file()}
        for name in files:
            assert (again / name).read_bytes() == (first / name).read_bytes(), name
            assert b"_name_or_path" not in (first / name).read_bytes(), name


def test_weights_in_another_format_are_not_missing(folder: Path) -> None:
    """An old folder: diffusers reads it if asked to, and says itself what it lacks."""
    make_pipeline().save_pretrained(folder.parent / "old", safe_serialization=False)
    assert not list((folder.parent / "old").rglob("*.safetensors"))
    loaded = UniRenderPipeline.from_pretrained(folder.parent / "old", use_safetensors=False)
    assert loaded.size == make_pipeline().size


def test_a_config_of_another_network_is_refused(folder: Path) -> None:
    widen(folder / CONFIG)
    with pytest.raises(UnirenderError, match=r"mine: cannot be read as a checkpoint \(.*expected shape"):
        UniRenderPipeline.from_pretrained(folder)


@pytest.mark.parametrize(
    ("file", "options", "says"),
    [
        (CONFIG, {"lamps": 3}, r"config\.json: options lamps are not known to this DualStreamModel.*update unirender"),
        (CONFIG, {"light": "encoder"}, r"config\.json: has light 'encoder', which is gone, expected 'latent'"),
        ("model_index.json", {"gamma": 2}, r"model_index\.json: options gamma are not known to this UniRenderPipeline"),
        ("model_index.json", {"material": "both"}, "material: got 'both', expected 'scalar' or 'map'"),
        (CONFIG, {"hdr_curves": {"specular": [10, 20]}}, "hdr_curves: got specular, expected one of each of: specular"),
        (CONFIG, {"patch": 4}, "attribute_channels: got 72, expected 288 with this codec, patch"),
    ],
)
def test_a_config_that_would_answer_otherwise_is_refused(
    folder: Path, file: str, options: dict[str, object], says: str
) -> None:
    """An option of a newer version was passed over with a warning, a contradiction failed at the first picture."""
    path = folder / file
    path.write_text(json.dumps(json.loads(path.read_text()) | options | {"_mine": 1, "quantization_config": None}))
    with pytest.raises(UnirenderError, match=says):
        UniRenderPipeline.from_pretrained(folder)


def test_a_network_that_diffusers_averaged_is_read(folder: Path, tmp_path: Path) -> None:
    pipeline = UniRenderPipeline.from_pretrained(folder)
    kind = type(pipeline.dual_stream)
    average = EMAModel(
        pipeline.dual_stream.parameters(), model_cls=kind, model_config=dict(pipeline.dual_stream.config)
    )
    average.save_pretrained(str(tmp_path / "ema"))
    averaged = kind.from_pretrained(tmp_path / "ema")
    UniRenderPipeline(averaged, pipeline.scheduler).save_pretrained(tmp_path / "whole")
    UniRenderPipeline.from_pretrained(tmp_path / "whole")


def test_a_pipeline_without_its_network_is_refused(folder: Path) -> None:
    with pytest.raises(UnirenderError, match="dual_stream: got None, expected a DualStreamModel"):
        UniRenderPipeline.from_pretrained(folder, dual_stream=None)


def test_a_mistake_of_the_caller_is_not_one_of_the_files(folder: Path) -> None:
    with pytest.raises(UnirenderError, match=r"mine: cannot be read as a checkpoint \(.*\)$"):
        UniRenderPipeline.from_pretrained(folder, device_map="nonsense")


def test_weights_that_the_network_does_not_know_are_no_reason_to_refuse(folder: Path) -> None:
    weights = load_file(folder / WEIGHTS)
    save_file(weights | {"of_a_later_version": np.zeros(3, dtype=np.float32)}, folder / WEIGHTS)
    assert UniRenderPipeline.from_pretrained(folder).size == make_pipeline().size


@pytest.mark.parametrize(
    ("file", "option", "says"),
    [
        ("model_index.json", {"calibration": {"albedo": [1, 0]}}, "calibration: got .*, expected a slope of 0 or more"),
        (CONFIG, {"physics_prior": "no"}, "physics_prior: got 'no', expected 'none' or one of: composite, split_sum"),
    ],
)
def test_what_a_setting_of_ours_says_is_said_of_the_folder(
    folder: Path, file: str, option: dict[str, object], says: str
) -> None:
    written = json.loads((folder / file).read_text())
    (folder / file).write_text(json.dumps(written | option))
    with pytest.raises(UnirenderError, match=f"mine: {says}"):
        UniRenderPipeline.from_pretrained(folder)


def test_the_package_runs_as_a_module() -> None:
    done = subprocess.run([sys.executable, "-m", "unirender", "--help"], capture_output=True, text=True, check=True)
    assert done.stdout.startswith("usage: unirender [-h]")


def test_too_little_memory_is_no_damaged_file(tmp_path: Path) -> None:
    (tmp_path / "model_index.json").write_text("{}")
    for error in (MemoryError(), RuntimeError("unable to mmap 9 bytes from file <x>: Cannot allocate memory (12)")):
        with pytest.raises(type(error)), reading(tmp_path):
            raise error
