"""What one sample is: the scene it is rendered of, the maps and estimates that come out, and the scene's hash."""

import hashlib
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from numbers import Integral, Real

import numpy as np
from jaxtyping import Float

from unirender.camera import Camera
from unirender.errors import UnirenderError
from unirender.intrinsics import Intrinsics
from unirender.shown import in_short, short_repr
from unirender_reference.lights import Light
from unirender_reference.shapes import MeshObject

HINTS = {
    "obj": "; load_mesh reads a file",
    "light": "; load_light reads a file, Light(name, environment) takes an array",
}


@dataclass(frozen=True)
class SceneSpec:
    """One sample to render. `exposure_seed` draws the gauge's target.

    Roughness (perceptual) and metallic are one value for the object, or None for its own map.

    Raises:
        UnirenderError: one of these is of another type.
    """

    obj: MeshObject
    light: Light
    roughness: float | None
    metallic: float | None
    camera: Camera = field(default_factory=Camera)
    resolution: int = 64
    exposure_seed: int = 0

    def __repr__(self) -> str:
        return (
            f"SceneSpec({self.obj.name}, {self.light.name}, roughness={self.roughness}, metallic={self.metallic}, "
            f"{self.camera}, resolution={self.resolution}, exposure_seed={self.exposure_seed})"
        )

    def __post_init__(self) -> None:
        kinds = {"obj": MeshObject, "light": Light, "camera": Camera, "resolution": Integral, "exposure_seed": Integral}
        for name, kind in {**kinds, "roughness": Real | None, "metallic": Real | None}.items():
            if not isinstance(value := getattr(self, name), kind):
                expected = getattr(kind, "__name__", "a number, or None for the object's own map")
                got = in_short(value) if isinstance(value, np.ndarray) else f"{value!r:.60}"
                raise UnirenderError(f"scene: got {name} {got}, expected {expected}{HINTS.get(name, '')}")
        if self.exposure_seed < 0:
            raise UnirenderError(f"scene: got exposure_seed {self.exposure_seed}, expected a seed of at least 0")


@dataclass(frozen=True)
class Sample:
    """A rendered scene.

    Attributes:
        image_linear: premultiplied by the mask.
        intrinsics: all maps, and the light as it was rendered: exposed, in camera axes.
        variance: of the means of "image", "specular" and "diffuse", per pixel and channel.
        provenance: what rendered it, of what, as text: the header of its files.
    """

    image_linear: Float[np.ndarray, "h w 3"]
    intrinsics: Intrinsics
    variance: dict[str, Float[np.ndarray, "h w c"]] = field(repr=False)
    provenance: dict[str, str]

    __repr__ = short_repr


def scene_hash(spec: SceneSpec) -> str:
    """sha256 over everything that defines a scene's radiance; 1, 1.0 and numpy's 1.0 are one value."""
    return next(scene_hashes([spec]))


def scene_hashes(specs: Iterable[SceneSpec]) -> Iterator[str]:
    """`scene_hash` of each spec; the arrays of an object under a light are read once while they stay the same."""
    shared, obj, light = hashlib.sha256(), None, None
    for spec in specs:
        if spec.obj is not obj or spec.light is not light:
            shared, obj, light = hashlib.sha256(), spec.obj, spec.light
            for part in (*_mesh(obj), np.ascontiguousarray(light.environment).tobytes(), *_maps(obj)):
                shared.update(part)
        digest = shared.copy()
        digest.update(repr(_plain(spec)).encode())
        yield digest.hexdigest()


def object_hash(obj: MeshObject) -> str:
    """sha256 over the arrays of an object."""
    digest = hashlib.sha256()
    for part in (*_mesh(obj), *_maps(obj)):
        digest.update(part)
    return digest.hexdigest()


def shared_scene_hash(hashes: Iterable[str]) -> str:
    """The scene hash of a member that belongs to several scenes: sha256 over theirs, in order."""
    return hashlib.sha256(" ".join(hashes).encode()).hexdigest()


def _mesh(obj: MeshObject) -> Iterator[bytes]:
    for array in (obj.vertices, obj.faces, obj.normals, obj.uv, obj.albedo):
        yield b"none" if array is None else np.ascontiguousarray(array).tobytes()


def _maps(obj: MeshObject) -> Iterator[bytes]:
    """Nothing for an object without maps: its hash is over its mesh and base colour alone."""
    for name in ("roughness", "metallic", "normal_map"):
        texture = getattr(obj, name)
        if texture is not None:
            yield f"{name} {texture.shape}".encode() + np.ascontiguousarray(texture).tobytes()


def _plain(spec: SceneSpec) -> tuple[float | None, float | None, Camera, int, int]:
    """What a spec holds besides arrays, as Python's own numbers: the text of others depends on their type."""
    roughness, metallic = (None if value is None else float(value) for value in (spec.roughness, spec.metallic))
    x, y = spec.camera.principal
    camera = Camera(float(spec.camera.fov_deg), (float(x), float(y)))
    return roughness, metallic, camera, int(spec.resolution), int(spec.exposure_seed)
