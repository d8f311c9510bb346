"""`make_light`: light number `seed` of a split."""

import re
from numbers import Integral

import numpy as np

from unirender.errors import UnirenderError
from unirender_reference.lights.bundled import bundled_lights
from unirender_reference.lights.light import Light, normalized
from unirender_reference.lights.placement import random_placement
from unirender_reference.lights.pool import LightPool, Split
from unirender_reference.lights.synthetic import (
    light_constant,
    light_gradient,
    light_softboxes,
    light_sunsky,
    random_tint,
)

SPLIT = {"train": 0x117421, "test": 0x117E57}
SHARES = {"bundled": 0.50, "softboxes": 0.25, "sunsky": 0.15, "gradient": 0.08, "constant": 0.02}
FROM_POOL = 0x117F01  # the random stream that decides between a user's pool and the built-in lights


def make_light(seed: int, split: Split, pool: LightPool | None = None) -> Light:
    """Draws light number `seed` of a split: half of them bundled maps (turned, mirrored, sometimes tilted).

    Draws come from `numpy.random.default_rng([SPLIT[split], seed])`: the splits share neither maps nor random streams.
    With a pool of the user's, `pool.share` of the seeds give one of its files instead, turned, mirrored and tilted
    likewise unless `pool.turn` is off; all other seeds give what they give without it. How a map was turned is in the
    light's provenance (`lights.placement`).

    Raises:
        UnirenderError: unknown split, negative seed, a pool of the other split, or one without readable files.
    """
    if split not in SPLIT or not isinstance(seed, Integral) or seed < 0:
        raise UnirenderError(f"make_light: got seed {seed!r}, split {split!r}; expected seed >= 0, 'train' or 'test'")
    if pool is not None and pool.split != split:
        raise UnirenderError(f"make_light: got a {pool.split} pool for split {split!r}, expected one of the same split")
    rng = np.random.default_rng([SPLIT[split], seed])
    if pool is not None:
        own = np.random.default_rng([SPLIT[split], seed, FROM_POOL])
        if own.random() < pool.share:
            light = pool.draw(own)
            return _drawn(_placed(light, own) if pool.turn else light, "pool", seed, split)
    kind = str(rng.choice(list(SHARES), p=list(SHARES.values())))
    if kind == "bundled":
        maps = bundled_lights(split)
        light = _placed(maps[int(rng.integers(len(maps)))], rng)
    elif kind == "constant":
        light = light_constant(random_tint(rng))
    else:
        light = {"softboxes": light_softboxes, "sunsky": light_sunsky, "gradient": light_gradient}[kind](rng)
    return _drawn(light, kind, seed, split)


def _placed(light: Light, rng: np.random.Generator) -> Light:
    """A map turned, mirrored and, sometimes, tilted."""
    placement = random_placement(rng, light.environment.shape[1])
    return Light(light.name, placement.apply(light.environment), {**light.provenance, **placement.provenance()})


def _drawn(light: Light, kind: str, seed: int, split: Split) -> Light:
    stem = re.sub(r"[^\w-]", "-", light.name.removesuffix("-drawn"))
    provenance = {**light.provenance, "kind": kind, "seed": str(seed), "split": split}
    return Light(f"{split}-{seed:06d}-{stem}", normalized(light.environment), provenance)
