"""`unirender calibrate`: how sure a checkpoint is of materials, set right on objects that are new to it.

The lines (`unirender.training.after.calibration_line`) stand in the configuration of the checkpoint's pipeline, whose
weights stay as they are.
"""

import contextlib
import json
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from unirender.command_line.option_checks import at_least
from unirender.errors import UnirenderError
from unirender.system.notices import notice
from unirender.system.wording import counted

if TYPE_CHECKING:
    import numpy as np
    from jaxtyping import Float, Int

    from unirender.pipelines.unirender_pipeline import UniRenderPipeline
    from unirender.training.after.calibration_line import Line
    from unirender.training.data.dataset import GroupDataset

INDEX = "model_index.json"


@dataclass(frozen=True)
class Calibrate:
    """Fit how predicted roughness and metallic are read, on objects that the checkpoint was not trained on."""

    data: Path
    """Folder that `unirender dataset` wrote, of other objects than those of the training."""
    out: Path
    """New folder of the calibrated copy of the checkpoint; none is written where no line is worth having."""
    checkpoint: Path | None = None
    """Folder of the checkpoint, or a shipped one by its name. None: `tiny`."""
    pictures: int = 3
    """At most this many pictures of each group, each under a random mixture of its lights, with a random one of its
    materials."""
    seed: int = 0
    """Of what is drawn."""

    def check(self) -> None:
        """Looks at the values.

        Raises:
            UsageError: one is outside its range.
        """
        at_least(1, pictures=self.pictures)
        at_least(0, seed=self.seed)

    def run(self) -> int:
        """Returns the exit status."""
        self.check()
        if not self.data.is_dir():
            raise UnirenderError(f"{self.data}: no such data folder, expected one written by `unirender dataset`")
        if self.out.is_dir() and any(self.out.iterdir()):
            raise UnirenderError(f"{self.out}: exists and is not empty, expected a new folder; choose another --out")
        lines = calibrate(self)
        print(f"{self.out}: {', '.join(lines)} calibrated" if lines else "no line is worth having: nothing is written")
        return 0


def calibrate(options: Calibrate) -> "dict[str, Line]":
    """Fits the lines and writes the copy, if there are any worth having; returns these.

    Raises:
        UnirenderError: no such checkpoint, a broken account of its training, no data, too few objects or pictures that
            are smaller than the network's; or the copy cannot be written.
    """
    import diffusers

    from unirender.models.precision import resolve_device
    from unirender.new_folders import new_folder
    from unirender.pipelines.calibration import NAMES
    from unirender.pipelines.unirender_pipeline import UniRenderPipeline
    from unirender.shipped import checkpoint_folder
    from unirender.system.writing import writing
    from unirender.training.after.calibration_line import LEAST_OBJECTS, fit
    from unirender.training.data.dataset import GroupDataset
    from unirender.training.data.same_objects import objects_of
    from unirender.training.loop.export import read_history
    from unirender.training.loop.facts import dataset_facts

    diffusers.utils.logging.disable_progress_bar()  # of loading: small files
    checkpoint = checkpoint_folder(options.checkpoint)
    pipeline = UniRenderPipeline.from_pretrained(checkpoint, calibration=None).to(resolve_device("auto"))
    pipeline.set_progress_bar_config(disable=True)
    history = read_history(checkpoint)
    data = GroupDataset(options.data)
    if min(data.resolution) < pipeline.size:
        raise UnirenderError(
            f"{options.data}: got pictures of {data.resolution[1]} x {data.resolution[0]} pixels, expected at least "
            f"{pipeline.size}, the size of {checkpoint}; render larger ones"
        )
    if seen := _trained_on(data, history):
        raise UnirenderError(f"{options.data}: {checkpoint} was trained on {seen}, expected a folder of other objects")
    if not any("data" in facts for facts in history):
        notice(f"{checkpoint}: does not say what it was trained on; make sure that {options.data} has other objects")
    numbers, alike = objects_of(data)
    if alike:
        print(f"{len(alike)} pairs of groups look alike, such as {' and '.join(alike[0])}: each is of one object")
    if (count := len(set(numbers))) < LEAST_OBJECTS:
        raise UnirenderError(f"{options.data}: got {counted(count, 'object')}, expected {LEAST_OBJECTS} or more")
    with contextlib.suppress(_NothingKept), new_folder(options.out) as folder:
        groups, found, truth = readings(pipeline, data, options.pictures, options.seed, _tell)
        lines = {name: fit(numbers[groups], found[:, column], truth[:, column]) for column, name in enumerate(NAMES)}
        for name, line in lines.items():
            print(f"{name}: {line}")
        kept = {name: line for name, line in lines.items() if line.better}
        if not kept:
            raise _NothingKept
        about = {"data": dataset_facts(options.data, data), "pictures": options.pictures, "seed": options.seed}
        with writing(options.out, "free some space or choose another --out"):
            write_calibrated(checkpoint, folder, options.out.name, kept, about)
        return kept
    return {}


class _NothingKept(Exception):
    """No folder is to appear."""


def _trained_on(data: "GroupDataset", history: Sequence[Mapping[str, Any]]) -> str | None:
    """What of a data folder the runs behind a checkpoint were trained on, in words; None: nothing that is known of.

    Accounts of earlier versions know the folder as a whole alone.
    """
    from unirender.training.loop.facts import HASH_DIGITS

    known = [facts.get("data") or {} for facts in history]
    if data.fingerprint in {facts.get("fingerprint") for facts in known}:
        return "this folder"
    hashes = {part for facts in known for part in facts.get("shard_hashes", "").split()}
    seen = [shard.name for shard in data.shards if shard.sha256[:HASH_DIGITS] in hashes]
    return f"{len(seen)} of its {counted(len(data.shards), 'shard')}, such as {seen[0]}" if seen else None


def readings(
    pipeline: "UniRenderPipeline",
    data: "GroupDataset",
    pictures: int,
    seed: int,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> 'tuple[Int[np.ndarray, " n"], Float[np.ndarray, "n 2"], Float[np.ndarray, "n 2"]]':
    """Number of the group, what is predicted, and the truth: means over the object, in the order of `NAMES`.

    Args:
        pipeline: without a calibration.
        data: new objects.
        pictures: of each group, at most.
        seed: of what is drawn.
        progress: called with (groups done, groups in all).

    Raises:
        UnirenderError: a group's pictures cannot be used; the message names it.
    """
    import numpy as np

    from unirender.color import image_srgb, unpremultiply
    from unirender.pipelines.calibration import NAMES
    from unirender.pipelines.masked_maps import masked_mean
    from unirender.training.augmentations.augment import from_maps
    from unirender.training.config import Augmentation

    drawn = Augmentation(permute=0.0, turn=0.0)
    of_group: dict[int, list[int]] = {}
    for index in range(pictures * len(data)):
        own = of_group.setdefault(data.drawn(index, seed, drawn)[0], [])
        own += [index] * (len(own) < pictures)
    groups, found, truth = [], [], []
    for done, (group, indices) in enumerate(sorted(of_group.items()), start=1):
        try:
            scenes = [from_maps(data.sample(index, seed, drawn)) for index in indices]
            masks = [maps.require("mask")["mask"] for _, maps in scenes]
            seen = [image_srgb(unpremultiply(image, mask)) for (image, _), mask in zip(scenes, masks, strict=True)]
            answers = pipeline.decompose_batch(seen, masks, closed=False)
        except UnirenderError as error:
            raise UnirenderError(f"{data.folder}: group {data.keys[group]}: {error}") from error
        for (_, maps), mask, answer in zip(scenes, masks, answers, strict=True):
            true = maps.require(*NAMES)
            groups.append(group)
            found.append([getattr(answer, name) for name in NAMES])
            truth.append([masked_mean(true[name], mask) for name in NAMES])
        progress(done, len(of_group))
    return np.array(groups), np.array(found), np.array(truth)


def write_calibrated(
    checkpoint: Path, folder: Path, name: str, lines: "Mapping[str, Line]", about: Mapping[str, Any]
) -> None:
    """Copies a pipeline folder and adds the lines, to its configuration and to the account of its training, if there is
    one.

    Args:
        checkpoint: to be copied.
        folder: empty.
        name: of the copy, for its model card.
        lines: by name, instead of those that it has.
        about: data, pictures and seed, for the account.
    """
    from unirender.training.loop.card import CARD_FILE, card_text
    from unirender.training.loop.export import SCORES_FILE, TRAINING_FILE

    shutil.copytree(checkpoint, folder, dirs_exist_ok=True, copy_function=shutil.copyfile)
    index = json.loads((folder / INDEX).read_text())
    index["calibration"] = {key: [round(line.slope, 4), round(line.offset, 4)] for key, line in lines.items()}
    (folder / INDEX).write_text(json.dumps(index, indent=2, sort_keys=True) + "\n")
    if not (folder / TRAINING_FILE).is_file():
        return
    calibration = {"lines": {key: asdict(line) for key, line in lines.items()}, **about}
    facts = json.loads((folder / TRAINING_FILE).read_text()) | {"calibration": calibration}
    (folder / TRAINING_FILE).write_text(json.dumps(facts, indent=2) + "\n")
    chosen = folder / SCORES_FILE
    card = card_text(name, facts, json.loads(chosen.read_text()) if chosen.is_file() else None)
    (folder / CARD_FILE).write_text(card, encoding="utf-8")


def _tell(done: int, total: int) -> None:
    if done % 50 == 0 or done == total:
        print(f"decomposed pictures of {done} of {counted(total, 'group')}", flush=True)
