"""The verdict: which claims about the rows hold on this run, by the paired bootstrap 95 % interval."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

from unirender_evaluation.comparisons import Comparison, Selection, compare
from unirender_evaluation.metrics import METRICS, Variant, metric_key
from unirender_evaluation.records import Record, RunInfo
from unirender_evaluation.statistics import paired_difference

MASKED = Variant("masked", "srgb", "raw")


@dataclass(frozen=True)
class Claim:
    """`a` against `b` on one number. `expected`: "beats" is a claim, "stated" only states the distance."""

    table: str
    protocol: str
    quantity: str
    metric: str
    a: str
    b: str
    expected: str = "beats"

    @property
    def key(self) -> str:
        return metric_key(self.quantity, METRICS[self.metric], MASKED)


@dataclass(frozen=True)
class Finding:
    """A claim with its comparison: None where a row has no such value. `holds` is None for a distance that is only
    stated, and where nothing was compared."""

    claim: Claim
    comparison: Comparison | None
    holds: bool | None

    def __str__(self) -> str:
        c = self.claim
        if self.comparison is None:
            what = f"{c.table}/{c.protocol} {c.quantity} {METRICS[c.metric].label}"
            return f"not run {what}: {c.a} against {c.b}"
        d = self.comparison.difference
        sign = {True: "HOLDS", False: "FAILS", None: "stated"}[self.holds]
        unit = METRICS[c.metric].unit
        return (
            f"{sign:7s}{c.table}/{c.protocol} {c.quantity} {METRICS[c.metric].label}: "
            f"{c.a} {self.comparison.verdict} {c.b}, "
            f"difference {d.mean:+.4g} [{d.low:+.4g}, {d.high:+.4g}] {unit} (n {d.n}, {d.clusters} objects)"
        )


OURS, ANCHORED = "ours-mean", "ours-mean-anchored"
PLAIN_COMPOSITE, ANCHORED_COMPOSITE = "composite-of-ours-mean", "composite-of-ours-mean-anchored"
CLAIMS: tuple[Claim, ...] = (
    *(
        Claim("rendering", "from-image", quantity, "psnr", row, "unedited-input")
        for row in (OURS, ANCHORED)
        for quantity in ("edit_metallic", "edit_roughness")
    ),
    *(
        Claim("rendering", "from-image", quantity, "psnr", a, b, "stated")
        for a, b in ((OURS, PLAIN_COMPOSITE), (ANCHORED, ANCHORED_COMPOSITE))
        for quantity in ("edit_metallic", "edit_roughness")
    ),
    *(
        Claim("rendering", protocol, quantity, "psnr", OURS, "composite", "stated")
        for protocol in ("given", "given-light")
        for quantity in ("edit_metallic", "edit_roughness")
    ),
    Claim("inverse", "single-image", "albedo", "psnr", OURS, "input-as-albedo"),
    Claim("inverse", "single-image", "albedo", "psnr", OURS, "mean-albedo"),
    Claim("inverse", "single-image", "normal", "cosine", OURS, "mean-normal"),
    Claim("inverse", "single-image", "normal", "cosine", OURS, "sphere-normal"),
    Claim("inverse", "single-image", "metallic", "mse", OURS, "constant-0-5"),
    Claim("inverse", "single-image", "roughness", "mse", OURS, "constant-0-5"),
    *(
        Claim("relighting", protocol, "relit", "psnr", row, "unedited-input")
        for protocol in ("from-image-sd", "from-image-hdri")
        for row in (OURS, ANCHORED)
    ),
)


def findings(records: Sequence[Record], claims: Sequence[Claim] = CLAIMS) -> list[Finding]:
    """Every claim; without a comparison where one of its two rows is not in the records."""
    found = []
    for claim in claims:
        chosen = Selection(claim.table, claim.protocol).of(records)
        present = {record.method for record in chosen if claim.key in record.values}
        if {claim.a, claim.b} <= present:
            comparison = compare(chosen, METRICS[claim.metric], claim.key, claim.a, claim.b)
            found.append(Finding(claim, comparison, comparison.a_beats_b if claim.expected == "beats" else None))
        else:
            found.append(Finding(claim, None, None))
    return found


@dataclass(frozen=True)
class CeilingBreach:
    """A measured row above the noise ceiling by more than its interval: the truth or the scorer is wrong."""

    table: str
    protocol: str
    key: str
    method: str
    low_db: float

    def __str__(self) -> str:
        where = f"{self.table}/{self.protocol} {self.key}"
        if math.isinf(self.low_db):
            return f"{self.method} returns the noisy truth itself on {where}: infinite PSNR against a finite ceiling"
        return f"{self.method} exceeds the noise ceiling on {where} by at least {self.low_db:.2f} dB"


def ceiling_breaches(
    records: Sequence[Record], ceiling: str = "noise-ceiling", exempt: Sequence[str] = ()
) -> list[CeilingBreach]:
    """Rows whose paired interval against the noise ceiling lies above 0; empty in a sound benchmark.

    An infinite score against a finite ceiling has no interval and is a breach by itself. Samples whose truth has no
    noise have an infinite ceiling, which nothing breaches.
    """
    breaches = []
    for table, protocol in dict.fromkeys((r.table, r.protocol) for r in records if r.method == ceiling):
        chosen = Selection(table, protocol).of(records)
        clusters = {r.sample: r.object for r in chosen}
        bound = [r for r in chosen if r.method == ceiling]
        for key in sorted({key for r in bound for key in r.values}):
            limit = {r.sample: r.values[key] for r in bound if math.isfinite(r.values.get(key, math.inf))}
            for method in sorted({r.method for r in chosen} - {ceiling, *exempt}):
                rows = (r for r in chosen if r.method == method and key in r.values and r.sample in limit)
                values = {r.sample: r.values[key] for r in rows}
                if not values:
                    continue  # no sample in common: the row was not asked, or no truth here has noise
                infinite = math.inf in values.values()
                low = math.inf if infinite else paired_difference(values, limit, clusters).low
                if low > 0:
                    breaches.append(CeilingBreach(table, protocol, key, method, low))
    return breaches


def verdict_text(records: Sequence[Record], run: RunInfo, check: dict) -> str:
    """The verdict section: claims, ceiling, truth check; one line each."""
    lines = [f"Verdict on suite {run.suite} (masked, sRGB, unaligned; paired bootstrap 95 % intervals over objects)"]
    lines += [f"  {finding}" for finding in findings(records)]
    breaches = ceiling_breaches(records)
    lines += [f"  FAILS  {breach}" for breach in breaches] or [
        "  HOLDS  no measured row exceeds the noise ceiling by more than its interval"
    ]
    state = "HOLDS" if check["passed"] else "FAILS"
    lines.append(
        f"  {state}  truth: {check['members']} members rendered again with other seeds agree with the shipped file "
        f"(check seed {check['seed']}, smallest pass share {check['smallest_pass_share']:.3f}), "
        f"{check['geometries']} objects' mask, albedo and normal too; "
        f"twins (roughness, albedo, normal off) detected: {check['twin_detected']}"
    )
    lines += [f"         {line}" for line in check["failed"]]
    if check["failed"] and check["other_objects"]:
        lines.append(
            f"         (the object generator makes other meshes of {', '.join(check['other_objects'])} "
            "than when the truth was made)"
        )
    if run.limit is not None:
        lines.append(f"  (--limit {run.limit}: a partial run, not a result)")
    return "\n".join(lines)
