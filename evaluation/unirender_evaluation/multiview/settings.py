"""What is rendered for the multi-view table; part of every content key of it."""

from dataclasses import dataclass


@dataclass(frozen=True)
class MultiviewSettings:
    """Cameras and samples."""

    seen: int = 8  # pictures that a method is given
    held_out: int = 4  # cameras that it never sees
    spp: int = 512  # samples per pixel of the pictures that it is given, and of those that its result is rendered to
    truth_spp: int = 1024  # of the pictures that these are scored against
    buffer_spp: int = 64  # camera rays per pixel of albedo, roughness and metallic


STANDARD = MultiviewSettings()
