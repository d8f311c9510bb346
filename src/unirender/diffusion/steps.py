"""How many steps a prediction takes: two named modes. Torch-free, as the command line needs it.

`mean` is one step from T: with zero terminal SNR and x0-prediction the network's output there is E[x0 | condition], the
best PSNR and no spread. `sample` is the paper's: several steps, several samples; standard deviations come from it only.
"""

from numbers import Integral

from unirender.errors import UnirenderError

SAMPLE_STEPS = 20  # the paper's
NUM_SAMPLES = 5
MOST_STEPS = 500  # of 1000 timesteps; from 667 on a step would start at timestep 0, where nothing is left to do


def steps_of(mode: str, num_inference_steps: int | None) -> int:
    """Number of steps of a mode: always 1 for `mean`; for `sample` as asked, or the paper's 20.

    Raises:
        UnirenderError: unknown mode, a number of steps outside [1, 500], or several steps in mode `mean`.
    """
    if mode not in ("mean", "sample"):
        raise UnirenderError(f"mode: got {mode!r}, expected 'mean' (one step, E[x0 | condition]) or 'sample'")
    if num_inference_steps is not None and (
        not is_whole(num_inference_steps) or not 1 <= num_inference_steps <= MOST_STEPS
    ):
        raise UnirenderError(f"num_inference_steps: got {num_inference_steps!r}, expected 1 to {MOST_STEPS}")
    if mode == "mean":
        if num_inference_steps not in (None, 1):
            raise UnirenderError(f"mode mean takes 1 step, got num_inference_steps {num_inference_steps}; use 'sample'")
        return 1
    return SAMPLE_STEPS if num_inference_steps is None else int(num_inference_steps)


def is_whole(value: object) -> bool:
    """Whether it is a whole number, Python's or NumPy's; True and False are none."""
    return isinstance(value, Integral) and not isinstance(value, bool)
