"""The race as a table, as JSON and as a picture."""

import io
import math
from collections.abc import Sequence
from dataclasses import asdict

from unirender_evaluation.studies.optimiser.curves import Finish, finish, geometric_mean
from unirender_evaluation.studies.optimiser.race import ObjectRace
from unirender_evaluation.tables.formats import json_text
from unirender_evaluation.tables.protocol import protocol_text
from unirender_evaluation.tables.text import TextTable

TITLES = (
    "Object",
    "Plain loop's best (dB)",
    "its loss",
    "after (s)",
    "ours at least there after (s)",
    "ratio",
    "ours at its end (dB)",
    "after (s)",
    "plain loop by then (dB)",
)
NEVER, UNKNOWN = "never", "-"
NOTE = (
    "Albedo: masked PSNR in sRGB after one factor for the object, all cameras, as in the multi-view table. The clock "
    "stands while it is measured. The plain loop's best is that of all its losses and measures; ratio: our seconds "
    "over its, to at least the same albedo. Ours runs first and so pays for kernels that both need."
)
COLOURS = ("#c2410c", "#2563eb", "#059669", "#7c3aed")


def finishes(races: Sequence[ObjectRace]) -> list[Finish]:
    """How each race ended."""
    return [finish(race.ours, race.loops) for race in races]


def ratio_text(found: Sequence[Finish]) -> str:
    """The sentence below the table."""
    reached, mean = sum(end.our_seconds is not None for end in found), geometric_mean([end.ratio for end in found])
    there = f"ours reaches the plain loop's best albedo on {reached} of {len(found)} objects"
    if not math.isfinite(mean):
        return f"Geometric mean of the ratios: none, since {there}."
    return f"Geometric mean of the ratios: {mean:.2f} (n = {len(found)}); {there}."


def race_table(races: Sequence[ObjectRace], protocol: Sequence[tuple[str, str]]) -> TextTable:
    """An object a row."""
    found = finishes(races)
    rows = tuple(
        (
            race.object,
            f"{end.target:.2f}",
            end.plain.rpartition(" ")[2],
            f"{end.plain_seconds:.1f}",
            NEVER if end.our_seconds is None else f"{end.our_seconds:.1f}",
            UNKNOWN if end.our_seconds is None else f"{end.ratio:.2f}",
            f"{end.our_end.psnr:.2f}",
            f"{end.our_end.seconds:.1f}",
            UNKNOWN if end.plain_then is None else f"{end.plain_then:.2f}",
        )
        for race, end in zip(races, found, strict=True)
    )
    notes = (ratio_text(found), NOTE, f"Protocol: {protocol_text(protocol)}.")
    return TextTable("Seconds to the same albedo", TITLES, (rows,), notes)


def to_json(races: Sequence[ObjectRace], protocol: Sequence[tuple[str, str]]) -> str:
    """Strict JSON: how each race ended, the mean, and all curves; what there is not is null."""
    found = finishes(races)
    mean = geometric_mean([end.ratio for end in found])
    content = {
        "protocol": dict(protocol),
        "geometric_mean_ratio": mean if math.isfinite(mean) else None,
        "objects": [
            {
                "object": race.object,
                "start_db": race.start,
                **asdict(end),
                "ratio": end.ratio if math.isfinite(end.ratio) else None,
                "curves": [asdict(curve) for curve in (race.ours, *race.loops)],
            }
            for race, end in zip(races, found, strict=True)
        ],
    }
    return json_text(content)


def draw(races: Sequence[ObjectRace]) -> bytes:
    """Albedo over seconds as a PNG, a panel for each of at least one object."""
    from matplotlib.figure import Figure

    across = min(len(races), 2)
    down = math.ceil(len(races) / across)
    figure = Figure(figsize=(5 * across, 3.2 * down), layout="constrained")
    panels = figure.subplots(down, across, squeeze=False).ravel()
    for axes, race in zip(panels, races, strict=False):
        for colour, curve in zip(COLOURS, (race.ours, *race.loops), strict=False):
            seconds, values = zip(*((point.seconds, point.psnr) for point in curve.points), strict=True)
            axes.plot(seconds, values, color=colour, marker=".", markersize=3, label=curve.name)
        axes.axhline(race.start, color="0.6", linestyle=":", linewidth=1, label="grey start")
        target = finish(race.ours, race.loops).target
        axes.axhline(target, color="0.3", linestyle="--", linewidth=0.8, label="plain loop's best")
        axes.set_title(race.object, fontsize=9)
        axes.set_xlim(left=0)
        axes.set_xlabel("seconds of work")
        axes.set_ylabel("albedo PSNR, aligned (dB)")
        axes.grid(alpha=0.2)
    for axes in panels[len(races) :]:
        axes.axis("off")
    panels[0].legend(fontsize=8)
    picture = io.BytesIO()
    figure.savefig(picture, format="png", dpi=110, metadata={"Software": None})
    return picture.getvalue()
