"""`unirender train-visibility`: teaches the network of shadows which directions objects hide from themselves.

The loss of an object is in `unirender.training.shadows.loss`. A run resumes by running the same command again: the
order of objects and all that is random is a function of the seed and the step.
"""

import contextlib
import dataclasses
import json
import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from unirender.command_line.option_checks import check_seed
from unirender.errors import UnirenderError, UsageError
from unirender.system.ends import Ended
from unirender.system.notices import notice
from unirender.system.writing import check_out, writing
from unirender.training.command import Alone

if TYPE_CHECKING:
    import torch

    from unirender.models.visibility import VisibilityNet
    from unirender.training.shadows.rays import VisibilityItem

HELD_OUT = 25  # every so many-th object is for validation
WARMUP = 50  # steps
FLAT = 0.5  # of the steps, after which the learning rate falls to 0
EMA_DECAY = 0.995
MAX_NORM = 1.0
SAVE_SECONDS = 120.0
WEIGHTS_FILE, LOG_FILE = "visibility.safetensors", "log.jsonl"
OF_A_STATE = ("options", "step", "net", "optimizer", "ema")


@dataclass(frozen=True)
class TrainVisibility:
    """Train the network that says which directions an object hides from itself; resumes by running the same command
    again. It ships trained: `render` uses it wherever a light is given and s and d are not."""

    data: Path
    """Folder that `unirender dataset --vary visibility` wrote."""
    out: Path
    """Run folder: `visibility.safetensors`, `log.jsonl` and the state."""
    steps: int = 2400
    """Steps of the optimiser."""
    batch_size: int = 8
    """Objects a step."""
    learning_rate: float = 2e-3
    """Peak learning rate of AdamW."""
    halved: float = 0.6
    """Share of the objects that are seen at half their size."""
    seed: int = 0
    """Seed of the weights, the order of objects and the lights."""

    def check(self) -> None:
        """Looks at the values.

        Raises:
            UsageError: one is outside its range.
        """
        for name in ("steps", "batch_size", "learning_rate"):
            if not 0 < getattr(self, name) < math.inf:
                raise UsageError(f"--{name.replace('_', '-')} {getattr(self, name)}: expected a number above 0")
        check_seed(self.seed)
        if not 0 <= self.halved <= 1:
            raise UsageError(f"--halved {self.halved}: expected a share in [0, 1]")

    def run(self, alone: Alone = contextlib.nullcontext) -> int:
        """Trains, or resumes; returns the exit status."""
        from unirender.training.loop.checkpoint import check_leftover

        self.check()
        if not self.data.is_dir():
            raise UnirenderError(
                f"{self.data}: no such data folder, expected one written by `unirender dataset --vary visibility`"
            )
        check_out(self.out)
        check_leftover(self.out, WEIGHTS_FILE)
        with alone(self.out):
            print(f"{train_visibility(self)}: trained")
        return 0


def train_visibility(options: TrainVisibility) -> Path:
    """Runs the training; returns the file of the averaged weights.

    Raises:
        UnirenderError: broken data, or the folder holds a run of other options or data.
        Ended: it was asked to stop.
    """
    from unirender.training.data.groups import unread_shards
    from unirender.training.loop.stopping import stopping_gently
    from unirender.training.shadows.rays import read_items

    if unread := unread_shards(options.data):
        notice(unread)
    items, shards = read_items(options.data, lambda done, total: print(f"looked at {done} of {total} shards"))
    run = _Run(options, *split(items), shards)
    if run.step == options.steps:
        run.write_weights(run.averaged())  # it may have ended between its state and them
    saved = time.monotonic()
    with stopping_gently() as stop:
        while run.step < options.steps and not stop.asked:
            run.train_step()
            if time.monotonic() - saved > SAVE_SECONDS or run.step == options.steps or stop.asked:
                with stop.unheard():
                    run.keep()
                saved = time.monotonic()
    if stop.signal is not None and run.step < options.steps:
        raise Ended(stop.signal)
    return options.out / WEIGHTS_FILE


class _Run:
    """A training as far as it has come; one that the folder holds is continued.

    Args:
        options: of the run.
        items: objects to learn from.
        held_out: objects to validate on.
        shards: sha256 of the data's shards by name.

    Raises:
        UnirenderError: the folder holds a run of other options or data.
    """

    def __init__(
        self,
        options: TrainVisibility,
        items: "Sequence[VisibilityItem]",
        held_out: "Sequence[VisibilityItem]",
        shards: Mapping[str, str],
    ) -> None:
        import torch

        from unirender.models.visibility import VisibilityNet
        from unirender.training.loop.checkpoint import load_state
        from unirender.training.optim.ema import Ema
        from unirender.training.shadows.loss import validate

        self.options, self.items, self.held_out = options, items, held_out
        self.asked = {**dataclasses.asdict(options), "data": dict(shards), "out": None}
        torch.manual_seed(options.seed)
        self.net = channels_last(VisibilityNet())
        self.optimizer = torch.optim.AdamW(self.net.parameters(), lr=options.learning_rate, betas=(0.9, 0.99))
        self.ema = Ema(self.net, EMA_DECAY)
        self.step, self.losses = 0, list[tuple[float, float]]()
        self.log = options.out / LOG_FILE
        if (state := load_state(options.out, OF_A_STATE)) is not None:
            self._resume(state)
        elif self.log.is_file():
            self.log.unlink()  # of a run that was killed before its first state
        if not self.step:
            print(self._log(validate(self.net, held_out, options.seed)), flush=True)  # before anything was learned

    def _resume(self, state: Mapping[str, Any]) -> None:
        """Takes weights, averages and place from a saved run with the same options."""
        from unirender.training.logs.run_log import forget_after

        before = state["options"]
        if differing := [name for name in self.asked if before.get(name) != self.asked[name]]:
            held = (
                "other data" if name == "data" else f"{name} {before.get(name)} instead of {self.asked[name]}"
                for name in differing
            )
            raise UnirenderError(
                f"{self.options.out}: holds a run with {', '.join(held)}; repeat the options of that run, or choose "
                "another --out"
            )
        self.net.load_state_dict(state["net"])
        self.optimizer.load_state_dict(state["optimizer"])
        self.ema.load_state_dict(state["ema"])
        self.step = int(state["step"])
        forget_after(self.log, self.step)

    def train_step(self) -> None:
        """One step of the optimiser."""
        import torch

        from unirender.training.shadows.loss import LIGHT_WEIGHT, terms

        options = self.options
        for group in self.optimizer.param_groups:
            group["lr"] = options.learning_rate * rate(self.step / options.steps, self.step)
        for index in range(self.step * options.batch_size, (self.step + 1) * options.batch_size):
            item, rng = drawn(self.items, index, options)
            bce, error = terms(self.net, item, rng)
            ((bce + LIGHT_WEIGHT * error) / options.batch_size).backward()
            self.losses.append((bce.item(), error.item()))
        norm = torch.nn.utils.clip_grad_norm_(self.net.parameters(), MAX_NORM)
        if not torch.isfinite(norm):
            raise UnirenderError(
                f"training: the gradient at step {self.step} is {float(norm)}; begin anew with a lower --learning-rate "
                "and another --out"
            )
        self.optimizer.step()
        self.optimizer.zero_grad(set_to_none=True)
        self.ema.update(self.net)
        self.step += 1

    def keep(self) -> None:
        """Saves the state and the averaged weights, and what they score.

        The line of the log comes first: of a run that is killed before the state it is dropped, and comes again.
        """
        from unirender.training.loop.checkpoint import save_state
        from unirender.training.shadows.loss import mean, validate

        shown = self.averaged()
        means = dict(zip(("bce", "log_error"), map(mean, zip(*self.losses, strict=True)), strict=True))
        told = self._log(means | validate(shown, self.held_out, self.options.seed))
        parts = {"net": self.net, "optimizer": self.optimizer, "ema": self.ema}
        state = {name: part.state_dict() for name, part in parts.items()}
        save_state(self.options.out, {**state, "step": self.step, "options": self.asked})
        self.write_weights(shown)
        self.losses.clear()
        print(told, flush=True)

    def averaged(self) -> "VisibilityNet":
        """A network that has the averaged weights."""
        from unirender.models.visibility import VisibilityNet

        shown = channels_last(VisibilityNet())
        self.ema.copy_to(shown)
        return shown

    def write_weights(self, shown: "VisibilityNet") -> None:
        """Writes the weights of a network."""
        from safetensors.torch import save

        from unirender.system.whole_files import whole_file

        halves = {name: value.half().contiguous() for name, value in shown.state_dict().items()}
        with writing(path := self.options.out / WEIGHTS_FILE), whole_file(path) as file:
            file.write(save(halves))

    def _log(self, values: Mapping[str, float]) -> str:
        """Adds a line to the log; the same for people."""
        line = {"step": self.step, "objects": self.step * self.options.batch_size, **values}
        with writing(self.log):
            self.options.out.mkdir(parents=True, exist_ok=True)
            with self.log.open("a") as file:
                file.write(json.dumps(line) + "\n")
        return " ".join(f"{key} {value:.4g}" for key, value in line.items())


def channels_last(net: "VisibilityNet") -> "VisibilityNet":
    """The network with its weights in the layout that convolutions on a CPU are fastest in."""
    import torch

    return net.to(memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue] - the stubs lack it


def split(items: "Sequence[VisibilityItem]") -> "tuple[list[VisibilityItem], list[VisibilityItem]]":
    """The objects to learn from, and those that are held out (of less than `HELD_OUT`, the last one).

    All views of one object are on one side.
    """
    names = [item.object or str(number) for number, item in enumerate(items)]
    objects = list(dict.fromkeys(names))
    apart = set(objects[HELD_OUT - 1 :: HELD_OUT] or objects[-1:])
    own, held_out = ([i for i, name in zip(items, names, strict=True) if (name in apart) == side] for side in (0, 1))
    return own or list(items), held_out


def rate(progress: float, step: int) -> float:
    """Factor of the learning rate."""
    return min(1, (step + 1) / WARMUP) * min(1, (1 - progress) / (1 - FLAT))


def drawn(
    items: "Sequence[VisibilityItem]", index: int, options: TrainVisibility
) -> "tuple[VisibilityItem, torch.Generator]":
    """Object number `index` of the stream as it is seen, and what its lights are drawn with."""
    import numpy as np
    import torch

    epoch, place = divmod(index, len(items))
    item = items[np.random.default_rng([options.seed, 0, epoch]).permutation(len(items))[place]]
    rng = np.random.default_rng([options.seed, 1, index])
    if rng.random() < options.halved and not any(size % 2 for size in item.surface.shape):
        half = item.halved()
        item = half if half.surface.any() else item
    item = item.turned(int(rng.integers(4)), bool(rng.integers(2)))
    return item, torch.Generator().manual_seed(int(rng.integers(1 << 62)))
