"""A folder of the user's own maps and photographs as a pool of lights, divided into train and test.

**Division.** Files of one folder whose names differ only in the suffix or in a size (`hall.jpg`, `hall_1k.hdr`,
`hall_4k.exr`) show one *place*. Places are numbered in name order, folder by folder; every `holdout`-th is for test. No
place is on both sides. One place under two names is for the user to know (`lights.twins` shows maps that look alike).

Only names are read to make a pool. A file is opened when it is drawn: one that is no light is passed over for the next
of the same draw, and the light that comes instead says so (`skipped` in its provenance).
"""

import functools
import hashlib
import os
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from unirender.arguments import check_switches
from unirender.errors import UnirenderError
from unirender.system.wording import counted
from unirender_reference.lights.files import HDR_SUFFIXES, load_light
from unirender_reference.lights.light import SHAPE, Light

Split = Literal["train", "test"]
PICTURE_SUFFIXES = {".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff", ".bmp"}
HOLDOUT, SHARE = 8, 0.5
TRIES = 16  # broken files in a row after which a draw gives up
SIZE_SUFFIX = re.compile(r"[_-]\d+k$")


@dataclass(frozen=True)
class LightPool:
    """The files of one side of a folder.

    Attributes:
        folder: where they lie.
        split: which side.
        names: paths below the folder, in the order of the division.
        share: of all draws of `make_light` that come from this pool.
        turn: draws are turned, mirrored and tilted at random; False: as the files are.
        height: rows of the maps; they have twice as many columns.
    """

    folder: Path
    split: Split
    names: tuple[str, ...]
    share: float = SHARE
    turn: bool = True
    height: int = SHAPE[0]

    @functools.cached_property
    def digest(self) -> str:
        """sha256 over the names and sizes of the files and the share; `turn` and `height` are not in it."""
        lines = [f"{name} {(self.folder / name).stat().st_size}\n" for name in self.names]
        return hashlib.sha256("".join([*lines, repr(self.share)]).encode()).hexdigest()

    def load(self, name: str) -> Light:
        """One file of the pool as a light of `height` rows, named after its path below the folder.

        Raises:
            UnirenderError: as `load_light`.
        """
        photograph = Path(name).suffix.lower() not in HDR_SUFFIXES
        light = load_light(self.folder / name, photograph, (self.height, 2 * self.height))
        return Light(re.sub(r"[^\w-]", "-", name), light.environment, {**light.provenance, "file": name})

    def draw(self, rng: np.random.Generator) -> Light:
        """A random file; those that cannot be read are passed over and named, with their reasons, in `skipped`.

        Each has a line there, which names it by its path below the folder.

        Raises:
            UnirenderError: `TRIES` files in a row, or all there are, are no lights.
        """
        skipped = []
        for index in rng.permutation(len(self.names))[:TRIES]:
            name = self.names[index]
            try:
                light = self.load(name)
            except UnirenderError as error:
                reason = " ".join(str(error).split())
                reason = reason.replace(" ".join(str(self.folder / name).split()), name)
                skipped.append(f"{name}: {reason.removeprefix('light ').removeprefix(f'{name}: ')}")
                continue
            if not skipped:
                return light
            return Light(light.name, light.environment, {**light.provenance, "skipped": "\n".join(skipped)})
        raise UnirenderError(
            f"lights {self.folder}: none of {len(skipped)} {self.split} files drawn is a light, expected maps or "
            f"photographs; the first: {skipped[0]}"
        )

    def check(self) -> Iterator[tuple[str, Light | UnirenderError]]:
        """Reads every file once: its light, or why it is none."""
        for name in self.names:
            try:
                yield name, self.load(name)
            except UnirenderError as error:
                yield name, error


def light_pool(
    folder: str | Path,
    split: Split,
    holdout: int = HOLDOUT,
    share: float = SHARE,
    turn: bool = True,
    height: int = SHAPE[0],
) -> LightPool:
    """The pool of one split from a folder of HDR/EXR/PFM maps and photographs, searched with its subfolders.

    Args:
        folder: files of other kinds in it are left alone.
        split: "train" or "test".
        holdout: every `holdout`-th place, in name order, is for test; at least 2.
        share: of the draws of `make_light`, in (0, 1]; the rest are the built-in lights.
        turn: turn, mirror and sometimes tilt what is drawn; False: take the files as they are.
        height: rows of the maps, at least 3; more than 64 shows in mirrors only.

    Raises:
        UnirenderError: no such folder, no places for this side of the division, or a number outside its range.
    """
    check_switches(turn=turn)
    if split not in ("train", "test"):
        raise UnirenderError(f"light_pool: got split {split!r}, expected 'train' or 'test'")
    if not 0 < share <= 1:
        raise UnirenderError(f"light_pool share: got {share:g}, expected more than 0 and at most 1")
    if height < 3:
        raise UnirenderError(f"light_pool height: got {height}, expected at least 3 rows")
    names = divide(folder, holdout)[split]
    if not names:
        places = sum(1 for _ in _places(Path(folder)))
        least = holdout if split == "test" else 1
        lower = f"lower --light-holdout (`unirender lights`: --holdout) to at most {places}, or " if places > 1 else ""
        raise UnirenderError(
            f"lights {folder}: no maps or photographs for the {split} side, expected at least {counted(least, 'place')}"
            f"{f' (one in {holdout} is for test)' if split == 'test' else ''}, got {places}; {lower}add files"
        )
    return LightPool(Path(folder), split, names, share, turn, height)


def divide(folder: str | Path, holdout: int = HOLDOUT) -> dict[Split, tuple[str, ...]]:
    """The files of both sides, as paths below the folder in name order; a side may be empty.

    Raises:
        UnirenderError: no such folder, or a `holdout` below 2.
    """
    folder = Path(folder)
    if holdout < 2:
        raise UnirenderError(f"light_pool holdout: got {holdout}, expected at least 2 (every 2nd place is for test)")
    if not folder.is_dir():
        raise UnirenderError(f"lights {folder}: no such folder; expected one with HDR, EXR or PFM maps or photographs")
    train, test = [], []
    for number, place in enumerate(_places(folder), start=1):
        (train if number % holdout else test).extend(place)
    return {"train": tuple(train), "test": tuple(test)}


def _places(folder: Path) -> Iterator[list[str]]:
    """The files of each place, as paths below the folder: folders in name order, places in name order within each."""
    suffixes = HDR_SUFFIXES | PICTURE_SUFFIXES
    for root, folders, files in os.walk(folder):
        folders.sort()
        places: dict[str, list[str]] = {}
        for name in sorted(files):
            stem, suffix = os.path.splitext(name)
            if suffix.lower() in suffixes and not name.startswith("."):
                key = SIZE_SUFFIX.sub("", stem.lower())
                places.setdefault(key, []).append((Path(root) / name).relative_to(folder).as_posix())
        for key in sorted(places):
            yield places[key]
