"""The light table: how near the light that a method finds in one picture is to the true one."""

from unirender_evaluation.light_balls import GLOSSY, GLOSSY_BALL, MATTE_BALL
from unirender_evaluation.light_metrics import PEAK_ANGLE, SCALED_LOG_RMSE
from unirender_evaluation.metrics import METRICS, Metric
from unirender_evaluation.tables.specs import Column, TableSpec
from unirender_evaluation.task import LIGHT


def _column(group: str, quantity: str, metric: Metric, **overrides: str) -> Column:
    return Column(group, quantity, metric, overrides, published=False)


LIGHT_TABLE = TableSpec(
    LIGHT[0],
    "Light",
    (
        _column("Environment", "environment", SCALED_LOG_RMSE),
        _column("Environment", "environment", PEAK_ANGLE),
        _column("Matte ball", MATTE_BALL, METRICS["rmse_relative"], scale="raw"),
        _column("Matte ball (aligned)", MATTE_BALL, METRICS["rmse_relative"], scale="aligned"),
        _column("Glossy ball", GLOSSY_BALL, METRICS["rmse_relative"], scale="raw"),
        _column("Glossy ball (aligned)", GLOSSY_BALL, METRICS["rmse_relative"], scale="aligned"),
    ),
    (LIGHT[1],),
    "One image in; the light out, as a lat-long map in camera axes; log-RMSE with one free factor. Balls: a white "
    f"matte one and a glossy one (F = 1, roughness {GLOSSY:g}) under the light found, against those under the true "
    "one, linear and not clipped. Aligned: one least-squares factor for each ball, since one picture does not tell the "
    "light's level from the albedo's.",
)
