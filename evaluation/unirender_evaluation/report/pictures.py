"""Keeps the predictions of a run as pictures, and makes the report's gallery from the worst, median and best sample.

Which sample is the worst is known only when all are scored, so every prediction is kept: one PNG each, a few kilobytes
at 64 pixels.
"""

import hashlib
import json
from collections.abc import Iterable, Iterator, Sequence
from io import BytesIO
from itertools import zip_longest
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from PIL import Image as PngImage
from PIL.PngImagePlugin import PngInfo

from unirender.color import eight_bits, image_srgb
from unirender.intrinsics import Intrinsics
from unirender.light.environment import sample_environment
from unirender.system.whole_files import replace_file
from unirender_evaluation.engine import Prediction
from unirender_evaluation.light_balls import GLOSSY_BALL, MATTE_BALL, ball_mask, ball_normals, balls
from unirender_evaluation.metrics import METRICS, Variant, metric_key
from unirender_evaluation.records import Record
from unirender_evaluation.report.gallery import GalleryItem, Mask, Picture, image_picture, map_pictures
from unirender_evaluation.suites.suite import Scene, Suite, material_key
from unirender_evaluation.tables.formats import format_number
from unirender_evaluation.task import LIGHT, PROTOCOLS, Task
from unirender_evaluation.tasks import tasks

PRIMARY = {  # table -> metric and quantities that rank its samples; a sample has one of them
    "rendering": ("psnr", ("edit_metallic", "edit_roughness")),
    "inverse": ("psnr", ("albedo",)),
    "relighting": ("psnr", ("relit",)),
    LIGHT[0]: ("rmse_relative", (MATTE_BALL,)),
}
RANKED_BY = {"inverse": "albedo", "relighting": "relit", LIGHT[0]: "matte ball"}  # its name beside other pictures
BALLS = {"matte ball": MATTE_BALL, "glossy ball": GLOSSY_BALL}
BALL_PICTURES = (*BALLS, "mirror ball")
SCORES = (("psnr", "{:.1f} dB"), ("cosine", "cos {:.3f}"), ("mse", "MSE {:.3f}"), ("rmse_relative", "error {:.2f}"))


class Pictures:
    """The kept predictions: `<folder>/<hash of task and row key>.png`, the pictures of one answer side by side.

    The PNG's text chunks hold the record's content key and the pictures' names.

    Args:
        folder: where they are.
        suite: the suite.
        scenes: of the run.
    """

    def __init__(self, folder: Path, suite: Suite, scenes: list[Scene]) -> None:
        self.folder, self.suite, self.scenes = folder, suite, scenes

    def keep(self, task: Task, method: str, key: str, prediction: Prediction) -> None:
        """Stores what the gallery would show of a prediction; `key` is the record's content key."""
        # Balls are made of every light, whatever the truth: no need to draw the true ones to know their names.
        wanted = BALL_PICTURES if task.asks_light else _pictures(task, task.truth_image, task.truth_maps)
        made = {n: p for n, p in _pictures(task, prediction.image, prediction.maps).items() if n in wanted}
        write_sheet(self._path(task.identity, method), made, key)

    def has(self, task: Task, method: str, key: str) -> bool:
        """Whether a prediction is stored under this key."""
        return sheet_key(self._path(task.identity, method)) == key

    def absent(self, records: Sequence[Record]) -> list[Record]:
        """Those of the records whose predictions are not stored, though predictions of their questions are."""
        asked = [record for record in records if (record.table, record.protocol) in PROTOCOLS]
        return [r for r in asked if not self._path(f"{r.table}/{r.protocol}/{r.sample}", r.method).is_file()]

    def items(self, records: Sequence[Record], main: str) -> list[GalleryItem]:
        """The gallery.

        Args:
            records: of the run.
            main: key of the row whose scores choose the samples; where it has none, the first with pictures that has.

        Returns:
            Worst, median and best sample of every protocol, in this order; without those whose pictures are not there.
        """
        found = []
        for table, protocol in PROTOCOLS:
            asked = [r for r in records if (r.table, r.protocol, r.subset) == (table, protocol, "main")]
            pictured = {r.method for r in asked if self._path(f"{table}/{protocol}/{r.sample}", r.method).is_file()}
            leader, ranked = ranking([r for r in asked if r.method in pictured], table, main)
            for place, rank in chosen_places(len(ranked)).items():
                sample, score = ranked[place]
                task = self._task(table, protocol, sample)
                if task is None:
                    continue
                about = {"leader": leader, "rank": rank, "place": place + 1, "count": len(ranked)}
                metric = METRICS[PRIMARY[table][0]]
                number = f"{metric.label} {format_number(score, metric.decimals - 1)} {metric.unit}"
                figure = f"{RANKED_BY.get(table, '')} {number}".strip()
                item = self._item(task, [r for r in asked if r.sample == sample], about | {"figure": figure})
                found += [] if item is None else [item]
        return found

    def leading(self, records: Sequence[Record], main: str) -> Iterator[GalleryItem]:
        """Every sample with the pictures of its protocol's leading row alone: the worst of all protocols first.

        Args:
            records: of the run.
            main: key of the row that leads where it has scores and pictures, as in `items`.
        """
        queues = []
        for table, protocol in PROTOCOLS:
            asked = [r for r in records if (r.table, r.protocol, r.subset) == (table, protocol, "main")]
            pictured = [r for r in asked if self._path(f"{table}/{protocol}/{r.sample}", r.method).is_file()]
            leader, ranked = ranking(pictured, table, main)
            own = {record.sample: record for record in pictured if record.method == leader}
            queues.append([(own[sample], place, len(ranked)) for place, (sample, _) in enumerate(ranked)])
        for line in zip_longest(*queues):
            for record, place, count in filter(None, line):
                task = self._task(record.table, record.protocol, record.sample)
                about = {"leader": record.method, "place": place + 1, "count": count}
                item = None if task is None else self._item(task, [record], about)
                if item is not None:
                    yield item

    def _task(self, table: str, protocol: str, sample: str) -> Task | None:
        """The question behind a sample; None where the run's scenes have none of that name."""
        scenes = [scene for scene in self.scenes if sample.startswith(f"{scene.key}_")]
        return next((t for t in tasks(self.suite, table, protocol, scenes) if t.sample == sample), None)

    def _item(self, task: Task, records: Sequence[Record], about: dict[str, Any]) -> GalleryItem | None:
        truth = _pictures(task, task.truth_image, task.truth_maps)
        predictions: dict[str, dict[str, Picture]] = {}
        for record in sorted(records, key=lambda record: record.method != about["leader"]):
            path = self._path(task.identity, record.method)
            made = read_sheet(path, task.mask.shape[1]) if path.is_file() else {}
            if made:
                predictions[record.method] = made
        if not predictions:
            return None
        return GalleryItem(
            table=task.table,
            protocol=task.protocol,
            sample=task.sample,
            caption=f"{task.scene.object} ({task.scene.family}) under {task.scene.light}",
            question=question(task, self.suite),
            mask=_mask(task),
            given_mask=task.mask if task.asks_light else None,
            given=_given(task),
            truth=truth,
            predictions=predictions,
            scores={record.method: _scores(task, record, truth) for record in records},
            **about,
        )

    def _path(self, identity: str, method: str) -> Path:
        return self.folder / f"{hashlib.sha256(f'{identity}/{method}'.encode()).hexdigest()[:20]}.png"


def ranking(records: Sequence[Record], table: str, main: str) -> tuple[str, list[tuple[str, float]]]:
    """(row, its samples with the score that ranks them, worst first) for the records of one protocol."""
    metric, quantities = PRIMARY.get(table, ("psnr", ()))
    keys = [metric_key(quantity, metric) for quantity in quantities]
    sign = 1 if METRICS[metric].higher_is_better else -1
    for method in dict.fromkeys([main, *(record.method for record in records)]):
        scores = {r.sample: r.values[key] for r in records if r.method == method for key in keys if key in r.values}
        if scores:
            return method, sorted(scores.items(), key=lambda pair: (sign * pair[1], pair[0]))
    return main, []


def chosen_places(count: int) -> dict[int, str]:
    """Place in a ranking -> its name, for the worst, the median and the best of `count` samples."""
    named = {count // 2: "median", count - 1: "best", 0: "worst"} if count else {}
    return dict(sorted(named.items()))


def question(task: Task, suite: Suite) -> str:
    """What was asked, with the numbers: the edit, the material or the light."""
    base, materials = suite.spec.base, [*suite.spec.edits, *task.scene.materials]
    material = next((m for m in materials if task.sample == f"{task.scene.key}_{material_key(m)}"), base)
    if "edit" in task.asks:
        pairs = zip(("metallic", "roughness"), base, material, strict=True)
        return ", ".join(f"{name} {old:.1f} → {new:.1f}" for name, old, new in pairs if old != new)
    if "relight" in task.asks:
        return f"relit by {suite.other_light(task.scene).light}"
    if task.asks_light:
        return f"the light, {task.scene.light}"
    asked = "render:" if "render" in task.asks else "decompose: true"
    return f"{asked} metallic {material[0]:.1f}, roughness {material[1]:.1f}"


def _given(task: Task) -> dict[str, Picture]:
    """What the method saw."""
    inputs = task.inputs[task.asks[0]]
    given = {"input": inputs["image_srgb"]} if "image_srgb" in inputs else {}
    maps: Intrinsics | None = inputs.get("intrinsics")
    if maps is not None:
        given |= map_pictures(maps)
    light: dict[str, Any] = {f"target {name}": inputs.get(name) for name in ("specular", "diffuse")}
    light["HDRI"] = inputs.get("environment") if maps is None else maps.environment
    return given | {name: image_srgb(value) for name, value in light.items() if value is not None}


def _pictures(task: Task, image: Float[np.ndarray, "h w 3"] | None, maps: Intrinsics | None) -> dict[str, Picture]:
    if task.asks_light:
        return {} if maps is None or maps.environment is None else ball_pictures(maps.environment, task.mask.shape[1])
    pictures = {} if image is None else {"image": image_picture(image, task.mask)}
    if maps is not None:
        pictures |= map_pictures(maps)
    return pictures


def ball_pictures(environment: Float[np.ndarray, "eh ew 3"], size: int) -> dict[str, Picture]:
    """Display pictures of balls under a light: those that are scored, and a mirror, which shows the light itself."""
    made = balls(environment, size)
    normal = ball_normals(size)
    view = np.array([0, 0, 1], np.float32)
    mirrored = 2 * normal[..., 2:] * normal - view
    mirror = sample_environment(environment, mirrored) * ball_mask(size)
    shown = (*(made[quantity] for quantity in BALLS.values()), mirror)
    return {name: image_srgb(value) for name, value in zip(BALL_PICTURES, shown, strict=True)}


def _mask(task: Task) -> Mask:
    """Of a question's truth and answers as `_pictures` shows them."""
    return ball_mask(task.mask.shape[1]) if task.asks_light else task.mask


def _scores(task: Task, record: Record, names: Iterable[str]) -> dict[str, str]:
    """The headline number of every picture."""
    texts = {}
    for name in names:
        quantity = task.quantity if name == "image" else BALLS.get(name, name)
        values = [(record.values.get(metric_key(quantity, metric)), text) for metric, text in SCORES]
        found = next(((value, text) for value, text in values if value is not None), None)
        if found is not None:
            texts[name] = found[1].format(found[0])
        aligned = record.values.get(metric_key(quantity, "rmse_relative", Variant(scale="aligned")))
        if aligned is not None:
            texts[name] += f", aligned {aligned:.2f}"
    return texts


def sheet_key(path: Path) -> str | None:
    """The content key of a sheet; None where there is none."""
    if not path.is_file():
        return None
    with PngImage.open(path) as image:
        return image.info.get("key")


def write_sheet(path: Path, pictures: dict[str, Picture], key: str) -> None:
    """Writes display pictures of one size side by side, with their names and a content key in the PNG's text; makes
    the folder."""
    levels = [eight_bits(picture) for picture in pictures.values()]
    sheet = np.concatenate(levels, axis=1) if levels else np.zeros((1, 1, 3), np.uint8)
    text = PngInfo()
    text.add_text("key", key)
    text.add_text("names", json.dumps(list(pictures)))
    content = BytesIO()
    PngImage.fromarray(sheet).save(content, format="PNG", pnginfo=text)
    replace_file(path, content.getvalue())


def read_sheet(path: Path, width: int) -> dict[str, Picture]:
    """The pictures of a sheet by name, each `width` pixels wide."""
    with PngImage.open(path) as image:
        names, sheet = json.loads(image.info["names"]), np.asarray(image, dtype=np.float32) / 255
    return {name: sheet[:, i * width : (i + 1) * width] for i, name in enumerate(names)}
