"""Where a run cannot write, one sentence says which file and why: before anything is built where that can be known."""

import builtins
import errno
import io
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from tiny_models import TRAIN, make_pipeline
from torch import nn

from unirender import cli
from unirender.errors import UnirenderError
from unirender.system.writing import unusable, writing
from unirender.training.after.average import Average
from unirender.training.config import RunConfig
from unirender.training.logs.run_log import RunLog
from unirender.training.loop.checkpoint import load_state, save_state
from unirender.training.loop.export import export_pipeline
from unirender.training.loop.pictures import save_sheet
from unirender.training.loop.trainer import Trainer
from unirender.training.optim.processes import ALONE

NO_SPACE = "No space left on device"


class FullDisk(io.FileIO):
    """A file of which the first 500 bytes find a place."""

    def write(self, data: Any) -> int:
        if self.tell() + len(memoryview(data)) > 500:
            raise OSError(errno.ENOSPC, NO_SPACE)
        return super().write(data)


def fill_the_disk(monkeypatch: pytest.MonkeyPatch) -> None:
    """From here on, whatever Python's own `open` opens for writing is cut short."""
    opened = io.open

    def full(path: Any, mode: str = "r", *arguments: Any, **options: Any) -> Any:
        if not set(mode) & set("wax"):
            return opened(path, mode, *arguments, **options)
        file = io.BufferedWriter(FullDisk(path, mode.replace("b", "").replace("t", "")), buffer_size=1)
        return file if "b" in mode else io.TextIOWrapper(file, write_through=True)

    monkeypatch.setattr(io, "open", full)
    monkeypatch.setattr(builtins, "open", full)


@pytest.mark.parametrize("under", ["", "below"])
@pytest.mark.parametrize("command", ["train", "train-visibility"])
def test_a_place_where_nothing_can_be_written_is_refused_before_anything_is_built(
    command: str, under: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "data").mkdir()  # of which nothing is said: it was not looked at
    (tmp_path / "file").write_text("kept")
    out = tmp_path / "file" / under
    with pytest.raises(SystemExit) as stopped:
        cli.main([command, "--data", str(tmp_path / "data"), "--out", str(out), "--steps", "1"])
    assert stopped.value.code == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert line.endswith(
        f"{out}: cannot be written ({tmp_path / 'file'} is no folder), expected a folder; choose another --out"
    )
    assert (tmp_path / "file").read_text() == "kept"


def test_looking_leaves_nothing(tmp_path: Path) -> None:
    assert unusable(tmp_path) is None
    assert unusable(tmp_path / "not" / "yet") is None
    assert not list(tmp_path.iterdir())
    assert unusable(Path("/proc") / "run") is not None
    assert unusable(tmp_path / ("x" * 300)) == os.strerror(errno.ENAMETOOLONG)


def test_a_state_that_finds_no_place_leaves_the_one_before(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """PyTorch raises an error of its own then, which names neither the file nor the reason."""
    save_state(tmp_path, {"step": 1})
    with monkeypatch.context() as patched:
        fill_the_disk(patched)
        with pytest.raises(UnirenderError, match=rf"state\.pt: cannot be written \({NO_SPACE}\); mend that and run"):
            save_state(tmp_path, {"step": 2, "weights": torch.ones(100_000)})
    assert [path.name for path in tmp_path.iterdir()] == ["state.pt"]
    state = load_state(tmp_path)
    assert state is not None
    assert state["step"] == 1


def test_lines_and_pictures_that_find_no_place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fill_the_disk(monkeypatch)
    with pytest.raises(UnirenderError, match=rf"log\.jsonl: cannot be written \({NO_SPACE}\)"):
        RunLog(tmp_path, ALONE).tell({"step": 1, "news": "x" * 600}, lambda line: None)
    noise = np.random.default_rng(0).integers(0, 255, (64, 64, 3), np.uint8)
    with pytest.raises(UnirenderError, match=rf"sheet\.png: cannot be written \({NO_SPACE}\)"):
        save_sheet(tmp_path / "pictures" / "sheet.png", noise)
    assert not list((tmp_path / "pictures").iterdir())


def no_place(quoted: bool) -> Callable[..., None]:
    """As safetensors fails to write: its error only quotes the system's own."""

    def fail(self: nn.Module, folder: Path, **options: object) -> None:
        from safetensors import SafetensorError

        Path(folder).mkdir(parents=True, exist_ok=True)
        (Path(folder) / "half.safetensors").write_bytes(b"half")
        text = f"Error while serializing: I/O error: {NO_SPACE} (os error 28)"
        raise SafetensorError(text) if quoted else OSError(errno.ENOSPC, NO_SPACE)

    return fail


@pytest.mark.parametrize("quoted", [True, False])
def test_a_pipeline_that_finds_no_place_leaves_nothing(
    quoted: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for seed in (0, 1):
        make_pipeline(seed).save_pretrained(tmp_path / f"{seed}")
    trainer = Trainer(TRAIN, RunConfig(tmp_path / "run", steps=1), torch.device("cpu"), torch.float32)
    monkeypatch.setattr("unirender.pipelines.unirender_pipeline.UniRenderPipeline.save_pretrained", no_place(quoted))
    with pytest.raises(UnirenderError, match=rf"pipeline: cannot be written \(.*{NO_SPACE}"):
        export_pipeline(trainer, tmp_path / "run" / "pipeline")
    assert not list((tmp_path / "run").iterdir())
    with pytest.raises(UnirenderError, match=rf"mean: cannot be written \(.*{NO_SPACE}.*choose another --out"):
        Average((tmp_path / "0", tmp_path / "1"), tmp_path / "mean").run()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["0", "1", "run"]


def test_other_errors_stay_what_they_are(tmp_path: Path) -> None:
    with pytest.raises(ZeroDivisionError), writing(tmp_path):
        raise ZeroDivisionError
    with pytest.raises(UnirenderError, match="said already"), writing(tmp_path):
        raise UnirenderError("said already")


def test_a_link_to_nothing_is_no_place(tmp_path: Path) -> None:
    (tmp_path / "link").symlink_to(tmp_path / "gone")
    assert "link to nothing" in (unusable(tmp_path / "link" / "run") or "")
    (tmp_path / "gone").mkdir()
    assert unusable(tmp_path / "link" / "run") is None
