"""How well a model takes apart, and renders, the pictures of a data set, where a suite has too few of a kind, or none.

Of folders that `unirender dataset` wrote: scores on objects that a model was trained on beside those on objects that it
never saw say whether more objects or more training are wanted. Stored pairs as they are, nothing mixed or turned.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from unirender.color import image_srgb, unpremultiply
from unirender.intrinsics import Intrinsics
from unirender.training.data.dataset import GroupDataset
from unirender.training.data.packing import Pair
from unirender.training.data.same_objects import object_of
from unirender_evaluation.methods.composite import ShadowedSplitSum
from unirender_evaluation.metrics import metric_key
from unirender_evaluation.scoring import score_image, score_maps
from unirender_evaluation.statistics import INTERVAL, Estimate, mean_estimate, unprinted_note
from unirender_evaluation.tables.formats import estimate_text
from unirender_evaluation.tables.text import TextTable

COLUMNS = {  # header -> metric of `score_maps`, decimals
    "albedo (dB) ↑": (metric_key("albedo", "psnr"), 2),
    "normal cos ↑": (metric_key("normal", "cosine"), 3),
    "roughness MSE ↓": (metric_key("roughness", "mse_object"), 4),
    "metallic MSE ↓": (metric_key("metallic", "mse_object"), 4),
    "s (dB) ↑": (metric_key("specular", "psnr"), 2),
    "d (dB) ↑": (metric_key("diffuse", "psnr"), 2),
}
RENDERS = {  # of pictures rendered from the true maps; closed form: what our network begins with
    "given (dB) ↑": (metric_key("given", "psnr"), 2),
    "given light (dB) ↑": (metric_key("given-light", "psnr"), 2),
    "closed form, given light (dB) ↑": (metric_key("closed-form", "psnr"), 2),
}


@dataclass(frozen=True)
class Scored:
    """One picture's scores."""

    folder: str  # it is from
    group: str  # its key there; an object may have several
    metallic: float | None  # of the object; None: it has a map
    scores: dict[str, float]  # by metric

    @property
    def object(self) -> str:
        """Of the group: what intervals draw, since its pictures are not independent."""
        return object_of(self.group)


def scored(pipeline: Any, folder: Path, objects: int, pairs: int, seed: int, renders: bool = False) -> Iterator[Scored]:
    """Decomposes pictures of a folder, one step each, as the benchmark's row *Ours (mean)*, and scores their maps.

    Args:
        pipeline: a `UniRenderPipeline`.
        folder: of shards.
        objects: drawn from it; fewer where it has fewer.
        pairs: drawn of each.
        seed: of both draws.
        renders: whether the pictures are rendered from their true maps as well (`RENDERS`).

    Raises:
        UnirenderError: no usable shards.
    """
    data, rng = GroupDataset(folder), np.random.default_rng(seed)
    pictures: dict[str, list[tuple[int, Pair]]] = {}  # of each object
    for group, key in enumerate(data.keys):
        pictures.setdefault(object_of(key), []).extend((group, pair) for pair in data.pairs(group))
    of_object = list(pictures.values())
    for number in sorted(rng.permutation(len(of_object))[:objects].tolist()):
        stored = of_object[number]
        for index in sorted(rng.permutation(len(stored))[:pairs].tolist()):
            group, pair = stored[index]
            image, truth = data.stored(group, pair)
            assert truth.mask is not None, "every group has one"
            display = np.clip(image_srgb(unpremultiply(image, truth.mask)), 0, 1)
            seen = (np.round(display * 255) / 255).astype(np.float32)
            found: Intrinsics = pipeline.decompose(seen, mask=truth.mask).intrinsics
            values = score_maps(found.replace(mask=None), truth)
            if renders:
                whole = truth.replace(environment=data.whole_light(group, pair))
                values |= _render_scores(pipeline, image, whole)
            yield Scored(str(folder), data.keys[group], pair.metallic, values)


def _render_scores(pipeline: Any, image: np.ndarray, truth: Intrinsics) -> dict[str, float]:
    """Of a picture rendered from its true maps, and from those but s and d, which its light has to say."""
    assert truth.mask is not None
    light = truth.replace(specular=None, diffuse=None)
    drawn = {
        "given": pipeline.render(truth),
        "given-light": pipeline.render(light),
        "closed-form": ShadowedSplitSum().render(light),
    }
    scores = [score_image(picture, image, truth.mask, quantity=name) for name, picture in drawn.items()]
    return {key: value for one in scores for key, value in one.items()}


def minus(found: Sequence[Scored], base: Sequence[Scored]) -> list[Scored]:
    """What `found` has more than `base`, another model's scores of the same draw, picture by picture."""
    pairs = zip(found, base, strict=True)
    return [
        replace(one, scores={key: one.scores[key] - other.scores[key] for key in one.scores}) for one, other in pairs
    ]


def shard_tables(found: Sequence[Scored], what: str, titled: str = "") -> list[TextTable]:
    """Means by folder and, below each, by metallic, ± half of their intervals over objects: of maps and, where there
    are any, of renderings.
    """
    read = f"{what} Masked, sRGB, raw; ± half of the {INTERVAL}."
    maps = f"{read} Pictures are seen at 8 bits. Roughness and metallic: mean over the object against its number."
    tables = [_table(f"Pictures of data sets{titled}", found, COLUMNS, maps)]
    if any(key in one.scores for one in found for key, _ in RENDERS.values()):
        renders = (
            f"{read} Given: rendered from the true maps; given light: from those but s and d, which the whole light "
            "says; closed form: what the renderer begins with there."
        )
        tables.append(_table(f"Renderings of data sets{titled}", found, RENDERS, renders))
    return tables


def _table(title: str, found: Sequence[Scored], columns: Mapping[str, tuple[str, int]], note: str) -> TextTable:
    """Rows by folder and metallic."""
    sections, estimates = [], []
    for folder in dict.fromkeys(one.folder for one in found):
        of_folder = [one for one in found if one.folder == folder]
        groups = {f"{folder}: all": of_folder}
        for metallic in sorted({one.metallic for one in of_folder if one.metallic is not None}):
            groups[f"metallic {metallic:g}"] = [one for one in of_folder if one.metallic == metallic]
        rows = []
        for name, own in groups.items():
            means = [_mean(own, key) for key, _ in columns.values()]
            texts = (estimate_text(mean, decimals) for mean, (_, decimals) in zip(means, columns.values(), strict=True))
            rows.append((name, str(len({one.object for one in own})), str(len(own)), *texts))
            estimates += means
        sections.append(tuple(rows))
    titles = ("data", "objects", "pictures", *columns)
    return TextTable(title, titles, tuple(sections), (note, *unprinted_note(estimates)))


def _mean(found: Sequence[Scored], key: str) -> Estimate | None:
    own = [one for one in found if key in one.scores]
    return mean_estimate([one.scores[key] for one in own], [one.object for one in own]) if own else None
