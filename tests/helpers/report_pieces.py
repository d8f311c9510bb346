"""A small report: three rows on six samples, two cards."""

from pathlib import Path

import numpy as np

from unirender_evaluation.gallery import GalleryItem
from unirender_evaluation.metrics import Variant, metric_key
from unirender_evaluation.records import MethodInfo, Record, RunInfo
from unirender_evaluation.report import write_report
from unirender_evaluation.report_samples import make_sheets
from unirender_evaluation.tables import build_tables

SIZE = 24
RUN = RunInfo(
    "tiny",
    "abcdef0123456789",
    SIZE,
    (
        MethodInfo("ours", "Ours <mean>", "ours", "Ours", 1, 1, 0),
        MethodInfo("input", "Input as albedo", "trivial"),
        MethodInfo("ceiling", "Noise ceiling", "ceiling"),
    ),
    lpips=("alex",),
    limit=2,
)


def mask() -> np.ndarray:
    y, x = np.mgrid[0:SIZE, 0:SIZE] - (SIZE - 1) / 2
    return np.clip(9 - np.hypot(y, x), 0, 1).astype(np.float32)[..., None]


def records() -> list[Record]:
    made = []
    for method, level in (("ours", 20.0), ("input", 12.0), ("ceiling", 45.0)):
        for i in range(6):
            values = {metric_key("albedo", "psnr", Variant(m)): level + i for m in ("masked", "whole")}
            made.append(Record("inverse", "single-image", method, f"s{i}", f"o{i // 2}", values))
    return made


def item(sample: str, place: int = 1, rank: str = "") -> GalleryItem:
    rng = np.random.default_rng(0)
    truth, other = rng.random((2, SIZE, SIZE, 3), dtype=np.float32)
    maps = {"albedo": truth, "normal": other}
    return GalleryItem(
        "inverse", "single-image", sample, f"caption {sample}", mask(), {"image": other}, maps,
        {"ours": maps, "input": {"albedo": other}}, {"ours": {"albedo": "20.0 dB"}},
        question=f"question {sample}", rank=rank, place=place, count=6, leader="ours", figure=f"PSNR {place} dB",
    )  # fmt: skip


def write_page(folder: Path) -> Path:
    """The report with everything in it: tables, plots, cards, samples and their sheets."""
    made, items = records(), [item("s5", 6, "best"), item("s0", 1, "worst")]
    sheets = make_sheets(items)
    return write_report(folder / "report.html", build_tables(made, RUN), items, RUN, made, sheets=sheets)
