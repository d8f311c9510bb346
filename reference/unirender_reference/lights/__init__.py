"""Lights: bundled maps, procedural lights, files, a user's own folder; `make_light` draws one of a split.

    pool = light_pool("my_hdris", "train", holdout=8)  # every 8th place is kept for light_pool("my_hdris", "test")
    light = make_light(seed, "train", pool)            # half of the seeds give one of its files

`docs/lights.md` has the pool, the rules and the figures; `unirender lights` shows them.
"""

from unirender_reference.lights.bundled import bundled_light, bundled_lights, catalogue
from unirender_reference.lights.draw import make_light
from unirender_reference.lights.files import load_light
from unirender_reference.lights.light import Light
from unirender_reference.lights.placement import Placement
from unirender_reference.lights.pool import LightPool, light_pool
from unirender_reference.lights.synthetic import light_constant, light_gradient, light_softboxes, light_sunsky

__all__ = [
    "Light",
    "LightPool",
    "Placement",
    "bundled_light",
    "bundled_lights",
    "catalogue",
    "light_constant",
    "light_gradient",
    "light_pool",
    "light_softboxes",
    "light_sunsky",
    "load_light",
    "make_light",
]
