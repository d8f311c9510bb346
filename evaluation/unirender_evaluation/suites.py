"""A suite: which scenes a benchmark run scores, and their truth, read from one hash-checked tar file.

A suite is a TOML file (:class:`SuiteSpec`) and beside it a tar of OpenEXR members with the contract's channel names:

    suite.json                                     how it was made: versions, samples, noise ceilings, exposures
    light_<name>.exr                               a light as rendered, before exposure and turn (float32)
    <object>.shared.exr                            albedo, normal, mask
    <object>_l<k>.diffuse.exr                      d                            and std.R/G/B
    <object>_l<k>.r050.specular.exr                s at roughness 0.50          and std.R/G/B
    <object>_l<k>.m050_r030.exr                    image, premultiplied R, G, B and std.R/G/B

`std` is the standard deviation of the stored mean relative to `max(|mean|, STD_FLOOR)`, so that half floats neither
underflow nor overflow. Notation: a *scene* is one object under one light; m, r are metallic and roughness.
"""

import hashlib
import io
import json
import tarfile
import tomllib
from collections import Counter
from dataclasses import dataclass, field
from functools import cached_property
from importlib import resources
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float

from unirender.camera import Camera
from unirender.errors import UnirenderError
from unirender.exr import read_exr_bytes
from unirender.intrinsics import Intrinsics

STD_FLOOR = 1e-3
Material = tuple[float, float]


def material_key(material: Material) -> str:
    """`(0.5, 0.3)` -> `m050_r030`: percent, no dots."""
    return f"m{round(100 * material[0]):03d}_r{round(100 * material[1]):03d}"


def stratified_materials(n_scenes: int, per_scene: int, levels: int, seed: int) -> list[list[Material]]:
    """Spreads `n_scenes * per_scene` materials evenly and independently over the `levels x levels` grid.

    Every cell of the grid is used equally often but for a remainder. The remainder of 240 over 121 cells is 2 x 121 -
    2: the two cells left out are (0.3, 0.9) and (0.9, 0.3), whose squared distances from 0.5 average 0.100, so that the
    constant 0.5 scores an MSE of exactly 0.100 for both. For other sizes the remainder is drawn at random. Scenes are
    blocks over metallic: each gets one value from each fifth (for `per_scene` 5) of its range.

    Args:
        n_scenes: number of scenes.
        per_scene: materials of each scene, all different.
        levels: levels of metallic and of roughness, {0, 1/(levels-1), .., 1}.
        seed: of the assignment; the result is a pure function of the arguments.

    Returns:
        For each scene its list of (metallic, roughness).
    """
    rng = np.random.default_rng(seed)
    total, step = n_scenes * per_scene, levels - 1
    cells = [(m, r) for m in range(levels) for r in range(levels)]
    repeats, remainder = divmod(total, len(cells))
    pool = cells * repeats
    if levels == 11 and remainder == len(cells) - 2:
        pool += [cell for cell in cells if cell not in ((3, 9), (9, 3))]
    else:
        pool += [cells[i] for i in rng.permutation(len(cells))[:remainder]]
    for _ in range(1000):
        noise = rng.random(total)
        order = np.lexsort((noise, np.array([m for m, _ in pool])))
        columns = [rng.permutation(order[k * n_scenes : (k + 1) * n_scenes]) for k in range(per_scene)]
        scenes = [[pool[column[i]] for column in columns] for i in range(n_scenes)]
        if all(len(set(scene)) == per_scene for scene in scenes):
            return [[(m / step, r / step) for m, r in scene] for scene in scenes]
    raise UnirenderError(
        f"no assignment of {per_scene} different materials to each of {n_scenes} scenes on {levels} levels: "
        "use more levels"
    )


@dataclass(frozen=True)
class SuiteSpec:
    """What the TOML file says. Materials are (metallic, roughness)."""

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
        UnirenderError: missing file, broken TOML, or a missing or unknown key.
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
    if flat["split"] not in ("train", "test"):
        raise UnirenderError(f"{path}: split is {flat['split']!r}, expected 'train' or 'test'")
    for name in ("objects", "procedural_lights", "base", "specular_roughness"):
        flat[name] = tuple(flat[name])
    flat["edits"] = tuple((float(m), float(r)) for m, r in flat["edits"])
    return SuiteSpec(**flat, path=path)


@dataclass(frozen=True)
class Scene:
    """One object under one light. `materials` are the stratified ones; base and edits come from the spec."""

    key: str
    object: str
    family: str
    textured: bool
    light: str
    turn_columns: int
    exposure: float
    materials: tuple[Material, ...]


class Suite:
    """A suite with its truth in memory. All arrays are float32, linear, exposed (display units).

    Raises:
        UnirenderError: the truth file is missing, is not the one that the TOML file names by hash, or is incomplete.
    """

    def __init__(self, spec: SuiteSpec) -> None:
        self.spec = spec
        path = spec.truth_path
        if not path.is_file():
            raise UnirenderError(
                f"suite {spec.name!r} has no truth file {path}: "
                f"make it with `unirender bench truth --suite {spec.path}`"
            )
        data = path.read_bytes()
        self.sha256 = hashlib.sha256(data).hexdigest()
        if self.sha256 != spec.truth_sha256:
            raise UnirenderError(
                f"the truth of suite {spec.name!r} was changed: {path} has sha256 {self.sha256}, {spec.path} says "
                f"{spec.truth_sha256 or 'nothing'}; restore the file, or remake it with "
                f"`unirender bench truth --suite {spec.path}`"
            )
        with tarfile.open(fileobj=io.BytesIO(data)) as tar:
            self._members = {m.name: data[m.offset_data : m.offset_data + m.size] for m in tar.getmembers()}
        self.provenance: dict = json.loads(self._member("suite.json"))
        self._cache: dict[str, dict[str, np.ndarray]] = {}
        self._hashes: dict[str, str] = {}

    def _member(self, name: str) -> bytes:
        if name not in self._members:
            raise UnirenderError(
                f"{self.spec.truth_path} has no member {name!r}: "
                f"remake it with `unirender bench truth --suite {self.spec.path}`"
            )
        return self._members[name]

    def _channels(self, name: str) -> dict[str, np.ndarray]:
        if name not in self._cache:
            self._cache[name] = read_exr_bytes(self._member(name))[0]
        return self._cache[name]

    def _rgb(self, name: str, prefix: str = "") -> Float[np.ndarray, "h w 3"]:
        channels = self._channels(name)
        return np.stack([channels[prefix + c] for c in "RGB"], axis=-1)

    @cached_property
    def scenes(self) -> tuple[Scene, ...]:
        """All scenes, objects outermost: the order in which a run scores them."""
        return tuple(
            Scene(**{**row, "materials": tuple((m, r) for m, r in row["materials"])})
            for row in self.provenance["scenes"]
        )

    def scene_hash(self, scene: Scene) -> str:
        """sha256 over everything that scene and object contribute to a task: members, light, entry in `suite.json`."""
        if scene.object not in self._hashes:
            digest = hashlib.sha256()
            for name in sorted(n for n in self._members if n.startswith((f"{scene.object}.", f"{scene.object}_"))):
                digest.update(name.encode() + hashlib.sha256(self._members[name]).digest())
            for row in (s for s in self.scenes if s.object == scene.object):
                digest.update(repr(row).encode() + hashlib.sha256(self._member(f"light_{row.light}.exr")).digest())
            self._hashes[scene.object] = digest.hexdigest()
        return self._hashes[scene.object]

    def scene(self, key: str) -> Scene:
        for scene in self.scenes:
            if scene.key == key:
                return scene
        raise UnirenderError(
            f"suite {self.spec.name!r} has no scene {key!r}: "
            f"expected one of {self.scenes[0].key} .. {self.scenes[-1].key}"
        )

    def other_light(self, scene: Scene) -> Scene:
        """The same object under its next light: the target of relighting."""
        same = [s for s in self.scenes if s.object == scene.object]
        return same[(same.index(scene) + 1) % len(same)]

    def image(self, scene: Scene, material: Material) -> Float[np.ndarray, "h w 3"]:
        """Linear image, premultiplied by coverage."""
        return self._rgb(f"{scene.key}.{material_key(material)}.exr")

    def image_variance(self, scene: Scene, material: Material) -> Float[np.ndarray, "h w 3"]:
        """Variance of the stored mean, same units squared."""
        return self._variance(f"{scene.key}.{material_key(material)}.exr")

    def diffuse_variance(self, scene: Scene) -> Float[np.ndarray, "h w 3"]:
        return self._variance(f"{scene.key}.diffuse.exr")

    def specular_variance(self, scene: Scene, roughness: float) -> Float[np.ndarray, "h w 3"]:
        return self._variance(f"{scene.key}.r{round(100 * roughness):03d}.specular.exr")

    def _variance(self, name: str) -> Float[np.ndarray, "h w 3"]:
        return np.square(self._rgb(name, "std.") * np.maximum(np.abs(self._rgb(name)), STD_FLOOR))

    def environment(self, scene: Scene) -> Float[np.ndarray, "eh ew 3"]:
        """The scene's light: the stored light, turned about +y by whole columns, times the exposure."""
        return np.roll(self._rgb(f"light_{scene.light}.exr"), scene.turn_columns, axis=1) * np.float32(scene.exposure)

    def mask(self, scene: Scene) -> Float[np.ndarray, "h w 1"]:
        return self._channels(f"{scene.object}.shared.exr")["mask.Y"][..., None]

    def intrinsics(self, scene: Scene, material: Material) -> Intrinsics:
        """All true maps; `specular` only where the suite stores it for this roughness, else None."""
        shared, mask = self._channels(f"{scene.object}.shared.exr"), self.mask(scene)
        inside = (mask > 0).astype(np.float32)
        name = f"{scene.key}.r{round(100 * material[1]):03d}.specular.exr"
        return Intrinsics(
            albedo=np.stack([shared[f"albedo.{c}"] for c in "RGB"], axis=-1),
            normal=np.stack([shared[f"normal.{c}"] for c in "XYZ"], axis=-1),
            metallic=inside * np.float32(material[0]),
            roughness=inside * np.float32(material[1]),
            specular=self._rgb(name) if name in self._members else None,
            diffuse=self._rgb(f"{scene.key}.diffuse.exr"),
            environment=self.environment(scene),
            mask=mask,
            camera=self.spec.camera,
        )


def load_suite(name_or_path: str | Path = "tiny") -> Suite:
    """Reads a suite by name (of the package) or TOML path and checks its truth's hash."""
    return Suite(read_spec(name_or_path))


def constant_mse(materials: list[list[Material]], value: float = 0.5) -> tuple[float, float]:
    """MSE that the constant `value` scores for (metallic, roughness) over all scenes' materials."""
    flat = np.array([material for scene in materials for material in scene])
    mse = np.mean((flat - value) ** 2, axis=0)
    return float(mse[0]), float(mse[1])


def level_counts(materials: list[list[Material]]) -> tuple[Counter, Counter]:
    """How often each level of metallic and of roughness occurs."""
    flat = [material for scene in materials for material in scene]
    return Counter(m for m, _ in flat), Counter(r for _, r in flat)
