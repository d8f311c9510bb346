"""What a suite's TOML file says: objects, lights, materials, and how good its truth has to be."""

import difflib
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib import resources
from pathlib import Path
from typing import Any, Literal

from unirender.arguments import as_path
from unirender.camera import Camera
from unirender.errors import UnirenderError
from unirender.system.wording import meant, near
from unirender_evaluation.suites.check import value_problems
from unirender_evaluation.suites.stratification import MetallicRoughness, stratified_materials

RENAMED = {  # keys of the tables -> attributes
    "truth": {"file": "truth_file", "sha256": "truth_sha256", "cost": "truth_cost"},
    "folders": {"objects": "objects_folder", "lights": "lights_folder"},
}


@dataclass(frozen=True)
class Files:
    """Which files of a folder a suite takes.

    Attributes:
        files: of meshes: a pattern of their paths below the folder, in which `*` also stands for slashes.
        holdout: the split "test" has every so many-th, "train" all others: of the files that match, or of the places
            of a folder of lights (`lights.pool`); 0: all of them, whatever the split.
        without: paths below the folder that are left out then.
        count: so many of the rest, drawn by `seed`; None: all. They are used in name order.
        seed: draws them.
    """

    files: str = "*"
    holdout: int = 0
    without: tuple[str, ...] = ()
    count: int | None = None
    seed: int = 0


@dataclass(frozen=True)
class SuiteSpec:
    """The TOML file's content. Materials are (metallic, roughness).

    Attributes:
        objects: seeds of the generator; `meshes` are further objects, of the folder of objects.
        bundled_lights, procedural_lights: built-in lights of the split; `light_files`: further ones, of the folder of
            lights.
        spp, max_spp: samples per pixel of an image at first, and at most.
        light_spp: at first, of the specular and diffuse buffers.
        target_db, light_target_db: noise ceiling (masked sRGB PSNR of a noise-free prediction) of images, and of the
            specular and diffuse buffers.
        ceiling_factor: so many times a member's samples for its near-noise-free twin.
        ceiling_scenes: (object, number of the light) of the scenes whose members have such a twin; the object by its
            seed, or its path below the folder of objects.
        truth_cost: how long making the truth takes, in words; empty: not stated.
        objects_folder, lights_folder: relative to the TOML file; empty: the file names none.
        objects_from, lights_from: where to get such a folder, in words.
    """

    name: str
    title: str
    resolution: int
    fov_deg: float
    split: Literal["train", "test"]
    objects: tuple[int, ...]
    bundled_lights: int
    procedural_lights: tuple[int, ...]
    lights_per_object: int
    light_rows: int
    assignment_seed: int
    base: MetallicRoughness
    edits: tuple[MetallicRoughness, ...]
    specular_roughness: tuple[float, ...]
    levels: int
    per_scene: int
    truth_file: str
    truth_sha256: str
    spp: int
    max_spp: int
    light_spp: int
    geometry_spp: int
    batches: int
    target_db: float
    light_target_db: float
    ceiling_factor: int
    ceiling_scenes: tuple[tuple[int | str, int], ...]
    truth_cost: str = ""
    meshes: tuple[Files, ...] = ()
    light_files: Files | None = None
    objects_folder: str = ""
    lights_folder: str = ""
    objects_from: str = ""
    lights_from: str = ""
    path: Path = field(default=Path(), compare=False)

    @property
    def camera(self) -> Camera:
        """Of all pictures."""
        return Camera(fov_deg=self.fov_deg)

    @property
    def truth_path(self) -> Path:
        """The tar with what Mitsuba rendered, beside the suite's file."""
        return self.path.parent / self.truth_file

    def folder(self, kind: Literal["objects", "lights"]) -> Path | None:
        """The folder of meshes or of light files that the file names, None where it names none."""
        named = self.objects_folder if kind == "objects" else self.lights_folder
        return self.path.parent / Path(named).expanduser() if named else None

    def materials(self, meshes: int = 0) -> list[list[MetallicRoughness]]:
        """Stratified materials of each scene, objects outermost; `meshes`: objects beside the procedural ones."""
        scenes = (len(self.objects) + meshes) * self.lights_per_object
        return stratified_materials(scenes, self.per_scene, self.levels, self.assignment_seed)


def suite_folder() -> Path:
    """Where the package's own suites lie."""
    return Path(str(resources.files("unirender_evaluation"))) / "data" / "suites"


def is_bundled(path: Path) -> bool:
    """Whether a suite's file is one of the package's own."""
    return path.resolve().parent == suite_folder().resolve()


def suite_path(name_or_path: str | Path) -> Path:
    """A suite's TOML file: a path as it is, a bare name among the package's own.

    Raises:
        UnirenderError: the package has none of that name.
    """
    path = as_path(name_or_path, "suite")
    if path.suffix == ".toml":
        return path
    bundled = suite_folder() / f"{name_or_path}.toml"
    if not bundled.is_file():
        known = sorted(p.stem for p in bundled.parent.glob("*.toml"))
        expected = f"expected one of {', '.join(known)}, or the path of a .toml file"
        raise UnirenderError(f"no suite {str(name_or_path)!r}: {expected}{meant(near(str(name_or_path), known))}")
    return bundled


def read_spec(name_or_path: str | Path) -> SuiteSpec:
    """Reads and checks a suite's TOML file.

    Raises:
        UnirenderError: missing file, broken TOML, missing or unknown keys, or values that are out of range or
            contradict each other; all that are wrong at once.
    """
    path = suite_path(name_or_path)
    return parse_spec(read_text(path), path)


def read_text(path: Path) -> str:
    """The text of a suite's TOML file.

    Raises:
        UnirenderError: it is not there, or no text.
    """
    try:
        return path.read_text(encoding="utf-8-sig")
    except FileNotFoundError:
        raise UnirenderError(
            f"no suite file {path}: expected a TOML file like the package's data/suites/tiny.toml"
        ) from None
    except UnicodeDecodeError as error:
        raise UnirenderError(f"{path} is not TOML: {error}") from None
    except OSError as error:
        raise UnirenderError(f"suite file {path}: cannot be read ({error.strerror}); check the path") from error


def parse_spec(text: str, path: Path) -> SuiteSpec:
    """`read_spec` of a text; `path` is where it lies, or is to lie.

    Raises:
        UnirenderError: as `read_spec`, but for a file that is not there.
    """
    try:
        flat = _flat(tomllib.loads(text))
    except (ValueError, RecursionError) as error:  # no TOML, a number of thousands of digits, nested too deeply
        raise UnirenderError(f"{path} is not TOML: {error}") from None
    fields = {name: f for name, f in SuiteSpec.__dataclass_fields__.items() if name != "path"}
    required = {name for name in fields if name not in _OPTIONAL}
    missing, unknown = sorted(required - flat.keys()), sorted(flat.keys() - fields.keys())
    if missing or unknown:
        meant = {key: difflib.get_close_matches(key, missing, 1) for key in unknown}
        named = [f"{key} (did you mean {close[0]}?)" if close else key for key, close in meant.items()]
        raise UnirenderError(
            f"{path}: missing keys: {', '.join(missing) or 'none'}; unknown keys: {', '.join(named) or 'none'}; "
            "docs/suites.md lists every key and the table that it stands in"
        )
    found = value_problems(flat)
    if found:
        raise UnirenderError(f"{path}: {'; '.join(found)}")
    for name in ("objects", "procedural_lights", "base", "specular_roughness"):
        flat[name] = tuple(flat[name])
    flat["edits"] = tuple((float(m), float(r)) for m, r in flat["edits"])
    flat["ceiling_scenes"] = tuple((obj, light) for obj, light in flat["ceiling_scenes"])
    flat["meshes"] = tuple(_files(group) for group in flat.get("meshes", ()))
    flat["light_files"] = _files(flat["light_files"]) if "light_files" in flat else None
    return SuiteSpec(**flat, path=path)


_OPTIONAL = {
    *("truth_cost", "meshes", "light_files"),
    *("objects_folder", "lights_folder", "objects_from", "lights_from"),
}


def _flat(data: dict[str, Any]) -> dict[str, Any]:
    """The file's keys as attributes: those of its tables beside those at its top."""
    flat = dict(data)
    for table in ("materials", "truth", "folders"):
        inner = flat.pop(table, {})
        if not isinstance(inner, Mapping):
            inner = {table: inner}  # a value where a table belongs: an unknown key
        flat |= {RENAMED.get(table, {}).get(key, key): value for key, value in inner.items()}
    return flat


def _files(group: Mapping[str, Any]) -> Files:
    values: dict[str, Any] = dict(group)
    values["without"] = tuple(values.get("without", ()))
    return Files(**values)
