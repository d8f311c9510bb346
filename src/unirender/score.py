"""A score: a number that knows which direction is better."""

import math
from dataclasses import dataclass


@dataclass(frozen=True)
class Score:
    """One number of a validation.

    Attributes:
        value: in the metric's own unit.
        higher_is_better: its direction.
    """

    value: float
    higher_is_better: bool

    def better_than(self, other: "Score") -> bool:
        """Whether this is strictly better; any number is better than a NaN.

        Raises:
            ValueError: the two have different directions, so they are no scores of one metric.
        """
        if self.higher_is_better != other.higher_is_better:
            raise ValueError(f"scores of different directions: {self} and {other}")
        if math.isnan(other.value):
            return not math.isnan(self.value)
        return self.value > other.value if self.higher_is_better else self.value < other.value
