"""Files that a command was asked for: looked at before the work begins, complete or not there."""

import errno
import json
import os
from pathlib import Path

import pytest

from unirender.errors import UnirenderError
from unirender.system.writing import writing
from unirender_reference.checks.command import Check
from unirender_reference.measure.census_command import Census
from unirender_reference.measure.contact_sheet import Sheet
from unirender_reference.measure.lights import Lights
from unirender_reference.measure.passes import Passes
from unirender_reference.output_files import check_file, write_file

NO_SPACE = "No space left on device"


def worked(*arguments: object, **options: object) -> None:
    raise AssertionError("the work was begun")


@pytest.mark.parametrize(
    ("command", "place", "sentence"),
    [
        *(
            (name, "folder", "is a folder, expected the name")
            for name in ("check", "census", "sheet", "lights --sheet")
        ),
        ("lights --export", "folder", "is there already, expected a new folder"),
        *(
            (name, "file/below.out", "file is no folder")
            for name in ("check", "census", "sheet", "lights --sheet", "lights --export")
        ),
    ],
)
def test_a_place_that_is_none_is_refused_before_the_work(
    command: str, place: str, sentence: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("unirender_reference.checks.registry.run_check", worked)
    monkeypatch.setattr("unirender_reference.measure.census.run_census", worked)
    monkeypatch.setattr("unirender_reference.render.render_sample", worked)
    monkeypatch.setattr("unirender_reference.lights.bundled_lights", worked)
    (tmp_path / "folder").mkdir()
    (tmp_path / "file").write_text("kept")
    path = tmp_path / place
    commands = {
        "check": Check(only=("exposure",), json=path),
        "census": Census(renders=1, workers=1, json=path),
        "sheet": Sheet(out=path, objects=1),
        "lights --sheet": Lights(sheet=path),
        "lights --export": Lights(export=path),
    }
    with pytest.raises(UnirenderError, match=sentence):
        commands[command].run()
    assert (tmp_path / "file").read_text() == "kept"


def test_looking_leaves_nothing_and_writing_replaces(tmp_path: Path) -> None:
    check_file("--json", tmp_path / "new" / "x.json")
    assert not list(tmp_path.iterdir())
    write_file("--json", tmp_path / "new" / "x.json", "one")
    write_file("--json", tmp_path / "new" / "x.json", b"two")
    assert (tmp_path / "new" / "x.json").read_bytes() == b"two"
    assert [path.name for path in (tmp_path / "new").iterdir()] == ["x.json"]
    (tmp_path / "link").symlink_to(tmp_path / "new" / "x.json")
    write_file("--json", tmp_path / "link", "three")
    assert (tmp_path / "link").is_symlink()
    assert (tmp_path / "new" / "x.json").read_text() == "three"


def test_what_is_no_plain_file_is_written_to(tmp_path: Path) -> None:
    """Not replaced by one."""
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    reader = os.open(pipe, os.O_RDONLY | os.O_NONBLOCK)
    try:
        check_file("--json", pipe)
        write_file("--json", pipe, json.dumps([1]))
        assert os.read(reader, 100) == b"[1]"
    finally:
        os.close(reader)
    assert pipe.is_fifo()


def test_a_full_disk_is_found_behind_other_errors() -> None:
    def closed() -> None:
        try:
            raise OSError(errno.ENOSPC, NO_SPACE)
        finally:
            raise ValueError("Can't close the ZIP file while there is an open writing handle on it")

    with (
        pytest.raises(UnirenderError, match=rf"out: cannot be written \({NO_SPACE}\); mend that"),
        writing("out", "mend that"),
    ):
        closed()
    with pytest.raises(ValueError, match="nan"), writing("out"):
        raise ValueError("nan")


def test_a_table_is_printed_although_its_sheet_finds_no_place(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def full(path: Path, content: bytes) -> None:
        raise OSError(errno.ENOSPC, NO_SPACE)

    monkeypatch.setattr("unirender.system.whole_files.replace_file", full)
    with pytest.raises(UnirenderError, match=rf"--sheet .*s\.png: cannot be written \({NO_SPACE}\)"):
        Lights(split="test", sheet=tmp_path / "s.png").run()
    assert "lights of 64 x 128 texels" in capsys.readouterr().out


def test_the_passes_of_another_scene_stay(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Passes, "render", worked)
    (tmp_path / "passes.exr").write_bytes(b"of another scene")
    with pytest.raises(UnirenderError, match=r"exists and is not empty, expected a new folder; choose another --out"):
        Passes(out=tmp_path).run()
    with pytest.raises(UnirenderError, match=r"cannot be written|is a file"):
        Passes(out=tmp_path / "passes.exr" / "below").run()
    assert (tmp_path / "passes.exr").read_bytes() == b"of another scene"
