"""Measures what steps and samples are worth to our model, and whether the spread of its samples is its error.

Every scene has one picture (one of its own materials), of which `decompose` is asked for the network's own maps, not
closed, and one of the suite's edits, in turn, whose image `render` is asked for from the true maps with the true s and
d: once in mode `mean`, and in mode `sample` for every number of steps and of samples. What is scored is the mean of the
samples. Fewer samples are the first of the many that one call draws. Calibration is defined in
`calibration`.
"""

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from unirender.intrinsics import Intrinsics
from unirender_evaluation.multiview.scenes import scene_material
from unirender_evaluation.records import Record
from unirender_evaluation.scoring import score_image, score_maps
from unirender_evaluation.store import Store, content_key
from unirender_evaluation.studies.sampling.calibration import scene_calibration
from unirender_evaluation.suites.suite import Scene, Suite
from unirender_evaluation.task import Task
from unirender_evaluation.tasks import picture, tasks
from unirender_evaluation.truth.render import item_seed
from unirender_evaluation.versions import MODEL, SEPARATOR, Versions, modules_version

TABLE, DECOMPOSE, RENDER = "sampling", "decompose", "render"
PROTOCOLS = (DECOMPOSE, RENDER)
USES = frozenset({MODEL})
OWN_MODULES = ("studies/sampling/measure", "studies/sampling/calibration")


@dataclass(frozen=True)
class Setting:
    """How the network is asked."""

    mode: str  # `mean` or `sample`
    steps: int = 1  # of the sampler
    samples: int = 1  # whose mean is scored

    @property
    def key(self) -> str:
        """In records."""
        return self.mode if self == MEAN else f"{self.mode}-{self.steps}x{self.samples}"


MEAN = Setting("mean")


@dataclass(frozen=True)
class SamplingStudy:
    """What is measured."""

    suite: Suite  # whose scenes
    out: Path  # folder of the records
    pipeline: Any  # a `UniRenderPipeline`, or what loads one when it is asked
    weights: str  # sha256 of its checkpoint
    device: str  # where it runs
    steps: tuple[int, ...]  # of mode `sample`, in rising order
    samples: tuple[int, ...]  # the same
    sampler: str  # of mode `sample`: `ddim` or `unipc`
    seed: int  # of the noise; every scene derives its own
    versions: Versions  # of the code, for the content keys

    @property
    def settings(self) -> tuple[Setting, ...]:
        """`mean`, then every number of steps with every number of samples."""
        return (MEAN, *(Setting("sample", steps, samples) for samples in self.samples for steps in self.steps))

    @property
    def code(self) -> str:
        """Versions of what the figures depend on."""
        return f"{self.versions.of(USES)}{SEPARATOR}{modules_version(*OWN_MODULES)}"

    def key(self, scene: Scene, protocol: str, setting: Setting) -> str:
        """The content key of a record."""
        config = {"weights": self.weights, "device": self.device, **asdict(setting)}
        if setting != MEAN:
            config |= {"sampler": self.sampler, "seed": self.seed}
        question = f"{TABLE}/{protocol}/{scene.key}"  # a scene's truth is hashed with its object's other lights
        return content_key(self.suite, scene, question, config, self.code)


def measure(what: SamplingStudy, scenes: Sequence[Scene]) -> Iterator[tuple[Record, bool]]:
    """The records of scenes, and whether each was measured now; those that are stored are not measured again."""
    store = Store.open(what.out / "records.jsonl")
    for scene in scenes:
        case = Case(what, scene)
        for protocol in PROTOCOLS:
            for setting in what.settings:
                key = what.key(scene, protocol, setting)
                new = not store.has(key)
                if new:
                    values = case.values(protocol, setting)
                    store.add(Record(TABLE, protocol, setting.key, scene.key, scene.object, values, key))
                yield store.used[key], new
    store.close()


class Case:
    """One picture; the samples that its records share are drawn when the first asks for them."""

    def __init__(self, what: SamplingStudy, scene: Scene) -> None:
        self.what, self.scene = what, scene
        self.material = scene_material(what.suite, scene)
        self._drawn: dict[tuple[str, int], tuple[Intrinsics, ...]] = {}

    def values(self, protocol: str, setting: Setting) -> dict[str, float]:
        """Metric key -> value."""
        return self._decomposed(setting) if protocol == DECOMPOSE else self._rendered(setting)

    def _decomposed(self, setting: Setting) -> dict[str, float]:
        from unirender.pipelines.results import combine

        samples = self._samples(setting)[: setting.samples]
        found = combine(samples).intrinsics
        values = score_maps(found.replace(mask=None, specular=None, diffuse=None, environment=None), self._truth)
        if len(samples) > 1:
            for name, calibration in scene_calibration(samples, self._truth).items():
                values |= calibration.values(name)
        return values

    def _rendered(self, setting: Setting) -> dict[str, float]:
        task = self._render_task
        image = self.what.pipeline.render(**task.inputs["render"], **self._sampling(RENDER, setting, setting.samples))
        assert task.truth_image is not None
        return score_image(image, task.truth_image, task.mask, quantity=RENDER)

    def _samples(self, setting: Setting) -> tuple[Intrinsics, ...]:
        """All that one call draws with these steps."""
        key = (setting.mode, setting.steps)
        if key not in self._drawn:
            seen = picture(self.what.suite, self.scene, self.material)
            count = 1 if setting.mode == "mean" else max(self.what.samples)
            found = self.what.pipeline.decompose(**seen, closed=False, **self._sampling(DECOMPOSE, setting, count))
            self._drawn[key] = found.samples or (found.intrinsics,)
        return self._drawn[key]

    def _sampling(self, protocol: str, setting: Setting, count: int) -> dict[str, Any]:
        """Keyword arguments of the pipeline's methods."""
        import torch

        if setting.mode == "mean":
            return {"mode": "mean"}
        generator = torch.Generator().manual_seed(item_seed(self.what.seed, self.scene.key, protocol))
        return {
            "mode": setting.mode,
            "num_inference_steps": setting.steps,
            "num_samples": count,
            "sampler": self.what.sampler,
            "generator": generator,
        }

    @cached_property
    def _truth(self) -> Intrinsics:
        return self.what.suite.intrinsics(self.scene, self.material)

    @cached_property
    def _render_task(self) -> Task:
        """One of the benchmark's questions `rendering`, given: the scenes of the suite take its edits in turn."""
        found = list(tasks(self.what.suite, "rendering", "given", [self.scene]))
        return found[self.what.suite.scenes.index(self.scene) % len(found)]
