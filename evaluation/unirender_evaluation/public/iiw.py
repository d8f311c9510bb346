"""Intrinsic Images in the Wild (Bell et al. 2014): photographs of rooms, and people's judgements of their reflectance.

    FOLDER/data/<id>.png      a photograph, sRGB; the files may also lie in FOLDER itself
    FOLDER/data/<id>.json     "intrinsic_points": id, x, y (fractions of width and height), opaque
                              "intrinsic_comparisons": point1, point2, darker ("1", "2", "E"), darker_score (weight)

The judgements' layout and the metric are those of the script that the set's authors distribute (`whdr.py`); that
photographs and judgements lie side by side is how others' code reads the release. Checked on made data only.
"""

from collections.abc import Sequence
from functools import cached_property
from pathlib import Path

from unirender.errors import UnirenderError
from unirender_evaluation.lpips import Lpips
from unirender_evaluation.metrics import Variant, metric_key
from unirender_evaluation.public.files import PublicSetError, missing_files, need_folder, parsed_json
from unirender_evaluation.public.metrics import DELTA, WHDR, Judgement, judgements, whdr
from unirender_evaluation.public.scenes import Scenes, scene_sample
from unirender_evaluation.public.sets import Answer, Sample
from unirender_evaluation.tables.specs import Column, TableSpec

NAME = "iiw"
LAYOUT = "IIW's photographs <id>.png and judgements <id>.json, there or in its subfolder data"


class Iiw(Scenes):
    """Reader of the set; see the module for the folder. `resolution` as in `Scenes`."""

    name = NAME
    tables: tuple[TableSpec, ...] = (
        TableSpec(NAME, "IIW", (Column("Albedo", "albedo", WHDR, published=False),), ("single-image",)),
    )
    modules: tuple[str, ...] = ("public/iiw", "public/files", "public/metrics", "public/scenes", "public/sets")
    variant = Variant("whole")

    def samples(self) -> tuple[Sample, ...]:
        """A sample for each photograph with at least one judgement that counts."""
        return tuple(sample for sample, judged in self._photographs if judged)

    @cached_property
    def _photographs(self) -> tuple[tuple[Sample, int], ...]:
        """Every photograph, with the number of its judgements that count."""
        need_folder(self.folder, self.name, LAYOUT)
        data = self.folder / "data"
        files = sorted((data if data.is_dir() else self.folder).glob("*.json"))
        problems = list(missing_files((file.with_suffix(".png") for file in files), "the photograph of its .json"))
        found = []
        for file in files:
            photo = file.with_suffix(".png")
            try:
                judged = len(read_judgements(file))
                found.append((scene_sample(NAME, file.stem, file.stem, (photo, file)), judged))
            except UnirenderError as error:
                problems.append(str(error))
        if not files:
            problems.append(f"{self.folder}: has no .json file, expected {LAYOUT}")
        if problems:
            raise PublicSetError(self.name, problems)
        return tuple(found)

    def score(self, sample: Sample, answer: Answer, lpips: Sequence[Lpips]) -> dict[str, float]:
        """WHDR of the albedo, over all pairs, those that people called equal, and the others."""
        if answer.maps is None or answer.maps.albedo is None:
            return {}
        found = whdr(answer.maps.albedo, read_judgements(sample.files[1]))
        return {f"{metric_key('albedo', WHDR)}{name.removeprefix('whdr')}": value for name, value in found.items()}

    def suspicions(self, sample: Sample, answer: Answer) -> dict[str, float]:
        """None: judgements are no map."""
        return {}

    def protocol(self, table: str) -> tuple[tuple[str, str], ...]:
        """(what, value) pairs: what exactly is measured; there is one table."""
        without = sum(not judged for _, judged in self._photographs)
        return (
            *self.about_scenes(),
            (
                "WHDR",
                f"delta {DELTA:g}; reflectance of a point = mean of the linear channels of its pixel; pairs of opaque "
                "points with a positive weight; mean over photographs",
            ),
            ("photographs without a judgement that counts", str(without)),
        )


def read_judgements(path: Path) -> list[Judgement]:
    """The judgements of a file that count.

    Raises:
        UnirenderError: no readable file, another layout, or a value out of its range (`judgements`).
    """
    return parsed_json(path, judgements, "IIW's intrinsic_points and intrinsic_comparisons")
