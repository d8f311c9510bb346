"""How many bytes a training holds whatever its batch is: the weights and what is kept beside each of them."""

from dataclasses import dataclass

from torch import nn

from unirender.training.optim.muon import is_hidden_matrix


@dataclass(frozen=True)
class TrainingBytes:
    """Bytes of a training on each device, without activations and without an autoencoder.

    Pictures, validation and saves hold copies of the weights for a while, which are not counted.
    """

    weights: int
    gradients: int
    moments: int  # the optimiser's: AdamW's two, or Muon's one of the weights that it takes
    average: int  # of the weights

    @property
    def total(self) -> int:
        return self.weights + self.gradients + self.moments + self.average

    def __str__(self) -> str:
        return (
            f"{readable(self.total)} besides activations: weights {readable(self.weights)}, gradients "
            f"{readable(self.gradients)}, moments {readable(self.moments)}, averaged weights "
            f"{readable(self.average)}"
        )


def training_bytes(model: nn.Module, optimizer: str = "adamw") -> TrainingBytes:
    """Bytes of the training of a model's parameters, of which each is kept in its own precision; frozen ones have
    neither gradient nor moments.

    Args:
        model: the network.
        optimizer: `OptimizerConfig.kind`.
    """
    one_moment = optimizer == "muon"
    weights = gradients = moments = 0
    for name, p in model.named_parameters():
        weights += p.nbytes
        if p.requires_grad:
            gradients += p.nbytes
            moments += p.nbytes if one_moment and is_hidden_matrix(name, p) else 2 * p.nbytes
    return TrainingBytes(weights, gradients=gradients, moments=moments, average=weights)


def readable(number: int) -> str:
    """Bytes in GiB, or in MiB below one GiB."""
    return f"{number / 2**30:.1f} GiB" if number >= 2**30 else f"{number / 2**20:.1f} MiB"
