"""What an optimisation is made of. Light to import."""

from dataclasses import dataclass, field

from unirender.errors import UsageError
from unirender_reference.optimize.refine_config import RefineConfig
from unirender_reference.optimize.shape.config import ShapeConfig
from unirender_reference.optimize.transport_config import TransportConfig


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
        """
        for name, least in (("texture_size", 4), ("light_rows", 8), ("patience", 0), ("shape_rounds", 0), ("seed", 0)):
            if getattr(self, name) < least:
                option = name.replace("_", "-")
                raise UsageError(f"--{option} {getattr(self, name)}: expected {least} or more")
        if self.light_rows % 2:
            raise UsageError(f"--light-rows {self.light_rows}: expected an even number")
        if not self.save_seconds >= 0:
            raise UsageError(f"--save-seconds {self.save_seconds:g}: expected 0 or more")
        self.transport.check()
        self.refine.check()
