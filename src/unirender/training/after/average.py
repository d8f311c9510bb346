"""`unirender average`: one checkpoint whose weights are the weighted mean of those of several.

    theta = sum over k of  share_k theta_k,      shares that add up to 1

A run and the weights that it began with (Wortsman et al. 2021, "Robust fine-tuning of zero-shot models"), or several
runs with one beginning (2022, "Model soups"), mostly lie in one basin of the loss, in which their mean has less of the
noise that each ended with. Of networks that have no common beginning the mean is no network; nothing here can tell.
"""

import json
import math
import reprlib
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import tyro

from unirender.errors import UnirenderError, UsageError
from unirender.system.notices import notice
from unirender.system.wording import counted

if TYPE_CHECKING:
    import torch
    from torch import Tensor, nn

    from unirender.pipelines.unirender_pipeline import UniRenderPipeline

Stored = Literal["float16", "float32"]

ROUNDING = 1e-6  # relative
ID = 12  # characters of a sha256 by which weights are named
OF_THE_WEIGHTS = ("scores", "scored_on", "losses", "calibration")  # facts of a run that its mean with others has not
NOT_OF_THE_RUN = (*OF_THE_WEIGHTS, "averaged", "stored_as", "continues")  # by which one run may be told differently


@dataclass(frozen=True)
class Average:
    """Average the weights of checkpoints of one network, such as a run and what it began with, into a new one."""

    checkpoints: tyro.conf.Positional[tuple[Path, ...]]
    """Folders of the checkpoints, or names of shipped ones; two or more. The account of the training is that of the
    last, under which the runs of the others are listed."""
    out: Path
    """New folder of the average."""
    shares: tuple[float, ...] = ()
    """Of each checkpoint in the average, in the same order; only their ratios count. None given: all alike."""
    store: Stored = "float16"
    """Type in which the network is stored; float32 where training goes on with it. An autoencoder stays in float32."""

    def check(self) -> tuple[float, ...]:
        """Looks at the values; the shares, which add up to 1.

        Raises:
            UsageError: fewer than two checkpoints, another number of shares, or one that is not above 0.
        """
        count = len(self.checkpoints)
        if count < 2:
            raise UsageError(f"average: got {counted(count, 'checkpoint')}, expected two or more")
        shares = self.shares or (1.0,) * count
        if len(shares) != count:
            raise UsageError(f"--shares: got {len(shares)}, expected {count}, one for each checkpoint")
        if not all(share > 0 for share in shares) or not math.isfinite(sum(shares)):
            raise UsageError(
                f"--shares {' '.join(map(str, shares))}: expected finite numbers above 0; leave out the others"
            )
        return tuple(share / sum(shares) for share in shares)

    def run(self) -> int:
        """Returns the exit status."""
        shares = self.check()
        if self.out.is_dir() and any(self.out.iterdir()):
            raise UnirenderError(f"{self.out}: exists and is not empty, expected a new folder; choose another --out")
        average(self.checkpoints, shares, self.out, self.store)
        parts = ", ".join(f"{share:.4g} of {path}" for path, share in zip(self.checkpoints, shares, strict=True))
        print(f"{self.out}: {parts}; use it with --checkpoint {self.out}")
        return 0


def average(checkpoints: Sequence[Path], shares: Sequence[float], out: Path, store: Stored = "float16") -> None:
    """Writes the average as a pipeline folder with an account of what it is made of.

    Lines of a calibration are not taken over: they belong to the weights that they were fitted to.

    Args:
        checkpoints: pipeline folders, or names of shipped ones.
        shares: of each; they add up to 1.
        out: new folder.
        store: type of the stored weights.

    Raises:
        UnirenderError: a folder is no checkpoint or cannot be read, or the account of its training is broken; the
            networks differ; or `out` lies in one of them or cannot be written.
    """
    import diffusers
    import torch

    from unirender.new_folders import new_folder
    from unirender.pipelines.unirender_pipeline import UniRenderPipeline
    from unirender.shipped import checkpoint_folder
    from unirender.system.writing import writing
    from unirender.training.loop.card import CARD_FILE, card_text
    from unirender.training.loop.export import TRAINING_FILE, read_history, save_weights

    diffusers.utils.logging.disable_progress_bar()  # of loading: small files
    folders = [checkpoint_folder(path) for path in checkpoints]
    for path, folder in zip(checkpoints, folders, strict=True):
        if folder.resolve() in (out.resolve(), *out.resolve().parents):
            raise UnirenderError(f"{out}: lies in {path}, which would then be another checkpoint; choose another --out")
    histories = [read_history(folder) for folder in folders]
    with new_folder(out) as new:
        first = _read(checkpoints[0], folders[0])
        material = first.config["material"]
        total = {name: shares[0] * value.double() for name, value in first.dual_stream.state_dict().items()}
        for path, folder, share in zip(checkpoints[1:], folders[1:], shares[1:], strict=True):
            other = _read(path, folder)
            _check_alike(first, other, checkpoints[0], path)
            material = other.config["material"] if material == "scalar" else material  # maps, if any of them has maps
            for name, value in other.dual_stream.state_dict().items():
                total[name] += share * value.double()
            del other
        vae = None if first.vae is None else _fresh(first.vae, first.vae.state_dict(), torch.float32)
        model = _fresh(first.dual_stream, total, getattr(torch, store))
        pipeline = UniRenderPipeline(model, first.scheduler, vae, material=material)
        facts = averaged_facts(histories, [_label(folder) for folder in folders], shares) | {"stored_as": store}
        facts.setdefault("train", {"model": {"codec": model.config["codec"]}})  # the card's licence depends on it
        with writing(out, "free some space or choose another --out"):
            save_weights(pipeline, new)
            (new / TRAINING_FILE).write_text(json.dumps(facts, indent=2) + "\n")
            (new / CARD_FILE).write_text(card_text(out.resolve().name, facts), encoding="utf-8")


def averaged_facts(
    histories: Sequence[Sequence[Mapping[str, Any]]], labels: Sequence[str], shares: Sequence[float]
) -> dict[str, Any]:
    """The account of an average: that of the last checkpoint's run, and under `continues` all other runs, each once.

    Args:
        histories: of each checkpoint, its runs, oldest first; [] where nothing is known of it.
        labels: of each, for `averaged`. The last one's own share goes to "this run", or, where it is an average itself,
            to what it is made of.
        shares: of each; they add up to 1.
    """
    *others, last = histories
    facts: dict[str, Any] = dict(last[-1]) if last else {}
    within = facts.pop("averaged", None) or {"this run" if last else labels[-1]: 1.0}
    averaged: defaultdict[str, float] = defaultdict(float)
    for label, share in zip(labels[:-1], shares[:-1], strict=True):
        averaged[label] += share
    for label, share in within.items():
        averaged[label] += share * shares[-1]
    runs: dict[str, Mapping[str, Any]] = {}
    for run in [run for own in (*others, last[:-1]) for run in own]:
        name = _name_of_run(run)
        if name not in runs or "averaged" in runs[name]:  # an average of it tells less of it than it does
            runs[name] = run
    runs.pop(_name_of_run(facts), None)
    known = {name: value for name, value in facts.items() if name not in OF_THE_WEIGHTS}
    return known | {"averaged": dict(averaged)} | ({"continues": list(runs.values())} if runs else {})


def _name_of_run(run: Mapping[str, Any]) -> str:
    """The same for every account of one run, whatever became of its weights."""
    return json.dumps({name: value for name, value in run.items() if name not in NOT_OF_THE_RUN}, sort_keys=True)


def _label(folder: Path) -> str:
    """A checkpoint's name and the beginning of its sha256; that of a run's pipeline is the run's."""
    from unirender.shipped import CHECKPOINTS, checkpoint_sha256
    from unirender.training.loop.card import OF_A_RUN

    own = folder.resolve()
    name = own.parent.name if own.name in OF_A_RUN else own.name
    shipped = " (shipped)" if own.parent == CHECKPOINTS.resolve() else ""
    return f"{name}{shipped} {checkpoint_sha256(folder)[:ID]}"


def _read(path: Path, folder: Path) -> "UniRenderPipeline":
    """A checkpoint, of whose calibration the user is told that it is not taken over.

    Raises:
        UnirenderError: it cannot be read.
    """
    from unirender.pipelines.unirender_pipeline import UniRenderPipeline

    pipeline = UniRenderPipeline.from_pretrained(folder)
    if pipeline.config["calibration"]:
        notice(f"{path}: its calibration is that of its own weights; run `unirender calibrate` on the average")
    return pipeline


def _fresh(model: Any, weights: "dict[str, Tensor]", dtype: "torch.dtype") -> Any:
    """A model of the same configuration with these weights; it does not know from which folder the first was read."""
    import torch

    own = type(model).from_config({name: value for name, value in model.config.items() if not name.startswith("_")})
    own.load_state_dict(weights)
    return torch.nn.Module.to(own.eval(), dtype)  # ModelMixin's own `to` warns for nothing


def _check_alike(first: "UniRenderPipeline", other: "UniRenderPipeline", first_name: Path, name: Path) -> None:
    """Looks whether two checkpoints have one network, one scheduler and one autoencoder.

    Raises:
        UnirenderError: they have not; the message names the first thing that differs.
    """
    for part in ("dual_stream", "scheduler"):
        one, two = (_settings(pipeline, part) for pipeline in (first, other))
        for entry in sorted(one.keys() | two.keys()):
            if not _same_setting(one.get(entry), two.get(entry)):
                got, expected = (reprlib.repr(settings.get(entry)) for settings in (two, one))
                raise UnirenderError(
                    f"{name}: {part}.{entry} is {got}, expected {expected}, that of {first_name}; only checkpoints of "
                    "one network can be averaged"
                )
    if not _equal(first.vae, other.vae):
        raise UnirenderError(
            f"{name}: its autoencoder is not that of {first_name}; only networks on the same latents can be averaged"
        )


def _settings(pipeline: "UniRenderPipeline", part: str) -> dict[str, Any]:
    """The configuration of a component, without what says nothing of the network."""
    settings = dict(getattr(pipeline, part).config)
    return {"class": type(getattr(pipeline, part)).__name__} | {
        name: list(value) if isinstance(value, tuple) else value
        for name, value in settings.items()
        if not name.startswith("_")
    }


def _same_setting(a: Any, b: Any) -> bool:
    """Whether two entries agree; numbers of a schedule to rounding, which differs between versions of PyTorch."""
    if isinstance(a, list) and isinstance(b, list) and len(a) == len(b):
        return all(_same_setting(x, y) for x, y in zip(a, b, strict=True))
    if isinstance(a, float) and isinstance(b, float):
        return math.isclose(a, b, rel_tol=ROUNDING)
    return a == b


def _equal(one: "nn.Module | None", two: "nn.Module | None") -> bool:
    """Whether two autoencoders are the same; None: there is none."""
    if one is None or two is None:
        return one is two
    a, b = one.state_dict(), two.state_dict()
    return a.keys() == b.keys() and all(value.equal(b[name]) for name, value in a.items())
