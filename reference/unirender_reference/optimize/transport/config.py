"""Settings of the start by light transport. Light to import."""

from dataclasses import dataclass
from typing import Literal, get_args

from unirender.errors import UnirenderError, UsageError
from unirender_reference.option_checks import require_least, require_one_of

LEAST_PIXELS = 16
MATRIX_BYTES = 96.0  # of memory for a pixel and a column of the light: 24 matrices (`matrices`)

Materials = Literal["one", "maps"]


@dataclass(frozen=True)
class TransportConfig:
    """The global start: light, materials and base colour solved for together, without descent (`solve`)."""

    enabled: bool = True
    """Solve for a start; off: grey, roughness and metallic 0.5, a constant light."""
    materials: Materials = "maps"
    """One roughness and metallic for the object, or maps of them, where the pictures speak for more than one."""
    pixels: int = 9000
    """At most so many pixels of all views; memory and time grow with it. Larger pictures (from 128 pixels along
    the shorter side) are reduced by a whole factor, to no less than 64; of what is left pixels are drawn at random."""
    fine_below: float = 0.25
    """Below this roughness the light is solved for on 24 x 48 texels, if the views have pixels enough for it."""
    fine_pixels: int = 6000
    """At most so many of the pixels then."""
    sharpen: bool = True
    """Solve again under Cauchy's loss at the residuals' own scale: highlights that it lacks decide less."""
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
    smooth_albedo: float | None = None
    """Weight of differences between neighbouring texels of the base colour; None: by pixels that are held out."""

    def check(self) -> None:
        """Looks at the values.

        Raises:
            UsageError: one is outside its range.
        """
        from unirender_reference.sample_counts import SAMPLES_PER_PASS, pass_count

        counts = {"pixels": LEAST_PIXELS, "fine_pixels": LEAST_PIXELS, "iterations": 0, "rounds": 0}
        weights = {"fine_below": 0, "smooth_light": 0, "neutral_light": 0, "smooth_albedo": 0}
        require_least(self, "transport", counts | weights)
        require_one_of(self, "transport", {"materials": get_args(Materials)})
        try:
            pass_count(self.correction_spp, 1, SAMPLES_PER_PASS)
        except UnirenderError as error:
            raise UsageError(f"--transport.correction-spp {self.correction_spp}: {error}") from error
