"""The protocol line: everything one must know to compare a number with one's own."""

from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Literal

from unirender_evaluation.metrics import LPIPS_SCALES, OWN_MASK, Variant
from unirender_evaluation.records import MethodInfo, Record, RunInfo
from unirender_evaluation.statistics import CONFIDENCE, CROSSED, METHOD
from unirender_evaluation.tables.mistakes import brightness_said, mistakes_said, truth_said
from unirender_evaluation.tables.published import taken_how
from unirender_evaluation.tables.specs import Column, Protocol

SPACE_TEXT = {"srgb": "sRGB (clipped to [0, 1], then encoded)", "linear": "linear Rec.709, clipped to [0, 1]"}
SCALE_TEXT = {
    "raw": "none",
    "aligned": "one least-squares factor per image, fitted in linear light in the true mask",
    "aligned_rgb": "one least-squares factor per image and channel, fitted in linear light in the true mask",
}
MASKED_QUANTITIES = ("albedo", "specular", "diffuse", "roughness", "metallic")  # maps, which a method's mask belongs to


def mask_source(method: str, records: Iterable[Record]) -> Literal["own", "pasted"]:
    """Which mask the whole-frame figures of a method's maps were taken with, by a run's records."""
    own = any(record.method == method and OWN_MASK in record.values for record in records)
    return "own" if own else "pasted"


def with_doubts(info: MethodInfo, records: Iterable[Record]) -> MethodInfo:
    """A row whose note says, too, what in its answers is probably a mistake."""
    return replace(info, note="; ".join([*filter(None, [info.note]), *doubts(info.key, records)]))


def doubts(method: str, records: Iterable[Record]) -> list[str]:
    """What a run's records say of a stranger's answers that is probably a mistake, a sentence each, for its note."""
    of_method = [record for record in records if record.method == method]
    own = [record.values for record in of_method]
    empty, masks = sum(values.get(OWN_MASK) == 0 for values in own), sum(OWN_MASK in values for values in own)
    found = [f"its own mask misses the object on {empty} of {masks} pictures (is it 0?)"] if empty else []
    found += [said for judge in (mistakes_said, brightness_said, truth_said) if (said := judge(of_method))]
    return found


def protocol_line(
    protocol: Protocol,
    variant: Variant,
    run: RunInfo,
    methods: Sequence[MethodInfo],
    records: Sequence[Record],
    columns: Sequence[Column],
    published_in: str | None,
    over_lights: bool = False,
) -> tuple[tuple[str, str], ...]:
    """(what, value) pairs in the order in which they are printed.

    Args:
        protocol: what a method is given.
        variant: how numbers are taken.
        run: describes suite, truth and code.
        methods: the rows.
        records: of the table.
        columns: of the table.
        published_in: the table of the paper whose numbers stand beside; None where none do.
        over_lights: whether intervals are over lights, too.
    """
    spp = protocol.truth or f"{'-' if run.truth_spp is None else run.truth_spp} spp"
    samples, objects = ({getattr(record, name) for record in records} for name in ("sample", "object"))
    frame = [
        ("variant", variant.label),
        ("mask", _mask_text(variant, methods, records)),
        ("colour", SPACE_TEXT[variant.space]),
        ("scale alignment", SCALE_TEXT[variant.scale]),
    ]
    has_lpips = any(column.metric.name.startswith("lpips_") for column in columns)
    coverage = "-" if run.coverage is None or protocol.truth else f"{run.coverage:.3f}"
    items = [
        ("given", protocol.given),
        *(frame if protocol.framed else ()),
        ("exposure", run.exposure),
        ("resolution", f"{run.resolution} x {run.resolution}"),
        ("n", f"{len(samples)} samples of {len(objects)} objects"),
        *([("coverage", coverage)] if protocol.framed else []),
        ("steps x samples", _sampling_text(methods)),
        ("seeds", ", ".join(map(str, run.seeds)) or "-"),
        *([("LPIPS", _lpips_text(variant, run))] if has_lpips else []),
        ("interval", CROSSED if over_lights else f"{CONFIDENCE:.0%} over objects, under these lights: {METHOD}"),
        ("suite", f"{run.suite} {run.suite_hash[:12]}"),
        ("truth", f"Mitsuba {run.mitsuba or '-'}, {spp}{f', unchecked ({run.unchecked})' if run.unchecked else ''}"),
        ("code", f"{run.code or '-'}, {run.date or '-'}{f' ({run.carried})' if run.carried else ''}"),
    ]
    if published_in is not None:
        items.append(("published", taken_how(published_in)))
    return tuple(items)


def protocol_text(items: Sequence[tuple[str, str]]) -> str:
    """One line of text."""
    return " · ".join(f"{name}: {value}" for name, value in items)


def _mask_text(variant: Variant, methods: Sequence[MethodInfo], records: Sequence[Record]) -> str:
    if variant.mask == "masked":
        return "inside the true mask, weighted by coverage"
    text = "whole frame in linear light over white (0 behind materials)"
    quantities = {key.partition(".")[0] for record in records for key in record.values}
    maps = not quantities.isdisjoint(MASKED_QUANTITIES)
    own = [info.label for info in methods if info.mask == "own"] if maps else []
    if not own:
        return f"{text}, the true mask pasted on every row"
    return f"{text}; own mask: {', '.join(own)} (maps; on pictures the true one is pasted); pasted: all other rows"


def _lpips_text(variant: Variant, run: RunInfo) -> str:
    if variant.scale not in LPIPS_SCALES:
        return f"not computed of aligned pictures (a {'-'.join(LPIPS_SCALES)} variant has it)"
    if not run.lpips:
        return "n/a (no weights)"
    space = "" if variant.space == "srgb" else ", of sRGB pictures as everywhere"
    frame = "" if variant.mask == "whole" else ", mean over the whole frame with the true mask pasted on both sides"
    return f"v0.1, {' and '.join(run.lpips)}{space}{frame}"


def _sampling_text(methods: Sequence[MethodInfo]) -> str:
    sampled = [info for info in methods if info.steps is not None or info.samples is not None]
    return "; ".join(f"{info.label} {info.steps or 1} x {info.samples or 1}" for info in sampled) or "no sampling"
