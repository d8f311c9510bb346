"""The rows that optimise each picture with Mitsuba's derivatives: slow, on a fixed subset of the scenes."""

from typing import Any

from unirender_evaluation.optimized_method import OPTIMISER, REFINED, OptimizedMethod
from unirender_evaluation.rows import Row, make_row
from unirender_evaluation.versions import MODEL, OPTIMIZER, REFERENCE

ASKED = frozenset(
    {
        ("rendering", "from-image"),
        ("inverse", "single-image"),
        ("relighting", "from-image-sd"),
        ("relighting", "from-image-hdri"),
    }
)
USES = frozenset({OPTIMIZER, REFERENCE})


def optimized_rows(scenes: int | None, pictures: int | None = None, ours: Any = None) -> list[Row]:
    """The rows of single-picture optimisation.

    Args:
        scenes: of the run, evenly spaced; None: all.
        pictures: of each scene in the inverse table; None: all.
        ours: our method, whose decomposition the refinement starts from; None: no such row.
    """
    rows = [
        make_row(
            OptimizedMethod(OPTIMISER),
            "optimisation",
            published="NvDiffrec",
            protocols=ASKED,
            scenes=scenes,
            pictures=pictures,
            uses=USES,
            note="one picture, shape from its silhouette; optimised and rendered by Mitsuba",
        ),
        make_row(
            OptimizedMethod(f"{OPTIMISER}, true mesh"),
            "optimisation",
            protocols=ASKED,
            scenes=scenes,
            pictures=pictures,
            uses=USES,
            told=frozenset({"geometry"}),
            note="told the object's true mesh, which no other row sees",
        ),
    ]
    if ours is not None:
        rows.append(
            make_row(
                OptimizedMethod(REFINED, base=ours),
                "ours",
                protocols=ASKED,
                scenes=scenes,
                pictures=pictures,
                uses=USES | {MODEL},
                note=f"starts from {ours.name}",
            )
        )
    return rows
