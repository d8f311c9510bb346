"""How the network is asked: the mode, and what follows from it."""

from dataclasses import dataclass

import torch

from unirender.diffusion.sampling import NUM_SAMPLES, steps_of
from unirender.errors import UnirenderError


@dataclass(frozen=True)
class Sampling:
    """Steps, samples and noise of one call.

    Attributes:
        steps: of the scheduler; 1 in mode `mean`.
        count: samples.
        generator: of the noise, on the CPU; None: torch's global state.
    """

    steps: int
    count: int
    generator: torch.Generator | None

    @classmethod
    def of(
        cls,
        mode: str = "mean",
        num_inference_steps: int | None = None,
        num_samples: int | None = None,
        generator: torch.Generator | None = None,
    ) -> "Sampling":
        """Resolves the arguments of a call: an expectation depends on no draw, so mode `mean` has a fixed noise.

        Raises:
            UnirenderError: an unknown mode, or numbers that do not go with it.
        """
        steps, count = steps_of(mode, num_inference_steps), _sample_count(mode, num_samples)
        return cls(steps, count, generator or (torch.Generator().manual_seed(0) if mode == "mean" else None))

    def draw_seed(self) -> int:
        """A seed from the generator's state, which moves on."""
        device = self.generator.device if self.generator is not None else "cpu"
        return int(torch.randint(0, 2**62, (), generator=self.generator, device=device))


def _sample_count(mode: str, num_samples: int | None) -> int:
    if num_samples is not None and num_samples < 1:
        raise UnirenderError(f"num_samples: got {num_samples}, expected at least 1")
    if mode == "mean" and num_samples not in (None, 1):
        raise UnirenderError(f"mode mean gives 1 sample, got num_samples {num_samples}; use mode 'sample'")
    return 1 if mode == "mean" else num_samples or NUM_SAMPLES
