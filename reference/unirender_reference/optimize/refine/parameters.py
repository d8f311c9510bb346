"""The space in which refinement makes its steps, and the limits of what it may find.

perceptual  display values of albedo, natural logarithms of light; roughness and metallic as they are
linear      everything as it is
"""

from typing import Literal

import numpy as np
from jaxtyping import Float

from unirender.color import display_slope, srgb_decode, srgb_encode
from unirender_reference.optimize.refine.config import Space
from unirender_reference.shader import MOST_METALLIC

Name = Literal["albedo", "roughness", "metallic", "environment"]
NAMES: tuple[Name, ...] = ("albedo", "roughness", "metallic", "environment")

LEAST_ALBEDO = 1e-3
LEAST_ROUGHNESS = 0.03  # below, highlights are as rare among samples as a mirror's
LEAST_LIGHT, MOST_LIGHT = 1e-4, 1e5
LIMITS: dict[Name, tuple[float, float]] = {
    "albedo": (LEAST_ALBEDO, 1.0),
    "roughness": (LEAST_ROUGHNESS, 1.0),
    "metallic": (0.0, MOST_METALLIC),
    "environment": (LEAST_LIGHT, MOST_LIGHT),
}

Map = Float[np.ndarray, "..."]


def to_parameter(name: Name, values: Map, space: Space) -> Map:
    """A map in the space of steps, within its limits."""
    values = np.clip(values, *LIMITS[name]).astype(np.float32)
    if space == "perceptual" and name == "albedo":
        return srgb_encode(values)
    return np.log(values) if space == "perceptual" and name == "environment" else values


def to_map(name: Name, parameter: Map, space: Space) -> Map:
    """The inverse of `to_parameter`, within the limits."""
    if space == "perceptual" and name == "albedo":
        parameter = srgb_decode(parameter)
    elif space == "perceptual" and name == "environment":
        parameter = np.exp(parameter)
    return np.clip(parameter, *LIMITS[name]).astype(np.float32)


def parameter_gradient(name: Name, parameter: Map, gradient: Map, space: Space) -> Map:
    """The derivative with respect to a parameter, from that with respect to its map."""
    if space == "perceptual" and name == "albedo":
        return (gradient / display_slope(srgb_decode(parameter))).astype(np.float32)
    if space == "perceptual" and name == "environment":
        return gradient * np.exp(parameter)
    return gradient
