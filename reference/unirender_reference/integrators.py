"""Mitsuba integrators: the path tracer of every image, and integrators written in Python.

The classes derive from `mi.SamplingIntegrator`, which exists once a variant is chosen: they are made on the first call,
never when this module is imported. `mi.render` runs them like any other, with the scene's film, filter and sampler.
"""

import functools
from collections.abc import Callable, Sequence
from typing import Any

from unirender_reference.backend import mitsuba

Radiance = Callable[[Any, Any, Any, Any], tuple[Any, Any, list[Any]]]


def path_integrator(depth: int) -> Any:
    """Mitsuba's path tracer with the environment hidden behind the object; depth 2 is one bounce, 4 is three."""
    return mitsuba().load_dict({"type": "path", "max_depth": depth, "hide_emitters": True})


def python_integrator(radiance: Radiance, channels: Sequence[str] = ()) -> Any:
    """An integrator that calls a Python function, once for each render, with arrays of camera rays.

    Args:
        radiance: `(scene, sampler, ray, active) -> (radiance, hit, values)` of Dr.Jit arrays; `hit` becomes alpha,
            `values` has one array for each name in `channels`.
        channels: names of further channels, behind RGBA.
    """
    return _class(mitsuba().variant())(radiance, tuple(channels))


@functools.cache
def _class(variant: str) -> Any:
    """The integrator class of a variant, whose radiance is a Python function."""
    mi = mitsuba(variant)

    class PythonIntegrator(mi.SamplingIntegrator):
        def __init__(self, radiance: Radiance, channels: tuple[str, ...]) -> None:
            super().__init__(mi.Properties())
            self._radiance, self._channels = radiance, channels

        def sample(self, scene: Any, sampler: Any, ray: Any, medium: Any = None, active: Any = True) -> Any:
            return self._radiance(scene, sampler, ray, active)

        def aov_names(self) -> list[str]:
            return list(self._channels)

    return PythonIntegrator
