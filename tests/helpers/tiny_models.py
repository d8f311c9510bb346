"""Very small dual-stream models and batches, for tests of the model, the losses, the trainer and the pipeline."""

import dataclasses
from typing import Any

import pytest
import torch
from torch import Tensor

from unirender.diffusion.schedule import make_scheduler
from unirender.models.build import build_model
from unirender.models.conditioning import Conditioning
from unirender.models.config import ModelConfig
from unirender.models.dual_stream import DualStreamModel
from unirender.pipelines.unirender_pipeline import UniRenderPipeline
from unirender.training.config import LossConfig, OptimizerConfig, TrainConfig

SIZE = 32

MODEL = ModelConfig(
    resolution=SIZE,
    patch=2,
    block_out_channels=(16, 32),
    attention_levels=(1,),
    attention_head_dim=16,
    cross_attention_dim=8,
    norm_num_groups=8,
    physics_prior="split_sum",
)
TRAIN = TrainConfig(
    model=MODEL,
    loss=LossConfig(cycle_warmup=0.0, cycle_share=0.5, cycle_into_renderer=False),
    optimizer=OptimizerConfig(learning_rate=2e-3, warmup_steps=2),
    batch_size=4,
    map_dropout=0.1,
)


def make_model(seed: int = 0, **changes: Any) -> tuple[DualStreamModel, Conditioning]:
    """A model with everything at random, the zero convolutions too: no path is silent."""
    torch.manual_seed(seed)
    model, conditioning = build_model(dataclasses.replace(MODEL, **changes))
    with torch.no_grad():
        for p in model.parameters():
            if not p.any():
                p.normal_(0, 0.05)
    return model.eval(), conditioning


def make_batch(batch: int = 4, seed: int = 0, size: int = SIZE) -> dict[str, Tensor]:
    """Smooth random maps with the reader's keys; the image is their composite."""
    generator = torch.Generator().manual_seed(seed)

    def smooth(channels: int, high: float = 1.0) -> Tensor:
        coarse = torch.rand(batch, channels, 4, 4, generator=generator) * high
        return torch.nn.functional.interpolate(coarse, size=(size, size), mode="bilinear")

    mask = torch.zeros(batch, 1, size, size)
    mask[..., 4:-4, 4:-4] = 1
    normal = torch.nn.functional.normalize(torch.cat([smooth(2) - 0.5, smooth(1) + 0.5], dim=1), dim=1)
    maps = {"albedo": smooth(3), "specular": smooth(3, 2.0), "diffuse": smooth(3), "normal": normal}
    maps = {name: value * mask for name, value in maps.items()}
    for name in ("roughness", "metallic"):
        maps[name] = torch.rand(batch, 1, 1, 1, generator=generator) * mask
    maps["environment"] = torch.rand(batch, 3, 16, 32, generator=generator) * 3
    maps["mask"] = mask
    dielectric = (1 - maps["metallic"]) * maps["albedo"] * maps["diffuse"]
    f0 = 0.04 * (1 - maps["metallic"]) + maps["albedo"] * maps["metallic"]
    return maps | {"image": (dielectric + f0 * maps["specular"]) * mask}


def make_pipeline(seed: int = 0, **changes: object) -> UniRenderPipeline:
    """A pipeline with an untrained model and a silent progress bar."""
    model, _ = make_model(seed, **changes)
    pipeline = UniRenderPipeline(dual_stream=model, scheduler=make_scheduler())
    pipeline.set_progress_bar_config(disable=True)
    return pipeline


def counted_rows(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """How many rows each pass of a network has from now on."""
    rows: list[int] = []
    forward = DualStreamModel.forward

    def counted(self: DualStreamModel, attributes: Any, *args: Any, **kwargs: Any) -> Any:
        rows.append(len(attributes))
        return forward(self, attributes, *args, **kwargs)

    monkeypatch.setattr(DualStreamModel, "forward", counted)
    return rows
