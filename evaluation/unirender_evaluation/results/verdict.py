"""`unirender bench verdict`: the claims of stored results, over objects and under other lights, in four formats."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from unirender_evaluation.ceiling import ceiling_breaches
from unirender_evaluation.comparisons import Lights
from unirender_evaluation.records import Record, RunInfo
from unirender_evaluation.table_list import ALL_TABLES
from unirender_evaluation.tables.formats import MISSING, json_number, json_text
from unirender_evaluation.tables.latex import text_latex
from unirender_evaluation.tables.specs import PROTOCOLS
from unirender_evaluation.tables.text import TextTable
from unirender_evaluation.verdict import HEAD, Finding, judged, scale_said, summary, verdict_text

COLUMNS = ("number", "A", "B", "A - B", "over objects", "under other lights", "n (objects, lights)")


def _text(run: RunInfo, records: Sequence[Record], lights: Lights) -> str:
    return verdict_text(records, run, None, lights) + "\n"


def _json(run: RunInfo, records: Sequence[Record], lights: Lights) -> str:
    found = judged(records, run, lights)
    content = {
        "suite": run.suite,
        "suite_hash": run.suite_hash,
        "limit": run.limit,
        "how": HEAD,
        "claims": [_plain(finding) for finding in found],
        "summary": summary(found),
        "ceiling_breaches": list(map(str, ceiling_breaches(records))),
    }
    return json_text(content)


def _plain(finding: Finding) -> dict[str, Any]:
    """A finding as JSON; what was not compared has no difference, of lights that are not known nothing is said."""
    claim, compared, over_lights = finding.claim, finding.comparison, finding.over_lights
    names = ("table", "protocol", "quantity", "metric", "scale", "a", "b", "expected", "remark")
    plain: dict[str, Any] = {name: getattr(claim, name) for name in names}
    if compared is None:
        return plain | {"state": finding.why.strip(" ,")}
    own = compared.difference
    plain |= {"state": finding.word.lower(), "difference": own.mean, "n": own.n, "asked": finding.asked}
    plain |= {"objects": own.clusters, "low": json_number(own.low), "high": json_number(own.high)}
    if over_lights is not None:
        ends = {"low": json_number(over_lights.low), "high": json_number(over_lights.high)}
        plain["other_lights"] = {"state": finding.other_lights, "lights": finding.lights, **ends}
    return plain


def claims_table(run: RunInfo, records: Sequence[Record], lights: Lights, stated: bool = True) -> TextTable:
    """The claims of a run that were compared, a row each; `stated`: and the distances that are only stated."""
    found = judged(records, run, lights)
    shown = [finding for finding in found if finding.comparison is not None and (stated or finding.holds is not None)]
    rows = tuple(_cells(run, finding) for finding in shown)
    summed = summary(found, lambda finding: "{}: {} against {}".format(*_names(run, finding)))
    limit = () if run.limit is None else (f"--limit {run.limit}: a partial run, not a result",)
    notes = (f"{HEAD}.", *(f"{line[0].upper()}{line[1:]}." for line in summed), *limit)
    return TextTable(f"Verdict on suite {run.suite}", COLUMNS, (rows,), notes)


def _names(run: RunInfo, finding: Finding) -> tuple[str, str, str]:
    """A claim's number and its rows, as tables call them."""
    claim, spec = finding.claim, ALL_TABLES[finding.claim.table]
    column = next(column for column in spec.columns if column.key(claim.variant) == claim.key)
    scale = "" if "scale" in column.overrides else scale_said(claim)  # which its group says
    title = f"{spec.title}, {PROTOCOLS[claim.protocol].label}"
    labels = {info.key: info.label for info in run.methods}
    a, b = (labels.get(key, key) for key in (claim.a, claim.b))  # a row that did not run has no label
    return f"{title}: {column.group} {claim.kind.label}{scale}", a, b


def _cells(run: RunInfo, finding: Finding) -> tuple[str, ...]:
    claim, compared, over_lights = finding.claim, finding.comparison, finding.over_lights
    if compared is None:
        return (*_names(run, finding), *[MISSING] * 4)
    own, unit = compared.difference, f" {claim.kind.unit}" if claim.kind.unit else ""
    alone = finding.word.lower() + (f" [{own.low:+.4g}, {own.high:+.4g}]" if compared.decided else "")
    other, counts = finding.other_lights or MISSING, f"{own.n} ({own.clusters}, {finding.lights or MISSING})"
    if over_lights is not None and other not in (MISSING, "not told"):
        other += f" [{over_lights.low:+.4g}, {over_lights.high:+.4g}]"
    return (*_names(run, finding), f"{own.mean:+.4g}{unit}", alone, other, counts)


def _markdown(run: RunInfo, records: Sequence[Record], lights: Lights) -> str:
    return claims_table(run, records, lights).markdown()


def _latex(run: RunInfo, records: Sequence[Record], lights: Lights) -> str:
    """Without the stated distances, with which it would be longer than a page."""
    return text_latex(claims_table(run, records, lights, stated=False), "verdict", names=3)


VERDICTS: Mapping[str, Callable[[RunInfo, Sequence[Record], Lights], str]] = {
    "text": _text,
    "markdown": _markdown,
    "latex": _latex,
    "json": _json,
}
