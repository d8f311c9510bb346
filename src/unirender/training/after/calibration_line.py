"""The line by which predicted roughness or metallic is read, fitted on new objects.

Of objects that it never saw a network says too extreme things, since it learned those of its training by heart: where
it says roughness 0.9 the truth averages lower, where it says 0.1 higher. The line of least squares through new objects
takes that back, for roughness and metallic each:

    truth ~ k predicted + c

Every object counts the same. Only a line is kept that lowers the error on objects that it was not fitted to, by more
than chance.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

FOLDS = 5  # parts of the objects, each of which is scored with the line of the others
LEAST_OBJECTS = 2 * FOLDS
LEAST_SPREAD = 0.01  # standard deviation of predictions: below it they are one number, and the line is level


@dataclass(frozen=True)
class Line:
    """truth ~ slope * predicted + offset.

    Attributes:
        slope: 1 where the network is as sure as it should be, less where it is too sure.
        offset: of the line.
        before: mean squared error of the predictions.
        after: the same of the lines' values, each at objects that its line was not fitted to.
        chance: half of the 95 % interval of the difference.
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

    def __str__(self) -> str:
        gain = f"lower by {self.before - self.after:.4f} ± {self.chance:.4f} with lines of other objects"
        kept = "" if self.better else ": not kept"
        return f"{self.slope:.3f} x predicted + {self.offset:.3f}; mean squared error {self.before:.4f}, {gain}{kept}"


def fit(objects: Int[np.ndarray, " n"], found: Float[np.ndarray, " n"], truth: Float[np.ndarray, " n"]) -> Line:
    """The line of least squares; its errors are those of lines that are fitted to four fifths of the objects.

    All objects weigh the same, however many pictures there are of them.
    """
    _, objects, count = np.unique(objects, return_inverse=True, return_counts=True)
    weight = 1 / count[objects]
    part = objects % FOLDS
    after = np.zeros_like(found)
    for fold in range(FOLDS):
        own = part == fold
        slope, offset = _line(found[~own], truth[~own], weight[~own])
        after[own] = np.clip(slope * found[own] + offset, 0, 1)
    errors = [np.bincount(objects, weight * np.square(value - truth)) for value in (found, after)]
    chance = 1.96 * float((errors[1] - errors[0]).std()) / len(count) ** 0.5
    return Line(*_line(found, truth, weight), float(errors[0].mean()), float(errors[1].mean()), chance)


def _line(
    found: Float[np.ndarray, " n"], truth: Float[np.ndarray, " n"], weight: Float[np.ndarray, " n"]
) -> tuple[float, float]:
    """Slope, not below 0, and offset."""
    x, y = (float(np.average(value, weights=weight)) for value in (found, truth))
    variance = float(np.average(np.square(found - x), weights=weight))
    covariance = float(np.average((found - x) * (truth - y), weights=weight))
    slope = max(covariance / variance, 0.0) if variance > LEAST_SPREAD**2 else 0.0
    return slope, y - slope * x
