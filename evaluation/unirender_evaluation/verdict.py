"""The verdict: which claims about the rows hold on this run, by the paired 95 % interval."""

import functools
import math
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

from unirender_evaluation.ceiling import ceiling_lines
from unirender_evaluation.claims import OUR_CLAIMS, Claim, run_claims
from unirender_evaluation.comparisons import (
    Comparison,
    Lights,
    Selection,
    compare,
    difference_over_lights,
    values_of,
    without_rounding,
)
from unirender_evaluation.records import Record, RunInfo
from unirender_evaluation.statistics import Estimate, holm, light_count, paired_p_value
from unirender_evaluation.tables.mistakes import is_truth, truth_said
from unirender_evaluation.task import LIGHT

ORDER = ("FAILS", "open", "HOLDS", "stated")
FEW = 20  # objects or lights: a claim that is not shown of fewer is open, of as many it fails


@dataclass(frozen=True)
class Finding:
    """A claim with its comparison: None where a row has no such value. `holds` is None for a distance that is only
    stated, and where nothing was compared, for the reason `why`. `asked`: on how many samples any row has this number,
    since a row may answer the easy ones alone; `in_part`: it did, and shows nothing by it. `p_value`: of the
    difference, for Holm's correction. `over_lights`: the difference again, with its interval over objects and lights;
    None where the lights of the samples, of which there are `lights`, are not known."""

    claim: Claim
    comparison: Comparison | None
    holds: bool | None
    why: str = "not run "
    asked: int = 0
    in_part: bool = False
    p_value: float = 1.0
    over_lights: Estimate | None = None
    lights: int = 0

    @property
    def word(self) -> str:
        """What a line of the verdict begins with, where something was compared."""
        return "open" if self.is_open else {True: "HOLDS", False: "FAILS", None: "stated"}[self.holds]

    @property
    def is_open(self) -> bool:
        """Whether it does not hold, nor its opposite, on fewer than `FEW` objects, or on a part of the questions: more
        of them may decide it."""
        found = self.comparison
        few = self.in_part or (found is not None and found.difference.clusters < FEW)
        return self.holds is False and found is not None and not found.b_beats_a and few

    @property
    def other_lights(self) -> str:
        """What is known of the claim under other lights: holds, open, fails, stated; "not told" of too few lights;
        empty where nothing is."""
        found, compared = self.over_lights, self.comparison
        if found is None or compared is None or not compared.decided:
            return ""
        if not math.isfinite(found.low):
            return "not told"
        if self.holds is None:
            return "stated"
        above, below = (found.low > 0, found.high < 0) if not compared.equal else (False, False)
        if (above, below)[not self.claim.kind.higher_is_better]:
            return "open" if self.in_part else "holds"
        return "open" if not (above or below) and min(found.clusters, self.lights) < FEW else "fails"

    @property
    def times_as_wide(self) -> float:
        """The interval over objects and lights against that over objects; NaN where one lacks, or has no width."""
        own, both = self.comparison, self.over_lights
        width = own.difference.half_width if own is not None else 0.0
        return both.half_width / width if both is not None and width > 0 else math.nan

    @property
    def number(self) -> str:
        """Which number it is about."""
        c = self.claim
        return f"{c.table}/{c.protocol} {c.quantity} {c.kind.label}{scale_said(c)}"

    def __str__(self) -> str:
        c = self.claim
        if self.comparison is None:
            return f"{self.why}{self.number}: {c.a} against {c.b}"
        d = self.comparison.difference
        remark = f"; {c.remark}" if c.remark else ""
        interval = f"[{d.low:+.4g}, {d.high:+.4g}]" if self.comparison.decided else ""
        difference = " ".join(filter(None, (f"{d.mean:+.4g}", interval, c.kind.unit)))
        objects = f"{d.clusters} object{'s' * (d.clusters != 1)}"
        n = f"{d.n} of {self.asked}" if d.n < self.asked else f"{d.n}"
        return (
            f"{self.word:7s}{self.number}: {c.a} {self.comparison.verdict} {c.b}, "
            f"difference {difference} (n {n}, {objects}{remark}){self._other_lights_text()}"
        )

    def _other_lights_text(self) -> str:
        word, found = self.other_lights, self.over_lights
        if not word or found is None:
            return ""
        if word == "not told":
            return f"; under other lights: not told by {self.lights} light{'s' * (self.lights != 1)}"
        said = "" if word == "stated" else f"{word} "
        return f"; under other lights: {said}[{found.low:+.4g}, {found.high:+.4g}]"


def scale_said(claim: Claim) -> str:
    """How a number is aligned; that it is not is said of the light alone."""
    unsaid = "scale" not in claim.kind.axes or (claim.scale == "raw" and claim.table != LIGHT[0])
    return "" if unsaid else f" ({claim.scale})"


def findings(
    records: Sequence[Record], claims: Sequence[Claim] = OUR_CLAIMS, lights: Lights | None = None
) -> list[Finding]:
    """Every claim; without a comparison where its two rows share no sample, or where they are not to be compared: a
    picture that is the truth to the bit has an infinite PSNR. `lights`: of all samples, or None."""
    found, of_selection = [], functools.cache(lambda selection: selection.of(records))
    for claim in claims:
        whole, key = of_selection(Selection(claim.table, claim.protocol)), claim.key
        chosen = _comparable(whole, claim.a, key)
        a, b = (values_of(chosen, method, key) for method in (claim.a, claim.b))
        common = a.keys() & b.keys()
        if common and all(math.isfinite(b[sample]) for sample in common):
            comparison = compare(chosen, claim.kind, key, claim.a, claim.b)
            claimed = claim.expected == "beats"
            asked = len({record.sample for record in whole if key in record.values})
            p = paired_p_value(a, without_rounding(a, b), {record.sample: record.object for record in chosen})
            in_part = claim.in_full and len(values_of(whole, claim.a, key)) < asked
            holds = comparison.a_beats_b and not in_part if claimed else None
            finding = Finding(claim, comparison, holds, asked=asked, in_part=in_part, p_value=p)
            if lights:
                other = difference_over_lights(chosen, key, claim.a, claim.b, lights)
                finding = replace(finding, over_lights=other, lights=light_count([lights[s] for s in common]))
            found.append(finding)
        else:
            exact = common or math.inf in values_of(whole, claim.a, key).values()
            found.append(Finding(claim, None, None, "infinite PSNR, not compared " if exact else "not run "))
    return found


def _comparable(whole: list[Record], first: str, key: str) -> list[Record]:
    """The records of a claim's question but for samples on which its first row is right to the bit: there is no
    difference in dB, and without them that row has less to show."""
    exact = {sample for sample, value in values_of(whole, first, key).items() if math.isinf(value)}
    return [record for record in whole if record.sample not in exact] if exact else whole


UNNAMED = "what holds under other lights is not told: the lights of the samples are not named"
HEAD = (
    "masked, sRGB and unaligned, where nothing else is said; paired 95 % intervals over objects, under these lights, "
    "each by itself; under other lights: over objects and lights, both as draws"
)


def verdict_text(records: Sequence[Record], run: RunInfo, check: dict | None, lights: Lights | None = None) -> str:
    """The verdict section: claims, those that fail first, then checks: ceiling and truth; one line each, counted apart.

    Args:
        records: of the run.
        run: its description.
        check: what the truth check found; None where that is not known.
        lights: of the samples; without those of all, nothing is said of other lights.
    """
    lines = [f"Verdict on suite {run.suite} ({HEAD})"]
    found = judged(records, run, lights)
    lines += [f"  {line}" for line in _counts_line(found)]
    lines += [f"  {finding}" for finding in sorted(found, key=_place)]
    lines += [f"  ({line})" for line in summary(found)]
    told = "what its check found stands in the run's verdict.txt"
    unknown = f"not rendered again ({run.unchecked})" if run.unchecked else told
    checks = [f"  FAILS  {method}: {said}" for method, said in _told(records)]
    checks += ceiling_lines(records)
    checks += _truth_lines(check) if check else [f"  open   truth: {unknown}"]
    lines += [_checks_line(checks), *checks]
    if run.limit is not None:
        lines.append(f"  (--limit {run.limit}: a partial run, not a result)")
    return "\n".join(lines)


def _told(records: Sequence[Record]) -> Iterator[tuple[str, str]]:
    """Rows most of whose maps or lights are the truth but for rounding, with what is said of them."""
    by_method: dict[str, list[Record]] = {}
    for record in records:
        by_method.setdefault(record.method, []).append(record)
    return ((method, truth_said(own)) for method, own in sorted(by_method.items()) if is_truth(own))


def _place(finding: Finding) -> int:
    """Where a claim stands among the others: those that fail before those that hold, what claims nothing last."""
    return len(ORDER) if finding.comparison is None else ORDER.index(finding.word)


def _counts_line(found: Sequence[Finding]) -> list[str]:
    """How many claims begin with each word; nothing where there is none."""
    words = Counter(finding.word for finding in found if finding.comparison is not None)
    counted = [*(f"{word} {words[word]}" for word in ORDER), f"not compared {len(found) - words.total()}"]
    return [f"(claims: {', '.join(counted)})"] if found else []


def _checks_line(checks: Sequence[str]) -> str:
    """How many lines of the checks begin with each word."""
    words = Counter(line.split()[0] for line in checks)
    return f"  (checks: {', '.join(f'{word} {words[word]}' for word in ORDER[:3])})"


def judged(records: Sequence[Record], run: RunInfo, lights: Lights | None) -> list[Finding]:
    """The claims of a run; without the lights of all samples nothing is said of other lights."""
    named = lights if lights and all(record.sample in lights for record in records) else None
    return findings(records, run_claims(records, run), named)


def _by_keys(finding: Finding) -> str:
    """A claim by the keys of its rows."""
    return f"{finding.number} of {finding.claim.a} against {finding.claim.b}"


Named = Callable[[Finding], str]


def summary(found: Sequence[Finding], named: Named = _by_keys) -> list[str]:
    """How many of the claims that hold are certain together, and how many hold under other lights; `named`: how the
    others are called."""
    if not any(f.comparison for f in found):
        return []
    return [*_corrected_lines(found, named), *_other_lights_lines(found, named)]


def _corrected_lines(found: Sequence[Finding], named: Named) -> list[str]:
    """How many of the claims that hold would do so if all claims were one question; nothing where none holds."""
    claimed = [f for f in found if f.holds is not None and f.comparison is not None and f.comparison.decided]
    sure = holm([finding.p_value for finding in claimed])
    holding = [(f, certain) for f, certain in zip(claimed, sure, strict=True) if f.holds]
    if not holding:
        return []
    unsure = [named(f) for f, certain in holding if not certain]
    but = f"; not {', '.join(unsure)}" if unsure else ""
    return [
        f"of {len(holding)} claims that hold {len(holding) - len(unsure)} also do after Holm's correction for all "
        f"{len(claimed)}, by Student's t over objects{but}"
    ]


def _other_lights_lines(found: Sequence[Finding], named: Named) -> list[str]:
    """How many of the claims that hold also do under other lights, and which do not; nothing where none holds."""
    if all(finding.over_lights is None for finding in found):
        return [UNNAMED]
    holding = [finding for finding in found if finding.holds]
    if not holding:
        return []
    missing = {
        word: [named(f) for f in holding if f.other_lights in words]
        for word, words in (("not", ("open", "fails")), ("not told of", ("not told",)))
    }
    but = "".join(f"; {word} {', '.join(names)}" for word, names in missing.items() if names)
    also = sum(finding.other_lights == "holds" for finding in holding)
    wider = sorted(ratio for finding in holding if math.isfinite(ratio := finding.times_as_wide))
    grown = f"; their intervals are {wider[0]:.2f} to {wider[-1]:.2f} times as wide" if wider else ""
    return [f"of {len(holding)} claims that hold {also} also do under other lights{but}{grown}"]


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
