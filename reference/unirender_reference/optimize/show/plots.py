"""The curve of an optimisation: every figure of its history that the eye can follow."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

# Figures of a step: those of one panel, and what its axis says. The transport stage has a cost and no loss.
COSTS, LOSSES, FITS = ("cost",), ("loss",), ("psnr", "held_out_psnr")
PANELS = (
    (COSTS, "cost of the\ntransport stage"),
    (LOSSES, "loss"),
    (FITS, "PSNR in dB, lowered\nby sampling noise"),
)
FEW = 20  # points that get a mark each


def loss_curve(history: Sequence[Mapping[str, Any]], path: Path) -> None:
    """Draws costs and losses (logarithmic) and fits in dB over the steps of all stages, as a PNG.

    A panel without a figure is left out. The fits are those of the steps: the noise of their samples lowers them,
    unlike the figures of the result.

    Args:
        history: lines of `history.jsonl`.
        path: the file.
    """
    from matplotlib.figure import Figure

    steps = list(enumerate(history, 1))
    panels = [panel for panel in PANELS if any(name in line["values"] for line in history for name in panel[0])]
    panels = panels or [PANELS[-1]]
    figure = Figure(figsize=(8, 1.2 + 2 * len(panels)), layout="constrained")
    rows = figure.subplots(len(panels), 1, sharex=True, squeeze=False)[:, 0]
    begins = {line["stage"]: k for k, line in reversed(steps)}
    for axes, (names, label) in zip(rows, panels, strict=True):
        for name in names:
            points = [(k, line["values"][name]) for k, line in steps if name in line["values"]]
            if points:
                marker = "." if len(points) < FEW else ""
                axes.plot(*zip(*points, strict=True), label=name.replace("_", " "), marker=marker)
        axes.set_ylabel(label)
        if names is not FITS:
            axes.set_yscale("log")
        elif axes.lines:
            axes.legend()
        for begin in begins.values():
            axes.axvline(begin, color="0.8", linewidth=0.8, zorder=0)
    for stage, begin in begins.items():
        rows[0].annotate(stage, (begin, 1.01), xycoords=("data", "axes fraction"), fontsize=8)
    rows[-1].set_xlabel("step")
    figure.savefig(path, format="png", dpi=110, metadata={"Software": None})
