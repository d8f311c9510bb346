"""The plots of the sampling study: what steps and samples change of the PSNR, and error over spread."""

import io
import math
from collections.abc import Sequence
from typing import Any

from unirender_evaluation.records import Record
from unirender_evaluation.studies.cells import difference
from unirender_evaluation.studies.sampling.calibration import MAPS, Calibration, pool
from unirender_evaluation.studies.sampling.measure import MEAN, Setting
from unirender_evaluation.studies.sampling.tables import COLUMNS, calibrations
from unirender_evaluation.tables.specs import Column

COLOURS = ("#93c5fd", "#3b82f6", "#1e3a8a")  # from few samples to many
LINE, LEVEL = "#2563eb", {"color": "0.3", "linestyle": "--", "linewidth": 0.9}
PANELS = tuple(column for column in COLUMNS if column.metric.name == "psnr")
ASIDE = 1.05  # factor between two lines' places of the same step, so that their intervals do not cover each other
LEAST_SHARE = 0.01  # of all pixels: a bin with fewer says little
LEAST_SPREAD = 2.0**-8  # a spread below that is none: such bins stand at the edge
ACROSS = 4  # panels of maps in a row
DOT = 120.0  # area in points^2 of a bin that has all pixels
TICKS = (0.01, 0.1, 1.0)


def draw_steps(records: Sequence[Record], settings: Sequence[Setting]) -> bytes:
    """PSNR less that of mode `mean` over steps as a PNG, a line for each number of samples.

    Differences are paired by picture, as are their intervals: pictures differ far more than settings do. All panels
    have one axis, so that a quantity that no setting changes is a level line.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(4.6 * len(PANELS), 3.4), layout="constrained")
    panels = figure.subplots(1, len(PANELS), squeeze=False, sharey=True)[0]
    for axes, column in zip(panels, PANELS, strict=True):
        _steps_panel(axes, records, settings, column)
    panels[0].set_ylabel("PSNR - that of mode mean (dB)")
    if any(panels[0].containers):
        panels[0].legend(fontsize=8, loc="lower left", title="mode sample", title_fontsize=8)
    return _png(figure)


def _steps_panel(axes: Any, records: Sequence[Record], settings: Sequence[Setting], column: Column) -> None:
    """Draws the difference from mode `mean` over steps, a line for each number of samples."""
    sampled = [setting for setting in settings if setting != MEAN]
    counts = sorted({setting.samples for setting in sampled})
    for index, count in enumerate(counts):
        own = [(s.steps, difference(records, s.key, MEAN.key, column)) for s in sampled if s.samples == count]
        points = [(steps, found) for steps, found in own if found is not None]
        if not points:
            continue
        axes.errorbar(
            [steps * ASIDE ** (index - (len(counts) - 1) / 2) for steps, _ in points],
            [found.mean for _, found in points],
            yerr=[0.0 if math.isnan(found.half_width) else found.half_width for _, found in points],
            color=COLOURS[min(index, len(COLOURS) - 1)],
            marker="o",
            markersize=4,
            linewidth=1.4,
            elinewidth=0.9,
            label=f"{count} sample{'s' * (count > 1)}",
        )
    steps = sorted({setting.steps for setting in sampled})
    axes.axhline(0, **LEVEL)
    axes.set_xscale("log")
    axes.set_xticks(steps, [str(number) for number in steps])
    axes.minorticks_off()
    axes.set_xlabel("steps")
    axes.set_title(column.group, fontsize=10)
    axes.grid(alpha=0.2)


def draw_reliability(records: Sequence[Record], setting: Setting) -> bytes:
    """RMS error over RMS spread by the octave of the spread as a PNG, a panel for each map, all of one scale.

    The spread includes the factor sqrt(1 + 1/N). A calibrated model lies on the diagonal wherever its spread differs
    from pixel to pixel by more than N samples make it differ by chance. A dot's area is the share of the pixels.
    """
    from matplotlib.figure import Figure

    shown = {name: found for name in MAPS if (found := calibrations(records, setting, name))}
    down = max(1, math.ceil(len(shown) / ACROSS))
    figure = Figure(figsize=(2.3 * ACROSS, 2.3 * down + 0.8), layout="constrained")
    panels = figure.subplots(down, ACROSS, squeeze=False, sharex=True, sharey=True).ravel()
    most = max(map(len, shown.values()), default=0)
    for axes, (name, found) in zip(panels, shown.items(), strict=False):
        _reliability_panel(axes, found)
        axes.set_title(name if len(found) == most else f"{name} ({len(found)} of {most} scenes)", fontsize=10)
    for axes in panels[len(shown) :]:
        axes.axis("off")
    for axes in panels[max(0, len(shown) - ACROSS) : len(shown)]:
        axes.tick_params(labelbottom=True)  # the lowest of each column
    if shown:
        _one_scale(list(panels[: len(shown)]))
    figure.supxlabel("RMS predicted spread", fontsize=10)
    figure.supylabel("RMS error of the mean", fontsize=10)
    asked = f"{setting.steps} step{'s' * (setting.steps > 1)}, {setting.samples} sample{'s' * (setting.samples > 1)}"
    figure.suptitle(f"{asked}; on the dashed line: calibrated, above it: too sure", fontsize=10)
    return _png(figure)


def _reliability_panel(axes: Any, found: Sequence[Calibration]) -> None:
    bins = [bin_ for bin_ in pool(found).bins if bin_.weight >= LEAST_SHARE * len(found)]
    spread = [max(math.sqrt(bin_.variance / bin_.weight), LEAST_SPREAD) for bin_ in bins]
    error = [math.sqrt(bin_.squared_error / bin_.weight) for bin_ in bins]
    axes.plot(spread, error, color=LINE, linewidth=1.2)
    axes.scatter(spread, error, s=[DOT * bin_.weight / len(found) for bin_ in bins], color=LINE, alpha=0.6)
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.grid(alpha=0.2)


def _one_scale(panels: Sequence[Any]) -> None:
    """The same square of spread and error for all panels, with its diagonal and decimal ticks."""
    low = min(min(axes.get_xlim()[0], axes.get_ylim()[0]) for axes in panels)
    high = max(max(axes.get_xlim()[1], axes.get_ylim()[1]) for axes in panels)
    ticks = [tick for tick in TICKS if low <= tick <= high]
    for axes in panels:
        axes.plot([low, high], [low, high], **LEVEL)
        axes.set(xlim=(low, high), ylim=(low, high), aspect="equal")
        axes.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
        axes.set_yticks(ticks, [f"{tick:g}" for tick in ticks])
        axes.minorticks_off()


def _png(figure: Any) -> bytes:
    picture = io.BytesIO()
    figure.savefig(picture, format="png", dpi=110, metadata={"Software": None})
    return picture.getvalue()
