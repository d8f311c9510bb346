"""A small report: three rows on six samples, two cards."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from unirender_evaluation.light_balls import GLOSSY_BALL, MATTE_BALL
from unirender_evaluation.metrics import Variant, metric_key
from unirender_evaluation.records import MethodInfo, Record, RunInfo
from unirender_evaluation.report.gallery import GalleryItem
from unirender_evaluation.report.page import write_report
from unirender_evaluation.report.samples import make_sheets
from unirender_evaluation.tables.build import build_tables
from unirender_evaluation.task import LIGHT

SIZE = 24
LONG = "Learned_inverse_rendering_with_transformer_priors_and_differentiable_path_tracing_v2.1"  # nowhere to break
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


VERDICT = """Verdict on suite tiny (paired 95 % intervals over objects)
  HOLDS  inverse/single-image albedo PSNR: ours beats input, difference +8 [+7, +9] dB (n 6, 3 objects)
  FAILS  ours exceeds the noise ceiling on <this> by at least 0.10 dB
  stated inverse/single-image albedo PSNR: ours is not told from input
  not run inverse/single-image normal cos: ours against mean-normal
         (a line that goes on)
"""


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


LIGHTS = replace(
    RUN,
    methods=(MethodInfo("lamp", "Lamp finder", "external"), MethodInfo("uniform-light", "Uniform light", "trivial")),
)


def light_records() -> list[Record]:
    """Of a stranger that finds lights and nothing else, and of a trivial row; by aligned numbers the stranger wins, by
    the raw ones it loses."""
    ball = {ball: {s: metric_key(ball, "rmse_relative", Variant(scale=s)) for s in ("raw", "aligned")}
            for ball in (MATTE_BALL, GLOSSY_BALL)}  # fmt: skip
    made = []
    for method, aligned, raw, peak in (("lamp", 0.2, 0.9, 10.0), ("uniform-light", 0.6, 0.5, 90.0)):
        for i in range(6):
            values = {"environment.log_rmse_scaled": aligned + i / 100, "environment.peak_deg": peak + i}
            values |= {keys["aligned"]: aligned + i / 50 for keys in ball.values()}
            values |= {keys["raw"]: raw + i / 50 for keys in ball.values()}
            made.append(Record(*LIGHT, method, f"s{i}", f"o{i // 2}", values))
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


def write_page(folder: Path, label: str | None = None) -> Path:
    """The report with everything in it: tables, plots, cards, samples and their sheets; `label`: of our row."""
    made, items = records(), [item("s5", 6, "best"), item("s0", 1, "worst")]
    ours, *others = RUN.methods
    run = replace(RUN, methods=(replace(ours, label=label or ours.label), *others))
    return write_report(
        folder / "report.html", build_tables(made, run), items, run, made, sheets=make_sheets(items), verdict=VERDICT
    )
