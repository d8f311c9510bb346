"""What the gains of a stranger's answers with a mistake undone say together: a sentence for the row's note."""

from collections.abc import Callable, Iterator, Mapping, Sequence

import numpy as np

from unirender_evaluation.light_metrics import PEAK_ANGLE, SCALED_LOG_RMSE
from unirender_evaluation.methods.mistakes import AT_WHITE, BIAS, EXACT, GAINS, MISTAKES, PLACE
from unirender_evaluation.metrics import metric_key
from unirender_evaluation.records import Record
from unirender_evaluation.statistics import mean_estimate

QUANTITIES = {
    "albedo": "albedo",
    "normal": "normal",
    "roughness": "roughness",
    "specular": "s",
    "diffuse": "d",
    "environment": "light",
    "edit_metallic": "edits of metallic",
    "edit_roughness": "edits of roughness",
    "relit": "relit",
}
LIGHT_DEG = 5.0  # between the brightest directions of lights that are one
TRUE: tuple[tuple[str, str, Callable[[float], bool], float], ...] = (  # of maps, which have no noise ceiling
    ("albedo", metric_key("albedo", "psnr"), lambda db: db > 50, 0.0),
    ("normal", metric_key("normal", "angle_deg"), lambda degrees: degrees < 0.5, 0.0),
    ("roughness", metric_key("roughness", "mse"), lambda mse: mse < 1e-5, 0.75),
    ("metallic", metric_key("metallic", "mse"), lambda mse: mse < 1e-5, 0.75),
    ("light", metric_key("environment", SCALED_LOG_RMSE), lambda error: error < 0.05, 0.75),
)  # quantity, metric, whether it is the truth, and in which share of pictures more: a constant is right on some
MOST = 0.75  # of the pictures that say anything
LEAST_DB = 0.1  # smaller gains say nothing, as those of a constant or of an object of one colour
OF_ROUGHNESS = {metric_key("roughness", GAINS[name]) for name in ("if_decoded", "if_inverted", "if_root")}
NOT_TOLD = ("roughness", "metallic")  # a suite may have one value of these
FEWEST_TOLD = 10  # pictures, and more than `MOST` of them: a method may be exact on the balls of a suite
FEWEST = 4  # objects whose pictures say something: of fewer it may be chance


def mistakes_said(records: Sequence[Record]) -> str:
    """The sentence about one method's records; empty where nothing is probably a mistake. Of each quantity and question
    the mistake that explains most."""
    told: dict[str, dict[str, list[list[float]]]] = {}  # mistake -> quantity -> gains of each question
    questions: dict[tuple[str, str], list[Record]] = {}
    for record in records:
        questions.setdefault((record.table, record.protocol), []).append(record)
    for quantity, name in QUANTITIES.items():
        for of_question in questions.values():
            likely = _likely(quantity, of_question)
            if likely:
                mistake = max(likely, key=lambda which: np.mean(likely[which]))
                told.setdefault(mistake, {}).setdefault(name, []).append(likely[mistake])
    found = [f"{MISTAKES[mistake].said}: {_counts(of_names)}" for mistake, of_names in told.items()]
    return f"its answers are nearer to the truth {', and '.join(found)}" if found else ""


def truth_said(records: Sequence[Record]) -> str:
    """The sentence on maps that no picture tells so well; empty where they are too few to be noted."""
    found = [f"{name} ({true} of {asked} pictures)" for name, true, asked in _true_maps(records)]
    return f"its answers are the truth but for rounding: {', '.join(found)} (was it told?)" if found else ""


def is_truth(records: Sequence[Record]) -> bool:
    """Whether so many of a method's maps, or lights, are the truth that it stands in no rank."""
    return any(
        asked >= FEWEST_TOLD and true > MOST * asked
        for name, true, asked in _true_maps(records)
        if name not in NOT_TOLD
    )


def _true_maps(records: Sequence[Record]) -> Iterator[tuple[str, int, int]]:
    """Quantities of which enough answers to be noted are the truth, and how many of how many."""
    strangers = [r for r in records if any(".if_" in key for key in r.values)]  # Mitsuba's maps have none
    for name, key, is_true, least in TRUE:
        asked = [record for record in strangers if key in record.values]
        true = [r.object for r in asked if is_true(r.values[key]) and not (name == "light" and _has_other_direction(r))]
        if len(set(true)) >= FEWEST and len(true) > least * len(asked):
            yield name, len(true), len(asked)


def _has_other_direction(record: Record) -> bool:
    """Whether a light is brightest elsewhere than the true one, as a constant is, or no direction of that is brightest:
    under a nearly uniform light a constant is right but for its brightness."""
    return record.values.get(metric_key("environment", PEAK_ANGLE), 90.0) > LIGHT_DEG


def brightness_said(records: Sequence[Record]) -> str:
    """The sentence on lights that end at white; empty where most do not, or they are too few to be noted."""
    key = metric_key("environment", AT_WHITE)
    asked = [record for record in records if key in record.values]
    white = [record.object for record in asked if record.values[key] == 1]
    if len(set(white)) < FEWEST or len(white) <= MOST * len(asked):
        return ""
    return f"its lights end at 1, where the true ones are brighter: {len(white)} of {len(asked)} pictures (of 8 bits?)"


def _beyond_bias(key: str, records: Sequence[Record]) -> float:
    """dB by which a mistake undone is better, over all answers together, than one constant taken from all of them: a
    roughness that is too high throughout is nearer to the truth when it is decoded, too."""
    error, bias, gain = (
        np.array([record.values[name] for record in records])
        for name in (metric_key("roughness", "mse"), metric_key("roughness", BIAS), key)
    )
    undone = (error + EXACT) / 10 ** (gain / 10)
    return float(10 * np.log10((error.mean() - bias.mean() ** 2 + EXACT) / undone.mean()))


def _counts(of_names: Mapping[str, Sequence[Sequence[float]]]) -> str:
    """On how many pictures, and by how much, by the name of the quantity."""
    pooled = {name: np.concatenate(list(gains)) for name, gains in of_names.items()}
    return ", ".join(f"{name} ({np.sum(g > 0)} of {len(g)}, {g.mean():+.1f} dB)" for name, g in pooled.items())


def _likely(quantity: str, records: Sequence[Record]) -> dict[str, list[float]]:
    """Mistake -> its gains that say something, of those that are probably made: by a large mean gain, or, but for
    roughness, by a smaller one that other objects would show, too; of roughness also beyond its bias."""
    found = {}
    for name, metric in GAINS.items():
        key = metric_key(quantity, metric)
        telling = [record for record in records if abs(record.values.get(key, 0.0)) > LEAST_DB]
        gains, objects = [record.values[key] for record in telling], [record.object for record in telling]
        if len(set(objects)) < FEWEST or sum(g > 0 for g in gains) <= MOST * len(gains):
            continue
        if key in OF_ROUGHNESS and _beyond_bias(key, [r for r in records if key in r.values]) <= PLACE:
            continue
        gain = mean_estimate(gains, objects)
        if gain.mean > MISTAKES[name].least or (gain.low > PLACE and quantity != "roughness"):
            found[name] = gains
    return found
