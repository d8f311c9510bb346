"""What ends a run, what is tried again and what is not; two runs in a folder, other versions, the journal."""

import dataclasses
import errno
import io
import json
import os
import signal
import subprocess
import sys
import tarfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from inline_executor import Inline
from stored_groups import Stored

from unirender.errors import UnirenderError
from unirender.exr import write_exr
from unirender.training.data.groups import list_shards
from unirender_reference import journal, passes, shards
from unirender_reference.cluster_machine import this_machine
from unirender_reference.commands import Dataset
from unirender_reference.dataset import generate, render_group
from unirender_reference.dataset_config import DatasetConfig
from unirender_reference.faults import FileFailure, FileNotSeen, ObjectFault, blamed_on
from unirender_reference.folder_lock import LOCK, locked
from unirender_reference.mesh_folder import MeshFile
from unirender_reference.plan import plan_groups
from unirender_reference.processes import TimeLimitPassed
from unirender_reference.shards import JOURNAL, FloorCount, shard_name
from unirender_reference.workers import WorkerDied

SIZE, SPP = 8, 16
MESH = MeshFile(Path("/models/chair.obj"), "chair.obj")


def config(out: Path, meshes: Path | None, **changes: Any) -> DatasetConfig:
    options: dict[str, Any] = {"objects": None, "pairs": 3, "resolution": SIZE, "vary": "basis", "spp": SPP}
    return DatasetConfig(out=out, meshes=meshes, workers=1, **{**options, **changes})


@pytest.fixture
def meshes(tmp_path: Path) -> Path:
    """Three boxes."""
    folder = tmp_path / "meshes"
    folder.mkdir()
    for number in range(3):
        trimesh.creation.box((1, 1, 0.5 + 0.2 * number)).export(folder / f"{number}.obj")
    return folder


def manifest(out: Path) -> dict[str, Any]:
    return json.loads((out / "manifest.json").read_text())


def raised_from(cause: BaseException) -> UnirenderError:
    """As `load_mesh` reports what a reader raised."""
    try:
        raise UnirenderError(f"mesh {MESH.path}: cannot be read") from cause
    except UnirenderError as error:
        return error


@pytest.mark.parametrize(
    ("error", "machine"),
    [
        (UnirenderError("mesh /models/chair.obj: has no faces"), False),
        (raised_from(ValueError("bad number")), False),
        (raised_from(OSError("image file is truncated")), False),  # as Pillow says it: no error number
        (raised_from(OSError(errno.EIO, "Input/output error")), True),
        (raised_from(PermissionError(errno.EACCES, "Permission denied")), True),
        (raised_from(MemoryError()), True),
        (MemoryError("of numpy"), True),
        (TimeLimitPassed("loading it: not done after 600 s"), True),
    ],
)
def test_what_is_of_the_file_and_what_of_the_machine(error: Exception, machine: bool) -> None:
    with pytest.raises(FileFailure) as failure, blamed_on(MESH, UnirenderError):
        raise error
    assert failure.value.machine is machine
    assert "/models" not in str(failure.value)


@pytest.mark.parametrize(
    "error",
    [
        UnirenderError("LLVM: no library found"),
        RuntimeError("drjit: out of resources"),
        OSError(errno.EMFILE, "Too many open files"),
        raised_from(ModuleNotFoundError("No module named 'PIL'")),
        FileNotSeen("mesh /models/chair.obj: no such file"),
    ],
)
def test_what_no_file_is_to_blame_for_ends_the_run(error: Exception) -> None:
    with pytest.raises(UnirenderError) as raised, blamed_on(MESH, ObjectFault):
        raise error
    assert not isinstance(raised.value, FileFailure)


def test_a_machine_without_its_denoiser_does_not_condemn_the_files(
    meshes: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The run ends; the same command succeeds once the fault is gone."""

    def missing(*_: object) -> None:
        raise UnirenderError("denoising: mitsuba-oidn is not installed")

    own = config(tmp_path / "out", meshes)
    with monkeypatch.context() as patch:
        patch.setattr("unirender_reference.members.GroupMembers.render", missing)
        with pytest.raises(UnirenderError, match="mitsuba-oidn is not installed"):
            generate(own, executor=Inline())
    with monkeypatch.context() as patch:
        patch.setattr(passes, "_render", lambda *_: (_ for _ in ()).throw(RuntimeError("kernel")))
        with pytest.raises(UnirenderError, match=r"failed at 0\.obj \(RuntimeError: kernel\), which is not listed"):
            generate(own, executor=Inline())
    assert not (tmp_path / "out").exists()
    assert generate(own, executor=Inline()).failures == ()


def test_pixels_that_stay_nan_are_of_the_file(meshes: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(passes, "_render", lambda *_: np.full((SIZE, SIZE, 4), np.nan, np.float32))
    report = generate(config(tmp_path / "out", meshes), executor=Inline())
    assert (report.groups, len(report.failures)) == (0, 3)
    for failure in report.failures:
        assert "stay NaN" in failure.reason
        assert not failure.machine


def test_an_object_that_covers_no_pixel(tmp_path: Path) -> None:
    folder = tmp_path / "meshes"
    folder.mkdir()
    (folder / "edge.obj").write_text("v 0 -1 -1\nv 0 1 -1\nv 0 0 1\nf 1 2 3\n")  # in the plane x = 0
    (failure,) = generate(config(tmp_path / "out", folder), executor=Inline()).failures
    assert failure.reason.startswith("covers no pixel of the picture")
    assert "flat and seen edge-on?" in failure.reason
    assert not failure.machine


def test_a_dead_worker_is_tried_again_and_a_broken_file_is_not(meshes: Path, tmp_path: Path) -> None:
    """And the end is that of a run in which nobody died."""
    (meshes / "broken.obj").write_text("v 0 0 0\n")
    own = config(tmp_path / "out", meshes)

    def die(_: DatasetConfig, plan: Any) -> None:
        if plan.mesh.name == "1.obj":
            raise WorkerDied("the worker died")

    first = generate(own, executor=Stored(die))
    assert {failure.file: failure.machine for failure in first.failures} == {"1.obj": True, "broken.obj": False}
    lines = [json.loads(line) for line in (own.out / "failures.jsonl").read_text().splitlines()]
    assert {line["file"]: line.get("machine", False) for line in lines} == {"1.obj": True, "broken.obj": False}
    assert manifest(own.out)["shards"][0]["groups"] == 2
    assert list(list_shards(own.out)) == [own.out / shard_name(0)]
    executor = Stored()
    assert [failure.file for failure in generate(own, executor=executor).failures] == ["broken.obj"]
    assert executor.begun == 4
    executor = Stored()
    generate(own, executor=executor)
    assert executor.begun == 0
    once = config(tmp_path / "once", meshes)
    generate(once, executor=Stored())
    for name in ("manifest.json", "failures.jsonl", shard_name(0)):
        assert (own.out / name).read_bytes() == (once.out / name).read_bytes()


def test_a_file_that_only_the_worker_misses_ends_the_run(meshes: Path, tmp_path: Path) -> None:
    def miss(*_: object) -> None:
        raise FileNotSeen("mesh 0.obj: no such file")

    with pytest.raises(UnirenderError, match="the command sees it: --meshes has to be at the same path"):
        generate(config(tmp_path / "out", meshes), executor=Stored(miss))


def test_a_file_that_is_gone_ends_the_run_and_a_link_to_nowhere_is_listed(meshes: Path, tmp_path: Path) -> None:
    def remove(_: DatasetConfig, plan: Any) -> None:
        if plan.index == 0:
            plan.mesh.path.rename(tmp_path / "0.obj")

    own = config(tmp_path / "out", meshes)
    with pytest.raises(UnirenderError, match="gone since the command began: put it back"):
        generate(own, executor=Inline(remove))
    (tmp_path / "0.obj").rename(meshes / "0.obj")
    (meshes / "gone.obj").symlink_to(tmp_path / "nowhere")
    report = generate(config(tmp_path / "out", meshes), executor=Stored())
    assert [(failure.file, failure.machine) for failure in report.failures] == [("gone.obj", False)]
    assert report.groups == 3


def test_a_removed_mesh_is_said_in_terms_of_meshes(meshes: Path, tmp_path: Path) -> None:
    generate(config(tmp_path / "out", meshes), executor=Stored())
    (meshes / "2.obj").unlink()
    with pytest.raises(UnirenderError, match="was made of more mesh files than --meshes has now"):
        generate(config(tmp_path / "out", meshes), executor=Stored())


def test_a_folder_that_cannot_be_listed_is_a_failure(
    meshes: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    closed = meshes / "closed"
    closed.mkdir()
    genuine = os.scandir

    def scandir(path: Path) -> Any:  # the tests may run as root, whom no permission stops
        if Path(path) == closed:
            raise PermissionError(errno.EACCES, "Permission denied", str(path))
        return genuine(path)

    monkeypatch.setattr(os, "scandir", scandir)
    report = generate(config(tmp_path / "out", meshes), executor=Stored())
    assert report.groups == 3
    assert [(failure.file, failure.reason) for failure in report.failures] == [
        ("closed/", "folder cannot be listed (Permission denied)")
    ]
    (line,) = (tmp_path / "out" / "failures.jsonl").read_text().splitlines()
    assert json.loads(line)["file"] == "closed/"
    assert generate(config(tmp_path / "out", meshes), executor=Stored()).failures == report.failures


def test_textures_may_lie_elsewhere_in_the_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """`load_mesh` is told the folder of all meshes."""
    file = MeshFile(tmp_path / "a" / "b" / "c.obj", "b/c.obj")
    assert file.folder == tmp_path / "a"
    roots: list[Path] = []

    def load(path: Path, root: Path) -> None:
        roots.append(root)
        raise UnirenderError(f"mesh {path}: enough seen")

    monkeypatch.setattr("unirender_reference.meshes.load_mesh", load)
    file.path.parent.mkdir(parents=True)
    file.path.touch()
    (failure,) = generate(config(tmp_path / "out", tmp_path / "a"), executor=Inline()).failures
    assert (failure.file, failure.reason) == ("b/c.obj", "enough seen")
    assert roots == [tmp_path / "a"]


def test_one_writer_at_a_time(tmp_path: Path) -> None:
    """The second is refused, and harms nothing; a killed one leaves no lock."""
    own = config(tmp_path / "out", None, objects=1)
    refused: list[str] = []

    def second(*_: object) -> None:
        with pytest.raises(UnirenderError, match="another run is writing here"):
            generate(own, executor=Stored())
        refused.append("once")

    assert generate(own, executor=Stored(second)).groups == 1
    assert refused
    assert not (own.out / LOCK).exists()
    script = (
        "import sys, time\nfrom pathlib import Path\nfrom unirender_reference.folder_lock import locked\n"
        "with locked(Path(sys.argv[1])):\n    print('held', flush=True)\n    time.sleep(60)\n"
    )
    process = subprocess.Popen([sys.executable, "-c", script, str(own.out)], stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    assert process.stdout.readline() == "held\n"
    with pytest.raises(UnirenderError, match="another run is writing here"), locked(own.out):
        pass
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    process.stdout.close()
    assert (own.out / LOCK).exists()
    with locked(own.out):
        pass
    assert not (own.out / LOCK).exists()


def test_a_system_without_locks_is_a_warning(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with locked(tmp_path):
        assert not list(tmp_path.iterdir())
    assert "no locks here (Windows); let no second run write to it" in caplog.text


def test_other_versions_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    own = config(tmp_path, None, objects=1)
    generate(own, executor=Stored())
    assert set(manifest(tmp_path)["versions"]) == {"unirender", "mitsuba", "drjit", "variant"}
    now = dict(manifest(tmp_path)["versions"])
    monkeypatch.setattr("unirender_reference.dataset.versions", lambda _: now | {"mitsuba": "9.9"})
    with pytest.raises(UnirenderError, match=rf"begun with mitsuba {now['mitsuba']} \(now 9\.9\), expected the same"):
        generate(own, executor=Stored())
    monkeypatch.undo()
    assert generate(own, executor=Stored()).groups == 0
    older = manifest(tmp_path)
    del older["versions"]
    (tmp_path / "manifest.json").write_text(json.dumps(older))
    with pytest.raises(UnirenderError, match=r"begun with .*mitsuba none \(now .*\), .*expected the same versions"):
        generate(own, executor=Stored())
    assert len(list_shards(tmp_path)) == 1  # it can be read


@pytest.mark.parametrize("names", [("shard-000000.tar",), ("mine.tar",), ("shard-000000.tar", "shard-000001.tar")])
def test_shards_that_may_be_of_others_are_not_overwritten(names: tuple[str, ...], tmp_path: Path) -> None:
    """A folder of one's own renders has the names of ours, and no manifest."""
    own = config(tmp_path, None, objects=2)
    for name in names:
        with tarfile.open(tmp_path / name, "w") as tar:
            entry = tarfile.TarInfo("chair.json")
            entry.size = len(text := b'{"vary": "independent"}')
            tar.addfile(entry, io.BytesIO(text))
    before = [(tmp_path / name).read_bytes() for name in names]
    with pytest.raises(UnirenderError, match=rf"has {names[0]} and no manifest\.json, .* is not overwritten"):
        generate(own, executor=Stored())
    assert [(tmp_path / name).read_bytes() for name in names] == before


def test_a_run_that_was_killed_before_its_first_manifest_goes_on(tmp_path: Path) -> None:
    with tarfile.open(tmp_path / shard_name(0), "w") as tar:
        entry = tarfile.TarInfo("object0_g0.json")
        entry.size = len(text := b'{"object_provenance": {}}')
        tar.addfile(entry, io.BytesIO(text))
    assert generate(config(tmp_path, None, objects=2), executor=Stored()).groups == 2


@pytest.fixture
def small_shards(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("unirender_reference.dataset.SHARD_GROUPS", 1)


def test_the_manifest_is_not_written_for_every_shard(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, small_shards: None
) -> None:
    """The first shard has it at once; the others stand in the journal, which resume and readers know."""
    own = config(tmp_path / "out", None, objects=5)
    written: list[bool] = []
    genuine = shards.write_manifest
    monkeypatch.setattr(
        journal,
        "write_manifest",
        lambda *args, complete: (written.append(complete), genuine(*args, complete=complete))[1],
    )
    seen: list[tuple[int, int, int]] = []

    def look(_: DatasetConfig, plan: Any) -> None:
        if plan.index == 4:
            lines = (own.out / JOURNAL).read_text().splitlines()
            listed = [sha for sha in list_shards(own.out).values() if sha is not None]
            seen.append((len(manifest(own.out)["shards"]), len(lines), len(listed)))

    monkeypatch.setattr("unirender_reference.dataset.AHEAD", 1)
    generate(own, executor=Stored(look))
    assert seen == [(1, 3, 4)]
    assert written == [False, True]
    assert sorted(path.suffix for path in own.out.iterdir()) == [".json", *[".tar"] * 5]
    monkeypatch.setattr(journal, "SECONDS", 0.0)  # the twin: each shard has its manifest
    generate(dataclasses.replace(own, out=tmp_path / "twin"), executor=Stored())
    assert written == [False, True, *[False] * 5, True]
    assert (tmp_path / "twin" / "manifest.json").read_bytes() == (own.out / "manifest.json").read_bytes()


def test_a_killed_run_goes_on_from_its_journal(tmp_path: Path, small_shards: None) -> None:
    """As kill -9 leaves it: the manifest of the first shard, a journal whose last line is torn."""
    own = config(tmp_path, None, objects=4)
    generate(own, executor=Stored())
    whole = (tmp_path / "manifest.json").read_bytes()
    content = manifest(tmp_path)
    lines = [json.dumps(entry) for entry in content["shards"][1:]]
    (tmp_path / JOURNAL).write_text("\n".join(lines)[:-20])
    (tmp_path / "manifest.json").write_text(
        json.dumps(content | {"shards": content["shards"][:1], "complete": False}, indent=1)
    )
    executor = Stored()
    generate(own, executor=executor)
    assert executor.begun == 1
    assert (tmp_path / "manifest.json").read_bytes() == whole
    assert not (tmp_path / JOURNAL).exists()


def test_bytes_of_old_shards_are_read_when_asked_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, small_shards: None
) -> None:
    monkeypatch.setattr("unirender_reference.resume.HASHED", 1)
    own = config(tmp_path, None, objects=2)
    generate(own, executor=Stored())
    for name in (shard_name(0), shard_name(1)):
        data = bytearray((tmp_path / name).read_bytes())
        data[700] ^= 1
        (tmp_path / name).write_bytes(data)
    assert generate(own, executor=Stored()).groups == 1  # the last one
    assert generate(own, executor=Stored(), verify=True).groups == 1
    assert generate(own, executor=Stored(), verify=True).groups == 0


def test_lights_of_another_list_stop_a_worker(tmp_path: Path) -> None:
    """A worker that lives longer than a data set lists its folder again, and compares it with the command's."""
    lights = tmp_path / "lights"
    lights.mkdir()
    for number in range(2):
        light = {name: np.full((8, 16), 1 + number, np.float32) for name in "RGB"}
        write_exr(lights / f"mine{number}.exr", light, half=False)
    own = config(tmp_path / "out", None, objects=1, lights=lights)
    plan = plan_groups(own)[0]
    stated = dataclasses.replace(own, lights_digest=own.content()["lights"])
    render_group(stated, plan)
    (lights / "mine0.exr").unlink()
    render_group(dataclasses.replace(own, lights_digest=own.content()["lights"]), plan)
    with pytest.raises(UnirenderError, match="other files, or other sizes, than when the command was started"):
        render_group(stated, plan)


def test_workers_need_the_denoiser_only_to_denoise() -> None:
    mine = dataclasses.replace(this_machine(), denoiser="1.0")
    without = dataclasses.replace(mine, denoiser="none")
    assert mine.differences(without) == ["denoiser"]
    assert dataclasses.replace(mine, denoiser=None).differences(without) == []


def test_a_report_without_renders_and_a_floor_that_is_not_reached(
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    caplog: pytest.LogCaptureFixture,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    (tmp_path / "bad.obj").write_text("")
    report = generate(config(tmp_path / "out", tmp_path / "bad.obj"), executor=Stored())
    assert (report.groups, len(report.failures)) == (0, 1)
    command = Dataset(out=tmp_path / "out", noise_floor=40.0)
    for floor, notices in ((FloorCount(9, 9, 40.1), 0), (FloorCount(9, 7, 31.25), 1)):
        monkeypatch.setattr(
            "unirender_reference.dataset.generate",
            lambda *_, verify, floor=floor: dataclasses.replace(report, floor=floor, failures=()),
        )
        caplog.clear()
        assert command.run() == 0
        said = capsys.readouterr().out
        assert "nothing rendered" in said
        assert "nan x" not in said
        assert caplog.text.count("2 images, s and d did not reach the noise floor with the 8192 samples") == notices
