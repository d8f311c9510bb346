"""The optimiser's ingredients: the full method, and what differs from it in one of them. Light to import.

Priors that the full method does without are switched on with such a weight that their derivative is about a third of
the pictures' (root mean square over the map's texels, after the transport stage on one object of the tiny suite; of an
anchor, where the map is 0.05 away from its start, and the light's logarithm 0.3).
"""

from dataclasses import asdict, dataclass, replace
from typing import Any

from unirender_evaluation.multiview.methods import PLAIN_ITERATIONS, PLAIN_TEXTURE
from unirender_reference.optimize.multiview.config import OptimizeConfig
from unirender_reference.optimize.refine.config import RefineConfig
from unirender_reference.optimize.transport.config import TransportConfig

FULL = "full"
START, REFINEMENT, PRIORS, GREY = "start", "refinement", "priors", "grey"
GROUPS = {
    START: "The start",
    REFINEMENT: "Refinement",
    PRIORS: "Ingredients that the full method does without, switched on",
    GREY: "From a grey object in uniform light",
}
# Loss and weights of NvDiffRec's code (Munkberg et al. 2022; geometry/dlmesh.py). Its albedo prior is on differences of
# nearby points of the surface, ours on those of neighbouring texels.
NVDIFFREC = {"loss": "log", "white_light": 0.005, "albedo_smoothness": 0.03}


@dataclass(frozen=True)
class Ingredient:
    """A row of the study."""

    name: str  # on the command line and in records
    group: str  # key of `GROUPS`; empty for the full method
    label: str  # what is different
    config: OptimizeConfig  # of the optimiser


def ingredients(seed: int = 0) -> tuple[Ingredient, ...]:
    """All rows, the full method first."""
    full = OptimizeConfig(seed=seed)

    def start(name: str, label: str, **changes: Any) -> Ingredient:
        return Ingredient(name, START, label, replace(full, transport=replace(full.transport, **changes)))

    def refined(name: str, label: str, group: str = REFINEMENT, **changes: Any) -> Ingredient:
        return Ingredient(name, group, label, replace(full, refine=replace(full.refine, **changes)))

    def grey(name: str, label: str, refine: RefineConfig) -> Ingredient:
        config = replace(full, transport=TransportConfig(enabled=False), refine=refine, texture_size=PLAIN_TEXTURE)
        return Ingredient(name, GREY, label, config)

    plain = RefineConfig.plain(PLAIN_ITERATIONS)
    return (
        Ingredient(FULL, "", "Full method", full),
        start("one-material", "one roughness and metallic instead of maps", materials="one"),
        start("no-correction", "no correction by path-traced pictures", rounds=0),
        start("huber", "Huber's loss alone", sharpen=False),
        start("coarse-light", "16 x 32 light cells, however smooth the surface", fine_below=0.0),
        start("rough-light", "light without smoothness", smooth_light=0.0),
        start("coloured-light", "light of any colour", neutral_light=0.0),
        start("rough-albedo", "base colour without smoothness", smooth_albedo=0.0),
        refined("no-refinement", "no refinement", START, enabled=False),
        refined("log", "NvDiffRec's log-tonemapped loss", loss="log"),
        refined("srgb", "squared error of display values", loss="srgb"),
        refined("linear", "squared error of radiance", loss="linear"),
        refined("same-weights", "pixels count the same, however the start explains them", robust=False),
        refined("two-sided", "saturated pixels count as exact", one_sided=False),
        refined(
            "no-pyramid",
            "Adam on texels alone",
            albedo_levels=1,
            material_levels=1,
            light_levels=1,
            uniform=False,
        ),
        refined("linear-steps", "steps in linear albedo and light", parametrisation="linear"),
        refined("direct-light", "direct light only: no interreflection", depth=2),
        refined("same-samples", "picture and derivative share their samples", decorrelated=False),
        refined("constant-rates", "learning rates do not decay", decay=1.0),
        refined(
            "small-rates",
            "a quarter of the learning rates",
            albedo_rate=full.refine.albedo_rate / 4,
            roughness_rate=full.refine.roughness_rate / 4,
            metallic_rate=full.refine.metallic_rate / 4,
            light_rate=full.refine.light_rate / 4,
        ),
        refined("white-light", "light drawn to white", PRIORS, white_light=1.5e-3),
        refined("smooth-albedo", "smooth albedo", PRIORS, albedo_smoothness=0.015),
        refined("anchors", "maps held at the start", PRIORS, albedo_anchor=0.2, material_anchor=0.2, light_anchor=4e-3),
        grey("from-grey", "the full method's refinement", full.refine),
        grey("plain", f"plain loop, {PLAIN_ITERATIONS} steps", plain),
        grey("nvdiffrec", "plain loop with NvDiffRec's loss and priors", replace(plain, **NVDIFFREC)),
    )


def changes(row: OptimizeConfig, full: OptimizeConfig) -> dict[str, Any]:
    """What two configurations differ in: `stage.field` -> the value in `row`."""
    found, ours, theirs = {}, asdict(row), asdict(full)
    for stage, value in ours.items():
        if isinstance(value, dict):
            found |= {f"{stage}.{name}": v for name, v in value.items() if v != theirs[stage][name]}
        elif value != theirs[stage]:
            found[stage] = value
    return found
