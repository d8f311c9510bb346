"""The factor of a loss whose gradient goes through float16, which has nothing below 6e-8 and nothing above 65,504.

It follows the rule of `torch.amp.GradScaler`: doubled after `PATIENCE` steps in a row, halved after a step whose
gradient was not finite. That step is left out. Here the gradient is the sum of many passes, over processes too, and the
factor is part of the state of the run.
"""

import torch

FIRST = 2.0**16
LEAST = 1.0  # a gradient that is not finite without a factor is none of its making
PATIENCE = 2000  # steps


class LossScale:
    """The factor of a run; 1 for ever where no gradient goes through float16.

    Attributes:
        value: the factor.
    """

    def __init__(self, dtype: torch.dtype = torch.float32) -> None:
        self.is_dynamic = dtype == torch.float16
        self.value = FIRST if self.is_dynamic else 1.0
        self._finite = 0  # steps since it changed

    def after_finite(self) -> None:
        """Raises the factor, if it is time for that."""
        self._finite += 1
        if self.is_dynamic and self._finite >= PATIENCE:
            self._set(2 * self.value)

    def after_overflow(self) -> bool:
        """Lowers the factor; whether that was possible."""
        if not self.is_dynamic or self.value <= LEAST:
            return False
        self._set(self.value / 2)
        return True

    def _set(self, value: float) -> None:
        self.value, self._finite = value, 0

    def state_dict(self) -> dict[str, float]:
        """{} where there is none to go on with."""
        return {"value": self.value, "finite": self._finite} if self.is_dynamic else {}

    def load_state_dict(self, state: dict[str, float]) -> None:
        """Goes on with the factor of a state, if it has one and this run needs one."""
        if self.is_dynamic and state:
            self.value, self._finite = float(state["value"]), int(state["finite"])
