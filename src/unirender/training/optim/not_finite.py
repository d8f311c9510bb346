"""Why the gradient of a batch is not finite, as far as it can be told."""

from collections.abc import Sequence

from unirender.models.packing import Maps
from unirender.training.optim.processes import Processes

MOST_NAMED = 5  # maps and groups of a batch in a message


def wrong_data(batch: Maps, keys: Sequence[str] | None, processes: Processes) -> str | None:
    """What of a batch is not finite, and what to do; None where all of it is finite.

    Args:
        batch: this process's rows.
        keys: the group of each; None: nobody knows.
        processes: all ask.
    """
    rows = {name: (~value.isfinite().flatten(1).all(dim=1)).nonzero().flatten() for name, value in batch.items()}
    own = [f"{name} of {keys[row] if keys else f'sample {row}'}" for name, of in rows.items() for row in of.tolist()]
    wrong = [each for one in processes.gather(own) for each in one]
    if not wrong:
        return None
    named = ", ".join(wrong[:MOST_NAMED])
    return f"the data have values that are not finite ({named}); mend these groups, or leave them out"


def too_large(saved: bool) -> str:
    """What to do where the data are finite, so that the steps are too large; `saved`: the run has a state."""
    if saved:
        return "begin anew with a lower --learning-rate and another --out: that of a saved run is fixed"
    return "lower the learning rate (--learning-rate)"
