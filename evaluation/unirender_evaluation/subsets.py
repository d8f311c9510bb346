"""On how many of a run's scenes the slow rows run: a stated subset, or the whole suite (`bench run --full`)."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Subsets:
    """Scenes of each slow part of a run, evenly spaced; None = all of the run's.

    Attributes:
        sample: of the sampling rows, which cost steps x samples; 0 = leave them out.
        shade: of `shade(true maps)`, which renders with Mitsuba.
        physics: of the physics table: renderer tests and closed loops.
        optimise: of the rows that optimise each picture.
        pictures: pictures of each such scene in the inverse table.
        views: objects of the multi-view table; 0 = leave it out.
        mitsuba: of the row *Mitsuba*, which renders as many samples as the truth has; 0 = leave it out.
    """

    sample: int | None = 4
    shade: int | None = 12
    physics: int | None = 12
    optimise: int | None = 4
    pictures: int | None = 2
    views: int | None = 4
    mitsuba: int | None = 4


STANDARD = Subsets()
WHOLE = Subsets(sample=None, shade=None, physics=None, optimise=None, pictures=None, views=None, mitsuba=None)


def partial(limit: int | None, whole: int) -> int | None:
    """A limit of scenes as tables say it: None where the whole has no more than that."""
    return limit if limit is not None and limit < whole else None
