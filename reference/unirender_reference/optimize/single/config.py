"""What single-view optimisation can be told, and how far it trusts what it starts from.

One picture does not determine its maps: light and albedo trade against each other at every pixel, and a smooth metal
looks like many a dielectric under another light. Everything that a picture leaves open is decided by priors. Their
widths are standard deviations, most of them of logarithms, so that twice and half as much cost the same.
"""

import math
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from types import MappingProxyType

from unirender.errors import UsageError
from unirender_reference.optimize.machine import require_memory
from unirender_reference.optimize.transport.config import MATRIX_BYTES
from unirender_reference.option_checks import require_least


@dataclass(frozen=True)
class Priors:
    """Standard deviations of what is found about what it starts from."""

    albedo: float = 0.3
    """Log albedo of a pixel."""

    albedo_step: float = 0.12
    """Log albedo between neighbouring pixels of equal chroma; more across an edge in the picture's chroma."""

    brightness: float = 0.05
    """Log albedo of the whole object, its mean over the channels."""

    tint: float = 0.04
    """Log albedo of the whole object, each channel against their mean."""

    metallic: float = 0.25
    """Metallic of the whole object."""

    roughness: float = 0.25
    """Roughness of the whole object."""

    light: float = 1.2
    """Log radiance of a direction."""

    light_step: float = 1.25
    """Log radiance between neighbouring directions of an 8 x 16 map at the horizon."""

    light_chroma: float = 0.2
    """Log radiance of a channel against the channels' mean."""

    light_level: float = 1.0
    """Log radiance of the whole light."""

    light_tint: float = 0.2
    """Log radiance of the whole light, a channel against the channels' mean."""


@dataclass(frozen=True)
class Trust:
    """What part of a change that was found is kept, [0, 1]: the factor that makes the map least wrong.

    One picture fits a metal under one light about as well as a dielectric under another, and the fit prefers metals;
    where normals are predicted, their errors are explained by light and paint. With all at 0 the start comes back.
    """

    albedo: float = 1.0
    """Of the change of log albedo. A predicted albedo keeps its mean in each channel: level and tint of paint and light
    cannot be told apart, and what the fit moves them by is no better. A grey start keeps its level. What the mean
    would have changed by goes into the light, whatever part is kept."""

    metallic: float = 1.0
    """Of the change of the object's metallic."""

    roughness: float = 1.0
    """Of the change of the object's roughness."""

    light: float = 1.0
    """Of the change of log radiance of a predicted light. On a known mesh its level is the one under which the maps are
    as bright as the picture, unless this is 0."""

    shading: float = 1.0
    """Of the change of a predicted s and d, as logarithms."""


@dataclass(frozen=True)
class SingleConfig:
    """Single-view optimisation."""

    priors: Priors | None = None
    """How far what is found may move from its start; None: those of `fitted` for what is given."""

    trust: Trust | None = None
    """How much of a change of material is believed; None: that of `fitted` for what is given."""

    steps: tuple[int, ...] = (5, 5, 8)
    """Levenberg-Marquardt steps at each of `noise`."""

    noise: tuple[float, ...] = (0.1, 0.05, 0.025)
    """Expected misfit in display values, from coarse to fine; also what the model cannot explain (light from
    elsewhere on the object, several surfaces in a pixel)."""

    noise_factor: float = 0.6
    """The misfit found so far, times this, is the least that the next stage expects."""

    fine_steps: int = 5
    """Steps at the picture's own size (within `pixels`), from what was found at the coarse one."""

    coarse_pixels: int = 450
    """Covered pixels, at most, while light and material are searched: a larger picture is averaged over blocks."""

    pixels: int = 1700
    """Covered pixels, at most, of the last stage; larger pictures get its result, with their own detail."""

    light_rows: int = 16
    """Rows of the light that is found; it has twice as many columns."""

    seed: int = 0
    """Of the places of surface points within their pixels."""

    def __post_init__(self) -> None:
        counts = {"fine_steps": 0, "seed": 0, "coarse_pixels": 16, "pixels": 16, "light_rows": 4}
        require_least(self, "single", counts | {"noise_factor": 0})
        for name, widths in (("priors", self.priors), ("trust", self.trust)):
            fields = {} if widths is None else dict.fromkeys(asdict(widths), 0)
            require_least(widths, f"single.{name}", fields, above=name == "priors")
        if min(self.steps, default=0) < 0:
            raise UsageError(f"--single.steps {_words(self.steps)}: expected 0 or more each")
        if not all(0 < misfit < math.inf for misfit in self.noise):
            raise UsageError(f"--single.noise {_words(self.noise)}: expected more than 0 each")
        if len(self.steps) != len(self.noise) or not self.steps:
            raise UsageError(
                f"--single.steps {_words(self.steps)}, --single.noise {_words(self.noise)}: expected as many numbers "
                "in both, a pair for each stage"
            )

    def require_memory(self, covered: int) -> None:
        """Looks at what the last stage takes.

        Args:
            covered: pixels of the picture.

        Raises:
            UnirenderError: it is more than the machine has in all.
        """
        entries = min(self.pixels, covered) * 2.0 * self.light_rows**2
        require_memory({f"--single.light-rows {self.light_rows}": MATRIX_BYTES * entries})

    def resolved(self, known_mesh: bool, warm: bool) -> tuple[Priors, Trust]:
        """Its own widths and trust, or those of `fitted`; arguments as there."""
        priors, trust = fitted(known_mesh, warm)
        return self.priors or priors, self.trust or trust


def _words(values: Iterable[float]) -> str:
    return " ".join(f"{value:g}" for value in values)


COLD: Mapping[str, float] = MappingProxyType({"albedo": 0.25, "roughness": 0.5, "metallic": 0.5})
"""The start without a prediction: means over training objects and their materials."""

# Factors of least error, rounded; 0 where the change is as often wrong as right.
WARM_MESH = Trust(metallic=0.0, roughness=0.5, light=0.75, shading=0.5)
WARM_NORMALS = Trust(albedo=0.0, metallic=0.0, roughness=0.0, light=0.5, shading=0.1)
COLD_MESH = Trust(metallic=0.0, roughness=0.6)
COLD_NORMALS = Trust(metallic=0.0, roughness=0.33)


def fitted(known_mesh: bool, warm: bool) -> tuple[Priors, Trust]:
    """Widths and trust for what is given, chosen on pictures of 8 to 40 objects of the train split.

    Metallic is held where it starts in all four cases: on most pictures the cost is least for a pure metal, and by how
    much has nothing to do with what the object is made of.

    Args:
        known_mesh: normals and shadows are those of the object itself, not predicted or inflated.
        warm: the start is a prediction; else it is `COLD` under even light.
    """
    if warm:
        return Priors(), WARM_MESH if known_mesh else WARM_NORMALS
    cold = Priors(albedo=0.5, tint=0.15, metallic=0.4, roughness=0.35, light=1.5)
    return cold, COLD_MESH if known_mesh else COLD_NORMALS


def kept_note(trust: Trust, warm: bool) -> str:
    """A sentence on what of a result is its start's: whoever looks at the maps takes it for found.

    Args:
        trust: that the result was made with.
        warm: the start is a prediction; else it is `COLD`.
    """
    kept = [name for name in ("metallic", "roughness", "albedo") if getattr(trust, name) == 0]
    if "albedo" not in kept:
        kept.append("the mean of albedo")
    if warm:
        return f"as predicted, since one picture does not tell it: {', '.join(kept)}"
    shown = [f"{name} ({COLD[name.rpartition(' ')[2]]:g})" for name in kept]
    note = f"assumed, since one picture does not tell it: {', '.join(shown)}"
    return note if "albedo" in kept else f"{note}; colours of albedo and light may be exchanged"
