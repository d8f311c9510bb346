"""The model card beside a pipeline: `README.md` in the manner of the Hugging Face hub, written from facts only.

`card_text` sees nothing but `training.json` and, for a pipeline that was chosen by its scores, `validation.json`. What
they do not say is not in the card: a missing fact is a missing line.
"""

import importlib.metadata
from collections.abc import Iterable, Mapping
from typing import Any

CARD_FILE = "README.md"
TAGS = ("unirender", "diffusers", "inverse-rendering", "neural-rendering", "intrinsic-images", "relighting")
OF_A_RUN = ("pipeline", "best")  # folders that every run has: the card is titled after the preset
NO_LOSSES = ("step", "minutes", "samples_per_s", "grad_norm", "lr", "loss_scale")  # entries of a line that are none

Facts = Mapping[str, Any]


def card_text(name: str, facts: Facts, chosen: Facts | None = None) -> str:
    """The card of a pipeline folder.

    Args:
        name: of the folder, for the title and the examples.
        facts: `training.json`: see `unirender.training.loop.facts`; of older versions with fewer entries.
        chosen: `validation.json` of a pipeline that was kept for its scores.
    """
    named = facts.get("preset") if name in OF_A_RUN else name
    title = f"unirender: {named}" if named else "unirender"
    sections = [
        _front_matter(facts),
        f"# {title}\n\nA diffusion model that takes a picture of an object apart (albedo, normal, roughness, "
        "metallic, specular and diffuse light, environment) and renders a picture from such maps.",
        _section("Use", [_USE.format(name=name)]),
        _section("Training", _table(_training_rows(facts))),
        _section("Loss at the end", _losses(facts.get("losses"))),
        _section("Scores", _scores(facts, chosen)),
        _section("Runs that it continues", _history(facts.get("continues", []))),
        _section("Configuration", _configuration(facts.get("train"))),
        _section("Limits", _limits(facts)),
    ]
    return "\n\n".join(section for section in sections if section) + "\n"


_USE = """```python
from unirender import UniRenderPipeline

pipeline = UniRenderPipeline.from_pretrained("{name}")  # the folder of this file
maps = pipeline.decompose(image_srgb, mask).intrinsics
```

```console
$ unirender decompose picture.png --checkpoint {name} --output maps
```"""


def _front_matter(facts: Facts) -> str:
    licence = importlib.metadata.metadata("unirender")["License-Expression"]
    lines = ["---", "library_name: diffusers", "pipeline_tag: image-to-image", "tags:", *(f"- {tag}" for tag in TAGS)]
    if licence and not _on_foreign_latents(facts):  # weights of other people come under their own licence
        lines.insert(1, f"license: {licence.lower()}")
    return "\n".join([*lines, "---"])


def _on_foreign_latents(facts: Facts) -> bool:
    return facts.get("train", {}).get("model", {}).get("codec") == "kl"


def _section(title: str, lines: Iterable[str]) -> str:
    body = "\n".join(lines)
    return f"## {title}\n\n{body}" if body else ""


def _table(rows: Mapping[str, str | None], head: tuple[str, str] = ("", "")) -> list[str]:
    """A table of two columns; rows without a value are left out, and a table without rows is no table."""
    lines = [f"| {name} | {value} |" for name, value in rows.items() if value]
    return [f"| {head[0]} | {head[1]} |", "|---|---|", *lines] if lines else []


def _training_rows(facts: Facts) -> dict[str, str | None]:
    """The table "training" of a model card, a text for each line that is known."""
    hardware, software = facts.get("hardware", {}), facts.get("software", {})
    counts = {name: facts[name] for name in ("parameters", "steps", "samples") if name in facts}
    where = [hardware.get("processor"), facts.get("device")]
    where += [f"{hardware[name]} {name}" for name in ("threads", "processes") if hardware.get(name, 1) > 1]
    where += [f"autocast {facts['autocast']}"] if "autocast" in facts else []
    return {
        "preset": f"`{facts['preset']}`" if "preset" in facts else None,
        **{name: f"{value:,}" for name, value in counts.items()},
        "minutes": f"{facts['minutes']:g}" if "minutes" in facts else None,
        "data": _data(facts.get("data")),
        "hardware": ", ".join(part for part in where if part),
        "software": ", ".join(f"{name} {version}" for name, version in software.items()),
        "weights stored as": facts.get("stored_as"),
        "weights averaged": ", ".join(f"{share:g} of {run}" for run, share in facts.get("averaged", {}).items())
        or None,
        "materials are read by": _calibration(facts.get("calibration")),
    }


def _calibration(fitted: Facts | None) -> str | None:
    if fitted is None:
        return None
    lines = [
        f"{name}: {line['slope']:.3f} x predicted + {line['offset']:.3f}, mean squared error {line['before']:.4f}, "
        f"lower by {line['before'] - line['after']:.4f} ± {line['chance']:.4f} at objects that it was not fitted to"
        for name, line in fitted["lines"].items()
    ]
    return "; ".join([*lines, f"{fitted['pictures']} pictures of each group of {_data(fitted['data'])}"])


def _data(data: Facts | None) -> str | None:
    if data is None:
        return None
    size = ", ".join(f"{data[name]:,} {name}" for name in ("shards", "groups", "pairs"))
    return f"`{data['folder']}`: {size}; fingerprint `{data['fingerprint']}`"


def _losses(line: Facts | None) -> list[str]:
    losses = {name: f"{value:.4g}" for name, value in (line or {}).items() if name not in NO_LOSSES}
    return [*_table(losses, ("term", f"mean up to step {line['step']}"))] if line else []


def _scores(facts: Facts, chosen: Facts | None) -> list[str]:
    """The scores of these weights; of weights that were chosen by them it says so."""
    values = facts.get("scores", {})
    if chosen is not None:
        values = {name: score["value"] for name, score in chosen["scores"].items()}
    if not values:
        return []
    on = f"Measured on {facts['scored_on']}, with the averaged weights in float32." if "scored_on" in facts else ""
    on += " Before its materials were calibrated." if on and "calibration" in facts else ""
    if chosen is not None:
        by = f"by {chosen['chosen_by']} " if "chosen_by" in chosen else ""
        said = f"This pipeline was chosen {by}on these very scenes: its scores there flatter it."
        on = f"{on} {said}".strip()
    return [*([on, ""] if on else []), *_table({name: f"{v:.4g}" for name, v in values.items()}, ("score", "value"))]


def _history(runs: Iterable[Facts]) -> list[str]:
    """The runs before this one, oldest first."""
    rows: dict[str, str | None] = {}
    for number, run in enumerate(runs, start=1):
        facts = [f"`{run['preset']}`"] if "preset" in run else []
        facts += [f"Stable Diffusion's weights, `{run['stable_diffusion']}`"] if "stable_diffusion" in run else []
        facts += [f"{run[name]:,} {name}" for name in ("steps", "samples", "minutes") if name in run]
        pixels = run.get("train", {}).get("model", {}).get("resolution")
        facts += [f"{pixels} x {pixels} pixels"] if pixels else []
        facts += [f"data {_data(run['data'])}"] if "data" in run else []
        rows[str(number)] = ", ".join(facts)
    return _table(rows, ("run", "facts"))


def _configuration(train: Facts | None) -> list[str]:
    """The resolved configuration, a row for each of its groups."""
    if train is None:
        return []
    groups = {name: value for name, value in train.items() if isinstance(value, Mapping)}
    rows: dict[str, str | None] = {name: _values(group) for name, group in groups.items()}
    rows["run"] = _values({name: value for name, value in train.items() if name not in groups})
    return _table(rows, ("group", "values"))


def _values(group: Facts) -> str:
    return ", ".join(f"{name} {value}" for name, value in group.items())


def _limits(facts: Facts) -> list[str]:
    lines = ["- Only the object inside the mask is described, by direct light and one surface per pixel."]
    model = facts.get("train", {}).get("model", {})
    if "resolution" in model:
        lines.append(f"- Trained on pictures of {model['resolution']} x {model['resolution']} pixels.")
    if _on_foreign_latents(facts):
        lines.append(
            "- It works on the latents of Stable Diffusion's autoencoder: the licence of those weights applies."
        )
    return lines
