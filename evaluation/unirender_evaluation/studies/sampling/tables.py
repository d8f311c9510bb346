"""The tables of the sampling study: figures by steps and samples, and calibration by map."""

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

from unirender_evaluation.metrics import DEFAULT_VARIANT
from unirender_evaluation.multiview.tables import plain_column
from unirender_evaluation.records import Record
from unirender_evaluation.statistics import INTERVAL, Estimate, unprinted_note
from unirender_evaluation.studies.cells import as_json, estimate
from unirender_evaluation.studies.sampling.calibration import CONFIDENCE, MAPS, Calibration, Pooled, pool
from unirender_evaluation.studies.sampling.measure import DECOMPOSE, MEAN, RENDER, Setting
from unirender_evaluation.tables.formats import MISSING, estimate_text, format_number, header, json_number, json_text
from unirender_evaluation.tables.protocol import protocol_text
from unirender_evaluation.tables.text import TextTable

DIGITS = 3

Protocol = Sequence[tuple[str, str]]


COLUMNS = (
    plain_column("albedo", "albedo", "psnr"),
    plain_column("normal", "normal", "cosine"),
    plain_column("roughness", "roughness", "mse"),
    plain_column("metallic", "metallic", "mse"),
    plain_column("render", RENDER, "psnr"),
)
QUALITY_NOTE = (
    "Albedo, normal, roughness, metallic: `decompose` of the picture, the network's own maps (not closed). Render: "
    "`render` of the true maps of one of the suite's edits, s and d among them. The mean of the samples is scored, "
    f"inside the true mask, weighted by coverage. Mean over pictures ± half of the {INTERVAL}."
)
CALIBRATION_NOTE = (
    "s: standard deviation of a pixel's N samples (N - 1 in the denominator). Ratio: RMS error of their mean over the "
    "RMS of s sqrt(1 + 1/N); 1 is calibrated, above 1 too sure. Coverage: share of true values inside mean ± q s "
    f"sqrt(1 + 1/N), q from Student's t with N - 1 degrees of freedom; {CONFIDENCE:.2f} for normal distributions. "
    "Rank: Spearman's correlation of spread and error, between the pixels of a scene (mean over scenes) and between "
    "scenes; s is itself an estimate from N samples, which lowers both. A dash: one value for all pixels."
)
UNITS_NOTE = (
    "Albedo, specular and diffuse as display values (clipped, sRGB), normals by component, environment as ln(x + 0.01) "
    "weighted by solid angle, the others by coverage. n: scenes; the suite has s for some materials only."
)


def calibrations(records: Sequence[Record], setting: Setting, name: str) -> list[Calibration]:
    """Those of one map, a scene each."""
    own = [record.values for record in records if record.method == setting.key and record.protocol == DECOMPOSE]
    return [found for values in own if (found := Calibration.of_values(name, values)) is not None]


def headline(settings: Sequence[Setting]) -> Setting | None:
    """The setting whose calibration is shown whole: most steps, most samples; None where none has a spread."""
    return max((s for s in settings if s.samples > 1), key=lambda s: (s.samples, s.steps), default=None)


def tables(records: Sequence[Record], settings: Sequence[Setting], protocol: Protocol) -> list[TextTable]:
    """Figures by setting; calibration of the most steps and samples; the ratio by steps."""
    shown = headline(settings)
    line = f"Protocol: {protocol_text(protocol)}."
    made = [quality_table(records, settings)]
    if shown is not None:
        made += [calibration_table(records, shown), ratio_table(records, settings, shown.samples)]
    last = made.pop()
    return [*made, TextTable(last.title, last.columns, last.sections, (*last.notes, line))]


def quality_table(records: Sequence[Record], settings: Sequence[Setting]) -> TextTable:
    """A setting a row; a section for each number of samples."""

    def row(setting: Setting) -> tuple[str, ...]:
        found = [(column, estimate(records, setting.key, column.key(DEFAULT_VARIANT))) for column in COLUMNS]
        cells = (estimate_text(value, column.metric.decimals) for column, value in found)
        return (setting.mode, f"{setting.steps}", f"{setting.samples}", *cells)

    sampled = [setting for setting in settings if setting != MEAN]
    counts = sorted({setting.samples for setting in sampled})
    sections = [tuple(row(s) for s in settings if s == MEAN)]
    sections += [tuple(row(s) for s in sampled if s.samples == count) for count in counts]
    note = unprinted_note(estimate(records, s.key, c.key(DEFAULT_VARIANT)) for s in settings for c in COLUMNS)
    titles = ("mode", "steps", "samples", *(f"{column.group} {header(column)}" for column in COLUMNS))
    return TextTable(f"Steps and samples: n = {_scenes(records)}", titles, tuple(sections), (QUALITY_NOTE, *note))


def calibration_table(records: Sequence[Record], setting: Setting) -> TextTable:
    """A map a row."""
    rows = []
    means: list[Estimate | None] = []
    for name in MAPS:
        if not (found := calibrations(records, setting, name)):
            continue
        pooled = pool(found)
        own = [estimate(records, setting.key, f"{name}.spread.{key}") for key in ("coverage", "rank")]
        means += own
        rows.append(
            (
                name,
                f"{pooled.rms_error:.{DIGITS}f}",
                f"{pooled.rms_spread:.{DIGITS}f}",
                format_number(pooled.ratio, 2),
                *(estimate_text(mean, 2) for mean in own),
                MISSING if pooled.rank_scenes is None else f"{pooled.rank_scenes:.2f}",
                str(len(found)),
            )
        )
    titles = (
        "map",
        "RMS error",
        "RMS s",
        "ratio",
        f"coverage of {CONFIDENCE:.0%}",
        "rank, pixels",
        "rank, scenes",
        "n",
    )
    title = f"Calibration of mode sample, {setting.steps} steps, {setting.samples} samples: n = {_scenes(records)}"
    return TextTable(title, titles, (tuple(rows),), (CALIBRATION_NOTE, UNITS_NOTE, *unprinted_note(means)))


def ratio_table(records: Sequence[Record], settings: Sequence[Setting], samples: int) -> TextTable:
    """A map a row, a number of steps a column."""
    own = [setting for setting in settings if setting != MEAN and setting.samples == samples]
    rows = []
    for name in MAPS:
        found = [calibrations(records, setting, name) for setting in own]
        if any(found):
            rows.append((name, *(format_number(pool(one).ratio, 2) if one else MISSING for one in found)))
    titles = ("map", *(f"{setting.steps} step{'s' * (setting.steps > 1)}" for setting in own))
    title = f"Ratio of error to spread by steps, {samples} samples: n = {_scenes(records)}"
    return TextTable(title, titles, (tuple(rows),))


def to_json(records: Sequence[Record], settings: Sequence[Setting], protocol: Protocol) -> str:
    """Strict JSON: protocol, means with intervals, calibration of every setting with a spread."""
    quality = {
        setting.key: {
            column.key(DEFAULT_VARIANT): as_json(estimate(records, setting.key, column.key(DEFAULT_VARIANT)))
            for column in COLUMNS
        }
        for setting in settings
    }
    calibration: dict[str, Any] = {}
    for setting in settings:
        found = {name: one for name in MAPS if (one := calibrations(records, setting, name))}
        if found:
            calibration[setting.key] = {
                name: _pooled(pool(one))
                | {key: as_json(estimate(records, setting.key, f"{name}.spread.{key}")) for key in ("coverage", "rank")}
                for name, one in found.items()
            }
    content = {
        "protocol": dict(protocol),
        "settings": {setting.key: asdict(setting) for setting in settings},
        "quality": quality,
        "calibration": calibration,
    }
    return json_text(content)


def _scenes(records: Sequence[Record]) -> int:
    return len({record.sample for record in records})


def _pooled(pooled: Pooled) -> dict[str, Any]:
    return asdict(pooled) | {"ratio": json_number(pooled.ratio)}
