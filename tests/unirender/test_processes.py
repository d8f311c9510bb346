"""Several processes train as one does: torchrun starts two on the CPU, and both must have run."""

import dataclasses
import json
import math
import os
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from synthetic_shards import write_dataset
from tiny_models import TRAIN, make_pipeline

from unirender.errors import UnirenderError
from unirender.pipelines.unirender_pipeline import UniRenderPipeline
from unirender.training.command import Train
from unirender.training.config import RunConfig, TrainConfig
from unirender.training.data.source import ShardSource
from unirender.training.loop.checkpoint import load_state
from unirender.training.loop.state import OF_ALL, check_alike
from unirender.training.loop.trainer import Trainer
from unirender.training.optim import processes
from unirender.training.optim.processes import ALONE, Processes, join_processes
from unirender.training.run import train

SCRIPT = Path(__file__).resolve().parents[1] / "helpers" / "train_tiny.py"
CPU = torch.device("cpu")
STEPS = 5
LOSSES = ("image", "material", "albedo", "normal", "specular", "diffuse", "environment", "cycle", "grad_norm")

BROKEN_DISK = """
import os
from unirender.errors import UnirenderError
from unirender.training.data.source import ShardSource

def next(self):
    raise UnirenderError("the disk of process 1 is gone")

if os.environ["RANK"] == "1":
    ShardSource.next = next
"""

SLOW_SAVE = """
import os, signal, time
from unirender.training.loop import trainer
from unirender.training.data.source import ShardSource

own_next, own_save = ShardSource.next, trainer.save_state

def next(self):
    if self.consumed == 5:
        os.kill(os.getpid(), signal.SIGTERM)
    return own_next(self)

def save_state(folder, state):
    time.sleep(4)
    return own_save(folder, state)

if os.environ["RANK"] == "0":
    trainer.save_state = save_state
else:
    ShardSource.next = next
"""


@dataclass(frozen=True)
class Run:
    """A run of two processes that has come to its end."""

    out: Path
    data: Path
    printed: str


def torchrun(data: Path, out: Path, *options: str, script: Path = SCRIPT) -> subprocess.CompletedProcess[str]:
    """Trains a batch of five samples in two processes: three and two."""
    launch = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2", str(script)]
    command = ["train", "--preset", "test", "--data", str(data), "--out", str(out), "--batch-size", "5"]
    common = ["--dtype", "float32", "--device", "cpu", "--log-every", "1"]
    env = os.environ | {"OMP_NUM_THREADS": "1"}
    return subprocess.run(
        [*launch, *command, *common, *options], env=env, capture_output=True, text=True, timeout=500, check=False
    )


def changed_by(lines: str, folder: Path) -> Path:
    """The program with something of it changed."""
    script = folder / "changed.py"
    run = f"runpy.run_path({str(SCRIPT)!r}, run_name='__main__')"
    script.write_text(f"{lines}\nimport runpy, sys\nsys.path.insert(0, {str(SCRIPT.parent)!r})\n{run}\n")
    return script


def losses(out: Path) -> list[dict[str, float]]:
    lines = [json.loads(line) for line in (out / "log.jsonl").read_text().splitlines()]
    return [{name: line[name] for name in ("step", *LOSSES) if name in line} for line in lines]


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Run:
    folder = tmp_path_factory.mktemp("torchrun")
    data = write_dataset(folder / "data", size=32)
    ended = torchrun(data, folder / "run", "--steps", str(STEPS))
    assert ended.returncode == 0, ended.stderr
    return Run(folder / "run", data, ended.stdout)


def one_process(run: Run, out: Path, seed: int) -> list[dict[str, float]]:
    """The same run in this process, its batch cut into the same two parts."""
    config = dataclasses.replace(TRAIN, batch_size=5, seed=seed)
    options = Train(
        data=run.data, out=out, steps=STEPS, seed=seed, device="cpu", dtype="float32", parallel=2, log_every=1
    )
    train(options, config, out)
    return losses(out)


@pytest.mark.long
def test_two_processes_give_the_losses_of_one(run: Run, tmp_path: Path) -> None:
    assert [f"process {rank} of 2" in run.printed for rank in range(3)] == [True, True, False]
    assert len(json.loads((run.out / "config.json").read_text())["hardware"]) == 2
    assert run.printed.count("use it with --checkpoint") == 1  # the first process alone speaks of it
    two, one, other = losses(run.out), *(one_process(run, tmp_path / str(seed), seed) for seed in (0, 1))
    assert [line["step"] for line in two] == list(range(1, STEPS + 1))
    assert all(set(LOSSES) <= line.keys() for line in two)
    for a, b, c in zip(two, one, other, strict=True):
        assert a == pytest.approx(b, rel=1e-5)
        assert a != pytest.approx(c, rel=1e-2)  # the twin: another seed


@pytest.mark.long
def test_the_first_process_alone_tells_of_the_beginning(run: Run, tmp_path: Path) -> None:
    make_pipeline().save_pretrained(tmp_path / "plain")
    lined = UniRenderPipeline.from_pretrained(tmp_path / "plain", calibration={"roughness": [0.5, 0.2]})
    lined.save_pretrained(tmp_path / "lined")
    ended = torchrun(run.data, tmp_path / "run", "--steps", "1", "--init", str(tmp_path / "lined"))
    assert ended.returncode == 0, ended.stderr
    assert ended.stderr.count("run `unirender calibrate` on the new ones") == 1


@pytest.mark.long
def test_two_processes_resume_and_end_by_one_clock(run: Run) -> None:
    """Each with a clock of its own, one of them would stop a step before the other, and the other wait for ever."""
    state = load_state(run.out)
    assert state is not None
    assert (state["step"], state["parts"], state["source"]["consumed"]) == (STEPS, 2, 5 * STEPS)
    ended = torchrun(run.data, run.out, "--steps", "100000", "--minutes", str(state["seconds"] / 60 + 0.03))
    assert ended.returncode == 0, ended.stderr
    steps = [int(line["step"]) for line in losses(run.out)]
    assert STEPS < steps[-1] < 100000
    assert steps == list(range(1, steps[-1] + 1))


@pytest.mark.long
def test_an_error_of_one_process_ends_all_with_a_line(run: Run, tmp_path: Path) -> None:
    ended = torchrun(run.data, tmp_path / "run", "--steps", "2", script=changed_by(BROKEN_DISK, tmp_path))
    assert ended.returncode == 1
    said = [line for line in ended.stderr.splitlines() if line.startswith("unirender: error:")]
    assert "unirender: error: the disk of process 1 is gone" in said
    assert all("the disk of process 1" in line or "process 0 of 2 stops: another process" in line for line in said)
    assert load_state(tmp_path / "run") is None


@pytest.mark.long
def test_all_wait_for_the_one_that_saves(run: Run, tmp_path: Path) -> None:
    """Another one alone is asked to stop, as where its machine is taken away; torchrun ends all when one has ended."""
    ended = torchrun(run.data, tmp_path / "run", "--steps", "9", script=changed_by(SLOW_SAVE, tmp_path))
    assert ended.returncode == 1
    state = load_state(tmp_path / "run")
    assert state is not None
    assert state["step"] == 2


def test_alone_everything_is_itself(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("WORLD_SIZE", "RANK", "LOCAL_RANK"):
        monkeypatch.delenv(name, raising=False)
    assert join_processes(CPU) == (ALONE, CPU)
    assert ALONE.is_main
    assert (ALONE.gather(3), ALONE.share(3)) == ([3], 3)
    tensors = [torch.ones(2), torch.zeros(1)]
    assert all(a is b for a, b in zip(ALONE.sum(tensors), tensors, strict=True))
    ALONE.close()
    assert not Processes(1, 2).is_main


def test_one_process_of_a_machine_goes_before_its_others(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each of eight would pack the same shards, and derive the same light, on all cores of the machine."""
    done: list[str] = []
    monkeypatch.setattr(Processes, "gather", lambda self, value: done.append("all met"))
    for local in (0, 1):
        with Processes(2 + local, 4, local).one_first():
            done.append(f"process {local} works")
    assert done == ["process 0 works", "all met", "all met", "process 1 works"]
    with pytest.raises(UnirenderError, match="disk"), Processes(2, 4, 0).one_first():
        raise UnirenderError("disk")
    assert len(done) == 4  # the others are told that it has ended


def test_processes_that_were_told_different_things_are_refused(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Another rate would give each its own weights without a word, another length let one wait for the others."""
    monkeypatch.setattr(Processes, "gather", lambda self, value: [[], value])

    def check(
        config: TrainConfig = TRAIN, steps: int = 9, parallel: int = 1, dtype: torch.dtype = torch.float32
    ) -> None:
        run = RunConfig(tmp_path, steps=9)
        first = (
            json.loads(json.dumps(dataclasses.asdict(TRAIN))),
            {n: getattr(run, n) for n in OF_ALL} | {"dtype": "float32"},
        )
        monkeypatch.setattr(Processes, "share", lambda self, value: first)
        own = dataclasses.replace(run, steps=steps, parallel=parallel)
        told = SimpleNamespace(config=config, run=own, processes=Processes(1, 2), dtype=dtype)
        check_alike(told)  # pyright: ignore[reportArgumentType] - all that it looks at

    check()
    faster = dataclasses.replace(TRAIN.optimizer, learning_rate=1.0)
    with pytest.raises(UnirenderError, match=r"optimizer.learning_rate 0.002 instead of 1.0, as process 1 has it"):
        check(dataclasses.replace(TRAIN, optimizer=faster))
    with pytest.raises(UnirenderError, match="process 0 of 2 was started with steps 9 instead of 7"):
        check(steps=7)
    with pytest.raises(UnirenderError, match="parallel 1 instead of 4"):  # by which each draws seeds for the parts
        check(parallel=4)
    with pytest.raises(
        UnirenderError, match=r"dtype 'float32' instead of 'float16', as process 1 has it.*--dtype auto"
    ):
        check(dtype=torch.float16)  # whose loss scale leaves out steps


@pytest.mark.parametrize(
    ("rank", "local", "order"),
    [(0, 0, ["all met"]), (1, 1, ["all met", "read"]), (2, 0, ["read", "all met"]), (3, 1, ["all met", "read"])],
)
def test_new_shards_are_packed_by_one_process_of_a_machine(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, rank: int, local: int, order: list[str]
) -> None:
    """After --refresh-minutes each process of another machine than the first packed them."""
    done: list[str] = []
    monkeypatch.setattr(Processes, "share", lambda self, value: value)
    monkeypatch.setattr(Processes, "gather", lambda self, value: done.append("all met"))
    monkeypatch.setattr(ShardSource, "load_state_dict", lambda self, state: done.append("read"))
    Trainer._follow_main(
        SimpleNamespace(processes=Processes(rank, 4, local)),  # pyright: ignore[reportArgumentType] - all it looks at
        ShardSource(tmp_path, batch_size=2, seed=0),
    )
    assert done == order


def test_a_shard_that_one_machine_lacks_is_told_as_such(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """It was told of a run that was trained on it, which there was not."""
    there = ShardSource(write_dataset(tmp_path / "there"), batch_size=2, seed=0)
    there.open()
    monkeypatch.setattr(Processes, "share", lambda self, value: there.state_dict())
    lacking = ShardSource(write_dataset(tmp_path / "lacking", shards=1), batch_size=2, seed=0)
    with pytest.raises(UnirenderError, match=r"process 1 of 2 does not find the data of process 0.*shard-000001"):
        Trainer._follow_main(
            SimpleNamespace(processes=Processes(1, 2)),  # pyright: ignore[reportArgumentType] - all that it looks at
            lacking,
        )


@pytest.mark.parametrize(
    ("variables", "device", "message"),
    [
        ({"WORLD_SIZE": "two"}, "cpu", "WORLD_SIZE='two', expected the number that torchrun sets"),
        ({"WORLD_SIZE": "2", "RANK": "0"}, "cpu", "got LOCAL_RANK='', expected the number"),
        ({"WORLD_SIZE": "2", "RANK": "0", "LOCAL_RANK": "0"}, "mps", "expected --device cpu or cuda"),
        ({"WORLD_SIZE": "2", "RANK": "0", "LOCAL_RANK": "999"}, "cuda", "has no GPU of its own"),
        ({"WORLD_SIZE": "2", "RANK": "1", "LOCAL_RANK": "1"}, "cpu", "process 1 of 2 cannot reach the others"),
    ],
)
def test_an_environment_that_torchrun_did_not_make_is_refused(
    monkeypatch: pytest.MonkeyPatch, variables: dict[str, str], device: str, message: str
) -> None:
    for name in ("WORLD_SIZE", "RANK", "LOCAL_RANK", "MASTER_ADDR", "MASTER_PORT"):
        monkeypatch.delenv(name, raising=False)
    for name, value in variables.items():
        monkeypatch.setenv(name, value)
    with pytest.raises(UnirenderError, match=message):
        join_processes(torch.device(device))


def test_gradients_travel_in_buckets_of_one_type(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(processes, "BUCKET", 10)
    sizes = (4, 5, 2, 30, 1, 3)
    tensors = [torch.zeros(size, dtype=torch.float16 if size == 3 else torch.float32) for size in sizes]
    buckets: list[Any] = list(processes._buckets(tensors))
    assert [[t.numel() for t in bucket] for bucket in buckets] == [[4, 5], [2], [30], [1], [3]]
    assert sum(t.numel() for bucket in buckets for t in bucket) == math.fsum(sizes)
