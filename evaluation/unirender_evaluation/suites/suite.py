"""A suite: which scenes a benchmark run scores, and their truth, read from one hash-checked tar file.

A suite is a TOML file (:class:`~unirender_evaluation.suites.spec.SuiteSpec`) and beside it a tar of OpenEXR members
(:mod:`~unirender_evaluation.suites.truth_file`); `suites.home` says where they lie. Notation: a *scene* is one object
under one light; m, r are metallic and roughness.
"""

import hashlib
import json
from collections import OrderedDict
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from jaxtyping import Float

from unirender.errors import UnirenderError
from unirender.exr import Channels, channels_rgb, read_exr_bytes
from unirender.intrinsics import Intrinsics
from unirender_evaluation.suites.definition import check_definition
from unirender_evaluation.suites.home import found_spec, truth_command
from unirender_evaluation.suites.spec import SuiteSpec
from unirender_evaluation.suites.stratification import MetallicRoughness, material_key
from unirender_evaluation.suites.truth_file import (
    CEILING,
    diffuse_member,
    estimate_mean,
    estimate_variance,
    image_member,
    light_member,
    list_tar,
    member_kind,
    shared_member,
    specular_member,
)

CACHE_BYTES = 512 * 2**20  # of decoded members that a suite keeps
NAME_DIGITS = 12  # of a neutral name

__all__ = ["MetallicRoughness", "Scene", "Suite", "SuiteSpec", "load_suite", "material_key"]


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
    materials: tuple[MetallicRoughness, ...]


class Suite:
    """A suite and its truth, whose members are read as they are asked for. All arrays are float32, linear, exposed
    (display units).

    Raises:
        UnirenderError: the truth file is missing, is not the one that the TOML file names by hash, or is incomplete.
    """

    def __init__(self, spec: SuiteSpec) -> None:
        self.spec = spec
        path = spec.truth_path
        if not path.is_file():
            raise UnirenderError(f"suite {spec.name!r} has no truth file {path}: make it with {truth_command(spec)}")
        with path.open("rb") as stream:
            self.sha256 = hashlib.file_digest(stream, "sha256").hexdigest()
        if self.sha256 != spec.truth_sha256:
            raise UnirenderError(
                f"the truth of suite {spec.name!r} was changed: {path} has sha256 {self.sha256}, {spec.path} says "
                f"{spec.truth_sha256 or 'nothing'}; restore the file, or remake it with {truth_command(spec)}"
            )
        self._members = list_tar(path)
        description = self._member("suite.json")
        self.provenance: dict = json.loads(description)
        self._description_sha256 = hashlib.sha256(description).hexdigest()
        self._cache: OrderedDict[str, Channels] = OrderedDict()
        self._cached_bytes = 0
        self._hashes: dict[str, str] = {}

    def _member(self, name: str) -> bytes:
        if name not in self._members:
            raise UnirenderError(
                f"{self.spec.truth_path} has no member {name!r}: remake it with {truth_command(self.spec)}"
            )
        return self._members[name].read()

    def _channels(self, name: str) -> Channels:
        """A member decoded; those used last are kept, up to `CACHE_BYTES`, and cannot be written into."""
        if name not in self._cache:
            self._cache[name] = read_exr_bytes(self._member(name))[0]
            for channel in self._cache[name].values():
                channel.flags.writeable = False
            self._cached_bytes += _bytes(self._cache[name])
            while self._cached_bytes > CACHE_BYTES and len(self._cache) > 1:
                self._cached_bytes -= _bytes(self._cache.popitem(last=False)[1])
        self._cache.move_to_end(name)
        return self._cache[name]

    def _image_member(self, scene: Scene, material: MetallicRoughness) -> str:
        stored = (self.spec.base, *self.spec.edits, *scene.materials)
        if material_key(material) not in map(material_key, stored):
            raise UnirenderError(
                f"suite {self.spec.name!r}: got (metallic, roughness) {material}, expected one of {scene.key}: "
                f"{', '.join(map(str, stored))}"
            )
        return image_member(scene.key, material)

    def _mean(self, name: str) -> Float[np.ndarray, "h w 3"]:
        return estimate_mean(member_kind(name), self._channels(name))

    def _variance(self, name: str) -> Float[np.ndarray, "h w 3"]:
        return estimate_variance(member_kind(name), self._channels(name))

    def _ceiling(self, name: str) -> Float[np.ndarray, "h w 3"] | None:
        return self._mean(CEILING + name) if CEILING + name in self._members else None

    def __repr__(self) -> str:
        return f"Suite({self.spec.name}, {len(self.scenes)} scenes at {self.spec.resolution} px)"

    @cached_property
    def scenes(self) -> tuple[Scene, ...]:
        """All scenes, objects outermost: the order in which a run scores them."""
        return tuple(
            Scene(**{**row, "materials": tuple((m, r) for m, r in row["materials"])})
            for row in self.provenance["scenes"]
        )

    @property
    def members(self) -> tuple[str, ...]:
        """Names of the OpenEXR members."""
        return tuple(name for name in self._members if name.endswith(".exr"))

    def read(self, member: str) -> tuple[Channels, dict[str, str]]:
        """Channels and header attributes of a member, as stored."""
        return read_exr_bytes(self._member(member), name=member)

    def scene_hash(self, scene: Scene) -> str:
        """sha256 over everything that scene and object contribute to a task: members, light, entry in `suite.json`."""
        if scene.object not in self._hashes:
            digest = hashlib.sha256()
            own = (f"{scene.object}.", f"{scene.object}_")
            for name in sorted(n for n in self._members if n.removeprefix(CEILING).startswith(own)):
                digest.update(name.encode() + hashlib.sha256(self._member(name)).digest())
            for row in (s for s in self.scenes if s.object == scene.object):
                digest.update(repr(row).encode() + hashlib.sha256(self._member(light_member(row.light))).digest())
            self._hashes[scene.object] = digest.hexdigest()
        return self._hashes[scene.object]

    def neutral_name(self, what: str) -> str:
        """A name that says nothing of what it names: a hash that takes what the truth's file says of itself (measured
        noise, exposures), without which nobody can try what gives it."""
        return hashlib.sha256(f"{self._description_sha256}/{what}".encode()).hexdigest()[:NAME_DIGITS]

    def scene(self, key: str) -> Scene:
        """The scene of that key.

        Raises:
            UnirenderError: there is none.
        """
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

    def image(self, scene: Scene, material: MetallicRoughness) -> Float[np.ndarray, "h w 3"]:
        """Linear image, premultiplied by coverage.

        Raises:
            UnirenderError: the material is neither the base nor an edit of the suite, nor one of the scene's.
        """
        return self._mean(self._image_member(scene, material))

    def image_variance(self, scene: Scene, material: MetallicRoughness) -> Float[np.ndarray, "h w 3"]:
        """Variance of the stored mean, same units squared."""
        return self._variance(self._image_member(scene, material))

    def diffuse_variance(self, scene: Scene) -> Float[np.ndarray, "h w 3"]:
        """The same of d."""
        return self._variance(diffuse_member(scene.key))

    def specular_variance(self, scene: Scene, roughness: float) -> Float[np.ndarray, "h w 3"]:
        """The same of s."""
        return self._variance(specular_member(scene.key, roughness))

    def ceiling_image(self, scene: Scene, material: MetallicRoughness) -> Float[np.ndarray, "h w 3"] | None:
        """The image rendered independently with `ceiling_factor` times its samples; None where none is stored."""
        return self._ceiling(image_member(scene.key, material))

    def ceiling_diffuse(self, scene: Scene) -> Float[np.ndarray, "h w 3"] | None:
        """The same of d."""
        return self._ceiling(diffuse_member(scene.key))

    def ceiling_specular(self, scene: Scene, roughness: float) -> Float[np.ndarray, "h w 3"] | None:
        """The same of s."""
        return self._ceiling(specular_member(scene.key, roughness))

    def environment(self, scene: Scene) -> Float[np.ndarray, "eh ew 3"]:
        """The scene's light: the stored light, turned about +y by whole columns, times the exposure."""
        light = channels_rgb(self._channels(light_member(scene.light)))
        return np.roll(light, scene.turn_columns, axis=1) * np.float32(scene.exposure)

    def mask(self, scene: Scene) -> Float[np.ndarray, "h w 1"]:
        """Coverage, [0, 1]."""
        return self._channels(shared_member(scene.object))["mask.Y"][..., None]

    def intrinsics(self, scene: Scene, material: MetallicRoughness) -> Intrinsics:
        """All true maps; `specular` only where the suite stores it for this roughness, else None."""
        shared, mask = self._channels(shared_member(scene.object)), self.mask(scene)
        inside = (mask > 0).astype(np.float32)
        name = specular_member(scene.key, material[1])
        return Intrinsics(
            albedo=channels_rgb(shared, "albedo"),
            normal=channels_rgb(shared, "normal", "XYZ"),
            metallic=inside * np.float32(material[0]),
            roughness=inside * np.float32(material[1]),
            specular=self._mean(name) if name in self._members else None,
            diffuse=self._mean(diffuse_member(scene.key)),
            environment=self.environment(scene),
            mask=mask,
            camera=self.spec.camera,
        )


def load_suite(name_or_path: str | Path = "tiny") -> Suite:
    """Reads a suite by name (of the package) or TOML path, and checks that its truth is the one that the file is of.

    Raises:
        UnirenderError: no such suite, or no truth of it: the message says which command makes it. Or the truth has
            another hash, or was made from other values than the file has.
    """
    suite = Suite(found_spec(name_or_path))
    check_definition(suite)
    return suite


def _bytes(channels: Channels) -> int:
    return sum(channel.nbytes for channel in channels.values())
