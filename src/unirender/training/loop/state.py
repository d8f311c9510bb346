"""What a run remembers: everything that its next step depends on, how it goes on from there, and its configuration."""

import dataclasses
import json
from typing import TYPE_CHECKING, Any

import torch

from unirender.errors import UnirenderError
from unirender.system.whole_files import whole_file
from unirender.system.writing import writing
from unirender.training.data.source import BatchSource
from unirender.training.logs.live import Report
from unirender.training.loop.beginning import check_beginning
from unirender.training.loop.checkpoint import differences, load_state, plain
from unirender.training.optim.passes import laid_out_like

if TYPE_CHECKING:
    from unirender.training.loop.trainer import Trainer

OF_A_STATE = (
    *("config", "step", "seconds", "model", "ema", "optimizer", "loss_scale", "generator", "parts"),
    *("unlogged", "continues", "begun_with", "source", "shown"),
)
OF_ALL = ("steps", "minutes", "log_every", "parallel", "accumulate")  # entries of the run by which all processes act


def state_of(trainer: "Trainer", source: BatchSource) -> dict[str, Any]:
    """Everything that the next step depends on, as plain data and tensors."""
    return {
        "config": plain(trainer.config),
        "step": trainer.step,
        "seconds": trainer.seconds,
        "model": trainer.model.state_dict(),
        "ema": trainer.ema.state_dict(),
        "optimizer": trainer.optimizer.state_dict(),
        "loss_scale": trainer.loss_scale.state_dict(),
        "generator": trainer.generator.get_state(),
        "parts": trainer.split.all_parts,
        "unlogged": dict(trainer.log.waiting),
        "continues": trainer.continues,
        "begun_with": trainer.begun_with,
        "source": source.state_dict(),
        "shown": trainer.shown,
    }


def resume(trainer: "Trainer", source: BatchSource, report: Report = lambda line: None) -> bool:
    """Continues from the folder's state; whether it has one.

    Args:
        trainer: that has not begun.
        source: of its batches.
        report: is told where the run cannot go on exactly.

    Raises:
        UnirenderError: the state is broken, belongs to another config, or was begun with other weights.
    """
    state = load_state(trainer.run.out, OF_A_STATE)
    if state is None:
        trainer.log.forget_after(-1)  # all of a run that was killed before its first save
        return False
    if differing := differences(state["config"], trainer.config):
        raise UnirenderError(
            f"{trainer.run.out}: holds a run with {', '.join(differing)}; repeat the options of that run, or pass "
            "another --out"
        )
    check_beginning(trainer.run.out, state["begun_with"], trainer.begun_with)
    trainer.begun_with, trainer.continues = state["begun_with"], state["continues"]
    trainer.step, trainer.seconds = state["step"], state["seconds"]
    trainer.model.load_state_dict(state["model"])
    trainer.ema.load_state_dict(state["ema"])
    trainer.optimizer.load_state_dict(state["optimizer"])
    for p, moments in trainer.optimizer.state.items():
        same_shape = {name: value for name, value in moments.items() if value.shape == p.shape}
        moments.update({name: laid_out_like(p, value) for name, value in same_shape.items()})
    trainer.loss_scale.load_state_dict(state["loss_scale"])
    trainer.generator.set_state(state["generator"])
    trainer.log.waiting.update(state["unlogged"])
    source.load_state_dict(state["source"])
    trainer.shown = state["shown"]
    trainer.log.forget_after(trainer.step)
    if (parts := state["parts"]) != trainer.split.all_parts:
        news = f"{parts} -> {trainer.split.all_parts}: from here on other noise is drawn than without the change"
        trainer.log.tell({"step": trainer.step, "parts": news}, report)
    return True


def check_alike(trainer: "Trainer") -> None:
    """Looks whether all processes were told the same: each of another machine has a command line of its own.

    With another learning rate they would end with other weights, with another length one would wait for ever, and in
    another precision one skips steps that the others take.

    Raises:
        UnirenderError: they were not.
    """
    own = {name: getattr(trainer.run, name) for name in OF_ALL}
    own["dtype"] = str(trainer.dtype).removeprefix("torch.")
    config, run = trainer.processes.share((plain(trainer.config), own))
    other = differences(config, trainer.config)
    other += [f"{name} {run[name]!r} instead of {value!r}" for name, value in own.items() if value != run[name]]
    for rank, found in enumerate(trainer.processes.gather(other)):
        if found:
            raise UnirenderError(
                f"process 0 of {trainer.processes.size} was started with {', '.join(found)}, as process {rank} has it; "
                "start all of them with the same options (--dtype auto depends on the machine)"
            )


def write_config(trainer: "Trainer") -> None:
    """Writes `config.json`: the resolved configuration, the length of the run, and the hardware of every process."""
    own = {"device": str(trainer.device), "dtype": str(trainer.dtype), "threads": torch.get_num_threads()}
    hardware = trainer.processes.gather(own)  # by process
    if not trainer.processes.is_main:
        return
    run = dataclasses.asdict(trainer.run) | {"out": str(trainer.run.out)}
    text = json.dumps({"train": dataclasses.asdict(trainer.config), "run": run, "hardware": hardware}, indent=2)
    path = trainer.run.out / "config.json"
    with writing(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        with whole_file(path) as file:
            file.write((text + "\n").encode())
