"""What the refinement is made of: every ingredient is a field, every field can be switched off."""

from dataclasses import dataclass
from typing import Literal, get_args

from unirender.errors import UsageError
from unirender_reference.option_checks import require_least, require_one_of

LossKind = Literal["log", "srgb", "linear", "slope"]
Space = Literal["perceptual", "linear"]


@dataclass(frozen=True)
class RefineConfig:
    """Refinement of textures and light by Mitsuba's derivatives."""

    enabled: bool = True
    """Off: the start is returned as it is."""
    iterations: int = 40
    """Steps of Adam."""
    loss: LossKind = "slope"
    """How pictures are compared; `losses` has the equations. "log" is NvDiffRec's."""
    one_sided: bool = True
    """More light than a display shows is no error where the picture is saturated."""
    robust: bool = True
    """Pixels count by how well the start explains them, under Cauchy's loss at the errors' own scale."""
    spp: int = 16
    """Samples per pixel of the picture."""
    spp_gradient: int = 8
    """Samples per pixel of its derivative."""
    depth: int = 4
    """Longest path: 2 is direct light with its shadows, 4 has three bounces."""
    decorrelated: bool = True
    """Picture and derivative draw different samples; off: the same, with a biased gradient."""
    parametrisation: Space = "perceptual"
    """Steps in display values of albedo and logarithms of light, or in the linear values themselves."""
    albedo_rate: float = 0.01
    """Learning rate of the albedo, in display values or linear ones."""
    roughness_rate: float = 0.002
    """Learning rate of roughness."""
    metallic_rate: float = 0.002
    """Learning rate of metallic."""
    light_rate: float = 0.005
    """Learning rate of the light, in natural logarithms or linear radiance."""
    decay: float = 0.1
    """What is left of the learning rates at the end."""
    albedo_levels: int = 3
    """Levels of the albedo's pyramid; 1: texels alone."""
    material_levels: int = 4
    """Levels of the pyramid of roughness and metallic."""
    light_levels: int = 2
    """Levels of the light's pyramid."""
    uniform: bool = True
    """One step length for all texels of a level."""
    beta_2: float = 0.99
    """What Adam keeps of its second moment in a step; 0.999 in Mitsuba's and most others' default."""
    white_light: float = 0.0
    """Weight of NvDiffRec's regulariser: mean |E_c - mean E|."""
    albedo_smoothness: float = 0.0
    """Weight of the smoothness of the albedo."""
    light_anchor: float = 0.0
    """Weight of the squared distance of the light's logarithm from the start."""
    material_anchor: float = 0.0
    """Weight of the squared distance of roughness and metallic from the start."""
    albedo_anchor: float = 0.0
    """Weight of the squared distance of the albedo from the start."""
    held_out_every: int = 0
    """Iterations between measures of the fit to held-out views; 0: never."""
    seed: int = 0
    """Equal seeds draw equal samples."""

    def check(self) -> None:
        """Looks at the values.

        Raises:
            UsageError: one is outside its range.
        """
        counts = {"iterations": 0, "spp": 1, "spp_gradient": 1, "depth": 2, "held_out_every": 0, "seed": 0}
        levels = {"albedo_levels": 1, "material_levels": 1, "light_levels": 1}
        rates = {"albedo_rate": 0, "roughness_rate": 0, "metallic_rate": 0, "light_rate": 0}
        weights = ("white_light", "albedo_smoothness", "light_anchor", "material_anchor", "albedo_anchor")
        require_least(self, "refine", counts | levels | rates | dict.fromkeys(weights, 0))
        require_one_of(self, "refine", {"loss": get_args(LossKind), "parametrisation": get_args(Space)})
        require_least(self, "refine", {"decay": 0}, above=True)
        require_least(self, "refine", {"beta_2": 0})
        if self.beta_2 >= 1:
            raise UsageError(f"--refine.beta-2 {self.beta_2}: expected less than 1")

    @classmethod
    def plain(cls, iterations: int = 800) -> "RefineConfig":
        """The loop of Mitsuba's tutorials: its Adam, 16 samples, squared error of display values, nothing else."""
        return cls(
            iterations=iterations,
            loss="srgb",
            one_sided=False,
            robust=False,
            spp=16,
            spp_gradient=16,
            decorrelated=True,
            parametrisation="linear",
            albedo_rate=0.02,
            roughness_rate=0.02,
            metallic_rate=0.02,
            light_rate=0.02,
            decay=1.0,
            albedo_levels=1,
            material_levels=1,
            light_levels=1,
            uniform=False,
            beta_2=0.999,
        )
