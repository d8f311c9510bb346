"""Overfitting one object under one light: how long until the plain model reproduces it in both directions.

A batch holds one stored pair of the shards many times, each time with noise of its own; no augmentation. The real
`Trainer` trains the preset without physics prior from random weights by the clock, and scores its averaged weights as
it goes, with the clock stopped. Mode `mean`, one step:

    render      the image of the true maps (s and d among them): PSNR of display values, masked
    inverse     the maps of the image, not closed, as the network's pictures (`Packing.pack`: display values, tone
                curves, normals), scaled to [0, 1]: PSNR of the mean squared error over the six, image-aligned ones
                masked, the light over all its texels; material is metallic and roughness. Albedo stands beside it.
"""

import dataclasses
import tempfile
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from unirender.color import image_srgb, unpremultiply
from unirender.intrinsics import Intrinsics
from unirender.score import Score
from unirender.training.config import OptimizerConfig, TrainConfig
from unirender.training.presets import get_preset
from unirender_evaluation.metrics import DEFAULT_VARIANT, metric_key, psnr_from_mse
from unirender_evaluation.scoring import score_image
from unirender_evaluation.studies.speed.timing import Part
from unirender_evaluation.tables.formats import format_number
from unirender_evaluation.tables.text import TextTable

AIM_DB = 35.0
PRESET = "tiny_plain"
BATCH = 8
LEARNING_RATE, FINAL_LR, WARMUP_STEPS = 2e-3, 0.01, 20  # the final one: of the first
EMA_DECAY = 0.98
LOOKS = 12  # measures over the run, besides those at its start and end
DIRECTIONS = {"render": "render", "inverse": "inverse, six pictures", "albedo": "inverse, albedo"}

Maps = dict[str, Any]  # name -> tensor [b c h w]


@dataclass(frozen=True)
class Point:
    """One measure: minutes of training, samples seen, PSNR in dB of each of `DIRECTIONS`."""

    minutes: float
    samples: int
    psnr: dict[str, float]


def overfit_config(config: TrainConfig | None = None) -> TrainConfig:
    """The configuration of the run; None: that of `PRESET`, whose network and loss stay as they are."""
    config = config or get_preset(PRESET)
    optimizer = OptimizerConfig(
        learning_rate=LEARNING_RATE, warmup_steps=WARMUP_STEPS, final_lr=FINAL_LR, ema_decay=EMA_DECAY
    )
    return dataclasses.replace(config, optimizer=optimizer, batch_size=BATCH, map_dropout=0.0)


class FixedSource:
    """The same batch for ever."""

    def __init__(self, batch: Maps) -> None:
        self.batch = batch

    def next(self) -> Maps:
        return self.batch

    def read_ahead(self) -> None:
        """There is nothing to read."""

    def state_dict(self) -> dict[str, Any]:
        return {}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """It has no place to return to."""

    def refresh(self) -> None:
        """It never changes."""


def one_pair(data: Path, size: int) -> Maps:
    """The first pair of the shards as a batch of one, not augmented."""
    from unirender.training.augmentations.augment import NO_AUGMENTATION
    from unirender.training.data.dataset import make_batch
    from unirender.training.data.source import ShardSource

    source = ShardSource(data, 1, 0, size=size)
    batch = make_batch(source.open(), 0, 1, 0, NO_AUGMENTATION)
    source.close()
    return batch


def as_intrinsics(pair: Maps) -> tuple[Intrinsics, np.ndarray]:
    """The maps of a batch of one, and its premultiplied linear image [h w 3]."""
    arrays = {name: np.moveaxis(value[0].float().cpu().numpy(), 0, -1) for name, value in pair.items()}
    image = arrays.pop("image")
    return Intrinsics(**arrays), image


def both_directions(pipeline: Any, pair: Maps) -> dict[str, float]:
    """PSNR in dB of each of `DIRECTIONS` (see the module)."""
    truth, image = as_intrinsics(pair)
    mask = truth.require("mask")["mask"]
    rendered = pipeline.render(truth)
    values = score_image(rendered, image, mask, quantity="render")
    seen = image_srgb(unpremultiply(image, mask))
    found = pipeline.decompose(seen, mask, camera=truth.camera, closed=False, material="map").intrinsics
    errors = picture_errors(pipeline.conditioning.packing, found, truth)
    return {
        "render": values[metric_key("render", "psnr", DEFAULT_VARIANT)],
        "inverse": psnr_from_mse(float(np.mean(list(errors.values())))),
        "albedo": psnr_from_mse(errors["albedo"]),
    }


def picture_errors(packing: Any, found: Intrinsics, truth: Intrinsics) -> dict[str, float]:
    """Mean squared error of each of the network's six pictures, scaled to [0, 1]."""
    import torch

    from unirender.models.packing import TRIPLETS

    def packed(maps: Intrinsics) -> np.ndarray:
        tensors = {name: torch.from_numpy(np.moveaxis(value, -1, 0)[None].copy()) for name, value in maps.maps.items()}
        return packing.pack(tensors)[0].double().numpy()

    weight = truth.require("mask")["mask"][..., 0].astype(np.float64)
    squared = np.square((packed(found) - packed(truth)) / 2).reshape(len(TRIPLETS), 3, *weight.shape)
    errors = {}
    for name, error in zip(TRIPLETS, squared, strict=True):
        channels = error[:2] if name == "material" else error  # the third is the mask, which is given
        if name == "environment":
            errors[name] = float(channels.mean())
        else:
            errors[name] = float((channels.mean(axis=0) * weight).sum() / weight.sum())
    return errors


def overfit(pair: Maps, config: TrainConfig, minutes: float, device: Any, dtype: Any) -> list[Point]:
    """Trains on one pair for so many minutes; a point for every measure, the first before the first step."""
    from unirender.training.config import RunConfig
    from unirender.training.loop.trainer import Trainer
    from unirender.training.optim.passes import side_by_side

    batch = {name: value.expand(config.batch_size, -1, -1, -1) for name, value in pair.items()}
    points: list[Point] = []
    with tempfile.TemporaryDirectory(prefix="unirender-overfit-") as name, side_by_side(device) as parallel:
        run = RunConfig(
            Path(name), minutes=minutes, picture_minutes=minutes / LOOKS, save_minutes=2 * minutes, parallel=parallel
        )
        trainer = Trainer(config, run, device, dtype)

        def look(pipeline: Any) -> dict[str, Score]:
            found = both_directions(pipeline, pair)
            points.append(Point(trainer.seconds / 60, trainer.step * config.batch_size, found))
            return {name: Score(value, higher_is_better=True) for name, value in found.items()}

        trainer.fit(FixedSource(batch), validate=look)
    return points


def reached(points: list[Point], direction: str) -> float | None:
    """Minutes at the first measure of at least `AIM_DB`; None: never."""
    return next((point.minutes for point in points if point.psnr[direction] >= AIM_DB), None)


def overfit_part(data: Path, minutes: float, device: Any, dtype: Any) -> Part:
    """The part `overfit`."""
    config = overfit_config()
    points = overfit(one_pair(data, config.model.resolution), config, minutes, device, dtype)
    content = {
        "preset": PRESET,
        "config": asdict(config),
        "device": str(device),
        "dtype": str(dtype).removeprefix("torch."),
        "minutes_to_aim": {name: reached(points, name) for name in DIRECTIONS},
        "points": [asdict(point) for point in points],
    }
    return Part("overfit", (overfit_table(points, minutes),), content)


def overfit_table(points: list[Point], minutes: float) -> TextTable:
    """A measure a row."""
    rows = tuple(
        (f"{p.minutes:.2f}", str(p.samples), *(format_number(p.psnr[name], 2) for name in DIRECTIONS)) for p in points
    )
    notes = [
        f"One pair of the shards, preset {PRESET} (no physics prior) from random weights, batch {BATCH} of the same "
        f"pair, AdamW, learning rate {LEARNING_RATE:g} with a cosine to {FINAL_LR:g} of it over {minutes:g} minutes, "
        f"average {EMA_DECAY:g}, no dropped maps. PSNR in dB of the averaged weights, one step, masked. Inverse: the "
        "network's pictures of the maps in [0, 1], their squared errors averaged; the light over all texels."
    ]
    for name, label in DIRECTIONS.items():
        minute = reached(points, name)
        when = "not reached" if minute is None else f"after {minute:.2f} minutes"
        notes.append(f"Aim: {label} >= {AIM_DB:g} dB within {minutes:g} minutes: {when}.")
    titles = ("minutes", "samples", *(f"{label} (dB)" for label in DIRECTIONS.values()))
    return TextTable("Overfitting one object under one light", titles, (rows,), tuple(notes))
