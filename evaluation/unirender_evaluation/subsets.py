"""On how many of a run's scenes the slow rows run: a stated subset, or the whole suite (`bench run --full`)."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Subsets:
    """Scenes of each slow part of a run, evenly spaced; None = all of the run's."""

    sample: int | None = 4  # of the sampling rows, which cost steps x samples; 0 = leave them out
    shade: int | None = 12  # of `shade(true maps)`, which renders with Mitsuba
    physics: int | None = 12  # of the physics table: renderer tests and closed loops
    optimise: int | None = 4  # of the rows that optimise each picture
    pictures: int | None = 2  # pictures of each such scene in the inverse table
    views: int | None = 4  # objects of the multi-view table; 0 = leave it out
    mitsuba: int | None = 4  # of the row *Mitsuba*, which renders as many samples as the truth has; 0 = leave it out


STANDARD = Subsets()
WHOLE = Subsets(sample=None, shade=None, physics=None, optimise=None, pictures=None, views=None, mitsuba=None)


def partial(limit: int | None, whole: int) -> int | None:
    """A limit of scenes as tables say it: None where the whole has no more than that."""
    return limit if limit is not None and limit < whole else None
