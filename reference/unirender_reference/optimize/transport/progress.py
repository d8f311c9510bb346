"""How far the start by light transport is, for an estimate of the time that it still takes."""

import itertools

from unirender_reference.optimize.transport.config import TransportConfig

# What the parts take beside each other: seconds of one run of 8 views of 64 pixels on 2 cores. Only ratios count.
MATRICES = 8.0  # the transport matrices
START = 0.6  # a solve with few steps from one of the starts
FULL = 2.6  # the solve from the best of them
SHARPER = 2.0  # more of it, where the light is sharpened
MAPS = 2.2  # materials that vary over the surface
ROUND = 4.0  # a round of correction by path-traced pictures


def solve_shares(config: TransportConfig, starts: int) -> list[float]:
    """The share of all work that is done after each solve that the stage reports, if nothing ends it early.

    A finer light, which is known to be needed only on the way, is not foreseen.

    Args:
        config: which solves there are.
        starts: materials that it starts from.
    """
    full = FULL + (SHARPER if config.sharpen else 0)
    maps = [MAPS] if config.materials == "maps" else []
    done = list(itertools.accumulate([MATRICES, *[START] * starts, full, *maps, *[ROUND] * config.rounds]))
    return [work / done[-1] for work in done[1:]]
