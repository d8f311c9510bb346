"""Lights: bundled maps, procedural lights, files; `make_light` draws one of a split."""

from typing import Literal

import numpy as np

from unirender.errors import UnirenderError
from unirender_reference.lights.bundled import bundled_light, bundled_lights, catalogue
from unirender_reference.lights.files import load_light
from unirender_reference.lights.light import Light, normalized, turned
from unirender_reference.lights.synthetic import (
    light_constant,
    light_gradient,
    light_softboxes,
    light_sunsky,
    random_tilt,
    random_tint,
)

__all__ = [
    "Light",
    "bundled_light",
    "bundled_lights",
    "catalogue",
    "light_constant",
    "light_gradient",
    "light_softboxes",
    "light_sunsky",
    "load_light",
    "make_light",
]

SPLIT = {"train": 0x117421, "test": 0x117E57}
SHARES = {"bundled": 0.50, "softboxes": 0.25, "sunsky": 0.15, "gradient": 0.08, "constant": 0.02}
TILTED = 0.15


def make_light(seed: int, split: Literal["train", "test"]) -> Light:
    """Draws light number `seed` of a split: half of them bundled maps (turned, mirrored, sometimes tilted).

    Draws come from `numpy.random.default_rng([SPLIT[split], seed])`: the splits share neither maps nor random streams.

    Raises:
        UnirenderError: unknown split or negative seed.
    """
    if split not in SPLIT or seed < 0:
        raise UnirenderError(f"make_light: got seed {seed}, split {split!r}; expected seed >= 0, 'train' or 'test'")
    rng = np.random.default_rng([SPLIT[split], seed])
    kind = str(rng.choice(list(SHARES), p=list(SHARES.values())))
    if kind == "bundled":
        pool = bundled_lights(split)
        light = pool[int(rng.integers(len(pool)))]
        environment = turned(light.environment, rng)
        if rng.random() < TILTED:
            environment = random_tilt(environment, rng)
    elif kind == "constant":
        light = light_constant(random_tint(rng))
        environment = light.environment
    else:
        light = {"softboxes": light_softboxes, "sunsky": light_sunsky, "gradient": light_gradient}[kind](rng)
        environment = light.environment
    name = f"{split}-{seed:06d}-{light.name.removesuffix('-drawn')}"
    provenance = {**light.provenance, "kind": kind, "seed": str(seed), "split": split}
    return Light(name, normalized(environment), provenance)
