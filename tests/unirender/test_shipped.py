"""The shipped checkpoints by name: paths stay paths, and what lies in the current folder goes first."""

from pathlib import Path

import pytest

from unirender.command_line.options import ModelOptions
from unirender.errors import UnirenderError
from unirender.pipelines.unirender_pipeline import UniRenderPipeline
from unirender.shipped import (
    CHECKPOINTS,
    checkpoint_folder,
    checkpoint_label,
    checkpoint_sha256,
    shipped_for,
    shipped_names,
)


def test_every_shipped_checkpoint_is_found_by_its_name() -> None:
    assert "tiny" in shipped_names()
    for name in shipped_names():
        for given in (name, Path(name)):
            assert checkpoint_folder(given) == CHECKPOINTS / name
        assert checkpoint_label(name) == f"{name} (shipped)"
    assert checkpoint_folder() == CHECKPOINTS / "tiny"
    assert checkpoint_label() == "tiny (shipped)"


@pytest.mark.parametrize("path", ["run/pipeline", "/somewhere/tiny", "enormous"])
def test_a_path_stays_a_path(path: str) -> None:
    assert checkpoint_folder(path) == Path(path)
    assert checkpoint_label(path) == Path(path).name


@pytest.mark.parametrize(
    ("pixels", "name"), [(32, "tiny"), (64, "tiny"), (127, "tiny"), (128, "small"), (512, "small")]
)
def test_pictures_of_a_size_have_the_largest_checkpoint_that_is_not_for_larger_ones(pixels: int, name: str) -> None:
    assert shipped_for(pixels) == CHECKPOINTS / name


def test_what_lies_in_the_current_folder_goes_first(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "tiny").mkdir()
    monkeypatch.chdir(tmp_path)
    assert checkpoint_folder("tiny") == Path("tiny")
    assert checkpoint_label("tiny") == "tiny"
    with pytest.raises(UnirenderError, match="no pipeline folder"):
        UniRenderPipeline.from_pretrained("tiny")


def test_a_wrong_name_is_told_the_right_ones(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(UnirenderError, match=r"one of the names .*tiny"):
        UniRenderPipeline.from_pretrained("enormous")


def test_provenance_names_it() -> None:
    options = ModelOptions(Path("tiny"), device="cpu", dtype="float32", progress=False)
    meta = options.provenance(options.load())
    assert meta["checkpoint"] == "tiny (shipped)"
    assert meta["checkpoint_sha256"] == checkpoint_sha256(CHECKPOINTS / "tiny")
