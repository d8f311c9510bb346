"""`python -m unirender.training.run --preset tiny --data DIR --out DIR --minutes 70`: train, or resume.

The command line's `unirender train` calls `train` here. Torch is imported only when training begins.
"""

from pathlib import Path
from typing import Any

from unirender.errors import UnirenderError
from unirender.paths import cache_dir
from unirender.training.presets import TrainConfig, get_preset


def train(
    preset: str = "tiny",
    data: Path | None = None,
    out: Path | None = None,
    minutes: float | None = None,
    steps: int | None = None,
    batch_size: int | None = None,
    device: str = "auto",
    dtype: str = "auto",
    seed: int = 0,
    parallel: int | None = None,
    refresh_minutes: float | None = None,
) -> Path:
    """Trains a preset; the same command again resumes.

    Args:
        preset: a row of `unirender.training.presets.PRESETS`.
        data: folder written by `unirender dataset`; default: `data/tiny-train` in the cache folder.
        out: folder of the run; default: `runs/PRESET` in the cache folder.
        minutes: length by the clock, over all resumes.
        steps: length in optimiser steps; the preset's where neither this nor minutes is given.
        batch_size: instead of the preset's.
        device: auto, cpu, cuda or mps.
        dtype: auto, float32 or bfloat16; weights stay fp32, this is the autocast format.
        seed: of the weights, the data order and the noise.
        parallel: parts of a batch that run side by side on a CPU, one thread each; default: PyTorch's thread count.
        refresh_minutes: look for new shards this often (a data folder that is still being written).

    Returns:
        The folder with the trained pipeline, `out/pipeline`.
    """
    import dataclasses

    config = dataclasses.replace(get_preset(preset), seed=seed)
    if batch_size is not None:
        config = dataclasses.replace(config, batch_size=batch_size)
    data = data or cache_dir() / "data" / "tiny-train"
    if not data.is_dir():
        raise UnirenderError(f"{data}: no such data folder, expected one written by `unirender dataset`; pass --data")
    out = out or cache_dir() / "runs" / preset
    return _train(config, data, out, minutes, steps, device, dtype, parallel, refresh_minutes)


def _train(
    config: TrainConfig,
    data: Path,
    out: Path,
    minutes: float | None,
    steps: int | None,
    device: str,
    dtype: str,
    parallel: int | None,
    refresh_minutes: float | None,
) -> Path:
    import torch

    from unirender.models.precision import resolve_device, resolve_dtype
    from unirender.training.groups import list_shards
    from unirender.training.source import ShardSource
    from unirender.training.trainer import RunConfig, Trainer

    where = resolve_device(device)
    parallel = parallel or (torch.get_num_threads() if where.type == "cpu" else 1)
    if parallel > 1:
        torch.set_num_threads(1)
    if steps is None and minutes is None:
        steps = config.steps
    run = RunConfig(out, steps, minutes, refresh_minutes=refresh_minutes, parallel=parallel)
    list_shards(data)  # says what is wrong with the data before anything is built or written
    trainer = Trainer(config, run, where, resolve_dtype(dtype, where))
    source = ShardSource(data, config.batch_size, config.seed)
    parameters = sum(p.numel() for p in trainer.model.parameters()) / 1e6
    print(f"{out}: {parameters:.2f} M parameters, {where}, {trainer.dtype}, {parallel} passes side by side", flush=True)
    trainer.fit(source, _report)
    source.close()

    from unirender.training.export import export_pipeline

    return export_pipeline(trainer, out / "pipeline")


def _report(line: dict[str, Any]) -> None:
    words = [f"{name} {value:.4g}" if isinstance(value, float) else f"{name} {value}" for name, value in line.items()]
    print("  ".join(words), flush=True)


if __name__ == "__main__":
    import sys

    import tyro

    try:
        tyro.cli(train)
    except UnirenderError as error:
        print(f"unirender train: {error}", file=sys.stderr)
        sys.exit(1)
