"""The rows of a run: which methods, under which name, on which tables, on how many scenes."""

import json
import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from unirender.errors import UnirenderError, UsageError
from unirender.intrinsics import Intrinsics
from unirender_evaluation.methods.composite import Composite, CompositeOf, ShadowedSplitSum, SplitSum
from unirender_evaluation.methods.decompositions import Decompositions
from unirender_evaluation.methods.kept_defaults import OwnDefaults
from unirender_evaluation.methods.light import MeanLight, UniformLight
from unirender_evaluation.methods.method import capabilities
from unirender_evaluation.methods.pipeline import PipelineMethod
from unirender_evaluation.methods.plugins import Plugin
from unirender_evaluation.methods.trivial import (
    ConstantMaterial,
    InputAsAlbedo,
    MeanAlbedo,
    MeanNormal,
    SphereNormal,
    UneditedInput,
)
from unirender_evaluation.predictions.folder import PredictionFolder
from unirender_evaluation.records import MethodInfo, MethodKind
from unirender_evaluation.suites.suite import Scene, material_key
from unirender_evaluation.task import LIGHT, PROTOCOLS, Task
from unirender_evaluation.versions import LPIPS, MODEL

T = TypeVar("T")
SAMPLE_STEPS, SAMPLE_COUNT = 20, 5
LOOKS = 6
FLAT_ALBEDO = "albedo made even between its edges"
MEAN_OF_LOOKS = "mean of looks at the picture, mirrored and with exchanged channels"
KEY_LETTERS = "a letter from a to z or a digit, of which its key is made, and nothing that does not print"


@dataclass(frozen=True)
class Row:
    """One row of the tables.

    Attributes:
        info: how records and tables name it.
        method: answers the tasks; None for a folder of predictions.
        predictions: the folder, if it is one.
        protocols: (table, protocol) pairs that it takes part in; None = all that its capabilities allow.
        scenes: runs on that many of the run's scenes, evenly spaced; None = all.
        pictures: in `inverse`, of that many of a scene's materials, evenly spaced; None = all.
        uses: the parts (`versions.PARTS`) that its answers depend on besides the core.
        told: what it is handed beyond the inputs that all rows have, by the name of the task's field: "geometry", the
            object's true mesh. Its label and note say so.
        found: what a stranger's method has found so far.
        defaults: of the process, as a stranger's method set them so far.
    """

    info: MethodInfo
    method: Any = None
    predictions: PredictionFolder | None = None
    protocols: frozenset[tuple[str, str]] | None = None
    scenes: int | None = None
    pictures: int | None = None
    uses: frozenset[str] = frozenset()
    told: frozenset[str] = frozenset()
    found: Decompositions[Intrinsics | None] = field(default_factory=Decompositions, compare=False, repr=False)
    defaults: OwnDefaults = field(default_factory=OwnDefaults, compare=False, repr=False)

    @property
    def config(self) -> dict[str, Any]:
        """What its results depend on."""
        return {**self.info.config, **({"told": sorted(self.told)} if self.told else {})}

    @property
    def scored_with(self) -> frozenset[str]:
        """The parts that its scores depend on."""
        return self.uses | {LPIPS}

    def answers(self, task: Task, scenes: list[Scene]) -> bool:
        """Whether the row takes part in a task of a run over `scenes`."""
        if self.protocols is not None and (task.table, task.protocol) not in self.protocols:
            return False
        if self.scenes is not None and task.scene not in evenly(scenes, self.scenes):
            return False
        if task.table == "inverse" and self.pictures is not None:
            chosen = evenly(task.scene.materials, self.pictures)
            if not any(task.sample == f"{task.scene.key}_{material_key(material)}" for material in chosen):
                return False
        if self.predictions is not None:
            return self.predictions.has(task)
        return any(name in capabilities(self.method) for name in task.asks)

    def described(self, scenes: int) -> MethodInfo:
        """How a run of that many scenes names it: where the row had fewer, its note says how many."""
        fewer = [self.info.note] if self.info.note else []
        if self.scenes is not None and self.scenes < scenes:
            fewer.append(f"{self.scenes} scene{'s' * (self.scenes != 1)} only")
        if self.pictures is not None:
            fewer.append(f"inverse: {self.pictures} picture{'s' * (self.pictures != 1)} of each scene only")
        return replace(self.info, note="; ".join(fewer))


def evenly(items: Sequence[T], count: int | None) -> list[T]:
    """`count` of the items, evenly spaced; all where None, or where there are not more."""
    if count is None or count >= len(items):
        return list(items)
    return [items[i] for i in np.linspace(0, len(items) - 1, count).round().astype(int)]


def slug(name: str) -> str:
    """A row's key: lower case, words joined by hyphens; empty where the name has no letter from a to z and no digit."""
    return re.sub(r"[^a-z0-9]+", "-", name.lower()).strip("-")


def _is_label(name: str) -> bool:
    return bool(slug(name)) and name.isprintable()  # others move the cursor, or turn the writing


def make_row(method: Any, kind: MethodKind, label: str | None = None, **options: Any) -> Row:
    """A row of a method; `options` are fields of :class:`Row` or of :class:`MethodInfo`.

    Raises:
        UnirenderError: the method's name has nothing for a key or does not print, its config is no JSON object, or one
            of them is a property that fails.
    """
    fields = {
        name: options.pop(name) for name in ("protocols", "scenes", "pictures", "uses", "told") if name in options
    }
    name, config = (_attribute(method, attribute) for attribute in ("name", "config"))
    if not isinstance(name, str) or not _is_label(name):
        raise UnirenderError(f"{method!r}: got the name {name!r}, expected a string with {KEY_LETTERS}")
    try:
        config = json.loads(json.dumps(dict(config), allow_nan=False))
    except (TypeError, ValueError) as error:
        raise UnirenderError(
            f"method {name!r}: its config is not JSON ({error}), expected a dict of strings, numbers and lists"
        ) from None
    info = MethodInfo(slug(name), label or name, kind, config=config, **options)
    return Row(info, method, **fields)


def _attribute(method: Any, name: str) -> Any:
    try:
        return getattr(method, name)
    except Exception as error:  # of a stranger's property
        raise UnirenderError(
            f"{type(method).__name__}: reading its `{name}` failed: {type(error).__name__}: {error}"
        ) from error


def trivial_rows() -> list[Row]:
    """What a method must beat."""
    notes = {
        "mean albedo": "constant: mean of display values over training objects",
        "sphere normal": "from the silhouette alone",
    }
    methods = [UneditedInput(), InputAsAlbedo(), MeanAlbedo(), MeanNormal(), SphereNormal(), ConstantMaterial()]
    of_light = frozenset({LIGHT})
    others = frozenset(PROTOCOLS) - of_light
    rows = [make_row(m, "trivial", protocols=others, note=notes.get(m.name, "")) for m in methods]
    lights = {UniformLight(): "white, as bright as the picture", MeanLight(): "mean of training lights by height"}
    rows += [make_row(m, "trivial", protocols=of_light, note=note) for m, note in lights.items()]
    given = frozenset({("rendering", "given"), ("rendering", "given-light")})
    light_alone = frozenset({("rendering", "given-light")})
    note = "given light: s and d derived without shadows"
    seen = "s and d derived with the shadows that the picture shows"
    split = "reflectance averaged over the GGX lobe instead of that at normal incidence"
    return [
        *rows,
        make_row(Composite(), "baseline", protocols=given, note=note),
        make_row(SplitSum(), "baseline", protocols=given, note=split),
        make_row(ShadowedSplitSum(), "baseline", protocols=light_alone, note=seen, uses=frozenset({MODEL})),
    ]


def our_rows(
    pipeline: Any, weights: str, seed: int = 0, sample_scenes: int | None = None, device: str = "cpu"
) -> list[Row]:
    """Our rows: `mean` plain, anchored, of several looks, with a flat albedo and not closed; composites of its
    decomposition; `sample` on a subset of scenes.

    Args:
        pipeline: a `UniRenderPipeline`.
        weights: `checkpoint_sha256` of its checkpoint.
        seed: of the sampling mode.
        sample_scenes: scenes of the sampling rows; None = all, 0 = leave them out.
        device: where it runs.
    """
    from_image = frozenset(
        {("rendering", "from-image"), ("relighting", "from-image-sd"), ("relighting", "from-image-hdri")}
    )
    shared = Decompositions[Any]()
    edited: dict[str, Intrinsics] = {}

    def ours(name: str, **options: Any) -> PipelineMethod:
        return PipelineMethod(pipeline, name, weights, seed=seed, device=device, **options)

    mean = ours("Ours (mean)", decompositions=shared)
    anchored = ours("Ours (mean, anchored)", anchored=True, decompositions=shared)
    looked = ours(f"Ours (mean, {LOOKS} looks)", looks=LOOKS)
    flat = ours("Ours (mean, flat albedo)", flat=True)
    open_mean = ours("Ours (mean, not closed)", closed=False)
    composites = [CompositeOf(mean, anchored=carried, edited=edited) for carried in (False, True)]
    decomposes = from_image | {("inverse", "single-image"), LIGHT}
    one: dict[str, Any] = {"steps": 1, "samples": 1, "uses": frozenset({MODEL})}
    many: dict[str, Any] = one | {"steps": SAMPLE_STEPS, "samples": SAMPLE_COUNT, "seed": seed}
    rows = [
        make_row(mean, "ours", published="Ours", **one),
        make_row(anchored, "ours", protocols=from_image, **one),
        make_row(looked, "ours", protocols=decomposes, note=MEAN_OF_LOOKS, **one),
        make_row(flat, "ours", protocols=decomposes, note=FLAT_ALBEDO, **one),
        make_row(open_mean, "ours", protocols=decomposes, note="maps as the network predicts them", **one),
        *(make_row(composite, "baseline", protocols=from_image, **one) for composite in composites),
    ]
    if sample_scenes != 0:
        sampled = ours("Ours (sample)", mode="sample", steps=SAMPLE_STEPS, samples=SAMPLE_COUNT)
        subset = decomposes - {("relighting", "from-image-sd"), ("relighting", "from-image-hdri")}
        rows.append(make_row(sampled, "ours", scenes=sample_scenes, protocols=subset, **many))
    return rows


def prediction_rows(folders: Mapping[str, Path]) -> list[Row]:
    """One row per `--predictions name=folder`.

    Raises:
        UsageError: a name has nothing for a key, or does not print.
        UnirenderError: a folder is not one of predictions.
    """
    rows = []
    for name, folder in folders.items():
        if not _is_label(name):
            raise UsageError(f"--predictions {name}={folder}: got the name {name!r}, expected {KEY_LETTERS}")
        predictions = PredictionFolder(Path(folder))
        info = MethodInfo(
            slug(name), name, "external", config={"name": name, "predictions": predictions.sha256()}, mask="pasted"
        )
        rows.append(Row(info, None, predictions))
    return rows


def plugin_rows(plugins: Sequence[Plugin]) -> list[Row]:
    """Rows of other people's methods; what they import of unirender is not known, so that all of it counts.

    Their name, class and arguments count beside their `config`: two methods of one file may leave that empty.
    Whole numbers of the names `steps`, `samples` and `seed` in a method's configuration stand in the protocol line.
    """
    rows = []
    for plugin in plugins:
        row = make_row(plugin.method, "external", uses=frozenset({MODEL}))
        config = row.info.config
        stated = {name: config[name] for name in ("steps", "samples", "seed") if type(config.get(name)) is int}
        told_apart = {"name": row.info.label, "source": plugin.source, "made_by": dict(plugin.made_by)}
        info = replace(row.info, config={**config, "plugin": told_apart}, **stated)
        rows.append(replace(row, info=info, defaults=plugin.defaults))
    return rows


def check_rows(rows: list[Row], reserved: Collection[str] = ()) -> list[Row]:
    """The rows as they are.

    Args:
        rows: of a run.
        reserved: keys that no row of a stranger may have: those of the bounds. Nor may they begin with ours.

    Raises:
        UnirenderError: two rows have one key, or a stranger's has a reserved one (`UsageError` where `--predictions`
            gave the name).
    """
    keys = [row.info.key for row in rows]
    double = [
        row
        for row in rows
        if keys.count(row.info.key) > 1
        or (row.info.kind == "external" and (row.info.key in reserved or row.info.key.split("-")[0] == "ours"))
    ]
    if double:
        names = ", ".join(sorted({row.info.key for row in double}))
        from_command_line = any(row.predictions is not None for row in double)
        raise (UsageError if from_command_line else UnirenderError)(
            f"rows: {names} occur twice or are taken, expected unique names, none that of a bound and none that "
            "begins with 'ours'; rename one"
        )
    return [replace(row) for row in rows]
