"""How well a model takes apart the pictures of a data set, where a suite has too few of a kind, or none.

Of folders that `unirender dataset` wrote: scores on objects that a model was trained on beside those on objects that it
never saw say whether more objects or more training are wanted. Stored pairs as they are, nothing mixed or turned.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from unirender.color import image_srgb, unpremultiply
from unirender.intrinsics import Intrinsics
from unirender.training.data import GroupDataset
from unirender_evaluation.metrics import metric_key
from unirender_evaluation.scoring import score_maps
from unirender_evaluation.statistics import bootstrap_mean
from unirender_evaluation.table_text import TextTable

COLUMNS = {  # header -> metric of `score_maps`, decimals
    "albedo (dB) ↑": (metric_key("albedo", "psnr"), 2),
    "normal cos ↑": (metric_key("normal", "cosine"), 3),
    "roughness MSE ↓": (metric_key("roughness", "mse_object"), 4),
    "metallic MSE ↓": (metric_key("metallic", "mse_object"), 4),
    "s (dB) ↑": (metric_key("specular", "psnr"), 2),
    "d (dB) ↑": (metric_key("diffuse", "psnr"), 2),
}


@dataclass(frozen=True)
class Scored:
    """One picture's scores.

    Attributes:
        folder: it is from.
        group: its key there; a group is one object.
        metallic: of the object; None: it has a map.
        scores: by metric.
    """

    folder: str
    group: str
    metallic: float | None
    scores: dict[str, float]


def scored(pipeline: Any, folder: Path, objects: int, pairs: int, seed: int) -> Iterator[Scored]:
    """Decomposes pictures of a folder, one step each, as the benchmark's row *Ours (mean)*, and scores their maps.

    Args:
        pipeline: a `UniRenderPipeline`.
        folder: of shards.
        objects: drawn from it; fewer where it has fewer.
        pairs: drawn of each.
        seed: of both draws.

    Raises:
        UnirenderError: no usable shards.
    """
    data, rng = GroupDataset(folder), np.random.default_rng(seed)
    for group in sorted(rng.permutation(len(data.keys))[:objects].tolist()):
        stored = data.pairs(group)
        for index in sorted(rng.permutation(len(stored))[:pairs].tolist()):
            image, truth = data.stored(group, stored[index])
            assert truth.mask is not None, "every group has one"
            display = np.clip(image_srgb(unpremultiply(image, truth.mask)), 0, 1)
            seen = (np.round(display * 255) / 255).astype(np.float32)
            found: Intrinsics = pipeline.decompose(seen, mask=truth.mask).intrinsics
            values = score_maps(found.replace(mask=None), truth)
            yield Scored(str(folder), data.keys[group], stored[index].metallic, values)


def shard_table(found: Sequence[Scored], what: str) -> TextTable:
    """Means by folder and, below each, by metallic, ± half of their intervals over objects.

    Args:
        found: at least one.
        what: was scored, and how, for the note.
    """
    sections = []
    for folder in dict.fromkeys(one.folder for one in found):
        of_folder = [one for one in found if one.folder == folder]
        rows = [_row(f"{folder}: all", of_folder)]
        for metallic in sorted({one.metallic for one in of_folder if one.metallic is not None}):
            rows.append(_row(f"metallic {metallic:g}", [one for one in of_folder if one.metallic == metallic]))
        sections.append(tuple(rows))
    note = (
        f"{what} Pictures as they are stored, at 8 bits; masked, sRGB, raw; ± half of the 95% bootstrap interval over "
        "objects. Roughness and metallic: mean over the object against its number."
    )
    return TextTable("Pictures of data sets", ("data", "objects", "pictures", *COLUMNS), tuple(sections), (note,))


def _row(name: str, found: Sequence[Scored]) -> tuple[str, ...]:
    cells = []
    for key, decimals in COLUMNS.values():
        with_value = [one for one in found if key in one.scores]
        if not with_value:
            cells.append("-")
            continue
        mean = bootstrap_mean([one.scores[key] for one in with_value], [one.group for one in with_value])
        interval = "" if np.isnan(mean.half_width) else f" ± {mean.half_width:.{decimals}f}"
        cells.append(f"{mean.mean:.{decimals}f}{interval}")
    return (name, str(len({one.group for one in found})), str(len(found)), *cells)
