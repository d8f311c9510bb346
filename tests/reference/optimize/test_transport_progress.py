"""The estimate of the transport stage."""

import itertools

import pytest

from unirender_reference.optimize.transport.config import TransportConfig
from unirender_reference.optimize.transport.progress import solve_shares
from unirender_reference.optimize.transport.solve import STARTS


@pytest.mark.parametrize(("materials", "rounds"), [("one", 0), ("maps", 2)])
def test_shares_grow_to_all(materials, rounds: int) -> None:
    shares = solve_shares(TransportConfig(materials=materials, rounds=rounds), len(STARTS))
    assert len(shares) == len(STARTS) + 1 + (materials == "maps") + rounds
    assert all(0 < before < after for before, after in itertools.pairwise(shares))
    assert shares[-1] == pytest.approx(1)
