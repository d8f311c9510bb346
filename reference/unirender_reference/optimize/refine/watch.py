"""Early stopping: the best state of a refinement by its fit to held-out views."""

from dataclasses import dataclass

from unirender_reference.optimize.solution import Solution

GAIN_DB = 0.02  # less is no gain: the figure is of a picture with few samples
FIGURE = "held_out_psnr"


@dataclass
class Watch:
    """What held-out views say so far.

    Attributes:
        patience: looks without gain after which it is enough; 0: never.
        best_db: the best fit, or None before the first look.
        best_iteration: where it was.
        stale: looks since then.
        best: the solution there.
    """

    patience: int
    best_db: float | None = None
    best_iteration: int = 0
    stale: int = 0
    best: Solution | None = None

    @property
    def enough(self) -> bool:
        """Whether to stop."""
        return bool(self.patience) and self.stale >= self.patience

    def look(self, iteration: int, fit_db: float) -> bool:
        """Counts a look; returns whether this state is the best so far (and then expects it in `best`)."""
        if self.best_db is None or fit_db > self.best_db + GAIN_DB:
            self.best_db, self.best_iteration, self.stale = fit_db, iteration, 0
            return True
        self.stale += 1
        return False
