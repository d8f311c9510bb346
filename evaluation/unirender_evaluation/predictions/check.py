"""Whether a folder of predictions can be scored, found out in full before anything runs: layout, sizes, conventions and
every file."""

import difflib
import json
import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import Float

from unirender.camera import Camera
from unirender.errors import UnirenderError
from unirender.exr import MAP_CHANNELS
from unirender.system.wording import counted
from unirender_evaluation.methods.method import Mask
from unirender_evaluation.predictions.conventions import FILE, Conventions
from unirender_evaluation.predictions.folder import LIGHT_FILES, MAP_FILES, SUFFIXES, PredictionFolder
from unirender_evaluation.rows import Row
from unirender_evaluation.suites.suite import Suite
from unirender_evaluation.task import PROTOCOLS
from unirender_evaluation.tasks import tasks

PICTURE_LIKE = (".exr", ".hdr", ".jpeg", ".jpg", ".npy", ".npz", ".pfm", ".png", ".tif", ".tiff", ".webp")
SETTINGS_LIKE = (".toml", ".toml.txt")  # of which one is read
NEAR = 0.7  # likeness of names, of `difflib`: that of `convention` is 0.95, that of `config` 0.47
PACKED = "roughness.png and metallic.png, its green and its blue channel"
ALIASES = {  # names of others, in small letters, and what they are here
    "basecolor": "albedo.png",
    "base_color": "albedo.png",
    "metallic_roughness": PACKED,
    "metallicroughness": PACKED,
    "orm": PACKED,
}
SHOWN = 3  # lines that say the same
SAME = 1e-3  # difference of two channels, below that of 8 bits
# Of `bench export`, `decompose`.
IGNORED = ("image.png", "mask.exr", "meta.json", *LIGHT_FILES, "environment.png", "mask.png")
GIVEN = ("given.exr", "environment.exr")  # of `bench export`, in an answer's folder
EXPORTED = "the folders' names of `unirender bench export`,"


class PredictionError(UnirenderError):
    """Folders of predictions that cannot be scored; `problems` has a line for each reason."""

    def __init__(self, problems: list[str]) -> None:
        count = counted(len(problems), "problem")
        super().__init__("\n".join([f"predictions: {count}, nothing was run", *_shortened(problems)]))
        self.problems = tuple(problems)


def _shortened(problems: list[str]) -> Iterator[str]:
    """The lines; of those that say the same of files of one name, or of folders, but for numbers, `SHOWN` and how many
    more."""
    alike: dict[tuple[str, str], list[str]] = {}
    for problem in problems:
        place, _, said = problem.partition(": ")
        file = Path(place).name if Path(place).suffix else ""
        alike.setdefault((file, re.sub(r"[\d.]+", "0", said)), []).append(problem)
    for lines in alike.values():
        yield from lines[:SHOWN]
        if len(lines) > SHOWN:
            yield f"... and {len(lines) - SHOWN} more like this, of other pictures"


@dataclass
class Question:
    """What a suite asks of one picture: the answers' names, and whether maps and the light are among them."""

    mask: Mask
    camera: Camera
    answers: set[str] = field(default_factory=set)
    maps: bool = False
    light: bool = False

    @property
    def pictures(self) -> list[str]:
        """The names that a file of an answer may have."""
        return [f"{name}{suffix}" for name in sorted(self.answers) for suffix in SUFFIXES]

    @property
    def files(self) -> str:
        """The names that any file may have, in short."""
        names = [f"{name}.exr|png" for name in sorted(self.answers)]
        return ", ".join([*names, *(MAP_FILES if self.maps else ()), *(LIGHT_FILES if self.light else ())])


def check_predictions(rows: Iterable[Row], suite: Suite) -> None:
    """Reads every file of the rows that are folders.

    Raises:
        PredictionError: there is a problem; all of them at once.
    """
    folders = [row.predictions for row in rows if row.predictions is not None]
    asked = questions(suite) if folders else {}
    problems = [problem for folder in folders for problem in folder_problems(folder, asked, suite.spec.name, EXPORTED)]
    problems += [problem for folder in folders for problem in _other_truth(folder.folder, asked, suite)]
    if problems:
        raise PredictionError(problems)


def questions(suite: Suite) -> dict[str, Question]:
    """What the suite asks, by the name of the picture's folder."""
    asked: dict[str, Question] = {}
    for table, protocol in PROTOCOLS:
        for task in tasks(suite, table, protocol, list(suite.scenes)):
            question = asked.setdefault(task.folder, Question(suite.mask(task.scene), suite.spec.camera))
            question.light |= task.asks_light
            if task.asks_light:
                continue
            if task.answer != "intrinsics":
                question.answers.add(task.answer)
            question.maps |= "decompose" in task.asks
    return asked


def folder_problems(
    predictions: PredictionFolder, asked: dict[str, Question], suite: str, names: str = "names"
) -> list[str]:
    """All that is wrong with one folder, a line each; `names`: what those of the pictures' folders are."""
    found: list[str] = []
    try:
        _ = predictions.conventions
    except UnirenderError as error:
        found += str(error).splitlines()
        predictions = PredictionFolder(predictions.folder, Conventions())  # and on to the files
    answered = 0
    for path in _visible(predictions.folder):
        if unusable := _unusable(path):
            found.append(unusable)
        elif path.is_dir() and path.name in asked:
            files = list(_visible(path))
            found += [_unread_settings(file, predictions.folder) for file in files if _is_settings(file)]
            found += _layout_problems(path, files, asked[path.name])
            readable = [file for file in files if _is_answer(file, asked[path.name])]
            answered += len(readable)
            found += [problem for file in readable for problem in _file_problems(predictions, file, asked[path.name])]
        elif path.is_dir():
            found.append(_unknown_picture(path, asked, suite, names))
        elif path.name != FILE and _is_settings(path):
            found.append(_unread_settings(path, predictions.folder))
        elif path.suffix.lower() in PICTURE_LIKE:
            found.append(f"{path}: lies outside the pictures' folders, expected <picture>/<answer>")
    if not answered and not found:
        found.append(f"{predictions.folder}: no file answers any question of the suite {suite!r}")
    return found


def _unknown_picture(path: Path, asked: dict[str, Question], suite: str, names: str) -> str:
    """What is wrong with a folder that is no picture's; one that has pictures' folders is another method's, or packed
    once more."""
    inside = sum(inner.is_dir() and inner.name in asked for inner in _visible(path))
    if inside:
        return (
            f"{path}: has folders of {inside} of the pictures itself, expected them in {path.parent}; score it by "
            f"itself, with --predictions NAME={path}"
        )
    named = [inner.name for inner in _visible(path) if inner.is_file() and any(name in inner.name for name in asked)]
    if named:
        return (
            f"{path}: has {len(named)} files named as pictures ({named[0]}), expected a folder for each picture and in "
            "it files like albedo.png; a script in the documentation sorts them (docs/your_files.md, Files of other "
            "methods)"
        )
    twins = [name for name in asked if name.casefold() == path.name.casefold()]
    close = twins or difflib.get_close_matches(path.name, asked, 1) or sorted(asked)[:1]
    there = path.with_name(close[0])  # on a file system without case it may be this very folder
    other = bool(twins) and there.is_dir() and not there.samefile(path)
    both = f"; {close[0]} is there, too: keep one of them" if other else ""
    return f"{path}: the suite {suite!r} has no such picture, expected {names} like {close[0]}{both}"


def _visible(folder: Path) -> Iterator[Path]:
    return (path for path in sorted(folder.iterdir()) if not path.name.startswith("."))


def _is_answer(path: Path, question: Question) -> bool:
    if not path.is_file():
        return False
    if question.light and path.name in LIGHT_FILES:
        return True
    if path.suffix not in SUFFIXES:
        return False
    return path.stem in question.answers or (question.maps and path.name in MAP_FILES)


def _layout_problems(folder: Path, files: list[Path], question: Question) -> Iterator[str]:
    """A line for each file that answers nothing, or that another one answers as well."""
    for path in files:
        expected = _is_answer(path, question) or path.name in IGNORED
        if unusable := _unusable(path):
            yield unusable
        elif path.is_dir() and path.name not in question.answers:
            yield f"{path}: an unknown folder, expected files {question.files}"
        elif path.is_dir():
            yield from _problems_in_an_answers_folder(path)
        elif path.is_file() and not expected and path.suffix.lower() in PICTURE_LIKE:
            yield f"{path}: answers no question about this picture{_meant(path, question)}, expected {question.files}"
    names = {path.name for path in files}
    for answer in sorted(question.answers):
        if {f"{answer}{suffix}" for suffix in SUFFIXES} <= names:
            yield f"{folder}: {answer} is there as EXR and as PNG, expected one of them"
    if question.light and "environment.png" in names and not names & set(LIGHT_FILES):
        yield f"{folder / 'environment.png'}: display values are no light, expected {' or '.join(LIGHT_FILES)}"
    if question.light and set(LIGHT_FILES) <= names:
        yield f"{folder}: {' and '.join(LIGHT_FILES)} are both there, expected one of them"


def _meant(path: Path, question: Question) -> str:
    """Which name was probably meant: the same in small letters or of another format, or one like it."""
    stem = path.stem.lower()
    if question.maps and path.suffix.lower() == ".exr" and f"{stem}.png" in MAP_FILES:
        return f" (did you mean {', '.join(MAP_CHANNELS[stem])} of intrinsics.exr?)"
    if question.maps and stem in ALIASES:
        return f" (did you mean {ALIASES[stem]}?)"
    names = [*question.pictures, *(MAP_FILES if question.maps else ()), *(LIGHT_FILES if question.light else ())]
    same = [name for name in names if name == path.name.lower()] or [name for name in names if Path(name).stem == stem]
    close = same or difflib.get_close_matches(path.name, names, 1, NEAR)
    return f" (did you mean {close[0]}?)" if close else ""


def _problems_in_an_answers_folder(folder: Path) -> Iterator[str]:
    """What lies beside the files that `bench export` puts there: nothing else is looked at."""
    for path in _visible(folder):
        if unusable := _unusable(path):
            yield unusable
        elif _is_settings(path):
            yield _unread_settings(path, folder.parents[1])
        elif path.is_dir() or (path.suffix.lower() in PICTURE_LIKE and path.name not in GIVEN):
            yield f"{path}: lies in a folder where no answer is looked for, expected {folder}.exr or .png"


def _is_settings(path: Path) -> bool:
    """Whether a file is probably meant to be the conventions: a method's other settings do no harm."""
    name = path.name.lower()
    stem = name.removesuffix(".txt").removesuffix(".toml")
    is_near = bool(difflib.get_close_matches(stem, [FILE.removesuffix(".toml")], cutoff=NEAR))
    return name.endswith(SETTINGS_LIKE) and is_near and path.is_file()


def _unread_settings(path: Path, folder: Path) -> str:
    return f"{path}: is not read, expected {folder / FILE} for all pictures, or none; rename, move or remove it"


def _unusable(path: Path) -> str | None:
    """What is wrong with what is neither a file nor a folder, and would count as an answer that is not there."""
    if path.is_file() or path.is_dir():
        return None
    if path.is_symlink():
        return f"{path}: a link to {path.readlink()}, which is not there; copy the file, or remove the link"
    return f"{path}: a pipe, a socket or a device, expected a file; save what it gives as a file, or remove it"


def _other_truth(folder: Path, asked: dict[str, Question], suite: Suite) -> Iterator[str]:
    """That the inputs, whose `meta.json` lies beside the answers, were exported with another truth: one line."""
    named = {path: _named_truth(path) for path in (folder / name / "meta.json" for name in sorted(asked))}
    others = [path for path, sha256 in named.items() if sha256 not in (None, suite.sha256)]
    if others:
        yield (
            f"{others[0]}: suite_sha256 is {named[others[0]]}, and {suite.sha256} of the truth here ({len(others)} "
            "such files): these inputs are of another truth; export them again (`unirender bench export`) and predict "
            "anew, or score with that truth"
        )


def _named_truth(path: Path) -> str | None:
    """The truth that a `meta.json` of `bench export` is of; None: another file of the name, or none."""
    try:
        meta = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    return str(meta["suite_sha256"]) if isinstance(meta, dict) and "suite_sha256" in meta else None


def _file_problems(predictions: PredictionFolder, path: Path, question: Question) -> Iterator[str]:
    """A line for each fault of a file's content."""
    try:
        if path.name in LIGHT_FILES:
            predictions.read_light(path)
        elif path.stem in question.answers:
            predictions.read_picture(path, question.mask)
        else:
            normal = predictions.read_maps(path, question.mask, question.camera).get("normal")
            inside = None if normal is None else normal[question.mask[..., 0] > 0]
            if inside is not None and _is_grey(inside) and (inside.any() or path.suffix == ".png"):
                yield f"{path}: the three channels of its normal are equal, expected x, y and z; write it in colour"
    except UnirenderError as error:
        yield str(error).removeprefix("predictions: ")


def _is_grey(normals: Float[np.ndarray, "n 3"]) -> bool:
    """Whether directions were made from one channel, or are none at all."""
    return float(np.ptp(np.abs(normals), axis=-1).max()) < SAME
