"""The multi-view table: its columns."""

from unirender_evaluation.light_metrics import PEAK_ANGLE, SCALED_LOG_RMSE
from unirender_evaluation.metrics import LOWER, METRICS, Metric
from unirender_evaluation.tables.specs import Column, TableSpec

PROTOCOL = "known-mesh"
SECONDS = Metric("seconds", "time", "s", LOWER, 0.0, (), 1, "wall clock of one object, optimisation only")
_IN_MASK = {"mask": "masked"}
_ALIGNED = {"scale": "aligned"}


def plain_column(group: str, quantity: str, metric: Metric | str, **overrides: str) -> Column:
    """A column of a metric, or of one of the benchmark's by its name; the paper has no number for it."""
    found = METRICS[metric] if isinstance(metric, str) else metric
    return Column(group, quantity, found, overrides, published=False)


MULTIVIEW_TABLE = TableSpec(
    "multi-view",
    "Multi-view inverse rendering",
    (
        plain_column("Albedo", "albedo", "psnr", scale="raw"),
        plain_column("Albedo (aligned)", "albedo", "psnr", **_ALIGNED),
        plain_column("Roughness", "roughness", "mse", **_IN_MASK),
        plain_column("Metallic", "metallic", "mse", **_IN_MASK),
        plain_column("Light", "environment", SCALED_LOG_RMSE),
        plain_column("Light", "environment", PEAK_ANGLE),
        plain_column("Relit", "relit", "psnr", scale="raw"),
        plain_column("Relit (aligned)", "relit", "psnr", **_ALIGNED),
        *(plain_column("Novel view", "novel", name) for name in ("psnr", "ssim", "lpips_vgg", "lpips_alex")),
        plain_column("Optimisation", "time", SECONDS),
    ),
    (PROTOCOL,),
    "Pictures of an object under one light in; textures and light out. Maps: all cameras. Relit (under the object's "
    "other light) and novel view: held-out cameras. Aligned: one least-squares factor in linear light, for albedo of "
    "the object, for relit of each picture (fitted before the clip), since albedo and light share an unknown one.",
)
