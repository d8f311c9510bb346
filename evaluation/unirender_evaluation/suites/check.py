"""Whether the values of a suite's TOML file make sense: every problem as a phrase, all of them at once."""

import re
from collections.abc import Callable, Iterator, Mapping
from typing import Any

LEAST = 31  # `lpips.SMALLEST["alex"]`, which imports torch; SSIM needs 11
FILES_KEYS = {"files", "holdout", "without", "count", "seed"}


def value_problems(flat: Mapping[str, Any]) -> list[str]:
    """What is wrong with the values of a suite's file, whose keys are complete."""
    found = [
        f"{name} is {flat[name]!r}, expected {expected}"
        for names, good, expected in RULES
        for name in names.split()
        if name in flat and not good(flat[name])
    ]
    found += _files_problems(flat)
    return found or list(_contradictions(flat))


def _integer(least: int) -> Callable[[Any], bool]:
    return lambda value: isinstance(value, int) and not isinstance(value, bool) and value >= least


def _number(low: float, high: float) -> Callable[[Any], bool]:
    return lambda value: isinstance(value, int | float) and not isinstance(value, bool) and low <= value <= high


def _list(good: Callable[[Any], bool]) -> Callable[[Any], bool]:
    return lambda value: isinstance(value, list) and all(map(good, value))


def _different(good: Callable[[Any], bool]) -> Callable[[Any], bool]:
    return lambda value: _list(good)(value) and len(set(value)) == len(value)


def _pair(value: Any) -> bool:
    return _list(_number(0, 1))(value) and len(value) == 2


def _scene(value: Any) -> bool:
    if not isinstance(value, list) or len(value) != 2:
        return False
    return (isinstance(value[0], str) or _integer(0)(value[0])) and _integer(0)(value[1])


def _text(value: Any) -> bool:
    return isinstance(value, str)


RULES: tuple[tuple[str, Callable[[Any], bool], str], ...] = (
    ("name", lambda v: _text(v) and re.fullmatch(r"[\w-]+", v) is not None, "letters, digits, - and _"),
    ("title objects_from lights_from truth_cost truth_sha256 objects_folder lights_folder", _text, "a text"),
    ("truth_file", lambda v: _text(v) and re.fullmatch(r"[\w.-]+", v) is not None, "a file's name without a folder"),
    ("split", lambda v: v in ("train", "test"), "'train' or 'test'"),
    ("objects procedural_lights", _different(_integer(0)), "a list of different whole numbers from 0"),
    ("resolution", _integer(LEAST), f"a whole number of pixels, at least {LEAST}: LPIPS-Alex asks for so many"),
    ("fov_deg", _number(1, 170), "degrees from 1 to 170"),
    ("bundled_lights assignment_seed", _integer(0), "a whole number from 0"),
    ("lights_per_object", _integer(2), "at least 2: relighting asks for the object's other light"),
    ("light_rows", _integer(3), "a whole number of rows, at least 3"),
    ("base", _pair, "[metallic, roughness], each from 0 to 1"),
    ("edits", lambda v: _list(_pair)(v) and len(v) > 0, "a list of [metallic, roughness], each from 0 to 1"),
    ("specular_roughness", _list(_number(0, 1)), "a list of numbers from 0 to 1"),
    ("levels", _integer(2), "a whole number, at least 2"),
    ("per_scene spp max_spp light_spp", _integer(1), "a whole number, at least 1"),
    ("geometry_spp", _integer(64), "a whole number, at least 64: with fewer the truth check tells nothing"),
    ("ceiling_factor", _integer(2), "a whole number, at least 2"),
    ("batches", _integer(8), "a whole number, at least 8: fewer do not tell the noise"),
    ("target_db light_target_db", _number(10, 80), "decibels from 10 to 80"),
    ("ceiling_scenes", _list(_scene), "a list of [object, number of the light]"),
)
FILES_RULES: tuple[tuple[str, Callable[[Any], bool], str], ...] = (
    ("files", _text, "a pattern of paths"),
    ("holdout", lambda v: v == 0 or _integer(2)(v), "0 (all files) or at least 2"),
    ("without", _list(_text), "a list of paths below the folder"),
    ("count", _integer(1), "a whole number, at least 1"),
    ("seed", _integer(0), "a whole number from 0"),
)


def _files_problems(flat: Mapping[str, Any]) -> Iterator[str]:
    """What is wrong with [[meshes]] and [light_files]."""
    meshes, lights = flat.get("meshes", []), flat.get("light_files", {})
    if not isinstance(meshes, list):
        yield "meshes is a table, expected [[meshes]], one for each group of files"
        meshes = []
    if not isinstance(lights, Mapping):
        yield "light_files is no table, expected one [light_files]"
        lights = {}
    groups = [(f"meshes[{i}]", group, FILES_KEYS) for i, group in enumerate(meshes)]
    for place, group, known in [*groups, ("light_files", lights, FILES_KEYS - {"files"})]:
        if not isinstance(group, Mapping):
            yield f"{place} is {group!r}, expected a table"
            continue
        unknown = sorted(group.keys() - known)
        if unknown:
            yield f"{place} has unknown keys {unknown}, expected some of {sorted(known)}"
        for name, good, expected in FILES_RULES:
            if name in group and not good(group[name]):
                yield f"{place}.{name} is {group[name]!r}, expected {expected}"


def _contradictions(flat: Mapping[str, Any]) -> Iterator[str]:
    """Values that are well-formed and do not go together."""
    base, edits, given = flat["base"], flat["edits"], flat["specular_roughness"]
    rendered = {r for _, r in (base, *edits)}
    if not set(given) <= rendered or base[1] not in given:
        yield (
            f"specular_roughness is {given}, expected some of the base's and the edits' values {sorted(rendered)}, "
            "the base's among them"
        )
    both = [edit for edit in edits if (edit[0] != base[0]) == (edit[1] != base[1])]
    if both:
        yield f"edits has {both}, expected materials that differ from the base in one of metallic and roughness"
    if not flat["objects"] and not flat.get("meshes"):
        yield "it has no objects, expected seeds in `objects`, or [[meshes]]"
    if flat["spp"] > flat["max_spp"] or flat["light_spp"] > flat["max_spp"]:
        yield f"max_spp is {flat['max_spp']}, expected at least spp and light_spp"
    # Which files a suite of meshes has is known where its folder is (`suite_objects.suite_sources`).
    unknown = [
        (obj, light)
        for obj, light in flat["ceiling_scenes"]
        if light >= flat["lights_per_object"] or (obj not in flat["objects"] and not isinstance(obj, str))
    ]
    if unknown:
        yield (
            f"ceiling_scenes has {unknown}, expected pairs of one of `objects` (or a mesh's path) and a light from 0 "
            f"to {flat['lights_per_object'] - 1}"
        )
