"""Keeps the predictions of a few samples of every protocol, and makes the report's gallery from them."""

import hashlib
from pathlib import Path

import numpy as np

from unirender.errors import UnirenderError
from unirender.intrinsics import Intrinsics
from unirender_evaluation.engine import Prediction
from unirender_evaluation.gallery import GalleryItem, Picture, image_picture, map_pictures
from unirender_evaluation.metrics import metric_key
from unirender_evaluation.records import Record
from unirender_evaluation.suites import Scene, Suite
from unirender_evaluation.tasks import PROTOCOLS, Task, tasks

SCENES = 6
STORED_MAPS = ("albedo", "normal", "roughness", "metallic", "specular", "diffuse")
QUANTITIES = ("albedo", "normal", "roughness", "metallic", "specular", "diffuse")


class Pictures:
    """The kept predictions of a run: `<folder>/<hash of task and row key>.npz`, half floats.

    Args:
        folder: where they are.
        suite: the suite.
        scenes: of the run; `SCENES` of them, evenly spaced, are kept, one sample for each protocol.
    """

    def __init__(self, folder: Path, suite: Suite, scenes: list[Scene]) -> None:
        self.folder, self.suite = folder, suite
        count = min(SCENES, len(scenes))
        self.scenes = [scenes[i] for i in np.linspace(0, len(scenes) - 1, count).round().astype(int)]
        folder.mkdir(parents=True, exist_ok=True)

    def keep(self, task: Task, method: str, key: str, prediction: Prediction) -> None:
        """Stores a prediction if its sample is in the gallery; `key` is the record's content key."""
        if task.scene not in self.scenes or not self._chosen(task):
            return
        arrays = {} if prediction.image is None else {"image": prediction.image}
        if prediction.maps is not None:
            arrays |= {n: getattr(prediction.maps, n) for n in STORED_MAPS if getattr(prediction.maps, n) is not None}
        half = {name: np.clip(value, -65504, 65504).astype(np.float16) for name, value in arrays.items()}
        np.savez_compressed(self._path(task, method), key=np.array(key), **half)  # type: ignore[arg-type]  # arrays by name

    def has(self, task: Task, method: str, key: str) -> bool:
        """Whether nothing is missing: the sample is not in the gallery, or its prediction is stored under this key."""
        if task.scene not in self.scenes or not self._chosen(task):
            return True
        path = self._path(task, method)
        if not path.is_file():
            return False
        with np.load(path) as data:
            return str(data["key"]) == key

    def items(self, records: list[Record], main: str) -> list[GalleryItem]:
        """The gallery; `main` is the row whose score decides what is a failure."""
        found = {(r.table, r.protocol, r.sample, r.method): r for r in records}
        items = []
        for table, protocol in PROTOCOLS:
            for task in tasks(self.suite, table, protocol, self.scenes):
                if self._chosen(task):
                    item = self._item(task, found, main)
                    if item is not None:
                        items.append(item)
        return items

    def _chosen(self, task: Task) -> bool:
        """One sample per scene and protocol; edits take turns."""
        samples = {
            "rendering": [f"{task.scene.key}_{self._edit(task.scene)}"],
            "inverse": [f"{task.scene.key}_{_material(task.scene, 0)}"],
        }
        return task.table == "relighting" or task.sample in samples[task.table]

    def _edit(self, scene: Scene) -> str:
        edits = self.suite.spec.edits
        metallic, roughness = edits[self.scenes.index(scene) % len(edits)]
        return f"m{round(100 * metallic):03d}_r{round(100 * roughness):03d}"

    def _path(self, task: Task, method: str) -> Path:
        return self.folder / f"{hashlib.sha256(f'{task.identity}/{method}'.encode()).hexdigest()[:20]}.npz"

    def _item(self, task: Task, found: dict[tuple[str, str, str, str], Record], main: str) -> GalleryItem | None:
        truth = _pictures(task, task.truth_image, task.truth_maps)
        predictions: dict[str, dict[str, Picture]] = {}
        scores: dict[str, dict[str, str]] = {}
        badness = 0.0
        for (table, protocol, sample, method), record in found.items():
            path = self._path(task, method)
            if (table, protocol, sample) != (task.table, task.protocol, task.sample) or not path.is_file():
                continue
            with np.load(path) as data:
                arrays = {name: data[name].astype(np.float32) for name in data.files if name != "key"}
            image = arrays.pop("image", None)
            try:
                maps = Intrinsics(**arrays) if arrays else None
            except UnirenderError:
                continue
            made = _pictures(task, image, maps)
            predictions[method] = {name: picture for name, picture in made.items() if name in truth}
            scores[method] = _scores(task, record)
            value = next(iter(v for k, v in record.values.items() if ".psnr@masked-srgb-raw" in k), None)
            if value is not None and (method == main or not badness):
                badness = -value
        if not predictions:
            return None
        order = sorted(predictions, key=lambda key: key != main)
        given = {}
        for inputs in task.inputs.values():
            if "image_srgb" in inputs:
                given = {"picture": inputs["image_srgb"]}
        if not given:
            given = {
                n: p for n, p in map_pictures(task.inputs["render"]["intrinsics"]).items() if n in ("albedo", "normal")
            }
        return GalleryItem(
            table=task.table,
            protocol=task.protocol,
            sample=task.sample,
            caption=f"{task.scene.object} ({task.scene.family}) under {task.scene.light}",
            mask=task.mask,
            given=given,
            truth=truth,
            predictions={key: predictions[key] for key in order},
            scores=scores,
            badness=badness,
        )


def _material(scene: Scene, index: int) -> str:
    if not scene.materials:
        return ""
    metallic, roughness = scene.materials[index]
    return f"m{round(100 * metallic):03d}_r{round(100 * roughness):03d}"


def _pictures(task: Task, image: Picture | None, maps: Intrinsics | None) -> dict[str, Picture]:
    pictures = {} if image is None else {"image": image_picture(image, task.mask)}
    if maps is not None:
        pictures |= map_pictures(maps)
    return pictures


def _scores(task: Task, record: Record) -> dict[str, str]:
    """The headline number of every picture."""
    texts = {}
    for name in ("image", *QUANTITIES):
        quantity = task.quantity if name == "image" else name
        for metric, text in (("psnr", "{:.1f} dB"), ("cosine", "cos {:.3f}"), ("mse", "MSE {:.3f}")):
            value = record.values.get(metric_key(quantity, metric))
            if value is not None:
                texts[name] = text.format(value)
                break
    return texts
