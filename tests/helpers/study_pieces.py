"""A study of one object that takes a second: few pixels, few samples, one thread."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

from tiny_suites import write_suite

from unirender_evaluation.multiview.settings import MultiviewSettings
from unirender_evaluation.studies.optimiser.ingredients import FULL, REFINEMENT, START, Ingredient
from unirender_evaluation.studies.optimiser.study import Study
from unirender_evaluation.versions import LPIPS, MULTIVIEW, OPTIMIZER, REFERENCE, Versions
from unirender_reference.backend import renderer_threads
from unirender_reference.optimize.multiview.config import OptimizeConfig
from unirender_reference.optimize.refine.config import RefineConfig
from unirender_reference.optimize.transport.config import TransportConfig

FEW = MultiviewSettings(seen=2, held_out=1, spp=16, truth_spp=16, buffer_spp=8)
SMALL = OptimizeConfig(
    transport=TransportConfig(materials="one", pixels=200, iterations=1, rounds=0),
    refine=RefineConfig(iterations=4, spp=4, spp_gradient=4, depth=2),
    texture_size=16,
    light_rows=8,
)
VERSIONS = Versions("test", {LPIPS: "none", MULTIVIEW: "1", OPTIMIZER: "1", REFERENCE: "1"})


def small_study(folder: Path, own: str, objects: int = 1, versions: Versions = VERSIONS) -> Study:
    """The first objects of a suite that is written here."""
    path = folder / "suite" / "ball.toml"
    if not path.exists():
        write_suite(path.parent, objects=2)
    return Study.of(str(path), objects, 0, own, FEW, versions)


def full() -> Ingredient:
    """The full method."""
    return Ingredient(FULL, "", "Full method", SMALL)


def twin() -> Ingredient:
    """The same under another name."""
    return Ingredient("twin", REFINEMENT, "nothing", SMALL)


def unrefined() -> Ingredient:
    """Without refinement."""
    return Ingredient("unrefined", START, "no refinement", replace(SMALL, refine=replace(SMALL.refine, enabled=False)))


@contextmanager
def one_thread() -> Iterator[None]:
    """Equal runs give equal bytes."""
    with renderer_threads(1):
        yield
