"""How many bytes a training holds whatever its batch is: the weights and what is kept beside each of them."""

from dataclasses import dataclass

from torch import nn


@dataclass(frozen=True)
class TrainingBytes:
    """Bytes of a training on each device, without activations and without an autoencoder.

    Pictures, validation and saves hold copies of the weights for a while, which are not counted.
    """

    weights: int
    gradients: int
    moments: int  # AdamW's two
    average: int  # of the weights

    @property
    def total(self) -> int:
        return self.weights + self.gradients + self.moments + self.average

    def __str__(self) -> str:
        return (
            f"{readable(self.total)} besides activations: weights {readable(self.weights)}, gradients "
            f"{readable(self.gradients)}, AdamW's moments {readable(self.moments)}, averaged weights "
            f"{readable(self.average)}"
        )


def training_bytes(model: nn.Module) -> TrainingBytes:
    """Bytes of the training of all parameters of a model, of which each is kept in its own precision."""
    weights = sum(p.numel() * p.element_size() for p in model.parameters())
    return TrainingBytes(weights, gradients=weights, moments=2 * weights, average=weights)


def readable(number: int) -> str:
    """Bytes in GiB, or in MiB below one GiB."""
    return f"{number / 2**30:.1f} GiB" if number >= 2**30 else f"{number / 2**20:.1f} MiB"
