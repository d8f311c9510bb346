"""The protocol line: everything one must know to compare a number with one's own."""

from collections import Counter
from collections.abc import Iterable, Sequence
from typing import Literal

from unirender_evaluation.metrics import FACING_AWAY, LPIPS_SCALES, OWN_MASK, TURNED, Variant, metric_key
from unirender_evaluation.records import MethodInfo, Record, RunInfo
from unirender_evaluation.statistics import CONFIDENCE, METHOD
from unirender_evaluation.tables.published import taken_how
from unirender_evaluation.tables.specs import Protocol

SPACE_TEXT = {"srgb": "sRGB (clipped to [0, 1], then encoded)", "linear": "linear Rec.709, clipped to [0, 1]"}
SCALE_TEXT = {
    "raw": "none",
    "aligned": "one least-squares factor per image, fitted in linear light in the true mask",
    "aligned_rgb": "one least-squares factor per image and channel, fitted in linear light in the true mask",
}
NORMALS = metric_key("normal", "cosine")
MOST = 0.75  # of a row's pictures: fewer are its errors
COLOURS = {
    "albedo": "albedo",
    "specular": "s",
    "diffuse": "d",
    "edit_metallic": "another metallic",
    "edit_roughness": "another roughness",
    "relit": "relit",
}
MASKED_QUANTITIES = ("albedo", "specular", "diffuse", "roughness", "metallic")  # maps, which a method's mask belongs to


def mask_source(method: str, records: Iterable[Record]) -> Literal["own", "pasted"]:
    """Which mask the whole-frame figures of a method's maps were taken with, by a run's records."""
    own = any(record.method == method and OWN_MASK in record.values for record in records)
    return "own" if own else "pasted"


def doubts(method: str, records: Iterable[Record]) -> list[str]:
    """What a run's records say of a stranger's maps that is probably a mistake, a sentence each, for its note."""
    of_method = [record for record in records if record.method == method]
    own = [record.values for record in of_method]
    empty, masks = sum(values.get(OWN_MASK) == 0 for values in own), sum(OWN_MASK in values for values in own)
    away, normals = sum(FACING_AWAY in values for values in own), sum(NORMALS in values for values in own)
    found = [f"its own mask misses the object on {empty} of {masks} pictures (is it 0?)"] if empty else []
    if away:
        found.append(
            f"its normals face away from the viewer on {away} of {normals} pictures (OpenCV axes? normal_axes in "
            "conventions.toml turns those of a folder)"
        )
    turned = sum(TURNED in values for values in own)
    if turned > MOST * normals:
        found.append(
            f"its normals are nearer to the truth with another sign of x or y on {turned} of {normals} pictures (+y is "
            "up; normal_axes in conventions.toml turns those of a folder)"
        )
    decoded = [f"{name} ({count})" for quantity, name in COLOURS.items() if (count := _decoded(quantity, of_method))]
    if decoded:
        found.append(
            f"taken for display values these of its answers are nearer to the truth: {', '.join(decoded)} (encoded? "
            "expected linear; exr_colour in conventions.toml decodes those of a folder)"
        )
    return found


def _decoded(quantity: str, records: Sequence[Record]) -> str:
    """On how many pictures colours would be nearer to the truth as display values; empty where it is not on most."""
    scored, gained = (
        Counter((r.table, r.protocol) for r in records if metric_key(quantity, metric) in r.values)
        for metric in ("psnr", "decoded")
    )
    asked = [question for question, count in scored.items() if gained[question] > MOST * count]
    return f"{sum(gained[q] for q in asked)} of {sum(scored[q] for q in asked)} pictures" if asked else ""


def protocol_line(
    protocol: Protocol,
    variant: Variant,
    run: RunInfo,
    methods: Sequence[MethodInfo],
    records: Sequence[Record],
    published_in: str | None,
) -> tuple[tuple[str, str], ...]:
    """(what, value) pairs in the order in which they are printed; `published_in`: the table of the paper whose numbers
    stand beside, None where none do."""
    spp = protocol.truth or f"{'-' if run.truth_spp is None else run.truth_spp} spp"
    samples, objects = ({getattr(record, name) for record in records} for name in ("sample", "object"))
    frame = [
        ("variant", variant.label),
        ("mask", _mask_text(variant, methods, records)),
        ("colour", SPACE_TEXT[variant.space]),
        ("scale alignment", SCALE_TEXT[variant.scale]),
    ]
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
        *([("LPIPS", _lpips_text(variant, run))] if protocol.framed else []),
        ("interval", f"{CONFIDENCE:.0%} over objects, under these lights: {METHOD}"),
        ("suite", f"{run.suite} {run.suite_hash[:12]}"),
        ("truth", f"Mitsuba {run.mitsuba or '-'}, {spp}"),
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
