"""Recipes: several data sets that are one training set, as a TOML file that a user can copy. Light to import.

    title = "..."
    assets_from = "..."     how to get the folders that the parts name; part of the message where one is missing
    [common]                options of `unirender dataset` that all parts have
    [parts.NAME]            a data set in the folder NAME, with its own options beside them; `meshes` and `lights` are
                            folders below --assets

Every part is a data set of its own, with its shards and manifest, so that one never waits for another and each is
continued where it was stopped.
"""

import re
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any

from unirender.errors import UnirenderError, UsageError
from unirender.system.wording import meant, near

FOLDERS = ("meshes", "lights")  # options that are folders of the user's
OPTIONS: Mapping[str, type] = {
    **dict.fromkeys(("objects", "holdout", "pairs", "resolution", "seed", "spp"), int),
    **dict.fromkeys(("light_holdout", "light_height"), int),
    **dict.fromkeys(("noise_floor", "light_share"), float),
    **dict.fromkeys(("denoise", "turn_lights", "turn_objects"), bool),
    **dict.fromkeys(("vary", "materials", *FOLDERS), str),
}
_NAME = re.compile(r"[a-z0-9][a-z0-9_-]*")


@dataclass(frozen=True)
class Recipe:
    """A training set in parts.

    Attributes:
        path: of the TOML file.
        title: what it is.
        assets_from: how to get the folders that the parts name.
        parts: options of each part by its name, common ones included; folders relative to those of the user.
    """

    path: Path
    title: str
    assets_from: str
    parts: Mapping[str, Mapping[str, Any]]

    def options(self, assets: Path | None) -> dict[str, dict[str, Any]]:
        """Options of each part, its folders below `assets`.

        Raises:
            UsageError: the parts need folders, and `assets` is None.
            UnirenderError: some of them are not there; all are named.
        """
        wanted = sorted({str(part[name]) for part in self.parts.values() for name in FOLDERS if name in part})
        if wanted and assets is None:
            raise UsageError(f"--recipe {self.path.stem}: needs the folders {', '.join(wanted)}; pass --assets FOLDER")
        missing = [name for name in wanted if assets is not None and not (assets / name).is_dir()]
        if missing:
            hint = f"; to get them: {self.assets_from}" if self.assets_from else "; copy or link them there"
            raise UnirenderError(f"{assets}: no folder {', '.join(missing)} in it, expected {', '.join(wanted)}{hint}")
        return {
            name: {key: str(assets / value) if assets and key in FOLDERS else value for key, value in part.items()}
            for name, part in self.parts.items()
        }


def recipe_path(name_or_path: str) -> Path:
    """A recipe's TOML file: a path as it is, a bare name among the package's own.

    Raises:
        UsageError: no such name.
    """
    if name_or_path.endswith(".toml"):
        return Path(name_or_path)
    folder = Path(str(resources.files("unirender_reference"))) / "data" / "recipes"
    path = folder / f"{name_or_path}.toml"
    if not path.is_file():
        known = sorted(p.stem for p in folder.glob("*.toml"))
        expected = f"expected one of {', '.join(known)}, or the path of a .toml file"
        raise UsageError(f"--recipe {name_or_path}: {expected}{meant(near(name_or_path, known))}")
    return path


def read_recipe(name_or_path: str) -> Recipe:
    """Reads and checks a recipe.

    Raises:
        UsageError: no recipe of that name.
        UnirenderError: missing or broken file, unknown keys or values of another type; all of these at once.
    """
    path = recipe_path(name_or_path)
    try:
        data = tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise UnirenderError(
            f"{path}: cannot be read ({error.strerror}), expected a recipe; is the path right?"
        ) from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise UnirenderError(f"{path} is not TOML: {error}; correct that line") from None
    common, parts = data.pop("common", {}), data.pop("parts", {})
    title, assets_from = data.pop("title", ""), data.pop("assets_from", "")
    problems = [f"unknown key {key!r}" for key in data]
    if not isinstance(parts, dict) or not parts:
        problems.append("no [parts.NAME]")
        parts = {}
    for name, options in {"common": common, **parts}.items():
        if not isinstance(options, dict):
            problems.append(f"{name} is {options!r}, expected a table")
            continue
        problems += [f"{name}: {line}" for key, value in options.items() if (line := _problem(key, value))]
    problems += [f"part {name!r}: expected a-z, 0-9, _ and -" for name in parts if not _NAME.fullmatch(name)]
    if problems:
        raise UnirenderError(
            f"{path}: {'; '.join(problems)}. Expected title, assets_from, [common] and [parts.NAME] with options of "
            f"`unirender dataset`: {', '.join(OPTIONS)}"
        )
    return Recipe(path, str(title), str(assets_from), {name: {**common, **part} for name, part in parts.items()})


def _problem(key: str, value: Any) -> str | None:
    """What is wrong with an option."""
    if key not in OPTIONS:
        return f"unknown option {key!r}"
    expected = OPTIONS[key]
    right = isinstance(value, (int, float) if expected is float else expected) and (
        expected is bool or not isinstance(value, bool)
    )
    if not right:
        return f"{key} is {value!r}, expected {expected.__name__}"
    if key in FOLDERS and (Path(str(value)).is_absolute() or ".." in Path(str(value)).parts):
        return f"{key} is {value!r}, expected a folder below --assets"
    return None
