"""Settings of the start by light transport. Light to import."""

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class TransportConfig:
    """The global start: light, materials and base colour solved for together, without descent (`solve`)."""

    enabled: bool = True
    """Solve for a start; off: grey, roughness and metallic 0.5, a constant light."""
    materials: Literal["one", "maps"] = "maps"
    """One roughness and metallic for the object, or maps of them, where the pictures speak for more than one."""
    pixels: int = 9000
    """At most so many pixels of all views, drawn at random; memory and time grow with it."""
    iterations: int = 6
    """Steps of Levenberg-Marquardt, at most: of each start on a coarse light, and of the best one on the full light."""
    rounds: int = 2
    """Corrections by a path-traced image: for interreflection and for what is smaller than a light cell."""
    correction_spp: int = 256
    """Samples per pixel of such an image."""
    smooth_light: float = 2.0
    """Weight of the light's smoothness in log space."""
    neutral_light: float = 1.0
    """Weight of the light's neutral colour in log space."""
    smooth_albedo: float = 15.0
    """Weight of differences between neighbouring texels of the base colour."""
