"""A network asked in both directions with the noise of one seed, and a source that gives one batch again and again."""

from collections.abc import Iterable

import torch
from tiny_models import TRAIN, make_batch
from torch import Tensor, nn

from unirender.diffusion.inference import infer_attributes, infer_image
from unirender.diffusion.schedule import make_scheduler
from unirender.models.conditioning import Conditioning
from unirender.models.dual_stream import DualStreamModel
from unirender.models.packing import TRIPLETS
from unirender.training.data import Batch


def decompose(parts: tuple[DualStreamModel, Conditioning], maps: dict[str, Tensor], steps: int = 1) -> Tensor:
    """The albedo that is found in the image."""
    seed = torch.Generator().manual_seed(0)
    return infer_attributes(*parts, make_scheduler(), maps["image"], maps["mask"], steps=steps, generator=seed)[
        "albedo"
    ]


def render(parts: tuple[DualStreamModel, Conditioning], maps: dict[str, Tensor]) -> Tensor:
    """The image of all maps."""
    given = torch.ones(len(maps["mask"]), len(TRIPLETS), dtype=torch.bool)
    return infer_image(*parts, make_scheduler(), maps, given, generator=torch.Generator().manual_seed(0))


def assert_each_counts(parts: tuple[DualStreamModel, Conditioning], modules: Iterable[nn.Module]) -> None:
    """Without the weights of any of the modules another albedo is found."""
    maps = make_batch(2)
    before = decompose(parts, maps)
    for module in modules:
        kept = {name: value.clone() for name, value in module.state_dict().items()}
        for parameter in module.parameters():
            nn.init.zeros_(parameter)
        assert (decompose(parts, maps) - before).abs().max() > 1e-4
        module.load_state_dict(kept)
    assert torch.equal(decompose(parts, maps), before)


class OneBatch:
    """The same batch of `TRAIN`'s size again and again."""

    def next(self) -> Batch:
        return make_batch(TRAIN.batch_size)

    def read_ahead(self) -> None: ...

    def state_dict(self) -> dict:
        return {}

    def load_state_dict(self, state: dict) -> None: ...

    def refresh(self) -> None: ...
