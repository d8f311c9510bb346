"""Training throughput against the bare passes of the same network, side by side in one process.

    trained   what `unirender train` does for every step: the next batch of the reader (shards, augmentation), and
              `Trainer.train_step` (encoding, noise, passes, losses with the cycle, gradient norm, optimiser, average).
              Not in it: log, pictures, validation, saves.
    bare      the same passes over as many rows on random tensors: `bare`

Blocks of steps of both take turns. The cycle is on from the first step, as it is in most of a real run.
"""

import dataclasses
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from unirender.training.config import TrainConfig
from unirender_evaluation.studies.speed.timing import Part, aim_text, medians
from unirender_evaluation.tables.text import TextTable

AIM = 0.85
SETTLING = 3  # steps at the start of a block that do not count: batches that the reader made during the other's block
NEVER = 10**9  # steps: the run has no end, its learning rate does not decay


def throughput(
    data: Path, config: TrainConfig, device: Any, dtype: Any, steps: int, turns: int
) -> tuple[list[dict[str, float]], int]:
    """Samples/s, a dict a turn with `trained`, `bare` and their `ratio`; and how many parts ran side by side."""
    from unirender.training.config import RunConfig
    from unirender.training.data.source import ShardSource
    from unirender.training.loop.export import averaged_pipeline
    from unirender.training.loop.trainer import Trainer
    from unirender.training.optim.passes import side_by_side
    from unirender_evaluation.studies.speed.bare import BarePasses

    config = dataclasses.replace(config, loss=dataclasses.replace(config.loss, cycle_warmup=0.0))
    source = ShardSource(
        data, config.batch_size, config.seed, augmentation=config.augmentation, size=config.model.resolution
    )
    source.open()
    found = []
    with tempfile.TemporaryDirectory(prefix="unirender-speed-") as name, side_by_side(device) as parallel:
        trainer = Trainer(config, RunConfig(Path(name), steps=NEVER, parallel=parallel), device, dtype)
        conditioning = averaged_pipeline(trainer).conditioning
        bare = BarePasses(trainer.model, conditioning, config, parallel, dtype)

        def block(action: Callable[[], Any]) -> float:
            for _ in range(SETTLING):
                action()
            synchronise(device)
            start = time.perf_counter()
            for _ in range(steps):
                action()
            synchronise(device)
            return steps * config.batch_size / (time.perf_counter() - start)

        try:
            for _ in range(turns):
                row = {
                    "trained": block(lambda: trainer.train_step(source.next(), source.read_ahead)),
                    "bare": block(bare),
                }
                found.append(row | {"ratio": row["trained"] / row["bare"]})
        finally:
            bare.close()
            source.close()
    return found, parallel


def synchronise(device: Any) -> None:
    """Waits until the device has done what it was told."""
    import torch

    if device.type == "cuda":
        torch.cuda.synchronize(device)


def training_part(
    data: Path, preset: str, config: TrainConfig, device: Any, dtype: Any, steps: int, turns: int
) -> Part:
    """The part `training`."""
    rows, parallel = throughput(data, config, device, dtype, steps, turns)
    middle, ratios = medians(rows), [row["ratio"] for row in rows]
    about = {
        "preset": preset,
        "batch": config.batch_size,
        "size": config.model.resolution,
        "dtype": str(dtype).removeprefix("torch."),
        "device": str(device),
        "parallel": parallel,
        "least": min(ratios),
        "largest": max(ratios),
    }
    table = training_table(middle, about, steps, turns)
    return Part("training", (table,), {**about, "median": middle, "turns": rows})


def training_table(middle: dict[str, float], about: dict[str, Any], steps: int, turns: int) -> TextTable:
    """Both in samples/s, and their ratio."""
    rows = (
        ("training (reader and train_step)", f"{middle['trained']:.1f}"),
        ("bare forward and backward", f"{middle['bare']:.1f}"),
        ("ratio", f"{middle['ratio']:.2f}"),
    )
    notes = (
        "{preset}, {size} px, batch {batch}, {device}, {dtype}, {parallel} parts side by side".format(**about)
        + f"; medians of {turns} turns of {steps} steps each, the first {SETTLING} of a block not counted. Training: "
        "next batch from the shards (augmentation included), encoding, passes, losses with the cycle, optimiser, "
        "average. Bare: the same passes over as many rows on random tensors, the cycle's among them; no reader, "
        "encoding, optimiser or average. The turns' ratios lie between {least:.2f} and {largest:.2f}.".format(**about),
        aim_text("training / bare", middle["ratio"], ">=", AIM),
    )
    return TextTable("Training throughput", ("samples/s", "median"), (rows,), notes)
