"""What an optimisation is made of. Light to import."""

from dataclasses import dataclass, field

from unirender.errors import UsageError
from unirender_reference.optimize.machine import require_memory
from unirender_reference.optimize.refine.config import RefineConfig
from unirender_reference.optimize.shape.config import ShapeConfig
from unirender_reference.optimize.transport.config import MATRIX_BYTES, TransportConfig
from unirender_reference.option_checks import require_least

# Bytes of memory, measured with textures of 512 and 1024 texels, lights of 16 to 48 rows, and 3 and 7 pictures of 512 x
# 512 pixels.
TEXEL_BYTES = 450.0  # for a texel of the textures or of a light that is refined: maps, their pyramids, Adam's moments
PIXEL_BYTES = 230.0  # for a pixel of the pictures, held-out ones too: the refinement shows all of them at once
PAIR_BYTES = 100.0  # for two columns of the light that the transport stage solves for: its normal equations


@dataclass(frozen=True)
class OptimizeConfig:
    """The stages of an optimisation from several views and what they share."""

    transport: TransportConfig = field(default_factory=TransportConfig)
    """The start: light, materials and base colour solved for together."""
    refine: RefineConfig = field(default_factory=lambda: RefineConfig(held_out_every=10))
    """Textures and light by Mitsuba's derivatives."""
    shape: ShapeConfig = field(default_factory=ShapeConfig)
    """The mesh, where none is given."""
    shape_rounds: int = 2
    """Without a mesh: how often the vertices are refined by the pictures, and then textures and light found again."""
    texture_size: int = 128
    """Texels along each side of the textures."""
    light_rows: int = 16
    """Rows of the environment, which has twice as many columns; 24 where the surface is smooth (`fine_below`)."""
    patience: int = 3
    """Looks at the held-out views without a gain of 0.02 dB, after which the refinement ends; its best state counts.
    0: it runs to its end. Without held-out views there is nothing to stop by."""
    save_seconds: float = 10.0
    """Seconds between two saved states of a refinement; a killed run loses no more."""
    seed: int = 0
    """Equal seeds draw equal samples."""

    def check(self) -> None:
        """Looks at the values.

        Raises:
            UsageError: one is outside its range.
            UnirenderError: one takes more memory than the machine has.
        """
        require_least(self, "", {"texture_size": 4, "light_rows": 8, "patience": 0, "shape_rounds": 0, "seed": 0})
        require_least(self, "", {"save_seconds": 0})
        if self.light_rows % 2:
            raise UsageError(f"--light-rows {self.light_rows}: expected an even number")
        self.transport.check()
        self.refine.check()
        columns = 2.0 * self.light_rows**2
        require_memory(
            {
                f"--texture-size {self.texture_size}": TEXEL_BYTES * self.texture_size**2,
                f"--light-rows {self.light_rows}": columns
                * (PAIR_BYTES * columns if self.transport.enabled else TEXEL_BYTES),
            }
        )

    def require_memory(self, covered: int) -> None:
        """Looks at what the transport stage takes.

        Args:
            covered: pixels of all pictures that are fitted.

        Raises:
            UnirenderError: it is more than the machine has in all.
        """
        entries = min(self.transport.pixels, covered) * 2.0 * self.light_rows**2
        named = f"--transport.pixels {self.transport.pixels}, --light-rows {self.light_rows}"
        require_memory({named: MATRIX_BYTES * entries}, "smaller numbers")
