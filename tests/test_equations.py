"""The paper's equations are named where they are computed, so that a reader finds each by its number."""

from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
MODEL, TRUTH = ROOT / "src" / "unirender", ROOT / "reference" / "unirender_reference"


@pytest.mark.parametrize(
    ("number", "path"),
    [
        ("Eq. 1", TRUTH / "shader.py"),  # the rendering equation, as it is sampled
        ("Eq. 1", MODEL / "composite.py"),  # and in closed form
        ("Eq. 2", MODEL / "training" / "losses" / "terms.py"),  # the regression
        ("Eq. 3", MODEL / "diffusion" / "timesteps.py"),  # which stream is clean, in training
        ("Eq. 3", MODEL / "diffusion" / "inference.py"),  # and in use
        ("Eq. 4", MODEL / "diffusion" / "timesteps.py"),  # the timestep of the other one
        ("Eq. 5", MODEL / "training" / "losses" / "consistency.py"),  # the cycle
        ("Algorithm 1", MODEL / "diffusion" / "timesteps.py"),  # the supplement's timesteps
    ],
)
def test_an_equation_is_named_where_it_is_computed(number: str, path: Path) -> None:
    assert number in path.read_text()
