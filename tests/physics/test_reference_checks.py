"""Every independent check passes on the reference as it is and fails on its twin, broken on purpose."""

from typing import Any

import pytest

from unirender_reference.backend import mitsuba
from unirender_reference.checks.perturbations import PERTURBATIONS, perturbed
from unirender_reference.checks.registry import CHECKS, TWIN, run_check

EQUAL_SEEDS = {"exposure"}  # compares two renders of the same samples


@pytest.fixture
def seeds(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """The seed of every `mi.render` from now on."""
    mi, seen = mitsuba(), []
    original = mi.render

    def render(*arguments: Any, **options: Any) -> Any:
        seen.append(options["seed"])
        return original(*arguments, **options)

    monkeypatch.setattr(mi, "render", render)
    return seen


@pytest.mark.long
@pytest.mark.parametrize("name", CHECKS)
def test_check_passes_and_its_twin_fails(name: str, seeds: list[int]) -> None:
    """No two renders of a check share a seed: their noise would be the same, and counted twice."""
    outcome = run_check(name)
    assert outcome.passed, outcome
    assert (len(set(seeds)) < len(seeds)) == (name in EQUAL_SEEDS)
    with perturbed(TWIN[name]):
        twin = run_check(name)
    assert not twin.passed, twin


def test_every_check_has_a_twin_and_every_perturbation_is_one() -> None:
    assert set(TWIN) == set(CHECKS)
    assert set(TWIN.values()) == set(PERTURBATIONS)
