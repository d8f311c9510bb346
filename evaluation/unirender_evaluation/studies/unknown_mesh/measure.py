"""Measures the whole optimisation without a mesh on a suite's objects: shape, materials, light, seconds.

Every object has a folder named by its content key: the optimisation goes on in it where it was killed, and its result
(`mesh.glb`, `environment.exr`, `strip.png`, ...) stays there. Its record is stored as soon as it is measured.
"""

import io
import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from unirender_evaluation.metrics import metric_key
from unirender_evaluation.multiview.scenes import suite_scene
from unirender_evaluation.multiview.scoring import solution_looks
from unirender_evaluation.multiview.settings import MultiviewSettings
from unirender_evaluation.multiview.tables import SECONDS
from unirender_evaluation.records import Record
from unirender_evaluation.store import Store, content_key
from unirender_evaluation.studies.folder import write_files
from unirender_evaluation.suites.suite import Scene, Suite
from unirender_evaluation.versions import MULTIVIEW, OPTIMIZER, REFERENCE, SEPARATOR, Versions, modules_version
from unirender_reference.optimize.multiview.config import OptimizeConfig
from unirender_reference.optimize.show.report import OnReport

TABLE, PROTOCOL, METHOD = "unknown-mesh", "unknown-mesh", "unirender-optimize"
USES = frozenset({MULTIVIEW, OPTIMIZER, REFERENCE})
STRIP = "strip.png"
DIGITS = 8  # of the content key, in a folder's name


@dataclass(frozen=True)
class UnknownMesh:
    """What is measured."""

    suite: Suite  # whose objects and lights
    out: Path  # folder of records and results
    settings: MultiviewSettings  # cameras and samples
    config: OptimizeConfig  # of the optimisation
    versions: Versions  # of the code, for the content keys

    @property
    def code(self) -> str:
        """Versions of what the figures depend on."""
        own = modules_version("studies/unknown_mesh/measure", "studies/unknown_mesh/scoring")
        return f"{self.versions.of(USES)}{SEPARATOR}{own}"

    def key(self, scene: Scene) -> str:
        """The content key of a scene's record."""
        question = f"{TABLE}/{json.dumps(asdict(self.settings), sort_keys=True)}"
        config = {name: value for name, value in asdict(self.config).items() if name != "save_seconds"}
        return content_key(self.suite, scene, question, config, self.code)

    def folder(self, scene: Scene) -> Path:
        """Where the result of a scene is."""
        return self.out / f"{scene.key}-{self.key(scene)[-DIGITS:]}"


def measure(
    what: UnknownMesh, scenes: Sequence[Scene], progress: Callable[[Scene], OnReport | None] = lambda scene: None
) -> Iterator[tuple[Record, bool]]:
    """The records of scenes, and whether each was measured now; those that are stored are not measured again."""
    store = Store.open(what.out / "records.jsonl")
    for scene in scenes:
        key = what.key(scene)
        new = not (store.has(key) and (what.folder(scene) / STRIP).is_file())
        if new:
            store.add(measured(what, scene, progress(scene)))
        yield store.used[key], new
    store.close()


def measured(what: UnknownMesh, scene: Scene, progress: OnReport | None = None) -> Record:
    """Optimises one object from its pictures, scores the result and draws it."""
    from unirender_evaluation.studies.unknown_mesh.pictures import found_strip
    from unirender_evaluation.studies.unknown_mesh.scoring import score_found
    from unirender_reference.optimize.multiview.run import optimize

    world, folder = suite_scene(what.suite, scene, what.settings), what.folder(scene)
    solution = optimize(world.views, None, what.config, folder, progress=progress, pictures=False)
    looks = solution_looks(world, solution)
    values = score_found(world, solution, looks) | stage_seconds(folder)
    picture = io.BytesIO()
    found_strip(world, looks).save(picture, format="PNG")
    write_files(folder, {STRIP: picture.getvalue()})
    total = values[metric_key("time", SECONDS)]
    return Record(TABLE, PROTOCOL, METHOD, scene.key, scene.object, values, what.key(scene), seconds=total)


def stage_seconds(folder: Path) -> dict[str, float]:
    """Seconds of every stage of a finished run, up to its last step, and of the whole run with its files.

    What is done between two stages (charts, textures) counts for the later one.
    """
    from unirender_reference.optimize.files.state import HISTORY, PROGRESS, STATE
    from unirender_reference.optimize.multiview.result import stage_table

    lines = (folder / HISTORY).read_text(encoding="utf-8").splitlines()
    values, before = {}, 0.0
    for stage in stage_table([json.loads(line) for line in lines]):
        values[metric_key(f"time_{stage['stage']}", SECONDS)] = stage["seconds"] - before
        before = stage["seconds"]
    state = json.loads((folder / STATE / PROGRESS).read_text(encoding="utf-8"))
    return values | {metric_key("time", SECONDS): float(state["seconds"])}
