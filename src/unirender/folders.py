"""Decompositions on disk: one result folder, or a folder of pictures with a result folder for each.

Each picture of a folder is decomposed as if alone: with the same noise, into a result folder that bears the picture's
whole file name (so `a.png` and `a.jpg` stay apart) and appears complete or not at all. What is there already with the
same settings is kept, so a run that was stopped goes on when it is started again. A picture that cannot be used is
listed, and the others are done. Light to import.
"""

import hashlib
import json
import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from unirender.errors import UnirenderError, UsageError
from unirender.files import ENVIRONMENT_FILE, INTRINSICS_FILE, write_result
from unirender.intrinsics import MAPS
from unirender.new_folders import META_FILE, SUMMARY_FILE, new_folder
from unirender.picture_files.display_files import RAW_SUFFIXES
from unirender.pictures import Picture, checked_file
from unirender.system.paths import forget_half_made
from unirender.system.whole_files import replace_file
from unirender.visualization import write_png

if TYPE_CHECKING:
    from unirender.pipelines.results import Decomposition

SUFFIXES = (".bmp", ".exr", ".jpeg", ".jpg", ".png", ".tif", ".tiff", ".webp")
RARE_SUFFIXES = (".avif", ".gif", ".j2k", ".jfif", ".jp2", ".mpo", ".pbm", ".pgm", ".pnm", ".ppm", ".qoi", ".tga")
FOREIGN_SUFFIXES = (".heic", ".heif", *RAW_SUFFIXES)  # listed, so that their failure is
FIGURES = ("roughness_mean", "metallic_mean", "clipped", "remarks", "std_max")  # of `meta.json`, for the summary
INPUT_SHA256 = "input_sha256"
ELSEWHERE = ("device", "input", "mask")  # of `meta.json`: another machine or another path to a file is no other setting
ADDED = {"looks": 1, "flat": False}  # settings that an older `meta.json` does not name, and what they were
AT_ONCE, PIXELS_AT_ONCE = 8, 4_000_000  # looks at pictures of one batch of the network, and pixels of the pictures

Read = Callable[[Path, Path | None], Picture]
Decompose = Callable[[list[Picture]], "list[Decomposition]"]


@dataclass
class FolderResult:
    """What became of a folder of pictures.

    Attributes:
        figures: of each picture that is done, by file name.
        kept: how many of them were there already.
        failed: why the others are not, by file name.
    """

    figures: dict[str, dict[str, Any]] = field(default_factory=dict)
    kept: int = 0
    failed: dict[str, str] = field(default_factory=dict)


def list_pictures(folder: Path) -> list[Path]:
    """The pictures that lie in a folder, not in folders inside it, in natural order: `f2.png` before `f10.png`.

    Links that lead nowhere are among them, so that they are listed as failed; so are a camera's files that cannot be
    read, unless a picture of the same stem was made of them.

    Raises:
        UnirenderError: there is none, or the folder is a result.
    """
    if (folder / META_FILE).is_file() and (folder / INTRINSICS_FILE).is_file():
        raise UnirenderError(
            f"{folder}: is a result, whose pictures are maps, expected a folder of pictures; see `unirender render`"
        )
    found = [path for path in folder.iterdir() if _is_picture(path) and not path.is_dir()]
    stems = {path.stem for path in found}
    found += [path for path in folder.iterdir() if _is_foreign(path) and path.stem not in stems]
    if not found:
        raise UnirenderError(f"{folder}: has no pictures, expected files that end in {', '.join(SUFFIXES)}")
    return sorted(found, key=lambda path: (natural_order(path.name), path.name))


def _is_picture(path: Path) -> bool:
    """By its name."""
    return path.suffix.lower() in SUFFIXES + RARE_SUFFIXES and not path.name.startswith(".")


def _is_foreign(path: Path) -> bool:
    return path.suffix.lower() in FOREIGN_SUFFIXES and not path.name.startswith(".") and not path.is_dir()


def natural_order(name: str) -> list[tuple[int, int, str]]:
    """A key that sorts numbers in a text by their value."""
    parts = re.split(r"(\d+)", name.lower())
    return [(0, int(part), "") if part.isdecimal() else (1, 0, part) for part in parts]


def write_decomposition(folder: Path, result: "Decomposition", meta: Mapping[str, Any]) -> dict[str, Any]:
    """Writes a result folder, with a picture of the spread of each map where there are several samples.

    Returns:
        `meta` and the figures of the result, as they stand in `meta.json`.
    """
    meta = dict(meta) | {"roughness_mean": result.roughness, "metallic_mean": result.metallic}
    if result.std is not None:
        meta["std_max"] = {name: float(spread.max()) for name, spread in result.std.items()}
    write_result(folder, result.intrinsics, meta)
    for name, spread in (result.std or {}).items():
        write_png(folder / f"{name}.std.png", spread / max(float(spread.max()), 1e-6))
    return meta


def decompose_folder(
    pictures: list[Path],
    output: Path,
    *,
    read: Read,
    decompose: Decompose,
    settings: Mapping[str, Any],
    masks: Path | None = None,
    overwrite: bool = False,
    watch: Callable[[int], None] = lambda done: None,
) -> FolderResult:
    """Decomposes pictures into `output/<file name>`.

    Args:
        pictures: files.
        output: folder; made where it is missing.
        read: (picture file, mask file or None) -> the picture with a mask.
        decompose: a few pictures at once.
        settings: all that decides a result beside the picture, for its `meta.json`.
        masks: the mask file of all pictures, or the folder of their masks.
        overwrite: do those again that are there already.
        watch: is told after each batch how many pictures are behind it: done, kept or failed.

    Raises:
        UsageError: `output` is the folder of the pictures.
        UnirenderError: `output` cannot be made, or is a result itself.
    """
    _make_output(output, pictures)
    done, damaged, mask_of = FolderResult(), set[Path](), mask_finder(masks)

    def wanted() -> Iterator[tuple[Path, Picture, dict[str, Any]]]:
        for path in pictures:
            try:
                mask = mask_of(path)
                meta = {**settings, "input": path, "mask": mask, INPUT_SHA256: input_sha256(path, mask)}
                if not overwrite and (figures := figures_of(output / path.name, meta)) is not None:
                    if not missing_files(output / path.name, figures):
                        done.figures[path.name] = figures
                        done.kept += 1
                        continue
                    damaged.add(path)
                picture = read(path, mask)
            except UnirenderError as error:
                done.failed[path.name] = str(error)
                continue
            yield path, picture, meta | of_picture(picture)

    def finish(batch: list[tuple[Path, Picture, dict[str, Any]]]) -> None:
        results = decompose([picture for _, picture, _ in batch])
        for (path, _, meta), result in zip(batch, results, strict=True):
            try:
                again = overwrite or path in damaged
                if not again and (figures := figures_of(output / path.name, meta)) is not None:
                    done.figures[path.name] = figures  # of another process, which was faster
                    done.kept += 1
                    continue
                with new_folder(output / path.name, overwrite=again, tidy=False) as folder:
                    written = write_decomposition(folder, result, meta)
            except UnirenderError as error:
                done.failed[path.name] = str(error)
            else:
                done.figures[path.name] = {name: written[name] for name in FIGURES if name in written}

    for batch in batches(wanted(), max(AT_ONCE // int(settings.get("looks", 1)), 1)):
        finish(batch)  # whose results are forgotten before the next are made
        watch(len(done.figures) + len(done.failed))
    return done


def _make_output(output: Path, pictures: list[Path]) -> None:
    """Makes the folder of the results; without what killed processes left there."""
    if (output / META_FILE).is_file():
        raise UnirenderError(
            f"{output}: has a {META_FILE}, so that it is one result, expected a folder for several; choose another"
        )
    if any(output.resolve() == path.resolve().parent for path in pictures):
        raise UsageError(f"{output}: is the folder of the pictures, expected another one for the results")
    try:
        output.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UnirenderError(f"{output}: cannot be written ({error.strerror}); choose another folder") from error
    forget_half_made(output, {path.name for path in pictures})


def of_picture(picture: Picture) -> dict[str, Any]:
    """For `meta.json`: what a picture cannot show, and what was assumed of it."""
    return {"clipped": picture.clipped, "remarks": dict(picture.remarks)}


def batches(
    items: Iterable[tuple[Path, Picture, dict[str, Any]]], most: int = AT_ONCE
) -> Iterator[list[tuple[Path, Picture, dict[str, Any]]]]:
    """Groups of at most `most` pictures and about `PIXELS_AT_ONCE` pixels, in order."""
    batch: list[tuple[Path, Picture, dict[str, Any]]] = []
    pixels = 0
    for item in items:
        height, width = item[1].image_srgb.shape[:2]
        if batch and pixels + height * width > PIXELS_AT_ONCE:
            yield batch
            batch, pixels = [], 0
        batch.append(item)
        pixels += height * width
        if len(batch) == most or pixels >= PIXELS_AT_ONCE:  # before the next is read
            yield batch
            batch, pixels = [], 0
    if batch:
        yield batch


def mask_finder(masks: Path | None) -> Callable[[Path], Path | None]:
    """What says which file is the mask of a picture: `masks` itself, or the picture in that folder with the same stem.

    The folder is listed once. What is returned raises `UnirenderError` where it has no such picture, or more than one.
    """
    if masks is None or not masks.is_dir():
        return lambda _: masks
    by_stem: dict[str, list[Path]] = {}
    for mask in filter(_is_picture, masks.iterdir()):
        by_stem.setdefault(mask.stem, []).append(mask)

    def mask_of(path: Path) -> Path:
        found = by_stem.get(path.stem, [])
        if len(found) != 1:
            raise UnirenderError(f"{masks}: has {len(found)} masks for {path.name}, expected one picture {path.stem}.*")
        return found[0]

    return mask_of


def input_sha256(path: Path, mask: Path | None) -> str:
    """sha256 over a picture file, and over its mask file if it has one.

    Raises:
        UnirenderError: a file cannot be read.
    """
    digest = hashlib.sha256()
    for file in filter(None, (path, mask)):
        try:
            digest.update(checked_file(file).read_bytes())
        except OSError as error:
            raise UnirenderError(f"{file}: cannot be read ({error.strerror}); check its permissions") from error
    return digest.hexdigest()


def figures_of(folder: Path, meta: Mapping[str, Any]) -> dict[str, Any] | None:
    """The figures of an earlier result; None where there is none.

    Raises:
        UnirenderError: there is one of another picture or of other settings.
    """
    try:
        stored = json.loads((folder / META_FILE).read_text())
    except (OSError, ValueError, RecursionError):
        return None
    if not isinstance(stored, dict):
        return None
    now = json.loads(json.dumps(dict(meta), default=str))
    differing = [
        name for name, value in now.items() if name not in ELSEWHERE and stored.get(name, ADDED.get(name)) != value
    ]
    if differing:
        said = ("picture or mask (a file changed since)" if name == INPUT_SHA256 else name for name in differing)
        raise UnirenderError(
            f"{folder}: is a result with another {', '.join(said)}; choose another folder or pass --overwrite"
        )
    return {name: stored[name] for name in FIGURES if name in stored}


def missing_files(folder: Path, figures: Mapping[str, Any]) -> list[str]:
    """Names of the files of a decomposition that are not in its folder, or empty there.

    Args:
        folder: of the result.
        figures: of it, as `figures_of` gives them.
    """
    pictures = [*MAPS, *(f"{name}.std" for name in figures.get("std_max", ()))]
    names = [INTRINSICS_FILE, ENVIRONMENT_FILE, *(f"{name}.png" for name in pictures)]
    return [name for name in names if not (folder / name).is_file() or not (folder / name).stat().st_size]


def write_summary(output: Path, result: FolderResult, facts: Mapping[str, Any]) -> None:
    """Writes `summary.json`, whole: what was asked for, the figures of each picture, and why others failed."""
    record = {**facts, "pictures": result.figures, "failed": result.failed}
    replace_file(output / SUMMARY_FILE, json.dumps(record, indent=2, sort_keys=True, default=str) + "\n")
