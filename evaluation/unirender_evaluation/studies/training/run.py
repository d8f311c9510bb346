"""A run of `unirender bench training`: trains, scores, prints, writes.

Every row has a folder of `unirender train` below `runs/`, named by what was trained on what, so that a study that was
stopped goes on, inside a training too.
"""

import hashlib
import json
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

from rich.console import Console

from unirender.command_line.options import Device
from unirender_evaluation.metrics import DEFAULT_VARIANT, metric_key
from unirender_evaluation.records import Record
from unirender_evaluation.scoring import score_image
from unirender_evaluation.store import Store, content_key
from unirender_evaluation.studies.about import description
from unirender_evaluation.studies.folder import open_folder, write_study
from unirender_evaluation.studies.training import tables
from unirender_evaluation.studies.training.choices import BASE_PRESET, Choice
from unirender_evaluation.suites.suite import Scene, Suite
from unirender_evaluation.tasks import picture
from unirender_evaluation.validation import score_scene
from unirender_evaluation.versions import (
    MODEL,
    REFERENCE,
    SEPARATOR,
    Part,
    installed_version,
    modules_version,
    package_folder,
    part_version,
    versions,
)

NAME, TABLE = "training", "training-choices"
SHADE_SPP = 128
OWN, MITSUBA = "again", "again_mitsuba"  # quantities: the unclosed maps, rendered by the network and by Mitsuba


@dataclass(frozen=True)
class TrainingStudy:
    """What is measured, but for the rows."""

    suite: Suite  # whose scenes
    data: Path  # folder of the training samples
    out: Path  # folder of records, tables and training runs
    steps: int  # of every training
    device: Device = "auto"  # where the training runs
    parallel: int | None = None  # passes side by side; None: as many as PyTorch has threads
    preset: str = BASE_PRESET  # what every row is a change of, for the description

    @cached_property
    def trained_on(self) -> dict[str, Any]:
        """Data and length of every training."""
        from unirender.training.data.dataset import GroupDataset

        dataset = GroupDataset(self.data)
        return {"data": dataset.fingerprint, "groups": len(dataset.keys), "steps": self.steps}

    @cached_property
    def code(self) -> str:
        """Versions of what the figures depend on."""
        training = Part({"unirender": ("training/**/*.py",)}, ("torch", "diffusers"))
        trainer = part_version(training, {"unirender": package_folder("unirender")})
        own = modules_version("studies/training/run", "validation")
        return SEPARATOR.join((versions().of(frozenset({MODEL, REFERENCE})), trainer, own))

    def config(self, choice: Choice) -> dict[str, Any]:
        """What a row's network depends on."""
        return {"train": asdict(choice.config), **self.trained_on, "parallel": self.parallel}

    def folder(self, choice: Choice) -> Path:
        """Of a row's training."""
        digest = hashlib.sha256(json.dumps(self.config(choice), sort_keys=True, default=str).encode()).hexdigest()
        return self.out / "runs" / f"{choice.name}-{digest[:8]}"

    def key(self, choice: Choice, scene: Scene, number: int) -> str:
        """The content key of a record; `number` chooses among the scene's questions."""
        what = f"{TABLE}/{scene.key}/{number}"  # the scene's hash is its object's
        return content_key(self.suite, scene, what, self.config(choice), self.code)


@dataclass
class Trained:
    """A row's network, trained when it is first asked for."""

    study: TrainingStudy
    choice: Choice
    facts: dict[str, float] = field(default_factory=dict)

    @cached_property
    def pipeline(self) -> Any:
        """The averaged weights at the end of the training, which goes on where it was stopped."""
        from unirender.pipelines.unirender_pipeline import UniRenderPipeline
        from unirender.training.command import Train
        from unirender.training.run import train

        study = self.study
        options = Train(data=study.data, steps=study.steps, device=study.device, parallel=study.parallel)
        made = train(options, self.choice.config, study.folder(self.choice))
        pipeline = UniRenderPipeline.from_pretrained(made)
        pipeline.set_progress_bar_config(disable=True)
        return pipeline

    def values(self, scene: Scene, number: int) -> dict[str, float]:
        """Metric key -> value on one scene.

        The decomposition that is rendered again is the network's own (not closed): by the network, which may have
        learned to accept its own wrong maps, and by Mitsuba, which has not.
        """
        from unirender_reference.shade import shade

        suite = self.study.suite
        found = score_scene(self.pipeline, suite, scene, number)
        values = {metric_key(name, metric, DEFAULT_VARIANT): value for (name, metric), value in found.items()}
        seen = picture(suite, scene, suite.spec.base)
        maps = self.pipeline.decompose(**seen, closed=False).intrinsics
        truth = suite.image(scene, suite.spec.base)
        for quantity, image in ((OWN, self.pipeline.render(maps)), (MITSUBA, shade(maps, spp=SHADE_SPP))):
            values |= score_image(image, truth, seen["mask"], quantity=quantity)
        return values


def measure(study: TrainingStudy, rows: Sequence[Choice], scenes: Sequence[Scene]) -> Iterator[tuple[Record, bool]]:
    """The records of rows and scenes, and whether each was measured now; rows that are stored are not trained again."""
    store = Store.open(study.out / "records.jsonl")
    for choice in rows:
        trained = Trained(study, choice)
        for number, scene in enumerate(scenes):
            key = study.key(choice, scene, number)
            new = not store.has(key)
            if new:
                values = trained.values(scene, number)
                store.add(Record(TABLE, "validation", choice.name, scene.key, scene.object, values, key))
            yield store.used[key], new
    store.close()


def run(study: TrainingStudy, rows: Sequence[Choice], scenes: Sequence[Scene], console: Console) -> list[Record]:
    """Trains and measures what is missing and writes `training.md` and `training.json`."""
    with open_folder(study.out):
        records, computed = [], 0
        for record, new in measure(study, rows, scenes):
            records.append(record)
            computed += new
        table, trained_on = tables.table(rows, records), study.trained_on
        about = description(
            study.suite,
            study.code,
            data=f"{trained_on['data'][:12]} ({trained_on['groups']} groups)",
            preset=study.preset,
            steps=f"{study.steps}",
            batch=f"{rows[0].config.batch_size}",
            torch=str(installed_version("torch")),
        )
        counts = f"{computed} new records of {len(records)}"
        content = tables.to_json(rows, records, about)
        write_study(study.out / NAME, [table], about, content, counts, console)
        return records
