"""The pieces of Python on the page about data sets, run on a tiny one."""

import re
from pathlib import Path

import pytest
from inline_executor import Inline

from unirender_reference.dataset import generate
from unirender_reference.dataset_config import DatasetConfig

PAGE = Path(__file__).resolve().parents[2] / "docs" / "dataset.md"


def pieces() -> list[str]:
    """The page's Python that reads a data set."""
    found = re.findall(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)
    return [piece for piece in found if "data/train" in piece]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    base = tmp_path_factory.mktemp("read-back")
    generate(DatasetConfig(2, 12, 8, "basis", base / "data" / "train", spp=16, workers=1), executor=Inline())
    return base


@pytest.mark.parametrize("reader", ["webdataset", "GroupDataset"])
def test_every_pair_is_read_back(
    reader: str, folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (piece,) = (piece for piece in pieces() if f"import {reader}\n" in piece or f", {reader}\n" in piece)
    monkeypatch.chdir(folder)
    names: dict[str, object] = {}
    exec(piece, names)
    lines = capsys.readouterr().out.strip().splitlines()
    assert len(lines) == 24
    for word in ("(8, 8, 3)", "'albedo'", "'specular'", "'diffuse'", "'environment'", "'mask'"):
        assert all(word in line for line in lines)
    intrinsics = names["intrinsics"]
    for name in ("albedo", "normal", "mask", "specular", "diffuse"):
        assert getattr(intrinsics, name).shape[:2] == (8, 8)


def test_both_readers_say_the_same_materials(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(folder)
    said = []
    for piece in pieces():
        exec(piece, {})
        numbers = [re.findall(r"\b[01]\.\d+", line) for line in capsys.readouterr().out.strip().splitlines()]
        said.append(sorted(tuple(row[-2:]) for row in numbers))
    assert len(said) == 2
    assert said[0] == said[1]
    assert {metallic for _, metallic in said[0]} == {"0.0", "0.5", "1.0"}
