"""The noise ceiling: no measured row may exceed it."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from unirender_evaluation.claims import CEILING
from unirender_evaluation.comparisons import Selection
from unirender_evaluation.records import Record
from unirender_evaluation.statistics import FEWEST, paired_difference

LEAST_DB = 0.5  # the mean of PSNRs lies above the PSNR of a mean error: a perfect renderer reached 0.04


@dataclass(frozen=True)
class Margin:
    """By how much a measured row exceeds the noise ceiling at least: its paired interval's lower end.

    Above `LEAST_DB` the row was told the truth, or the truth or the scorer is wrong. NaN, and nothing is told, where
    fewer than `FEWEST` objects have both.
    """

    table: str
    protocol: str
    key: str
    method: str
    low_db: float

    @property
    def breaks(self) -> bool:
        return self.low_db > LEAST_DB

    def __str__(self) -> str:
        where = f"{self.table}/{self.protocol} {self.key}"
        if math.isinf(self.low_db):
            return f"{self.method} returns the noisy truth itself on {where}: infinite PSNR against a finite ceiling"
        return f"{self.method} exceeds the noise ceiling on {where} by at least {self.low_db:.2f} dB"


def ceiling_breaches(records: Sequence[Record]) -> list[Margin]:
    """Rows whose paired PSNR interval against the noise ceiling lies above `LEAST_DB`; empty in a sound benchmark.

    (The ceilings of SSIM and LPIPS are scores of a picture with a little noise of its own: a good row may pass them.)

    An infinite score against a finite ceiling has no interval and is a breach by itself. Samples whose truth has no
    noise have an infinite ceiling, which nothing breaches.
    """
    return [margin for question in _bounded(records) for margin in _margins(records, *question) if margin.breaks]


def _bounded(records: Sequence[Record]) -> list[tuple[str, str]]:
    """Table and protocol of every question that has a ceiling."""
    return list(dict.fromkeys((r.table, r.protocol) for r in records if r.method == CEILING))


def _margins(records: Sequence[Record], table: str, protocol: str) -> Iterator[Margin]:
    """Of every row on every PSNR that it shares with the ceiling."""
    chosen = Selection(table, protocol).of(records)
    for key in sorted({key for r in chosen if r.method == CEILING for key in r.values if ".psnr" in key}):
        yield from margins_of(chosen, key)


def margins_of(chosen: Sequence[Record], key: str) -> Iterator[Margin]:
    """Of every row on one PSNR; `chosen` is one `Selection`."""
    clusters = {r.sample: r.object for r in chosen}
    bound = (r for r in chosen if r.method == CEILING)
    limit = {r.sample: r.values[key] for r in bound if math.isfinite(r.values.get(key, math.inf))}
    for method in sorted({r.method for r in chosen} - {CEILING}):
        rows = [r for r in chosen if r.method == method and key in r.values and r.sample in limit]
        values = {r.sample: r.values[key] for r in rows}
        if not values:
            continue  # no sample in common: the row was not asked, or no truth here has noise
        infinite = math.inf in values.values()
        low = math.inf if infinite else paired_difference(values, limit, clusters).low
        yield Margin(rows[0].table, rows[0].protocol, key, method, low)


def ceiling_lines(records: Sequence[Record]) -> list[str]:
    """What the verdict says: the breaches, in which tables there is no other, and of which rows nothing is told."""
    breaches, told, untold = [], [], []
    for table, protocol in _bounded(records):
        margins = list(_margins(records, table, protocol))
        breaches += [f"  FAILS  {margin}" for margin in margins if margin.breaks]
        few = list(dict.fromkeys(margin.method for margin in margins if math.isnan(margin.low_db)))
        if any(not math.isnan(margin.low_db) for margin in margins):
            told.append(f"{table}/{protocol}")
        if few:
            untold.append(f"{table}/{protocol} {', '.join(few)}")
    lines = list(breaches)
    if told:
        other = "other " if breaches else ""
        within = f"no {other}measured row exceeds the noise ceiling by half a dB beyond its interval"
        lines.append(f"  HOLDS  {within} ({', '.join(told)})")
    if untold:
        nothing = f"nothing is told of fewer than {FEWEST} objects"
        lines.append(f"  open   noise ceiling: {nothing} ({'; '.join(untold)})")
    return lines or ["  open   noise ceiling: these results have no row that could exceed one"]
