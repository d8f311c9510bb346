"""`unirender calibrate`: how sure a checkpoint is of materials, set right on objects that it never saw.

A network knows the objects that it was trained on too well, and is too sure of others: the roughness that it predicts
lies farther from the middle than the truth does on average. A line of least squares through new objects takes that
back, for roughness and metallic each:

    truth ~ k predicted + c,    clipped to [0, 1]

Only a line is kept that lowers the error on objects that it was not fitted to, by more than chance. It stands in the
configuration of the checkpoint's pipeline, whose weights stay as they are.
"""

import json
import shutil
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from unirender.errors import UnirenderError, UsageError

if TYPE_CHECKING:
    import numpy as np
    from jaxtyping import Float, Int

    from unirender.pipelines.unirender_pipeline import UniRenderPipeline
    from unirender.training.data import GroupDataset

NAMES = ("roughness", "metallic")
FOLDS = 5  # parts of the objects, each of which is scored with the line of the others
LEAST_OBJECTS = 2 * FOLDS
INDEX = "model_index.json"


@dataclass(frozen=True)
class Calibrate:
    """Fit how predicted roughness and metallic are read, on objects that the checkpoint was not trained on."""

    data: Path
    """Folder that `unirender dataset` wrote, of other objects than those of the training."""
    out: Path
    """Folder of the calibrated copy of the checkpoint; it must not exist."""
    checkpoint: Path | None = None
    """Folder of the checkpoint, or a shipped one by its name. None: `tiny`."""
    pictures: int = 3
    """Pictures of each object, drawn as in training: of any mixture of its lights, any of its materials."""
    seed: int = 0
    """Of what is drawn."""

    def run(self) -> int:
        """Returns the exit status."""
        if self.pictures < 1:
            raise UsageError(f"--pictures {self.pictures}: expected 1 or more")
        if self.out.exists():
            raise UnirenderError(f"{self.out}: exists, expected a new folder; choose another --out")
        lines = calibrate(self)
        print(f"{self.out}: {', '.join(lines) or 'nothing'} calibrated")
        return 0


@dataclass(frozen=True)
class Line:
    """truth ~ slope * predicted + offset.

    Attributes:
        slope: 1 where the network is as sure as it should be, less where it is too sure.
        offset: of the line.
        before: mean squared error of the predictions.
        after: the same of the lines' values, each at objects that its line was not fitted to.
        chance: half of the 95 % interval of the difference, over objects.
    """

    slope: float
    offset: float
    before: float
    after: float
    chance: float

    @property
    def better(self) -> bool:
        """Whether the line is worth having."""
        return self.before - self.after > self.chance


def calibrate(options: Calibrate) -> dict[str, Line]:
    """Fits the lines and writes the copy; returns those that it has got.

    Raises:
        UnirenderError: no such checkpoint or data, or too few objects.
    """
    from unirender.pipelines.unirender_pipeline import UniRenderPipeline
    from unirender.shipped import checkpoint_folder
    from unirender.training.data import GroupDataset
    from unirender.training.facts import dataset_facts

    checkpoint = checkpoint_folder(options.checkpoint)
    pipeline = UniRenderPipeline.from_pretrained(checkpoint, calibration=None)
    pipeline.set_progress_bar_config(disable=True)
    data = GroupDataset(options.data)
    if len(data.keys) < LEAST_OBJECTS:
        raise UnirenderError(f"{options.data}: got {len(data.keys)} objects, expected {LEAST_OBJECTS} or more")
    objects, found, truth = readings(pipeline, data, options.pictures, options.seed, _tell)
    kept: dict[str, Line] = {}
    for column, name in enumerate(NAMES):
        line = fit(objects, found[:, column], truth[:, column])
        errors = f"{line.before:.4f}, with lines of other objects {line.after:.4f} (± {line.chance:.4f})"
        print(
            f"{name}: {line.slope:.3f} x predicted + {line.offset:.3f}; mean squared error {errors}"
            f"{'' if line.better else ': left as it is'}"
        )
        if line.better:
            kept[name] = line
    about = {"data": dataset_facts(options.data, data), "pictures": options.pictures, "seed": options.seed}
    write_calibrated(checkpoint, options.out, kept, about)
    return kept


def readings(
    pipeline: "UniRenderPipeline",
    data: "GroupDataset",
    pictures: int,
    seed: int,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> 'tuple[Int[np.ndarray, " n"], Float[np.ndarray, "n 2"], Float[np.ndarray, "n 2"]]':
    """Number of the object, what is predicted, and the truth: means over the object, in the order of `NAMES`.

    Args:
        pipeline: without a calibration.
        data: new objects, at any size.
        pictures: of each object.
        seed: of what is drawn.
        progress: called with (pictures done, pictures in all).
    """
    import numpy as np

    from unirender.color import image_srgb, unpremultiply
    from unirender.pipelines.editing import masked_mean
    from unirender.training.augment import NO_AUGMENTATION, from_maps
    from unirender.training.presets import Augmentation

    drawn = Augmentation(permute=NO_AUGMENTATION.permute, turn=NO_AUGMENTATION.turn)
    total = pictures * len(data)
    objects, found, truth = [], [], []
    for index in range(total):
        image, maps = from_maps(data.sample(index, seed, drawn))
        mask = maps.require("mask")["mask"]
        seen = pipeline.decompose(image_srgb(unpremultiply(image, mask)), mask, closed=False)
        true = maps.require(*NAMES)
        objects.append(data.drawn(index, seed, drawn)[0])
        found.append([getattr(seen, name) for name in NAMES])
        truth.append([masked_mean(true[name], mask) for name in NAMES])
        progress(index + 1, total)
    return np.array(objects), np.array(found), np.array(truth)


def fit(objects: 'Int[np.ndarray, " n"]', found: 'Float[np.ndarray, " n"]', truth: 'Float[np.ndarray, " n"]') -> Line:
    """The line of least squares; its errors are those of lines that are fitted to four fifths of the objects."""
    import numpy as np

    part = objects % FOLDS
    after = np.zeros_like(found)
    for fold in range(FOLDS):
        slope, offset = _line(found[part != fold], truth[part != fold])
        after[part == fold] = np.clip(slope * found[part == fold] + offset, 0, 1)
    change = np.square(after - truth) - np.square(found - truth)
    count = np.bincount(objects)
    of_object = np.bincount(objects, change)[count > 0] / count[count > 0]
    chance = 1.96 * float(of_object.std()) / len(of_object) ** 0.5
    before, after = (float(np.square(value - truth).mean()) for value in (found, after))
    return Line(*_line(found, truth), before, after, chance)


def _line(found: 'Float[np.ndarray, " n"]', truth: 'Float[np.ndarray, " n"]') -> tuple[float, float]:
    """Slope, not below 0, and offset."""
    variance = float(found.var())
    slope = max(float(((found - found.mean()) * (truth - truth.mean())).mean()) / variance, 0.0) if variance else 0.0
    return slope, float(truth.mean() - slope * found.mean())


def write_calibrated(checkpoint: Path, out: Path, lines: Mapping[str, Line], about: Mapping[str, Any]) -> None:
    """A copy of a pipeline folder with these lines in its configuration, and in the account of its training, if it has
    one; it appears when it is complete.

    Args:
        checkpoint: to be copied.
        out: the copy.
        lines: by name; none: a calibration that it has is taken out.
        about: data, pictures and seed, for the account.
    """
    from unirender.training.checkpoint import replace_folder
    from unirender.training.export import TRAINING_FILE

    partial = out.with_name(f"{out.name}.partial")
    shutil.rmtree(partial, ignore_errors=True)
    shutil.copytree(checkpoint, partial)
    index = json.loads((partial / INDEX).read_text())
    rounded = {name: [round(line.slope, 4), round(line.offset, 4)] for name, line in lines.items()}
    index["calibration"] = rounded or None
    (partial / INDEX).write_text(json.dumps(index, indent=2, sort_keys=True) + "\n")
    if (partial / TRAINING_FILE).is_file():
        _write_account(partial, out.name, {"lines": {n: asdict(line) for n, line in lines.items()}, **about})
    replace_folder(out, partial)


def _write_account(folder: Path, name: str, calibration: Mapping[str, Any]) -> None:
    """Adds a calibration to `training.json`, and writes the model card anew."""
    from unirender.training.card import CARD_FILE, card_text
    from unirender.training.export import SCORES_FILE, TRAINING_FILE

    facts = json.loads((folder / TRAINING_FILE).read_text()) | {"calibration": calibration}
    if not calibration["lines"]:
        del facts["calibration"]
    chosen = folder / SCORES_FILE
    (folder / TRAINING_FILE).write_text(json.dumps(facts, indent=2) + "\n")
    card = card_text(name, facts, json.loads(chosen.read_text()) if chosen.is_file() else None)
    (folder / CARD_FILE).write_text(card, encoding="utf-8")


def _tell(done: int, total: int) -> None:
    if done % 100 == 0 or done == total:
        print(f"decomposed {done} of {total} pictures", flush=True)
