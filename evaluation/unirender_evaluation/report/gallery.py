"""Pictures for the report: display versions of maps and images, FLIP error maps, PNG data URIs; the gallery's cards.

All pictures are un-premultiplied sRGB display values in [0, 1], `[h, w, 3]`; the mask becomes the PNG's alpha, so that
they sit on a light and on a dark page. FLIP (Andersson et al. 2020, its reference implementation at 67 pixels per
degree) compares the pictures over white with the true mask pasted on both.
"""

import base64
import io
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Float
from PIL import Image

from unirender.color import eight_bits, image_srgb, srgb_decode, unpremultiply
from unirender.errors import UnirenderError
from unirender.intrinsics import Intrinsics
from unirender_evaluation.records import RunInfo
from unirender_evaluation.report.plots import LEADING, heading
from unirender_evaluation.scoring import over_white
from unirender_reference.principled import one_thread

GALLERY_BYTES = 12_000_000  # of all its pictures, about: where they would take more, they are shown smaller
BYTES_PER_PIXEL = 1.2  # of a PNG data URI; measured: 1.16, 499 pictures of the tiny suite; noise takes up to 5
HERO_WIDTH = 256  # pixels at the head of the page
SMALLEST = 48  # pixels that a picture keeps in any case

Picture = Float[np.ndarray, "h w 3"]
Mask = Float[np.ndarray, "h w 1"]
AnyPicture = Float[np.ndarray, "_ _ 3"]  # sizes are checked where they are put together


@dataclass(frozen=True)
class GalleryItem:
    """One sample of the gallery.

    Attributes:
        table: as in records.
        protocol: as in records.
        sample: as in records.
        caption: for people: object and light.
        mask: coverage of truth and predictions, [0, 1]: the true mask, or, where balls are shown, theirs.
        given: what the method saw, name -> picture; a light may have a size of its own.
        truth: name -> picture.
        predictions: method key -> name -> picture; names are those of `truth`.
        scores: method key -> name -> text, e.g. "23.1 dB".
        question: what was asked, e.g. "roughness 0.5 → 0.1".
        rank: why the sample was chosen: "worst", "median", "best".
        place: in the ranking of its table and protocol; 1 = worst.
        count: how many were ranked.
        leader: key of the method whose score ranked them.
        figure: that score, e.g. "PSNR 13.7 dB".
        given_mask: coverage of what was given, where it is not that of the truth.
    """

    table: str
    protocol: str
    sample: str
    caption: str
    mask: Float[np.ndarray, "h w 1"]
    given: Mapping[str, AnyPicture]
    truth: Mapping[str, AnyPicture]
    predictions: Mapping[str, Mapping[str, AnyPicture]]
    scores: Mapping[str, Mapping[str, str]] = field(default_factory=dict)
    question: str = ""
    rank: str = ""
    place: int = 1
    count: int = 1
    leader: str = ""
    figure: str = ""
    given_mask: Float[np.ndarray, "h w 1"] | None = None

    def __post_init__(self) -> None:
        size = self.mask.shape[:2]
        for group, pictures in {"truth": self.truth, **self.predictions}.items():
            for name, picture in pictures.items():
                if picture.shape != (*size, 3):
                    raise UnirenderError(
                        f"gallery {self.sample}, {group} {name}: got shape {picture.shape}, expected {(*size, 3)}"
                    )


def map_pictures(intrinsics: Intrinsics) -> dict[str, Picture]:
    """Display pictures of the image-aligned maps that are present, in the report's order.

    Albedo and light as sRGB (clipped), normals as (n + 1) / 2, roughness and metallic as grey values.
    """
    pictures: dict[str, Picture] = {}
    for name in ("albedo", "normal", "roughness", "metallic", "specular", "diffuse"):
        value = getattr(intrinsics, name)
        if value is None:
            continue
        if name == "normal":
            pictures[name] = (value + 1) / 2
        elif name in ("roughness", "metallic"):
            pictures[name] = np.repeat(np.clip(value, 0, 1), 3, axis=-1)
        else:
            pictures[name] = image_srgb(value)
    return pictures


def image_picture(image_linear: Picture, mask: Float[np.ndarray, "h w 1"]) -> Picture:
    """Display picture of a premultiplied linear image."""
    return image_srgb(unpremultiply(image_linear, mask))


def flip_map(prediction: Picture, truth: Picture, mask: Float[np.ndarray, "h w 1"]) -> tuple[Picture, float]:
    """(FLIP error in the magma colours, mean error over the object weighted by coverage)."""
    import flip_evaluator

    frames = [image_srgb(over_white(srgb_decode(np.clip(picture, 0, 1)), mask)) for picture in (truth, prediction)]
    # FLIP's OpenMP threads, which it shares with torch, spin for one another: 170 ms a small picture, 14 ms with one.
    with one_thread():
        error, _, _ = flip_evaluator.evaluate(frames[0], frames[1], "LDR", applyMagma=False)
    error = np.asarray(error, dtype=np.float32).reshape(*mask.shape[:2], 1)
    mean = float((error * mask).sum() / mask.sum())
    return _magma(error[..., 0]), mean


def data_uri(picture: Picture, mask: Float[np.ndarray, "h w 1"] | None = None) -> str:
    """PNG data URI; the mask becomes the alpha channel."""
    channels = [picture] if mask is None else [picture, mask]
    levels = eight_bits(np.concatenate(channels, axis=-1))
    buffer = io.BytesIO()
    Image.fromarray(levels).save(buffer, format="PNG")
    return "data:image/png;base64," + base64.b64encode(buffer.getvalue()).decode("ascii")


def picture_size(width: int, most: int) -> int:
    """The width at which a picture is shown: its own, else the largest whole fraction of it that is at most `most`."""
    return width // math.ceil(width / most)


def shrink(picture: Float[np.ndarray, "h w c"], width: int) -> Float[np.ndarray, "h2 w2 c"]:
    """A picture at a whole fraction of its width: means of squares of pixels; what is left over at the edges is cut."""
    factor = picture.shape[1] // width
    if factor <= 1:
        return picture
    height = picture.shape[0] // factor
    cut = picture[: height * factor, : width * factor]
    return cut.reshape(height, factor, width, factor, -1).mean(axis=(1, 3), dtype=np.float32)


def shrink_covered(
    picture: Picture, mask: Mask, width: int
) -> tuple[Float[np.ndarray, "h2 w2 3"], Float[np.ndarray, "h2 w2 1"]]:
    """The same of a picture and its mask: what lies outside the mask does not run into the edge."""
    if width >= picture.shape[1]:
        return picture, mask
    small = shrink(mask, width)
    return shrink(picture * mask, width) / np.maximum(small, 1e-6), small


def shown_width(gallery: Sequence[GalleryItem], limit: int = GALLERY_BYTES) -> int:
    """Pixels that a picture's width may have so that the gallery takes about `limit` bytes of the page."""
    if not gallery:
        return SMALLEST
    width = max(item.mask.shape[1] for item in gallery)
    # Each prediction has its FLIP map.
    count = sum(len(item.given) + len(item.truth) + 2 * sum(map(len, item.predictions.values())) for item in gallery)
    return min(width, max(SMALLEST, int(math.sqrt(limit / (BYTES_PER_PIXEL * count)))))


def _magma(error: Float[np.ndarray, "h w"]) -> Picture:
    from matplotlib import colormaps

    return np.asarray(colormaps["magma"](np.clip(error, 0, 1)), dtype=np.float32)[..., :3]


def hero(gallery: Sequence[GalleryItem], run: RunInfo) -> dict[str, Any] | None:
    """What was given, and what the first row of ours made of it on the median sample: picked by rank, not by eye."""
    kinds = [[info.key for info in run.methods if info.kind == kind] for kind in LEADING]
    ours = set(next(filter(None, kinds), []))
    candidates = [item for item in gallery if item.table == "inverse" and ours & item.predictions.keys()]
    if not candidates:
        return None
    item = min(candidates, key=lambda item: abs(2 * item.place - item.count - 1))
    method = next(key for key in item.predictions if key in ours)
    return {
        "given": [_named(name, picture, item, HERO_WIDTH) for name, picture in item.given.items()],
        "pairs": [
            {
                "name": name,
                "ours": _shown(picture, item, HERO_WIDTH),
                "truth": _shown(item.truth[name], item, HERO_WIDTH),
            }
            for name, picture in item.predictions[method].items()
        ],
        "caption": f"{run.method(method).label} on the sample of {item.rank or 'median'} score: "
        f"{item.caption} ({item.sample}).",
    }


def shelves(gallery: Sequence[GalleryItem], run: RunInfo, titles: Mapping[str, str], most: int) -> list[dict[str, Any]]:
    """Cards by table and protocol, worst first in each.

    Args:
        gallery: the samples.
        run: names the rows.
        titles: the tables' names for people.
        most: pixels that a picture's width may have (`shown_width`).
    """
    groups: dict[tuple[str, str], list[GalleryItem]] = {}
    for item in gallery:
        groups.setdefault((item.table, item.protocol), []).append(item)
    return [
        {
            "which": "-".join(which),
            "title": heading(titles.get(which[0], which[0]), which[1]),
            "by": " and ".join(dict.fromkeys(run.method(item.leader).label for item in items if item.leader)),
            "cards": [_card(item, run, most) for item in sorted(items, key=lambda item: item.place)],
        }
        for which, items in groups.items()
    ]


def picture_rows(item: GalleryItem, run: RunInfo) -> list[tuple[str, dict[str, str]]]:
    """(label, map -> method key): a row per method, but trivial methods for different maps share rows."""
    rows: list[tuple[str, dict[str, str]]] = []
    shared: list[dict[str, str]] = []
    for method, made in item.predictions.items():
        cells = {name: method for name in item.truth if name in made}
        if run.method(method).kind != "trivial" or len(item.truth) == 1:
            rows.append((run.method(method).label, cells))
            continue
        free = next((row for row in shared if not row.keys() & cells.keys()), None)
        if free is None:
            shared.append(cells)
        else:
            free.update(cells)
    return rows + [("Trivial", cells) for cells in shared]


def _card(item: GalleryItem, run: RunInfo, most: int) -> dict[str, Any]:
    names = list(item.truth)
    place = f"{item.rank} of {item.count}" if item.rank else f"{item.place} of {item.count}"
    return {
        "id": f"{item.table}-{item.protocol}-{item.place}",
        "title": ": ".join(text for text in (place, item.figure) if text),
        "question": item.question,
        "sub": f"{item.caption} · {item.sample}",
        "names": names,
        "truth": [_shown(picture, item, most) for picture in item.truth.values()],
        "given": [_named(name, picture, item, most) for name, picture in item.given.items()],
        "rows": [
            {
                "label": label,
                "cells": [_prediction(item, cells[n], n, run, most) if n in cells else None for n in names],
            }
            for label, cells in picture_rows(item, run)
        ],
    }


def _prediction(item: GalleryItem, method: str, name: str, run: RunInfo, most: int) -> dict[str, Any]:
    picture, info = item.predictions[method][name], run.method(method)
    error, mean = flip_map(picture, item.truth[name], item.mask)
    alone = info.kind != "trivial" or len(item.truth) == 1
    return {
        "picture": _shown(picture, item, most),
        "label": info.label,
        "name": "" if alone else info.label,
        "score": item.scores.get(method, {}).get(name, ""),
        "flip": _shown(error, item, most),
        "flip_mean": f"FLIP {mean:.3f}",
    }


def _named(name: str, picture: Picture, item: GalleryItem, most: int) -> dict[str, Any]:
    return {"name": name, "picture": _shown(picture, item, most, item.given_mask)}


def _shown(picture: Picture, item: GalleryItem, most: int, cover: Mask | None = None) -> dict[str, Any]:
    """A picture for the template, at most `most` pixels wide; those of the frame's size carry the mask `cover`, or the
    item's."""
    width = picture_size(picture.shape[1], most)
    cover = item.mask if cover is None else cover
    if picture.shape[:2] == cover.shape[:2]:
        small, mask = shrink_covered(picture, cover, width)
    else:
        small, mask = shrink(picture, width), None
    return {"uri": data_uri(small, mask), "width": small.shape[1], "height": small.shape[0]}
