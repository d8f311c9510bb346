"""Exponential moving average of a model's weights; what is validated, drawn and shipped."""

import torch
from torch import Tensor, nn


class Ema:
    """Average of the parameters. The decay warms up with the number of updates n: min(decay, (1 + n) / (10 + n))."""

    def __init__(self, model: nn.Module, decay: float) -> None:
        self.decay = decay
        self.updates = 0
        self.average = {name: p.detach().clone() for name, p in model.named_parameters()}

    @torch.no_grad()
    def update(self, model: nn.Module) -> None:
        """Moves the average towards the model's weights."""
        decay = min(self.decay, (1 + self.updates) / (10 + self.updates))
        torch._foreach_lerp_(  # pyright: ignore[reportPrivateImportUsage] - torch.optim is built on it
            list(self.average.values()), list(model.parameters()), 1 - decay
        )
        self.updates += 1

    @torch.no_grad()
    def copy_to(self, model: nn.Module) -> None:
        """Writes the average into a model of the same shape."""
        for name, p in model.named_parameters():
            p.copy_(self.average[name])

    def state_dict(self) -> dict[str, int | dict[str, Tensor]]:
        return {"updates": self.updates, "average": self.average}

    def load_state_dict(self, state: dict) -> None:
        """Restores what `state_dict` gave.

        Raises:
            KeyError: the state is of another model.
        """
        self.updates = int(state["updates"])
        for name, value in self.average.items():
            value.copy_(state["average"][name])
