"""How a row answers a public set's sample: a method is asked, a folder of predictions is read.

A folder has a subfolder for each photograph (`Sample.folder`), in it `intrinsics.exr` or single maps, and pictures by
name (`Sample.answer`), as `predictions` says; `intrinsics.exr` may also have a channel `depth.Z`.
"""

import time
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from unirender.camera import Camera
from unirender.errors import UnirenderError
from unirender.exr import read_exr
from unirender.intrinsics import Intrinsics
from unirender_evaluation.engine import answered, ask
from unirender_evaluation.predictions.check import Question
from unirender_evaluation.predictions.folder import MAP_FILES, SUFFIXES, PredictionFolder
from unirender_evaluation.public.sets import MAPS, Answer, PublicSet, Sample
from unirender_evaluation.rows import Row

DEPTH = "depth.Z"


def takes_part(row: Row, sample: Sample) -> bool:
    """Whether the row has, or can give, an answer to the sample."""
    if row.protocols is not None and (sample.table, sample.protocol) not in row.protocols:
        return False
    if row.predictions is not None:
        return bool(answer_files(row.predictions, sample))
    return sample.one_picture and callable(getattr(row.method, sample.asks, None))


def answer_files(predictions: PredictionFolder, sample: Sample) -> list[Path]:
    """The files of a folder that answer the sample."""
    folder = predictions.folder / sample.folder
    names = MAP_FILES if sample.answer == MAPS else [f"{sample.answer}{suffix}" for suffix in SUFFIXES]
    return [folder / name for name in names if (folder / name).is_file()]


def asked(row: Row, sample: Sample, inputs: dict[str, Any]) -> tuple[Answer, float]:
    """What a method says to the sample, nothing where it returns None, and the seconds it took.

    Raises:
        UnirenderError: a stranger's method fails, or returns something else than was asked for.
    """
    start = time.perf_counter()
    result = answered(partial(ask, row, sample.asks, f"{sample.table}/{sample.key}", **inputs))
    seconds = time.perf_counter() - start
    return (Answer(maps=result) if sample.asks == "decompose" else Answer(image=result)), seconds


def read_answer(predictions: PredictionFolder, sample: Sample, size: tuple[int, int], camera: Camera) -> Answer:
    """What a folder says to the sample.

    Raises:
        UnirenderError: a file is broken or of another size.
    """
    cover, files = whole(size), answer_files(predictions, sample)
    if sample.answer != MAPS:
        return Answer(image=predictions.read_picture(files[0], cover))
    maps: dict[str, np.ndarray] = {}
    for file in files:
        maps = predictions.read_maps(file, cover, camera) | maps
    return Answer(Intrinsics(**maps, camera=camera), depth=_depth(files[0], size))


def _depth(file: Path, size: tuple[int, int]) -> Float[np.ndarray, "h w 1"] | None:
    depth = read_exr(file)[0].get(DEPTH) if file.suffix == ".exr" else None
    if depth is None:
        return None
    if depth.shape != size or not np.isfinite(depth).all():
        raise UnirenderError(f"predictions: {file}: {DEPTH} is of {depth.shape}, expected finite values of {size}")
    return depth[..., None]


def questions(public: PublicSet) -> dict[str, Question]:
    """What the set asks, by the name of a folder's subfolder: to find what is wrong with one before a run."""
    found: dict[str, Question] = {}
    for sample in public.samples():
        if sample.folder not in found:
            size, camera = public.frame(sample)
            found[sample.folder] = Question(whole(size), camera)
        if sample.answer == MAPS:
            found[sample.folder].maps = True
        else:
            found[sample.folder].answers.add(sample.answer)
    return found


def whole(size: tuple[int, int]) -> Float[np.ndarray, "h w 1"]:
    """A mask of ones that takes no memory."""
    return np.broadcast_to(np.float32(1), (*size, 1))
