"""What is rendered for the multi-view table; part of every content key of it."""

from dataclasses import dataclass


@dataclass(frozen=True)
class MultiviewSettings:
    """Cameras and samples.

    Attributes:
        seen: pictures that a method is given.
        held_out: cameras that it never sees.
        spp: samples per pixel of the pictures that a method is given, and of those that its result is rendered to.
        truth_spp: of the pictures that these are scored against.
        buffer_spp: camera rays per pixel of albedo, roughness and metallic.
    """

    seen: int = 8
    held_out: int = 4
    spp: int = 512
    truth_spp: int = 1024
    buffer_spp: int = 64


STANDARD = MultiviewSettings()
