"""What a suite's TOML file says: objects, lights, materials, and how good its truth has to be."""

import tomllib
from dataclasses import dataclass, field
from importlib import resources
from pathlib import Path
from typing import Any, Literal

from unirender.camera import Camera
from unirender.errors import UnirenderError
from unirender_evaluation.stratification import Material, stratified_materials


@dataclass(frozen=True)
class SuiteSpec:
    """The TOML file's content. Materials are (metallic, roughness).

    Attributes:
        spp, max_spp: samples per pixel of an image at first, and at most.
        light_spp: at first, of the specular and diffuse buffers.
        target_db, light_target_db: noise ceiling (masked sRGB PSNR of a noise-free prediction) of images, and of the
            specular and diffuse buffers.
        ceiling_factor: so many times a member's samples for its near-noise-free twin.
        ceiling_scenes: (object, number of the light) of the scenes whose members have such a twin.
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
    base: Material
    edits: tuple[Material, ...]
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
    ceiling_scenes: tuple[tuple[int, int], ...]
    path: Path = field(default=Path(), compare=False)

    @property
    def camera(self) -> Camera:
        return Camera(fov_deg=self.fov_deg)

    @property
    def truth_path(self) -> Path:
        return self.path.parent / self.truth_file

    def materials(self) -> list[list[Material]]:
        """Stratified materials of each scene, objects outermost."""
        return stratified_materials(
            len(self.objects) * self.lights_per_object, self.per_scene, self.levels, self.assignment_seed
        )


def suite_path(name_or_path: str | Path) -> Path:
    """A suite's TOML file: a path as it is, a bare name among the package's own."""
    path = Path(name_or_path)
    if path.suffix == ".toml":
        return path
    bundled = Path(str(resources.files("unirender_evaluation"))) / "data" / "suites" / f"{name_or_path}.toml"
    if not bundled.is_file():
        known = ", ".join(sorted(p.stem for p in bundled.parent.glob("*.toml")))
        raise UnirenderError(f"no suite {str(name_or_path)!r}: expected one of {known}, or the path of a .toml file")
    return bundled


def read_spec(name_or_path: str | Path) -> SuiteSpec:
    """Reads and checks a suite's TOML file.

    Raises:
        UnirenderError: missing file, broken TOML, a missing or unknown key, or values that contradict each other.
    """
    path = suite_path(name_or_path)
    try:
        data = tomllib.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise UnirenderError(
            f"no suite file {path}: expected a TOML file like the package's data/suites/tiny.toml"
        ) from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise UnirenderError(f"{path} is not TOML: {error}") from None
    materials, truth = data.pop("materials", {}), data.pop("truth", {})
    flat = {
        **data,
        **materials,
        **{{"file": "truth_file", "sha256": "truth_sha256"}.get(k, k): v for k, v in truth.items()},
    }
    expected = set(SuiteSpec.__dataclass_fields__) - {"path"}
    if flat.keys() != expected:
        missing, unknown = sorted(expected - flat.keys()), sorted(flat.keys() - expected)
        raise UnirenderError(
            f"{path}: missing keys {missing}, unknown keys {unknown}; compare with the package's data/suites/tiny.toml"
        )
    for name in ("objects", "procedural_lights", "base", "specular_roughness"):
        flat[name] = tuple(flat[name])
    flat["edits"] = tuple((float(m), float(r)) for m, r in flat["edits"])
    flat["ceiling_scenes"] = tuple((int(obj), int(light)) for obj, light in flat["ceiling_scenes"])
    _check_values(path, flat)
    return SuiteSpec(**flat, path=path)


def _check_values(path: Path, flat: dict[str, Any]) -> None:
    if flat["split"] not in ("train", "test"):
        raise UnirenderError(f"{path}: split is {flat['split']!r}, expected 'train' or 'test'")
    rendered = {r for _, r in (flat["base"], *flat["edits"])}
    if not set(flat["specular_roughness"]) <= rendered:
        raise UnirenderError(
            f"{path}: specular_roughness is {list(flat['specular_roughness'])}, expected some of the base's and the "
            f"edits' values {sorted(rendered)}"
        )
    scenes = {(obj, light) for obj in flat["objects"] for light in range(flat["lights_per_object"])}
    unknown = [pair for pair in flat["ceiling_scenes"] if pair not in scenes]
    if unknown:
        raise UnirenderError(
            f"{path}: ceiling_scenes has {unknown}, expected pairs of one of `objects` and a light from 0 to "
            f"{flat['lights_per_object'] - 1}"
        )
