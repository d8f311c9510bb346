"""The plots of the sampling study: PSNR over steps, and error over spread."""

import io
import math
from collections.abc import Sequence
from typing import Any

from unirender_evaluation.metrics import DEFAULT_VARIANT
from unirender_evaluation.records import Record
from unirender_evaluation.specs import Column
from unirender_evaluation.studies.sampling.calibration import MAPS, pool
from unirender_evaluation.studies.sampling.measure import MEAN, Setting
from unirender_evaluation.studies.sampling.tables import COLUMNS, calibrations, estimate

COLOURS = ("#2563eb", "#c2410c", "#059669", "#7c3aed", "#0891b2", "#be185d", "#4d7c0f")
PANELS = tuple(column for column in COLUMNS if column.metric.name == "psnr")
ASIDE = 1.03  # factor between two lines' places of the same step, so that their intervals do not cover each other
LEAST_SHARE = 0.002  # of all pixels: a bin with fewer says nothing


def draw_steps(records: Sequence[Record], settings: Sequence[Setting]) -> bytes:
    """PSNR over steps as a PNG, a line for each number of samples; mode `mean` is a dashed level."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(5 * len(PANELS), 3.4), layout="constrained")
    for axes, column in zip(figure.subplots(1, len(PANELS), squeeze=False)[0], PANELS, strict=True):
        _steps_panel(axes, records, settings, column)
    figure.axes[0].legend(fontsize=8)
    return _png(figure)


def _steps_panel(axes: Any, records: Sequence[Record], settings: Sequence[Setting], column: Column) -> None:
    key = column.key(DEFAULT_VARIANT)
    sampled = [setting for setting in settings if setting != MEAN]
    counts = sorted({setting.samples for setting in sampled})
    for index, count in enumerate(counts):
        own = [(s.steps, estimate(records, s.key, key)) for s in sampled if s.samples == count]
        points = [(steps, found) for steps, found in own if found is not None and math.isfinite(found.mean)]
        bars = [0.0 if math.isnan(found.half_width) else found.half_width for _, found in points]
        axes.errorbar(
            [steps * ASIDE ** (index - (len(counts) - 1) / 2) for steps, _ in points],
            [found.mean for _, found in points],
            yerr=bars,
            color=COLOURS[index % len(COLOURS)],
            marker=".",
            linewidth=1.2,
            elinewidth=0.6,
            label=f"sample, {count} sample{'s' * (count > 1)}",
        )
    level = estimate(records, MEAN.key, key)
    if level is not None and math.isfinite(level.mean):
        axes.axhline(level.mean, color="0.3", linestyle="--", linewidth=0.9, label="mean")
    steps = sorted({setting.steps for setting in sampled})
    axes.set_xscale("log")
    axes.set_xticks(steps, [str(number) for number in steps])
    axes.minorticks_off()
    axes.set_xlabel("steps")
    axes.set_ylabel(f"{column.group} PSNR, masked (dB)")
    axes.grid(alpha=0.2)


def draw_reliability(records: Sequence[Record], setting: Setting) -> bytes:
    """RMS error over RMS spread by the octave of the spread as a PNG, a line for each map; both in the map's units.

    The spread includes the factor sqrt(1 + 1/N). A calibrated model lies on the diagonal wherever its spread differs
    from pixel to pixel by more than N samples make it differ by chance.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(5.4, 4.6), layout="constrained")
    axes = figure.subplots()
    ends = []
    for index, name in enumerate(MAPS):
        found = calibrations(records, setting, name)
        if not found:
            continue
        bins = [bin_ for bin_ in pool(found).bins if bin_.variance > 0 and bin_.weight > LEAST_SHARE * len(found)]
        spread = [math.sqrt(bin_.variance / bin_.weight) for bin_ in bins]
        error = [math.sqrt(bin_.squared_error / bin_.weight) for bin_ in bins]
        ends += spread
        axes.plot(spread, error, color=COLOURS[index], marker=".", linewidth=1.2, label=name)
    if ends:
        axes.plot([min(ends), max(ends)], [min(ends), max(ends)], color="0.3", linestyle="--", linewidth=0.9)
        axes.set_xscale("log", base=2)
        axes.set_yscale("log", base=2)
        axes.legend(fontsize=8)
    axes.set_xlabel("RMS predicted spread")
    axes.set_ylabel("RMS error of the mean")
    axes.set_title(f"{setting.steps} steps, {setting.samples} samples; dashed: calibrated", fontsize=9)
    axes.grid(alpha=0.2)
    return _png(figure)


def _png(figure: Any) -> bytes:
    picture = io.BytesIO()
    figure.savefig(picture, format="png", dpi=110, metadata={"Software": None})
    return picture.getvalue()
