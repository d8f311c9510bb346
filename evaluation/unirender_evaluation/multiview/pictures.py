"""Keeps what the multi-view rows found as pictures, and makes the report's cards of them: one held-out camera's view of
every result, next to the truth.

The truth of this table is rendered in the run, so it is kept, too: as the pictures of a row named `TRUTH`.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from unirender.color import image_srgb
from unirender_evaluation.metrics import METRICS, metric_key
from unirender_evaluation.multiview.scenes import MultiviewScene
from unirender_evaluation.multiview.scoring import Looks
from unirender_evaluation.multiview.settings import STANDARD
from unirender_evaluation.multiview.tables import MULTIVIEW_TABLE, PROTOCOL
from unirender_evaluation.records import Record, RunInfo
from unirender_evaluation.report.gallery import GalleryItem, Picture, image_picture
from unirender_evaluation.report.pictures import SCORES, chosen_places, read_sheet, sheet_key, write_sheet
from unirender_evaluation.suites.suite import Suite
from unirender_evaluation.tables.formats import format_number

TRUTH = "truth"
CAMERA = 0  # of the held-out ones
GIVEN, MASK = "seen", "mask"
QUANTITIES = {"novel view": "novel", "relit": "relit", "albedo": "albedo", "roughness": "roughness"}
QUANTITIES |= {"metallic": "metallic"}  # picture -> quantity of its score


class MultiviewPictures:
    """The kept pictures of the multi-view table: `<folder>/multi-view-<scene>-<row>.png`."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def has(self, scene_key: str, method: str, key: str) -> bool:
        """Whether the pictures of a record are there, and the truth's."""
        return sheet_key(self._path(scene_key, method)) == key and self._path(scene_key, TRUTH).is_file()

    def keep(self, scene_key: str, method: str, key: str, scene: MultiviewScene, looks: Looks) -> None:
        """Stores the pictures of one row; with the truth beside them they are what a card shows."""
        write_sheet(self._path(scene_key, method), camera_pictures(looks, scene), key)

    def keep_truth(self, scene_key: str, scene: MultiviewScene, looks: Looks) -> None:
        """Stores the truth, two of the pictures that were given, and the mask of the card."""
        shown = scene.views.seen[:: max(len(scene.views.seen) // 2, 1)][:2]
        given = {f"{GIVEN} {number + 1}": view.image for number, view in enumerate(shown)}
        mask = np.repeat(looks.novel.mask(CAMERA), 3, axis=-1)
        write_sheet(self._path(scene_key, TRUTH), {**camera_pictures(looks, scene), **given, MASK: mask}, TRUTH)

    def items(self, records: Sequence[Record], suite: Suite, run: RunInfo) -> list[GalleryItem]:
        """Worst, median and best object by the novel views of the run's first row with pictures."""
        own = [r for r in records if (r.table, r.protocol) == (MULTIVIEW_TABLE.name, PROTOCOL)]
        own = [r for r in own if self._path(r.sample, r.method).is_file() and self._path(r.sample, TRUTH).is_file()]
        if not own:
            return []
        ranked_by, found = metric_key("novel", METRICS["psnr"]), []
        leader = next(info.key for info in run.methods if any(r.method == info.key for r in own))
        ranked = sorted((r.values[ranked_by], r.sample) for r in own if r.method == leader)
        for place, rank in chosen_places(len(ranked)).items():
            score, sample = ranked[place]
            about = {"leader": leader, "rank": rank, "place": place + 1, "count": len(ranked)}
            item = self._item(sample, [r for r in own if r.sample == sample], suite)
            found.append(GalleryItem(**item, **about, figure=f"PSNR of novel views {format_number(score, 1)} dB"))
        return found

    def _item(self, sample: str, records: Sequence[Record], suite: Suite) -> dict:
        scene, size = suite.scene(sample), suite.spec.resolution
        truth = read_sheet(self._path(sample, TRUTH), size)
        mask = truth.pop(MASK)[..., :1]
        given = {name: truth.pop(name) for name in list(truth) if name.startswith(GIVEN)}
        return {
            "table": MULTIVIEW_TABLE.name,
            "protocol": PROTOCOL,
            "sample": sample,
            "caption": f"{scene.object} ({scene.family}) under {scene.light}, a held-out camera",
            "question": f"textures and light from {STANDARD.seen} views; relit by {suite.other_light(scene).light}",
            "mask": mask,
            "given": given,
            "given_mask": np.ones_like(mask),  # whole pictures: other cameras see the object elsewhere
            "truth": truth,
            "predictions": {r.method: read_sheet(self._path(sample, r.method), size) for r in records},
            "scores": {r.method: _scores(r) for r in records},
        }

    def _path(self, scene_key: str, method: str) -> Path:
        return self.folder / f"multi-view-{scene_key}-{method}.png"


def camera_pictures(looks: Looks, scene: MultiviewScene) -> dict[str, Picture]:
    """What one held-out camera sees, as display values: pictures and maps."""
    size = scene.resolution
    first = (len(scene.seen_poses) + CAMERA) * size
    maps = {name: value[first : first + size] for name, value in looks.buffers.maps.items()}
    grey = {name: np.repeat(maps[name], 3, axis=-1) for name in ("roughness", "metallic")}
    mask = maps["mask"]
    return {
        "novel view": image_picture(looks.novel.rgb(CAMERA), mask),
        "relit": image_picture(looks.relit.rgb(CAMERA), mask),
        "albedo": image_srgb(maps["albedo"]),
        **grey,
    }


def _scores(record: Record) -> dict[str, str]:
    """The number of every picture: of this camera, where it has one of its own, else of the object."""
    texts = {}
    for name, quantity in QUANTITIES.items():
        own = f"{quantity}_{CAMERA}" if quantity in ("novel", "relit") else quantity
        values = [(record.values.get(metric_key(own, metric)), text) for metric, text in SCORES]
        found = next(((value, text) for value, text in values if value is not None), None)
        if found is not None:
            texts[name] = found[1].format(found[0])
    return texts
