"""The noise ceiling: no measured row may exceed it."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

from unirender_evaluation.claims import CEILING
from unirender_evaluation.comparisons import Selection
from unirender_evaluation.records import Record
from unirender_evaluation.statistics import FEWEST, paired_difference


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
    for table, protocol in _bounded(records):
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


def _bounded(records: Sequence[Record]) -> list[tuple[str, str]]:
    """Table and protocol of every question that has a ceiling."""
    return list(dict.fromkeys((r.table, r.protocol) for r in records if r.method == CEILING))


def ceiling_lines(records: Sequence[Record]) -> list[str]:
    """What the verdict says: the breaches, or in which tables there is none, and of which nothing is told."""
    if breaches := ceiling_breaches(records):
        return [f"  FAILS  {breach}" for breach in breaches]
    told, untold, lines = [], [], []
    for table, protocol in _bounded(records):
        bound = [r for r in Selection(table, protocol).of(records) if r.method == CEILING]
        enough = len({r.object for r in bound}) >= FEWEST
        (told if enough else untold).append(f"{table}/{protocol}")
    if told:
        within = "no measured row exceeds the noise ceiling by more than its interval"
        lines.append(f"  HOLDS  {within} ({', '.join(told)})")
    if untold:
        nothing = f"nothing is told of fewer than {FEWEST} objects"
        lines.append(f"  open   noise ceiling: {nothing} ({', '.join(untold)})")
    return lines or ["  open   noise ceiling: these results have no row of it, which a row could exceed"]
