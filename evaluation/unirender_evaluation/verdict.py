"""The verdict: which claims about the rows hold on this run, by the paired 95 % interval."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

from unirender_evaluation.claims import CEILING, OUR_CLAIMS, Claim, run_claims
from unirender_evaluation.comparisons import Comparison, Selection, compare, values_of
from unirender_evaluation.records import Record, RunInfo
from unirender_evaluation.statistics import FEW, holm, paired_difference, paired_p_value
from unirender_evaluation.task import LIGHT


@dataclass(frozen=True)
class Finding:
    """A claim with its comparison: None where a row has no such value. `holds` is None for a distance that is only
    stated, for one object, and where nothing was compared, for the reason `why`. `asked`: on how many samples any row
    has this number, since a row may answer the easy ones alone."""

    claim: Claim
    comparison: Comparison | None
    holds: bool | None
    why: str = "not run "
    asked: int = 0

    @property
    def is_open(self) -> bool:
        """Whether it does not hold, nor its opposite, on fewer than `FEW` objects: more of them may decide it."""
        found = self.comparison
        return self.holds is False and found is not None and not found.b_beats_a and found.difference.clusters < FEW

    def __str__(self) -> str:
        c = self.claim
        if self.comparison is None:
            what = f"{c.table}/{c.protocol} {c.quantity} {c.kind.label}{_scale(c)}"
            return f"{self.why}{what}: {c.a} against {c.b}"
        d = self.comparison.difference
        sign = "open" if self.is_open else {True: "HOLDS", False: "FAILS", None: "stated"}[self.holds]
        unit = c.kind.unit
        remark = f"; {c.remark}" if c.remark else ""
        interval = f"[{d.low:+.4g}, {d.high:+.4g}] " if self.comparison.decided else ""  # one object has none
        objects = f"{d.clusters} object{'s' * (d.clusters != 1)}"
        n = f"{d.n} of {self.asked}" if d.n < self.asked else f"{d.n}"
        return (
            f"{sign:7s}{c.table}/{c.protocol} {c.quantity} {c.kind.label}{_scale(c)}: "
            f"{c.a} {self.comparison.verdict} {c.b}, "
            f"difference {d.mean:+.4g} {interval}{unit} (n {n}, {objects}{remark})"
        )


def _scale(claim: Claim) -> str:
    """How a number is aligned; that it is not is said of the light alone."""
    unsaid = "scale" not in claim.kind.axes or (claim.scale == "raw" and claim.table != LIGHT[0])
    return "" if unsaid else f" ({claim.scale})"


def findings(records: Sequence[Record], claims: Sequence[Claim] = OUR_CLAIMS) -> list[Finding]:
    """Every claim; without a comparison where its two rows share no sample, or where they are not to be compared: a
    picture that is the truth to the bit has an infinite PSNR."""
    found = []
    for claim in claims:
        chosen = Selection(claim.table, claim.protocol).of(records)
        a, b = (values_of(chosen, method, claim.key) for method in (claim.a, claim.b))
        common = a.keys() & b.keys()
        if common and all(math.isfinite(a[sample]) and math.isfinite(b[sample]) for sample in common):
            comparison = compare(chosen, claim.kind, claim.key, claim.a, claim.b)
            claimed = claim.expected == "beats" and comparison.decided
            asked = len({record.sample for record in chosen if claim.key in record.values})
            found.append(Finding(claim, comparison, comparison.a_beats_b if claimed else None, asked=asked))
        else:
            found.append(Finding(claim, None, None, "infinite PSNR, not compared " if common else "not run "))
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


def ceiling_breaches(records: Sequence[Record]) -> list[CeilingBreach]:
    """Rows whose paired PSNR interval against the noise ceiling lies above 0; empty in a sound benchmark.

    (The ceilings of SSIM and LPIPS are scores of a picture with a little noise of its own: a good row may pass them.)

    An infinite score against a finite ceiling has no interval and is a breach by itself. Samples whose truth has no
    noise have an infinite ceiling, which nothing breaches.
    """
    breaches = []
    for table, protocol in dict.fromkeys((r.table, r.protocol) for r in records if r.method == CEILING):
        chosen = Selection(table, protocol).of(records)
        clusters = {r.sample: r.object for r in chosen}
        bound = [r for r in chosen if r.method == CEILING]
        for key in sorted({key for r in bound for key in r.values if ".psnr" in key}):
            limit = {r.sample: r.values[key] for r in bound if math.isfinite(r.values.get(key, math.inf))}
            for method in sorted({r.method for r in chosen} - {CEILING}):
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
    head = (
        "masked, sRGB and unaligned, where nothing else is said; paired 95 % intervals over objects, under these "
        "lights, each by itself"
    )
    lines = [f"Verdict on suite {run.suite} ({head})"]
    found = findings(records, run_claims(records, run))
    lines += [f"  {finding}" for finding in found]
    lines += _corrected_lines(records, found)
    breaches = ceiling_breaches(records)
    lines += [f"  FAILS  {breach}" for breach in breaches] or [
        "  HOLDS  no measured row exceeds the noise ceiling by more than its interval"
    ]
    lines += _truth_lines(check)
    if run.limit is not None:
        lines.append(f"  (--limit {run.limit}: a partial run, not a result)")
    return "\n".join(lines)


def _corrected_lines(records: Sequence[Record], found: Sequence[Finding]) -> list[str]:
    """How many of the claims that hold would do so if all claims were one question; nothing where none holds."""
    claimed = [finding for finding in found if finding.holds is not None]
    sure = holm([_p_value(records, finding.claim) for finding in claimed])
    holding = [(f.claim, certain) for f, certain in zip(claimed, sure, strict=True) if f.holds]
    if not holding:
        return []
    unsure = [
        f"{c.table}/{c.protocol} {c.quantity} {c.kind.label}{_scale(c)} of {c.a} against {c.b}"
        for c, certain in holding
        if not certain
    ]
    but = f"; not {', '.join(unsure)}" if unsure else ""
    return [
        f"  (of {len(holding)} claims that hold {len(holding) - len(unsure)} also do after Holm's correction for all "
        f"{len(claimed)}, by Student's t over objects{but})"
    ]


def _p_value(records: Sequence[Record], claim: Claim) -> float:
    chosen = Selection(claim.table, claim.protocol).of(records)
    a, b = (values_of(chosen, method, claim.key) for method in (claim.a, claim.b))
    return paired_p_value(a, b, {record.sample: record.object for record in chosen})


def _truth_lines(check: dict) -> list[str]:
    """What the truth check found, or why there was none."""
    if check["passed"] is None:
        return [f"  open   truth: not rendered again, {check['reason']}"]
    state = "HOLDS" if check["passed"] else "FAILS"
    agree = "differ from" if check["failed"] else "agree with"
    objects = f"{check['geometries']} object{'s' * (check['geometries'] != 1)}"
    lines = [
        f"  {state}  truth: {check['members']} members, and mask, albedo and normal of {objects}, "
        f"rendered again with other seeds {agree} the truth file (check seed {check['seed']}, {check['date']}, "
        f"smallest pass share {check['smallest_pass_share']:.3f}); {_twins_text(check)}"
    ]
    here, scenes = check["chosen_from"]
    if here < scenes:
        lines.append(f"         (chosen from {here} of {scenes} scenes: the meshes of the others are not here)")
    lines += [f"         {line}" for line in check["failed"]]
    if check["failed"] and check["other_objects"]:
        lines.append(
            f"         (the object generator makes other meshes of {', '.join(check['other_objects'])} "
            "than when the truth was made)"
        )
    return lines


def _twins_text(check: dict) -> str:
    """Whether the check found its deliberate errors; which it did not, with what may help."""
    if check["twin_detected"]:
        return "deliberate errors of roughness, albedo and normal were found"
    return "deliberate errors NOT found: " + "; ".join(f"{name} ({advice})" for name, advice in check["missed"].items())
