"""Losses that count a large residual for less than its square."""

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float

TAIL = 2.0  # of Cauchy's loss: residuals in units of the scale, where its weight is half
TO_SIGMA = 0.6745  # median of |x| for a normal x of standard deviation 1


@runtime_checkable
class Loss(Protocol):
    """Of sizes of residuals, which are not negative: the cost, and what a squared residual counts so that its
    derivative is the loss's."""

    def cost(self, size: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]: ...

    def weight(self, size: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]: ...


@dataclass(frozen=True)
class Huber:
    """Squares of small residuals, and beyond `knee` as much as their size (convex: it finds its way from afar)."""

    knee: float = 4.0

    def cost(self, size: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
        return np.where(size > self.knee, 2 * self.knee * size - self.knee**2, size**2)

    def weight(self, size: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
        return self.knee / np.maximum(size, self.knee)


HUBER = Huber()


@dataclass(frozen=True)
class Cauchy:
    """Squares of residuals in units of `scale`, far out their logarithm: what cannot be explained decides little."""

    scale: float

    def cost(self, size: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
        return TAIL**2 * np.log1p((size / (TAIL * self.scale)) ** 2)

    def weight(self, size: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
        return 1 / self.scale**2 / (1 + (size / (TAIL * self.scale)) ** 2)


def cauchy(size: Float[np.ndarray, "*n"], least: float) -> Cauchy:
    """Cauchy's loss at the residuals' own scale, by their median; at least `least`."""
    return Cauchy(max(float(np.median(size)) / TO_SIGMA, least) if size.size else least)
