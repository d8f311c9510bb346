"""Adapters as plug-ins: arguments in a SPEC, what identifies a folder, and a run from the SPEC to a scored table."""

import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from safetensors.torch import load_file, save_file
from tiny_adapter_folders import APPEARANCE, LIGHTING, write_intrinsics, write_normals, write_rgbx
from tiny_suites import make_suite

from unirender.camera import Camera
from unirender.errors import UnirenderError, UsageError
from unirender_evaluation.adapters.folder import folder_sha256
from unirender_evaluation.adapters.marigold import MarigoldNormals
from unirender_evaluation.adapters.rgbx import RgbToX
from unirender_evaluation.engine import method_jobs
from unirender_evaluation.methods.plugins import named_plugin
from unirender_evaluation.records import RunInfo
from unirender_evaluation.report.pictures import Pictures
from unirender_evaluation.rows import plugin_rows
from unirender_evaluation.tables.build import build_tables
from unirender_evaluation.tables.formats import to_markdown
from unirender_evaluation.versions import LPIPS, MODEL, Versions

SOURCE = """
from pathlib import Path
from typing import Optional


class Given:
    name = "given"

    def __init__(self, sigma: float = 1.0, folder: Path | None = None, count: int = 1, fast: bool = False, plain="",
                 several: list[int] = [], depth: Optional[int] = None):
        self.config = {"sigma": sigma, "folder": str(folder), "count": count, "fast": fast, "plain": plain,
                       "depth": depth}

    def render(self, intrinsics):
        return self.config["sigma"] * intrinsics.albedo


made = Given()
"""
MARIGOLD = "unirender_evaluation.adapters.marigold"


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "given.py"
    path.write_text(SOURCE)
    return path


def test_arguments_have_the_types_of_the_signature(file: Path) -> None:
    found = named_plugin(f"{file}:Given?sigma=2&folder=a/b=c&count=3&fast=true&plain=7&depth=2").method.config
    assert found == {"sigma": 2.0, "folder": "a/b=c", "count": 3, "fast": True, "plain": "7", "depth": 2}
    assert isinstance(found["sigma"], float)
    assert named_plugin(f"{file}:Given?plain=Q%26A, 100%25, 5%").method.config["plain"] == "Q&A, 100%, 5%"
    default = named_plugin(f"{file}:Given").method.config
    assert default == {"sigma": 1.0, "folder": "None", "count": 1, "fast": False, "plain": "", "depth": None}


@pytest.mark.parametrize(
    ("query", "message"),
    [
        ("Given?", "got '', expected ?name=value&name=value"),
        ("Given?sigma", "got 'sigma', expected ?name=value&name=value"),
        ("Given?sigma=1&sigma=2", "sigma is given twice, expected once"),
        ("Given?sigmas=1", "no argument 'sigmas', expected some of sigma, folder, count, fast, plain, several, depth"),
        ("Given?sigma=much", "sigma is 'much', expected one float"),
        ("Given?count=1.5", "count is '1.5', expected one int"),
        ("Given?fast=yes", "fast is 'yes', expected true or false"),
        ("Given?several=1", "expected a number, text, path or true/false in a SPEC"),
        ("made?sigma=1", "takes no arguments"),
    ],
)
def test_wrong_arguments_are_wrong_usage(file: Path, query: str, message: str) -> None:
    with pytest.raises(UsageError, match=re.escape(message)):
        named_plugin(f"{file}:{query}")


@pytest.fixture(scope="module")
def normals(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_normals(tmp_path_factory.mktemp("plugins") / "my-normals")


def copied(folder: Path, to: Path) -> Path:
    return shutil.copytree(folder, to / "copy")


def changed_weight(folder: Path) -> None:
    path = folder / "unet" / "diffusion_pytorch_model.safetensors"
    weights = load_file(path)
    weights["conv_in.bias"] += 1e-3
    save_file(weights, path, metadata={"format": "pt"})


def changed(name: str, before: str, after: str) -> Callable[[Path], None]:
    def change(folder: Path) -> None:
        text = (folder / name).read_text()
        assert before in text
        (folder / name).write_text(text.replace(before, after))

    return change


def unread(folder: Path) -> None:
    """Files that are never read: another precision, and an account of the model."""
    part = folder / "unet"
    shutil.copy(part / "diffusion_pytorch_model.safetensors", part / "diffusion_pytorch_model.fp16.safetensors")
    (folder / "README.md").write_text("# A model")


@pytest.mark.parametrize(
    ("change", "same"),
    [
        (changed_weight, False),
        (changed("tokenizer/merges.txt", "0.2", "0.3"), False),
        (changed("scheduler/scheduler_config.json", "trailing", "linspace"), False),
        (changed("model_index.json", '"default_denoising_steps": 2', '"default_denoising_steps": 3'), False),
        (unread, True),
    ],
)
def test_whatever_is_read_of_a_folder_is_in_the_key(
    normals: Path, tmp_path: Path, change: Callable[[Path], None], same: bool
) -> None:
    copy = copied(normals, tmp_path)
    assert MarigoldNormals(copy).config == MarigoldNormals(normals).config, "its place and name are not"
    change(copy)
    assert (folder_sha256(copy) == folder_sha256(normals)) == same
    assert (MarigoldNormals(copy).config == MarigoldNormals(normals).config) == same


@pytest.mark.parametrize(
    "option", [{"steps": 3}, {"ensemble": 2}, {"seed": 1}, {"resolution": 0}, {"background": "grey"}]
)
def test_every_setting_is_in_the_key(normals: Path, option: dict[str, Any]) -> None:
    assert MarigoldNormals(normals, **option).config != MarigoldNormals(normals).config
    assert MarigoldNormals(normals, name="other").config == MarigoldNormals(normals).config


def test_names_of_rows(normals: Path) -> None:
    spec = f"{MARIGOLD}:MarigoldNormals?folder={normals}"
    rows = plugin_rows([named_plugin(spec), named_plugin(f"{spec}&name=Marigold (4 steps)&steps=4")])
    assert [row.info.key for row in rows] == ["my-normals", "marigold-4-steps"]


def removed(name: str) -> Callable[[Path], None]:
    def change(folder: Path) -> None:
        path = folder / name
        shutil.rmtree(path) if path.is_dir() else path.unlink()

    return change


def only_fp16(folder: Path) -> None:
    path = folder / "vae" / "diffusion_pytorch_model.safetensors"
    path.rename(path.with_name("diffusion_pytorch_model.fp16.safetensors"))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (removed("."), "no such folder, expected a model in diffusers format"),
        (removed("unet"), "unet/config.json: is missing, expected the config of a part UNet2DConditionModel"),
        (
            removed("vae/diffusion_pytorch_model.safetensors"),
            "vae: no weights, expected .safetensors without a variant",
        ),
        (only_fp16, "vae: no weights, expected .safetensors without a variant such as fp16"),
        (removed("tokenizer"), "tokenizer: no tokenizer, expected the files vocab.json and merges.txt"),
        (removed("tokenizer/merges.txt"), "tokenizer: no tokenizer, expected the files vocab.json and merges.txt"),
        (removed("scheduler"), "scheduler_config.json: is missing, expected the scheduler's configuration"),
        (removed("model_index.json"), "model_index.json: is missing, expected the index of a MarigoldNormalsPipeline"),
        (changed("model_index.json", "default_denoising_steps", "steps"), "no default_denoising_steps, .* say steps="),
    ],
)
def test_a_folder_that_lacks_something(
    normals: Path, tmp_path: Path, change: Callable[[Path], None], message: str
) -> None:
    copy = copied(normals, tmp_path)
    change(copy)
    with pytest.raises(UnirenderError, match=f"could not construct it: .*{message}"):
        named_plugin(f"{MARIGOLD}:MarigoldNormals?folder={copy}")


def test_a_scheduler_of_another_kind_is_told_at_the_first_question(normals: Path, tmp_path: Path) -> None:
    copy = copied(normals, tmp_path)
    changed("scheduler/scheduler_config.json", "DDIMScheduler", "PNDMScheduler")(copy)
    with pytest.raises(UnirenderError, match="'PNDMScheduler', expected DDIMScheduler or LCMScheduler"):
        _ = MarigoldNormals(copy).pipeline


@pytest.mark.parametrize(
    ("option", "message"),
    [
        ("steps=0", "steps: got 0, expected at least 1"),
        ("ensemble=0", "ensemble: got 0, expected at least 1"),
        ("resolution=-8", "resolution: got -8, expected at least 0"),
        ("background=red", "background: got 'red', expected one of white, grey, black"),
        ("dtype=int8", "dtype: got 'int8'"),
        ("device=tpu", "device: tpu is not available here"),
        ("seed=18446744073709551616", "seed: got 18446744073709551616, expected an integer of 64 bits"),
    ],
)
def test_settings_out_of_range(normals: Path, option: str, message: str) -> None:
    with pytest.raises(UnirenderError, match=message):
        named_plugin(f"{MARIGOLD}:MarigoldNormals?folder={normals}&{option}")


@pytest.mark.slow
def test_from_a_spec_to_a_scored_table(normals: Path, tmp_path: Path) -> None:
    """Four folders on a scene: numbers for the maps that each gives, a dash for the others."""
    appearance = write_intrinsics(tmp_path / "appearance", APPEARANCE)
    lighting = write_intrinsics(tmp_path / "lighting", LIGHTING)
    rgbx = write_rgbx(tmp_path / "rgb-to-x")
    specs = [
        f"{MARIGOLD}:MarigoldIntrinsics?folder={appearance}&steps=1",
        f"{MARIGOLD}:MarigoldIntrinsics?folder={lighting}&steps=1",
        f"{MARIGOLD}:MarigoldNormals?folder={normals}&steps=1",
        f"unirender_evaluation.adapters.rgbx:RgbToX?folder={rgbx}&steps=1&resolution=0",
    ]
    suite = make_suite(tmp_path / "suite", objects=1, per_scene=1)
    rows, scenes = plugin_rows([named_plugin(spec) for spec in specs]), list(suite.scenes)
    versions, pictures = Versions("test", {LPIPS: "none", MODEL: "1"}), Pictures(tmp_path / "p", suite, scenes)
    records = [job.make() for job in method_jobs(suite, rows, scenes, scenes[0], versions, (), pictures)]
    given: dict[str, set[str]] = {}
    for record in records:
        given.setdefault(record.method, set()).update(key.partition(".")[0] for key in record.values)
    assert given == {
        "appearance": {"albedo", "roughness", "metallic"},
        "lighting": {"albedo", "diffuse"},
        "my-normals": {"normal"},
        "rgb-to-x": {"albedo", "roughness", "metallic", "normal"},
    }
    run = RunInfo("ball", suite.sha256, suite.spec.resolution, tuple(row.info for row in rows))
    table = next(table for table in build_tables(records, run) if table.name == "inverse")
    groups = [column.group for column in table.columns]
    cells = {row.key: dict(zip(groups, row.cells, strict=True)) for row in table.rows}
    assert cells["my-normals"]["Normal"].measured is not None
    assert cells["my-normals"]["Albedo"].measured is None
    assert cells["appearance"]["Roughness"].measured is not None
    assert cells["lighting"]["Roughness"].measured is None
    lines = [[cell.strip() for cell in line.split("|")] for line in to_markdown(table).splitlines() if "|" in line]
    dashes = {cells[1]: cells.count("-") for cells in lines}
    assert dashes["rgb-to-x"] < dashes["appearance"] < dashes["my-normals"]


def test_another_precision_answers_alike(normals: Path, tmp_path: Path) -> None:
    """RGB-to-X has the same noise at any precision: answers differ by rounding, those of another seed by more."""
    options: dict[str, Any] = {"steps": 1, "resolution": 0}
    image = np.random.default_rng(0).uniform(0, 1, (16, 12, 3)).astype(np.float32)
    shown: dict[str, Any] = {"image_srgb": image, "mask": np.ones((16, 12, 1), np.float32), "camera": Camera()}
    folder = write_rgbx(tmp_path / "rgb-to-x")
    plain, coarse = RgbToX(folder, **options), RgbToX(folder, **options, dtype="bfloat16")
    expected = plain.decompose(**shown).maps["normal"]
    difference = np.abs(coarse.decompose(**shown).maps["normal"] - expected).mean()
    twin = np.abs(RgbToX(folder, **options, seed=1).decompose(**shown).maps["normal"] - expected).mean()
    assert 0 < difference < 0.2 * twin
    assert coarse.config != plain.config
    marigold = MarigoldNormals(normals, **options, dtype="bfloat16").decompose(**shown).maps["normal"]
    np.testing.assert_allclose(np.linalg.norm(marigold, axis=-1), 1, atol=1e-3)
