"""The rows that optimise each picture with Mitsuba's derivatives: slow, on a fixed subset of the scenes."""

from typing import Any

from unirender_evaluation.methods.optimized import OPTIMISER, REFINED, OptimizedMethod
from unirender_evaluation.rows import Row, make_row
from unirender_evaluation.task import PROTOCOLS
from unirender_evaluation.versions import MODEL, OPTIMIZER, REFERENCE
from unirender_reference.optimize.single.config import COLD, fitted

ASKED = frozenset(PROTOCOLS) - {("rendering", "given"), ("rendering", "given-light")}
USES = frozenset({OPTIMIZER, REFERENCE})


def optimized_rows(scenes: int | None, pictures: int | None = None, ours: Any = None) -> list[Row]:
    """The rows of single-picture optimisation.

    Args:
        scenes: of the run, evenly spaced; None: all.
        pictures: of each scene in the inverse table; None: all.
        ours: our method, whose decomposition the refinement starts from; None: no such row.
    """
    part: dict[str, Any] = {"protocols": ASKED, "scenes": scenes, "pictures": pictures}
    note = f"one picture, shape from its silhouette; optimised and rendered by Mitsuba{_held(known_mesh=False)}"
    rows = [make_row(OptimizedMethod(OPTIMISER), "optimisation", published="NvDiffrec", uses=USES, note=note, **part)]
    note = f"told the object's true mesh, which no other row sees{_held(known_mesh=True)}"
    told = OptimizedMethod(f"{OPTIMISER}, true mesh")
    rows.append(make_row(told, "optimisation", uses=USES, told=frozenset({"geometry"}), note=note, **part))
    if ours is not None:
        refined = OptimizedMethod(REFINED, base=ours)
        rows.append(make_row(refined, "ours", uses=USES | {MODEL}, note=f"starts from {ours.name}", **part))
    return rows


def _held(known_mesh: bool) -> str:
    """What a reader of a cold row's figures must know of the materials that it does not look for."""
    trust = fitted(known_mesh, warm=False)[1]
    held = [name for name in ("metallic", "roughness") if getattr(trust, name) == 0]
    return "".join(
        f"; {name} is held at {COLD[name]:g}, since one picture does not decide it: the constant's score in the "
        "inverse table, the true value where pictures are edited or relit"
        for name in held
    )
