"""What a run claims: which row is expected to beat which, and whose distance is only stated."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

from unirender_evaluation.light_balls import GLOSSY_BALL, MATTE_BALL
from unirender_evaluation.metrics import Metric, Scale, Variant, metric_key
from unirender_evaluation.records import Record, RunInfo
from unirender_evaluation.table_list import ALL_METRICS
from unirender_evaluation.task import LIGHT

MASKED = Variant("masked", "srgb", "raw")


class MaskedNumber:
    """What a quantity scores in a metric, inside the mask and in display values."""

    quantity: str
    metric: str
    scale: Scale

    @property
    def kind(self) -> Metric:
        """The metric that it is about."""
        return ALL_METRICS[self.metric]

    @property
    def key(self) -> str:
        """Under which records hold it."""
        return metric_key(self.quantity, self.kind, self.variant)

    @property
    def variant(self) -> Variant:
        """How it is taken."""
        return replace(MASKED, scale=self.scale)


@dataclass(frozen=True)
class Claim(MaskedNumber):
    """`a` against `b` on one number. `expected`: "beats" is a claim, "stated" only states the distance. `remark`: what
    a reader must know beside the figure. `scale`: how the number is aligned, where its metric has such variants.
    `in_full`: it can hold only where `a` answers every sample: a stranger chooses which."""

    table: str
    protocol: str
    quantity: str
    metric: str
    a: str
    b: str
    expected: str = "beats"
    remark: str = ""
    scale: Scale = "raw"
    in_full: bool = False


OPTIMISED, REFINED = "nvdiffrec-mitsuba", "ours-mitsuba-refinement"
OPTIMISED_ON_MESH = f"{OPTIMISED}-true-mesh"
HELD = "held at 0.5"
EDITS = ("edit_metallic", "edit_roughness")
GIVEN = ("given", "given-light")
LIT = ("from-image-sd", "from-image-hdri")
LIGHT_BARS = ("uniform-light", "mean-light")
OURS, ANCHORED = "ours-mean", "ours-mean-anchored"
PLAIN_COMPOSITE, ANCHORED_COMPOSITE = "composite-of-ours-mean", "composite-of-ours-mean-anchored"
COMPOSITE, SPLIT_SUM, CEILING = "composite", "composite-split-sum", "noise-ceiling"
SHADOWED = "composite-split-sum-seen-shadows"  # where the light is given; with s and d given there is nothing to derive


def edit_claims(row: str, expected: str = "beats") -> tuple[Claim, ...]:
    """Material edits against the unedited picture."""
    return tuple(
        Claim("rendering", "from-image", quantity, "psnr", row, "unedited-input", expected) for quantity in EDITS
    )


def given_claims(row: str, against: Sequence[str] = (COMPOSITE, SPLIT_SUM, SHADOWED)) -> tuple[Claim, ...]:
    """Renderings of true maps: the distance to closed forms."""
    return tuple(
        Claim("rendering", protocol, quantity, "psnr", row, other, "stated")
        for other in against
        for protocol in (GIVEN[1:] if SHADOWED in (row, other) else GIVEN)
        for quantity in EDITS
    )


def inverse_claims(row: str, expected: str = "beats") -> tuple[Claim, ...]:
    """Decompositions against the trivial ones. One picture does not tell the albedo's level from the light's, and some
    methods do not try: what is left after one factor for each picture is stated. (A constant is then exact on objects
    of one colour, and no rival.)"""
    bars = (
        ("albedo", "psnr", "input-as-albedo"),
        ("albedo", "psnr", "mean-albedo"),
        ("normal", "cosine", "mean-normal"),
        ("normal", "cosine", "sphere-normal"),
        ("metallic", "mse", "constant-0-5"),
        ("roughness", "mse", "constant-0-5"),
    )
    question = "inverse", "single-image"
    level_free = Claim(*question, "albedo", "psnr", row, "input-as-albedo", "stated", scale="aligned")
    return (*(Claim(*question, quantity, metric, row, bar, expected) for quantity, metric, bar in bars), level_free)


def relight_claims(row: str, protocol: str, expected: str = "beats") -> tuple[Claim, ...]:
    """Relighting against the picture as it was."""
    return (Claim("relighting", protocol, "relit", "psnr", row, "unedited-input", expected),)


def light_claims(row: str, expected: str = "beats") -> tuple[Claim, ...]:
    """Lights found in a picture against the trivial ones: as maps and by the balls under them. What depends on the
    light's level, which one picture does not tell from the albedo's, is only stated."""
    questions: tuple[tuple[str, str, Scale, str], ...] = (
        ("environment", "log_rmse_scaled", "raw", expected),  # the metric itself has a free factor
        (MATTE_BALL, "rmse_relative", "aligned", expected),
        (GLOSSY_BALL, "rmse_relative", "aligned", expected),
        (MATTE_BALL, "rmse_relative", "raw", "stated"),
    )
    return tuple(
        Claim(*LIGHT, quantity, metric, row, bar, what, scale=scale)
        for quantity, metric, scale, what in questions
        for bar in LIGHT_BARS
    )


def ceiling_claims(row: str) -> tuple[Claim, ...]:
    """The distance to what a noise-free prediction would score."""
    asked = [("rendering", protocol, quantity) for protocol in ("from-image", *GIVEN) for quantity in EDITS]
    asked += [("relighting", protocol, "relit") for protocol in LIT]
    asked += [("relighting", LIT[0], quantity) for quantity in ("specular", "diffuse")]
    return tuple(
        Claim(table, protocol, quantity, "psnr", row, CEILING, "stated") for table, protocol, quantity in asked
    )


OUR_CLAIMS: tuple[Claim, ...] = (
    *edit_claims(OURS),
    *edit_claims(ANCHORED),
    *(
        Claim("rendering", "from-image", quantity, "psnr", a, b, "stated")
        for a, b in ((OURS, PLAIN_COMPOSITE), (ANCHORED, ANCHORED_COMPOSITE))
        for quantity in EDITS
    ),
    *given_claims(OURS),
    *inverse_claims(OURS),
    *light_claims(OURS),
    *(claim for protocol in LIT for row in (OURS, ANCHORED) for claim in relight_claims(row, protocol)),
)


def optimisation_claims() -> tuple[Claim, ...]:
    """Our prediction against optimisation of one picture, as in the paper, and how that stands to the trivial rows;
    what refining our prediction by Mitsuba gains; and optimisation from many views against a constant object and
    against the plain loop."""
    maps = [("albedo", "psnr"), ("normal", "cosine"), ("roughness", "mse"), ("metallic", "mse")]
    asked = [("rendering", "from-image", quantity, "psnr") for quantity in EDITS]
    asked += [("inverse", "single-image", *what) for what in maps]
    asked += [("relighting", protocol, "relit", "psnr") for protocol in LIT]
    rivals = ((OURS, OPTIMISED), (OURS, OPTIMISED_ON_MESH), (REFINED, OURS), (REFINED, OPTIMISED))
    single = [_of_one_picture(Claim(*question, *pair)) for pair in rivals for question in asked]
    found = [
        Claim(*LIGHT, ball, "rmse_relative", *pair, "stated", scale="aligned")
        for pair in rivals
        for ball in (MATTE_BALL, GLOSSY_BALL)
    ]
    trivial = [*edit_claims(OPTIMISED, "stated"), *inverse_claims(OPTIMISED, "stated")]
    trivial += [claim for protocol in LIT for claim in relight_claims(OPTIMISED, protocol, "stated")]
    many = [("albedo", "psnr"), ("metallic", "mse"), ("roughness", "mse"), ("relit", "psnr"), ("novel", "psnr")]
    views = [
        Claim("multi-view", "known-mesh", *what, f"{OPTIMISED}-multi-view", other, expected)
        for other, expected in (("constant-object", "beats"), ("plain-mitsuba-loop", "stated"))
        for what in many
    ]
    return (*single, *found, *(_of_one_picture(claim) for claim in trivial), *light_claims(OPTIMISED, "stated"), *views)


def _of_one_picture(claim: Claim) -> Claim:
    """The claim as far as the optimiser answers its question: it estimates no metallic, and its constant is the true
    value of the pictures that are edited and relit."""
    rival = next((row for row in (claim.a, claim.b) if row in (OPTIMISED, OPTIMISED_ON_MESH)), None)
    remark = "" if rival is None or claim.table == "inverse" else f"{rival} is right about metallic: {HELD}"
    if rival is not None and claim.quantity == "metallic":
        remark = f"{rival} does not look for it: {HELD}"
    promised = (claim.a, claim.b) == (OURS, OPTIMISED) and claim.quantity != "metallic"
    return replace(claim, expected="beats" if promised else "stated", remark=remark)


def stranger_claims(row: str) -> tuple[Claim, ...]:
    """What is asked of somebody else's row: to beat every trivial row; its distance to closed forms and ceiling."""
    relighting = (claim for protocol in LIT for claim in relight_claims(row, protocol))
    maps = (*inverse_claims(row), *light_claims(row))
    asked = (*edit_claims(row), *given_claims(row), *maps, *relighting, *ceiling_claims(row))
    return tuple(replace(claim, in_full=True) for claim in asked)


def run_claims(records: Sequence[Record], run: RunInfo) -> list[Claim]:
    """The claims of a run: ours where our rows ran; those about optimisation where both sides did; of strangers' rows
    those on the tables that they have answers for; the closed forms' distance."""
    ours = any(info.kind == "ours" for info in run.methods)
    claims = list(OUR_CLAIMS) if ours else []
    present: dict[tuple[str, str, str], set[str]] = {}
    for r in records:
        present.setdefault((r.table, r.protocol, r.method), set()).update(r.values)
    others = [c for info in run.methods if info.kind == "external" for c in stranger_claims(info.key)]
    optional = [*others, *given_claims(SPLIT_SUM, (COMPOSITE,)), *given_claims(SHADOWED, (SPLIT_SUM,))]

    def ran(claim: Claim, row: str) -> bool:
        return claim.key in present.get((claim.table, claim.protocol, row), ())

    against_optimisation = [c for c in optimisation_claims() if ran(c, c.a) and ran(c, c.b)]
    return [*claims, *against_optimisation, *(c for c in optional if ran(c, c.a))]
