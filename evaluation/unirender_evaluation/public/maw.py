"""Measured Albedo in the Wild (Wu et al. 2023): photographs of rooms, with the measured colour of some surfaces.

    FOLDER/images_png/<category>/<name>.png   a photograph, sRGB
    FOLDER/labels/meta.csv                    a line for each, six columns with tabs between: colours (.npy), mask
                                              (.png), category, name, a picture of the colours, judgements; the files
                                              lie below labels
    colours                                   (k, 3), linear Adobe RGB (1998), in [0, 1]
    mask                                      0: not measured; the k other values, in rising order, are the k colours

Layout and metrics are those of the evaluation code that the set's authors distribute; only the name of the folder of
photographs is inferred, from that of its archive. Checked on made data only.
"""

import csv
from collections.abc import Sequence
from functools import cached_property, lru_cache
from pathlib import Path

import numpy as np
from jaxtyping import Float, Integer
from PIL import Image

from unirender.color import image_srgb, srgb_decode
from unirender.errors import UnirenderError
from unirender_evaluation.lpips import Lpips
from unirender_evaluation.methods.suspicions import suspicions_of_maps
from unirender_evaluation.metrics import Variant, metric_key
from unirender_evaluation.public.files import PublicSetError, missing_files, need_folder
from unirender_evaluation.public.metrics import CHROMATICITY, INTENSITY, chromaticity, intensity, segment_means
from unirender_evaluation.public.scenes import Scenes, scene_sample
from unirender_evaluation.public.sets import Answer, Sample
from unirender_evaluation.tables.specs import Column, TableSpec

NAME = "maw"
LAYOUT = "MAW's folders labels (with meta.csv) and images_png"
COLUMNS = 6
RANGE_TOLERANCE = 1e-3  # of measured colours below 0
MOST_MEASURED = 2.0  # a measurement of white may end a little above 1; far above, it is in another unit
SIZE = (320, 240)  # width and height at which albedo and mask are compared


class Maw(Scenes):
    """Reader of the set; see the module for the folder. `resolution` as in `Scenes`."""

    name = NAME
    tables: tuple[TableSpec, ...] = (
        TableSpec(
            NAME,
            "MAW",
            (
                Column("Intensity", "albedo", INTENSITY, published=False),
                Column("Chromaticity", "albedo", CHROMATICITY, published=False),
            ),
            ("single-image",),
        ),
    )
    modules: tuple[str, ...] = ("public/maw", "public/files", "public/metrics", "public/scenes", "public/sets")
    variant = Variant("whole")

    def samples(self) -> tuple[Sample, ...]:
        """A sample for each line of `meta.csv`; a category is what intervals are over."""
        return self._photographs

    @cached_property
    def _photographs(self) -> tuple[Sample, ...]:
        """The photographs of `meta.csv`; every faulty line has its problem."""
        need_folder(self.folder, self.name, LAYOUT)
        meta = self.folder / "labels" / "meta.csv"
        try:
            rows = list(csv.reader(meta.read_text(encoding="utf-8-sig").splitlines(), delimiter="\t"))
        except (OSError, UnicodeDecodeError) as error:
            raise PublicSetError(self.name, [f"{meta}: cannot be read ({error}), expected {LAYOUT}"]) from error
        found, problems = [], []
        for number, row in enumerate(rows, start=1):
            if len(row) != COLUMNS:
                problems.append(f"{meta}, line {number}: has {len(row)} columns, expected {COLUMNS} with tabs between")
                continue
            colours, mask, category, name = row[:4]
            photo = self.folder / "images_png" / category / f"{name}.png"
            files = (photo, meta.parent / colours, meta.parent / mask)
            whats = ("a photograph", "measured colours", "a mask of the measured surfaces")
            gone = [line for file, what in zip(files, whats, strict=True) for line in missing_files([file], what)]
            problems += gone
            if not gone:
                try:
                    measured(files[1], files[2])
                except UnirenderError as error:
                    problems.append(str(error))
            found.append(scene_sample(NAME, f"{category}_{name}", category, files))
        names = [sample.key for sample in found]
        problems += [f"{meta}: {name} occurs twice" for name in sorted({n for n in names if names.count(n) > 1})]
        if not rows:
            problems.append(f"{meta}: is empty, expected a line for each photograph")
        if problems:
            raise PublicSetError(self.name, problems)
        return tuple(found)

    def score(self, sample: Sample, answer: Answer, lpips: Sequence[Lpips]) -> dict[str, float]:
        """Intensity and chromaticity of the albedo against the measured colours."""
        if answer.maps is None or answer.maps.albedo is None:
            return {}
        truth, labels = measured(sample.files[1], sample.files[2])
        small = np.asarray(Image.fromarray(labels).resize(SIZE, Image.Resampling.NEAREST))
        means, counts = segment_means(as_compared(answer.maps.albedo), small, kinds(labels))
        seen = counts > 0
        if not seen.any():
            raise UnirenderError(
                f"{sample.files[2]}: no measured surface is left at {SIZE[0]} x {SIZE[1]} pixels, expected one or "
                "more; take the photograph out of meta.csv"
            )
        arguments = means[seen], truth[seen], counts[seen]
        return {
            metric_key("albedo", INTENSITY): intensity(*arguments),
            metric_key("albedo", CHROMATICITY): chromaticity(*arguments),
        }

    def suspicions(self, sample: Sample, answer: Answer) -> dict[str, float]:
        """Of the albedo on the measured surfaces."""
        if answer.maps is None or answer.maps.albedo is None:
            return {}
        colours, labels = measured(sample.files[1], sample.files[2])
        small = np.asarray(Image.fromarray(labels).resize(SIZE, Image.Resampling.NEAREST))
        painted = np.concatenate([np.zeros((1, 3)), colours])[np.searchsorted([0, *kinds(labels)], small)]
        found = suspicions_of_maps(
            {"albedo": as_compared(answer.maps.albedo)},
            {"albedo": painted.astype(np.float32)},
            (small > 0)[..., None].astype(np.float32),
        )
        return {key: gain for key, gain in found.items() if not key.endswith("if_in_box")}  # there is no object

    def protocol(self, table: str) -> tuple[tuple[str, str], ...]:
        """(what, value) pairs: what exactly is measured; there is one table."""
        return (
            *self.about_scenes(),
            ("compared", f"8-bit sRGB albedo brought to {SIZE[0]} x {SIZE[1]} px (bilinear), linear mean over each "
             "measured surface, weighted by its pixels; mean over photographs"),
            ("intensity", "100 x squared error of grey values (channel means), a least-squares factor per photograph"),
            ("chromaticity", "CIEDE2000, D65, after a factor per surface that equals its grey value, clipped at 1"),
        )  # fmt: skip


def as_compared(albedo_linear: Float[np.ndarray, "h w 3"]) -> Float[np.ndarray, "240 320 3"]:
    """An albedo of any size as the authors' code compares it: through 8-bit sRGB, resized there, linear."""
    stored = Image.fromarray(np.round(image_srgb(albedo_linear) * 255).astype(np.uint8))
    return srgb_decode(np.asarray(stored.resize(SIZE, Image.Resampling.BILINEAR), np.float32) / 255)


@lru_cache(maxsize=1)
def adobe_to_rec709() -> Float[np.ndarray, "3 3"]:
    """Linear Adobe RGB (1998) -> linear Rec.709; both have the white D65."""
    import colour  # 2 s to import

    spaces = colour.RGB_COLOURSPACES
    return np.asarray(colour.matrix_RGB_to_RGB(spaces["Adobe RGB (1998)"], spaces["sRGB"], None), np.float64)


def measured(colours: Path, mask: Path) -> tuple[Float[np.ndarray, "k 3"], Integer[np.ndarray, "h w"]]:
    """The measured colours, linear Rec.709 in [0, 1], and the labels of the pixels that have them.

    Adobe RGB has colours outside Rec.709: what leaves [0, 1] on the way is clipped, and so is a measurement above 1.

    Raises:
        UnirenderError: a file is broken, a stored colour is in another unit (negative, or above `MOST_MEASURED`), or
            the files do not fit together.
    """
    try:
        adobe = np.load(colours, allow_pickle=False)
    except Exception as error:  # NumPy raises half a dozen kinds for a damaged file
        raise UnirenderError(f"{colours}: not a readable NumPy array ({error!s:.200}); copy it again") from error
    if not isinstance(adobe, np.ndarray):
        raise UnirenderError(f"{colours}: is an archive of arrays, expected one array of (k, 3)")
    if adobe.ndim != 2 or adobe.shape[1] != 3 or adobe.dtype.kind not in "fiu" or not np.isfinite(adobe).all():
        raise UnirenderError(f"{colours}: got {adobe.dtype} of {adobe.shape}, expected finite numbers of (k, 3)")
    if adobe.size and (adobe.min() < -RANGE_TOLERANCE or adobe.max() > MOST_MEASURED):
        raise UnirenderError(
            f"{colours}: has values from {adobe.min():g} to {adobe.max():g}, expected linear colours from 0 to 1"
        )
    try:
        with Image.open(mask) as picture:
            labels = np.asarray(picture)
    except (OSError, ValueError, SyntaxError) as error:
        raise UnirenderError(f"{mask}: not a readable PNG ({error}); copy it again") from error
    if labels.ndim != 2 or labels.dtype.kind not in "iu":
        raise UnirenderError(f"{mask}: got {labels.dtype} of {labels.shape}, expected one channel of labels")
    count = len(kinds(labels))
    if count != len(adobe):
        raise UnirenderError(
            f"{mask}: has {count} labels beside 0, expected {len(adobe)} as {colours.name} has colours"
        )
    return np.clip(np.clip(adobe.astype(np.float64), 0, 1) @ adobe_to_rec709().T, 0, 1), labels


def kinds(labels: Integer[np.ndarray, "h w"]) -> list[int]:
    """The labels beside 0, in rising order; of 8 bits by counting, which takes no time."""
    found = np.flatnonzero(np.bincount(labels.ravel())) if labels.dtype == np.uint8 else np.unique(labels)
    return [int(label) for label in found if label]
