"""The paper's equations are named where they are computed, so that a reader finds each by its number."""

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
MODEL, TRUTH = ROOT / "src" / "unirender", ROOT / "reference" / "unirender_reference"
WRITTEN_OUT = re.compile(r" {4,}\S.*\(Eq\. (\d)\)")


@pytest.mark.parametrize(
    ("number", "path"),
    [
        ("Eq. 1", TRUTH / "shader.py"),  # the rendering equation, as it is sampled
        ("Eq. 1", MODEL / "composite.py"),  # and in closed form
        ("Eq. 2", MODEL / "training" / "losses" / "loss_function.py"),  # the regression
        ("Eq. 2", MODEL / "training" / "losses" / "terms.py"),  # of one stream
        ("Eq. 3", MODEL / "diffusion" / "timesteps.py"),  # which stream is clean, in training
        ("Eq. 3", MODEL / "diffusion" / "inference.py"),  # and in use
        ("Eq. 4", MODEL / "diffusion" / "timesteps.py"),  # the timestep of the other one
        ("Eq. 5", MODEL / "training" / "losses" / "loss_function.py"),  # the cycle
        ("Eq. 5", MODEL / "training" / "losses" / "consistency.py"),  # by itself
        ("Algorithm 1", MODEL / "diffusion" / "timesteps.py"),  # the supplement's timesteps
    ],
)
def test_an_equation_is_named_where_it_is_computed(number: str, path: Path) -> None:
    assert number in path.read_text()


@pytest.mark.parametrize(
    ("path", "numbers"),
    [
        ("composite.py", (1,)),
        ("light/surface_light.py", (1,)),
        ("diffusion/timesteps.py", (3, 4)),
        ("diffusion/inference.py", (3,)),
        ("training/losses/loss_function.py", (2, 5)),
        ("training/losses/terms.py", (2,)),
        ("training/losses/consistency.py", (5,)),
    ],
)
def test_an_equation_is_written_out_where_it_is_computed(path: str, numbers: tuple[int, ...]) -> None:
    """A line of its own in what the module says of itself, which ends with the equation's number."""
    said = (ast.get_docstring(ast.parse((MODEL / path).read_text())) or "").splitlines()
    assert [int(found[1]) for line in said if (found := WRITTEN_OUT.fullmatch(line))] == list(numbers)
