"""The rows of a run: which methods, under which name, on which tables, on how many scenes."""

import hashlib
import json
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from unirender.camera import Camera
from unirender.errors import UnirenderError
from unirender.intrinsics import Intrinsics
from unirender_evaluation.methods import (
    Composite,
    CompositeOf,
    ConstantMaterial,
    Image,
    InputAsAlbedo,
    Mask,
    MeanAlbedo,
    MeanNormal,
    SphereNormal,
    UneditedInput,
    capabilities,
    plugin_methods,
)
from unirender_evaluation.predictions import PredictionFolder
from unirender_evaluation.records import MethodInfo, MethodKind
from unirender_evaluation.suites import Scene
from unirender_evaluation.tasks import Task

SAMPLE_SCENES = 4  # the sampling mode costs steps x samples: it runs on a stated subset
SAMPLE_STEPS, SAMPLE_COUNT = 20, 5


@dataclass(frozen=True)
class Row:
    """One row of the tables.

    Attributes:
        info: how records and tables name it.
        method: answers the tasks; None for a folder of predictions.
        predictions: the folder, if it is one.
        protocols: (table, protocol) pairs that it takes part in; None = all that its capabilities allow.
        scenes: runs on that many of the run's scenes, evenly spaced; None = all.
    """

    info: MethodInfo
    method: Any = None
    predictions: PredictionFolder | None = None
    protocols: frozenset[tuple[str, str]] | None = None
    scenes: int | None = None

    @property
    def config(self) -> dict[str, Any]:
        """What its results depend on."""
        return dict(self.info.config)

    def answers(self, task: Task, scenes: list[Scene]) -> bool:
        """Whether the row takes part in a task of a run over `scenes`."""
        if self.protocols is not None and (task.table, task.protocol) not in self.protocols:
            return False
        if self.scenes is not None and self.scenes < len(scenes):
            chosen = [scenes[i] for i in np.linspace(0, len(scenes) - 1, self.scenes).round().astype(int)]
            if task.scene not in chosen:
                return False
        if self.predictions is not None:
            return self.predictions.has(task)
        return any(name in capabilities(self.method) for name in task.asks)


def slug(name: str) -> str:
    """A row's key: lower case, words joined by hyphens."""
    return re.sub(r"[^a-z0-9]+", "-", name.lower()).strip("-")


def make_row(method: Any, kind: MethodKind, label: str | None = None, **options: Any) -> Row:
    """A row of a method; `options` are fields of :class:`Row` or of :class:`MethodInfo`."""
    fields = {name: options.pop(name) for name in ("protocols", "scenes") if name in options}
    info = MethodInfo(
        slug(method.name), label or method.name, kind, config=json.loads(json.dumps(dict(method.config))), **options
    )
    return Row(info, method, **fields)


def trivial_rows() -> list[Row]:
    """What a method must beat."""
    notes = {
        "mean albedo": "constant: mean of display values over training objects",
        "sphere normal": "from the silhouette alone",
    }
    methods = [UneditedInput(), InputAsAlbedo(), MeanAlbedo(), MeanNormal(), SphereNormal(), ConstantMaterial()]
    rows = [make_row(m, "trivial", note=notes.get(m.name, "")) for m in methods]
    given = frozenset({("rendering", "given"), ("rendering", "given-light")})
    return [
        *rows,
        make_row(Composite(), "baseline", protocols=given, note="given light: s and d derived without shadows"),
    ]


class PipelineMethod:
    """Our model as a benchmark method.

    Args:
        pipeline: a `UniRenderPipeline`.
        name: of the row.
        mode: "mean" (one step) or "sample".
        anchored: edits and relighting carry over what the decomposition could not explain.
        steps: denoising steps of "sample".
        samples: averaged per prediction in "sample".
        seed: of the generator; every call starts from it.
        weights: sha256 of the checkpoint.
        decompositions: shared with another row of the same pipeline and mode.
        closed: albedo, s and d are changed so that their rendering is the picture.
    """

    def __init__(
        self,
        pipeline: Any,
        name: str,
        mode: str,
        anchored: bool,
        steps: int,
        samples: int,
        seed: int,
        weights: str,
        decompositions: dict[str, Any] | None = None,
        closed: bool = True,
    ) -> None:
        self.pipeline, self.name, self.mode, self.anchored = pipeline, name, mode, anchored
        self.closed = closed
        self.steps, self.samples, self.seed, self.weights = steps, samples, seed, weights
        self._decompositions: dict[str, Any] = {} if decompositions is None else decompositions

    @property
    def config(self) -> dict[str, Any]:
        return {
            "pipeline": "unirender",
            "weights": self.weights,
            "mode": self.mode,
            "anchored": self.anchored,
            "closed": self.closed,
            "steps": self.steps,
            "samples": self.samples,
            "seed": self.seed,
        }

    def _options(self) -> dict[str, Any]:
        import torch

        if self.mode == "mean":
            return {"mode": "mean"}
        generator = torch.Generator().manual_seed(self.seed)
        return {
            "mode": self.mode,
            "num_inference_steps": self.steps,
            "num_samples": self.samples,
            "generator": generator,
        }

    def _decomposition(self, image_srgb: Image, mask: Mask, camera: Camera) -> Any:
        """Of a picture, computed once: the rows that share it differ in what they do with it."""
        key = hashlib.sha256(image_srgb.tobytes() + mask.tobytes() + repr(camera).encode()).hexdigest()
        if key not in self._decompositions:
            options = {**self._options(), "closed": self.closed}
            made = self.pipeline.decompose(image_srgb, mask=mask, camera=camera, **options)
            self._decompositions[key] = made
        return self._decompositions[key]

    def decompose(self, image_srgb: Image, mask: Mask, camera: Camera) -> Intrinsics:
        return self._decomposition(image_srgb, mask, camera).intrinsics

    def edit(self, image_srgb: Image, mask: Mask, camera: Camera, **material: float) -> Image:
        found = self._decomposition(image_srgb, mask, camera)
        options = {**self._options(), "anchored": self.anchored, "decomposition": found, **material}
        return self.pipeline.edit(image_srgb, mask=mask, camera=camera, **options).image_linear

    def relight(
        self,
        image_srgb: Image,
        mask: Mask,
        camera: Camera,
        environment: Any = None,
        specular: Any = None,
        diffuse: Any = None,
    ) -> Image:
        found = self._decomposition(image_srgb, mask, camera)
        options = {**self._options(), "anchored": self.anchored, "decomposition": found, "exposure": "keep"}
        light = {"specular": specular, "diffuse": diffuse}
        return self.pipeline.relight(image_srgb, environment, mask=mask, camera=camera, **light, **options).image_linear

    def render(self, intrinsics: Intrinsics) -> Image:
        return self.pipeline.render(intrinsics, **self._options())


def weights_hash(folder: Path) -> str:
    """sha256 over the files of a checkpoint folder."""
    digest = hashlib.sha256()
    files = sorted(p for p in folder.rglob("*") if p.suffix in (".safetensors", ".json"))
    if not files:
        raise UnirenderError(f"no checkpoint in {folder}: expected .safetensors and .json files")
    for path in files:
        digest.update(str(path.relative_to(folder)).encode() + path.read_bytes())
    return digest.hexdigest()


class LazyPipeline:
    """A pipeline that is loaded when it is first asked something: a run that has nothing to do loads nothing."""

    def __init__(self, load: Callable[[], Any]) -> None:
        self._load = load
        self._pipeline: Any = None

    def __getattr__(self, name: str) -> Any:
        if self._pipeline is None:
            self._pipeline = self._load()
        return getattr(self._pipeline, name)


def our_rows(pipeline: Any, weights: str, seed: int = 0, sample_scenes: int = SAMPLE_SCENES) -> list[Row]:
    """Our rows: `mean` plain, anchored and not closed, composites of its decomposition, `sample` on a subset of scenes.

    Args:
        pipeline: a `UniRenderPipeline`.
        weights: `weights_hash` of its checkpoint.
        seed: of the sampling mode.
        sample_scenes: scenes of the sampling rows; 0 leaves them out.
    """
    from_image = frozenset(
        {("rendering", "from-image"), ("relighting", "from-image-sd"), ("relighting", "from-image-hdri")}
    )
    shared: dict[str, Any] = {}
    edited: dict[str, Intrinsics] = {}
    mean = PipelineMethod(pipeline, "Ours (mean)", "mean", False, 1, 1, seed, weights, shared)
    anchored = PipelineMethod(pipeline, "Ours (mean, anchored)", "mean", True, 1, 1, seed, weights, shared)
    open_mean = PipelineMethod(pipeline, "Ours (mean, not closed)", "mean", False, 1, 1, seed, weights, closed=False)
    decomposes = from_image | {("inverse", "single-image")}
    rows = [
        make_row(mean, "ours", published="Ours", steps=1, samples=1),
        make_row(anchored, "ours", steps=1, samples=1, protocols=from_image),
        make_row(open_mean, "ours", steps=1, samples=1, protocols=decomposes, note="maps as the network predicts them"),
        make_row(CompositeOf(mean, anchored=False, edited=edited), "ours", steps=1, samples=1, protocols=from_image),
        make_row(CompositeOf(mean, anchored=True, edited=edited), "ours", steps=1, samples=1, protocols=from_image),
    ]
    if sample_scenes:
        sampled = PipelineMethod(pipeline, "Ours (sample)", "sample", False, SAMPLE_STEPS, SAMPLE_COUNT, seed, weights)
        subset = frozenset({("rendering", "from-image"), ("inverse", "single-image")})
        extra = {"steps": SAMPLE_STEPS, "samples": SAMPLE_COUNT, "seed": seed, "note": f"{sample_scenes} scenes only"}
        rows.append(make_row(sampled, "ours", scenes=sample_scenes, protocols=subset, **extra))
    return rows


def prediction_rows(folders: Mapping[str, Path]) -> list[Row]:
    """One row per `--predictions name=folder`."""
    rows = []
    for name, folder in folders.items():
        predictions = PredictionFolder(Path(folder))
        info = MethodInfo(
            slug(name), name, "external", config={"name": name, "predictions": predictions.sha256()}, mask="pasted"
        )
        rows.append(Row(info, None, predictions))
    return rows


def plugin_rows(names: list[str] | None = None) -> list[Row]:
    """Rows of installed plug-ins."""
    return [make_row(method, "external") for method in plugin_methods(names)]


def check_rows(rows: list[Row]) -> list[Row]:
    """Refuses two rows of one key."""
    keys = [row.info.key for row in rows]
    double = sorted({key for key in keys if keys.count(key) > 1})
    if double:
        raise UnirenderError(f"rows: {', '.join(double)} occur twice, expected unique names; rename one")
    return [replace(row) for row in rows]
