"""The curve of an optimisation: every figure of its history that the eye can follow."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

LOSSES, FITS = ("loss",), ("psnr", "held_out_psnr")


def loss_curve(history: Sequence[Mapping[str, Any]], path: Path) -> None:
    """Draws losses (logarithmic) and fits in dB over the steps of all stages, as a PNG.

    Args:
        history: lines of `history.jsonl`.
        path: the file.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8, 5), layout="constrained")
    upper, lower = figure.subplots(2, 1, sharex=True)
    for axes, names, label in ((upper, LOSSES, "loss"), (lower, FITS, "dB")):
        for name in names:
            points = [(k, line["values"][name]) for k, line in enumerate(history, 1) if name in line["values"]]
            if points:
                axes.plot(
                    *zip(*points, strict=True), label=name.replace("_", " "), marker="." if len(points) < 20 else ""
                )
        axes.set_ylabel(label)
    if upper.lines:
        upper.set_yscale("log")
    if lower.lines:
        lower.legend()
    begins = {line["stage"]: k for k, line in reversed(list(enumerate(history, 1)))}
    for stage, begin in begins.items():
        upper.annotate(stage, (begin, 1.01), xycoords=("data", "axes fraction"), fontsize=8)
        for axes in (upper, lower):
            axes.axvline(begin, color="0.8", linewidth=0.8, zorder=0)
    lower.set_xlabel("step")
    figure.savefig(path, format="png", dpi=110, metadata={"Software": None})
