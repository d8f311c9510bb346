"""Stanford-ORB (Kuang et al. 2023): objects photographed in several places, with scanned shape and measured light.

    FOLDER/blender_LDR/<capture>/test/<id>.png      photographs, sRGB; test_mask/<id>.png; the same for train
    FOLDER/blender_HDR/<capture>/test/<id>.exr      the same photographs, linear
    FOLDER/blender_LDR/<capture>/transforms_test.json   camera_angle_x (radians); frames: file_path ("test/0000") and
                                                        transform_matrix (camera to world, OpenGL axes)
    .../transforms_train.json, transforms_novel.json    novel: photographs of the object elsewhere, the poses in this
                                                        capture's world; each frame has scene_name and camera_angle_x
    FOLDER/ground_truth/<capture>/surface_normal/<id>.npy    camera axes, as ours
                                 /z_depth/<id>.npy, /env_map/<id>.exr (linear, in camera axes)
                                 /pseudo_gt_albedo/<id>.png (sRGB), or .npy (taken as linear)

A capture is one object in one place, `<object>_scene<number>`. Two questions. *Decompose*: the maps of a test
photograph. *Relight*: the object of one capture as it was photographed in another. The benchmark asks that of all views
of a capture: a folder of predictions can answer always, a method that sees one picture where some photograph of the
capture was taken from nearly the other's camera.

Layout, conventions and metrics are those of the set's README and of its evaluation code. Not verified: that blender_LDR
is blender_HDR clipped and encoded, the exposure of env_map against the photographs, and what a pseudo_gt_albedo in .npy
holds. Checked on made data only.
"""

from collections.abc import Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from unirender.camera import Camera
from unirender.errors import UnirenderError
from unirender_evaluation.lpips import Lpips
from unirender_evaluation.methods.suspicions import suspicions_of_maps
from unirender_evaluation.metrics import Variant
from unirender_evaluation.public import orb_scoring as scoring
from unirender_evaluation.public.files import PublicSetError, missing_files, need_folder
from unirender_evaluation.public.metrics import ERODED, eroded
from unirender_evaluation.public.orb_files import OrbFiles, frame_truths, light_file
from unirender_evaluation.public.orb_frames import HDR, LDR, Capture, Photograph, captures, relightings
from unirender_evaluation.public.sets import MAPS, Answer, Sample
from unirender_evaluation.tables.specs import TableSpec

NAME = "stanford-orb"
RESOLUTION = 512  # of the benchmark
TOLERANCE_DEG = 2.0
LAYOUT = "Stanford-ORB's folders blender_LDR, ground_truth and, for relighting, blender_HDR"


class StanfordOrb:
    """Reader of the set; see the module for the folder.

    Args:
        folder: where the set is.
        resolution: columns at which everything is handed out and compared; the benchmark's own is 512.
        tolerance_deg: how far two cameras may differ to count as one (`orb_frames.difference_deg`).
    """

    name = NAME
    tables: tuple[TableSpec, ...] = (scoring.MAPS_TABLE, scoring.RELIT_TABLE)
    modules: tuple[str, ...] = ("public/orb*", "public/files", "public/metrics", "public/sets")
    variant = Variant("masked")
    averaged_first: str | None = "captures"

    def __init__(self, folder: Path, resolution: int = RESOLUTION, tolerance_deg: float = TOLERANCE_DEG) -> None:
        self.folder, self.resolution, self.tolerance_deg = folder, resolution, tolerance_deg
        self._files = OrbFiles(folder, resolution)

    @cached_property
    def _captures(self) -> list[Capture]:
        need_folder(self.folder / LDR, self.name, LAYOUT)
        found, problems = captures(self.folder)
        if not found:
            problems.append(f"{self.folder / LDR}: has no capture, expected folders like teapot_scene001")
        if problems:
            raise PublicSetError(self.name, problems)
        return found

    @cached_property
    def _tests(self) -> dict[str, Photograph]:
        """Test photographs by the key of their sample."""
        return {f"{frame.capture}_{frame.id}": frame for capture in self._captures for frame in capture.test}

    @cached_property
    def _relit(self) -> dict[str, tuple[Photograph | None, Photograph]]:
        """By the key of their sample: the photograph that a method sees, if there is one, and that which is asked."""
        if not (self.folder / HDR).is_dir():
            return {}
        return {
            f"{capture.name}/{_relight_name(frame)}": (capture.nearest(frame, self.tolerance_deg), frame)
            for capture, frame in relightings(self._captures)
        }

    @cached_property
    def _samples(self) -> tuple[Sample, ...]:
        """All questions of the folder; missing files are named all at once."""
        named = {capture.name: capture for capture in self._captures}
        found = [
            self._map_sample(key, frame, named[frame.capture])
            for key, frame in self._tests.items()
            if frame_truths(self.folder, frame)
        ]
        for key, (source, frame) in self._relit.items():
            found.append(self._relight_sample(key, source, frame, named[key.split("/")[0]]))
        whats = {".png": "a photograph, a mask or an albedo", ".exr": "a linear photograph or a light"}
        problems = [
            line
            for path in dict.fromkeys(file for sample in found for file in sample.files)
            for line in missing_files([path], whats.get(path.suffix, "a file of the set"))
        ]
        if not found:
            problems.append(f"{self.folder}: has nothing to compare with, expected {LAYOUT}")
        if problems:
            raise PublicSetError(self.name, problems)
        return tuple(found)

    def samples(self) -> tuple[Sample, ...]:
        """The maps of every test photograph that has a truth, and every relighting."""
        return self._samples

    def unit(self, sample: str) -> str:
        """The capture that a method was given."""
        return self._tests[sample].capture if sample in self._tests else sample.split("/")[0]

    def _map_sample(self, key: str, frame: Photograph, capture: Capture) -> Sample:
        truths = frame_truths(self.folder, frame).values()
        files = (frame.photo(self.folder), frame.mask(self.folder), capture.files[0], *truths)
        return Sample(scoring.MAPS_TABLE.name, key, capture.object, "decompose", key, MAPS, files)

    def _relight_sample(self, key: str, source: Photograph | None, frame: Photograph, capture: Capture) -> Sample:
        light = light_file(self.folder, frame)
        sees = source is not None and light.parent.is_dir()
        files = [frame.photo(self.folder, HDR), frame.mask(self.folder), *capture.files]
        if source is not None and sees:
            files += [source.photo(self.folder), source.mask(self.folder), light]
        name = scoring.RELIT_TABLE.name
        return Sample(
            name, key, capture.object, "relight", capture.name, _relight_name(frame), tuple(files), one_picture=sees
        )

    def inputs(self, sample: Sample) -> dict[str, Any]:
        """The photograph at the run's resolution, in 8 bits; for relighting also the other place's light."""
        frame = self._tests[sample.key] if sample.asks == "decompose" else self._relit[sample.key][0]
        if frame is None:
            raise UnirenderError(f"{sample.key}: no photograph was taken from the camera of the relit one")
        mask = self._files.mask(frame)
        picture = self._files.picture(frame, mask)
        found: dict[str, Any] = {"image_srgb": picture, "mask": mask, "camera": frame.camera(*mask.shape[:2])}
        if sample.asks == "relight":
            found["environment"] = self._files.light(self._relit[sample.key][1])
        return found

    def frame(self, sample: Sample) -> tuple[tuple[int, int], Camera]:
        """The run's resolution, square as the set is."""
        frame = self._tests[sample.key] if sample.asks == "decompose" else self._relit[sample.key][1]
        return (self.resolution, self.resolution), frame.camera(self.resolution, self.resolution)

    def score(self, sample: Sample, answer: Answer, lpips: Sequence[Lpips]) -> dict[str, float]:
        """The benchmark's metrics of maps, or of a relit picture, each with a factor per channel and without."""
        mask, truths = self._truths(sample)
        if sample.asks == "relight":
            return {} if answer.image is None else scoring.score_relit(answer.image, truths["relit"], mask, lpips)
        return scoring.score_maps(answer, truths, mask, lpips)

    def suspicions(self, sample: Sample, answer: Answer) -> dict[str, float]:
        """Of albedo, normals and relit pictures, inside the mask that counts."""
        mask, truths = self._truths(sample)
        found = {} if answer.maps is None else dict(answer.maps.maps)
        found |= {} if answer.image is None else {"relit": answer.image}
        return suspicions_of_maps(found, truths, eroded(mask))

    def _truths(self, sample: Sample) -> tuple[Float[np.ndarray, "h w 1"], dict[str, Float[np.ndarray, "h w c"]]]:
        """The mask of a sample, and what its answer is compared with."""
        if sample.asks == "relight":
            frame = self._relit[sample.key][1]
            return self._files.mask(frame), {"relit": self._files.relit(frame)}
        frame = self._tests[sample.key]
        mask = self._files.mask(frame)
        return mask, self._files.maps(frame, mask)

    def why_absent(self, table: str) -> str | None:
        """How many photographs could be relit by a method, where it is none."""
        relit = [sample for sample in self.samples() if sample.asks == "relight"]
        if table != scoring.RELIT_TABLE.name or not relit or any(sample.one_picture for sample in relit):
            return None
        return (
            f"relighting: 0 of {len(relit)} photographs were taken from within {self.tolerance_deg:g} degrees of a "
            "photograph of the capture that is relit; see --tolerance-deg"
        )

    def protocol(self, table: str) -> tuple[tuple[str, str], ...]:
        """(what, value) pairs: what exactly the table of that name measures."""
        shared = (
            ("resolution", f"{self.resolution} columns, means over blocks"),
            ("mask", f"over one half, shrunk by {ERODED} x {ERODED} px; both sides black outside it"),
            *scoring.ABOUT,
        )
        if table == scoring.MAPS_TABLE.name:
            return (("given", "one photograph (8-bit sRGB) with its mask and camera"), *shared, *scoring.ABOUT_MAPS)
        relit = [sample for sample in self.samples() if sample.asks == "relight"]
        seen = sum(sample.one_picture for sample in relit)
        return (
            ("given", "one photograph (8-bit sRGB) with its mask and camera, and the other place's light"),
            (
                "asked",
                f"the object in another place, {len(relit)} photographs; of methods that see one picture only the "
                f"{seen} from within {self.tolerance_deg:g} degrees of a photograph of the capture",
            ),
            *shared,
            *scoring.ABOUT_RELIT,
        )


def _relight_name(frame: Photograph) -> str:
    return f"relight_{frame.capture}_{frame.id}"
