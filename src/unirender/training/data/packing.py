"""The groups of a shard as rows of arrays; what their members may hold, `unirender.training.data.members` says."""

import re
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float16

from unirender.errors import UnirenderError
from unirender.models.config import ENVIRONMENT_SIZE
from unirender.training.augmentations.environments import turned_environments
from unirender.training.data.members import (
    ADVICE,
    check_background,
    decoded,
    light_map,
    members_of_lights,
    percent,
    radiance,
    surface,
    vary_of,
)

SCALAR_CHANNELS = 7  # of shared maps without roughness and metallic

_INTERPOLATED = "interpolated"  # attribute of pictures whose noise may be below 0


@dataclass(frozen=True)
class Pair:
    """One picture of a group and the rows of its buffers in `Shard.pixels` (`light`: row of `Shard.environment`).

    Metallic and roughness are both None where they are the group's maps.
    """

    light: int
    metallic: float | None
    roughness: float | None
    image: int
    specular: int
    diffuse: int


@dataclass(frozen=True)
class Group:
    """An object under its lights; `shared` is a row of `Shard.shared`."""

    key: str
    vary: str
    shared: int
    pairs: tuple[Pair, ...]


class Packer:
    """Collects the rows of a shard's arrays.

    Args:
        path: of the shard, for messages.
    """

    def __init__(self, path: str) -> None:
        self.path = path
        self._pixels: list[Float16[np.ndarray, "3 h w"]] = []
        self._shared: list[Float16[np.ndarray, "c h w"]] = []
        self._environment: list[Float[np.ndarray, "4 3 16 32"]] = []
        self._size: tuple[tuple[int, ...], str] | None = None  # of the pictures, and the group that it is of

    def add(self, key: str, members: Mapping[str, bytes]) -> Group:
        """Takes a group's members, by name without the key.

        Raises:
            UnirenderError: a member is missing, unknown, damaged, of another size, or has values outside the contract.
        """
        where = f"{self.path}: group {key}"
        found = members_of_lights(members, where)
        vary = vary_of(members, where)
        images = _images(found, vary, where)
        own_maps = any(metallic is None for _, metallic, _ in images)
        size = self._add_shared(key, members, own_maps)
        rows: dict[tuple, int] = {}
        lights: dict[int, int] = {}
        for name, match in found.items():
            file, light = f"{where}.{name}", int(match["light"])
            channels, attributes = decoded(members[name], file)
            if match["environment"]:
                lights[light] = len(self._environment)
                turned = turned_environments(light_map(channels, file), ENVIRONMENT_SIZE)
                self._environment.append(np.ascontiguousarray(np.moveaxis(turned, -1, 1)))
                continue
            kind = "diffuse" if match["diffuse"] else "specular" if match["specular"] else ""
            pixels = radiance(channels, kind, _INTERPOLATED in attributes, file)
            if pixels.shape[:2] != size:
                raise UnirenderError(
                    f"{file}: is {_text(pixels.shape)} pixels, expected {_text(size)}, the size of shared.exr"
                )
            if kind == "diffuse":
                rows[light, "diffuse"] = len(self._pixels)
            elif kind == "specular":
                rows[light, "specular", percent(match["level"])] = len(self._pixels)
            else:
                check_background(pixels, self._shared[-1][6] == 0, file)
                rows[light, percent(match["metallic"]), percent(match["roughness"])] = len(self._pixels)
            self._pixels.append(np.moveaxis(pixels, -1, 0).astype(np.float16))
        pairs = tuple(
            _pair(*image, rows, lights, where)
            for image in sorted(images, key=lambda image: tuple(part or 0 for part in image))
        )
        return Group(key=key, vary=vary, shared=len(self._shared) - 1, pairs=pairs)

    def arrays(self) -> dict[str, np.ndarray]:
        """`pixels`, `shared` and `environment` of a shard; roughness and metallic of groups without maps are 0."""
        channels = max(len(row) for row in self._shared)
        shared = [np.pad(row, ((0, channels - len(row)), (0, 0), (0, 0))) for row in self._shared]
        stacks = {"pixels": self._pixels, "shared": shared, "environment": self._environment}
        return {name: np.stack(rows) for name, rows in stacks.items()}

    def _add_shared(self, key: str, members: Mapping[str, bytes], own_maps: bool) -> tuple[int, ...]:
        """Takes what does not depend on the light; height and width."""
        where = f"{self.path}: group {key}"
        file = f"{where}.shared.exr"
        if "shared.exr" not in members:
            raise UnirenderError(f"{where}: shared.exr is missing, expected albedo, normal and mask; {ADVICE}")
        channels, _ = decoded(members["shared.exr"], file)
        maps = surface(channels, own_maps, file)
        size = maps.shape[1:]
        if self._size is None:
            self._size = size, key
        if size != self._size[0]:
            raise UnirenderError(
                f"{file}: is {_text(size)} pixels, expected {_text(self._size[0])}, the size of group {self._size[1]}; "
                "make one folder per size"
            )
        self._shared.append(maps.astype(np.float16))
        return size


def _images(found: Mapping[str, re.Match[str]], vary: str, where: str) -> list[tuple[int, int | None, int | None]]:
    """The light, and metallic and roughness in percent (None: the object's own maps), of each picture of a group.

    Raises:
        UnirenderError: there is none, one of them twice, or own maps in a basis group.
    """
    images = [
        (int(match["light"]), percent(match["metallic"]), percent(match["roughness"]))
        for match in found.values()
        if not (match["environment"] or match["diffuse"] or match["specular"])
    ]
    if not images:
        raise UnirenderError(f"{where}: has no picture, expected at least one; {ADVICE}")
    if len(set(images)) < len(images):
        raise UnirenderError(
            f"{where}: two members are the same picture, like m050_r030 and m50_r30, expected one of each; {ADVICE}"
        )
    if vary == "basis" and any(metallic is None for _, metallic, _ in images):
        raise UnirenderError(
            f"{where}: vary is basis and the pictures have the object's own roughness and metallic maps, expected "
            "pictures at metallic 0, 0.5 and 1; write vary independent"
        )
    return images


def _pair(
    light: int,
    metallic: int | None,
    roughness: int | None,
    rows: Mapping[tuple, int],
    lights: Mapping[int, int],
    where: str,
) -> Pair:
    """A picture with the rows of what explains it.

    Raises:
        UnirenderError: something of it is missing.
    """
    level = "maps" if roughness is None else f"r{roughness:03d}"
    picture = f"l{light}.{level if metallic is None else f'm{metallic:03d}_{level}'}.exr"
    needed = {
        f"l{light}.environment.exr": lights.get(light),
        f"l{light}.diffuse.exr": rows.get((light, "diffuse")),
        f"l{light}.{level}.specular.exr": rows.get((light, "specular", roughness)),
    }
    for name, row in needed.items():
        if row is None:
            raise UnirenderError(f"{where}: member {name} is missing, which {picture} needs; {ADVICE}")
    environment, diffuse, specular = needed.values()
    assert environment is not None
    assert diffuse is not None
    assert specular is not None
    return Pair(
        light=environment,
        metallic=None if metallic is None else metallic / 100,
        roughness=None if roughness is None else roughness / 100,
        image=rows[light, metallic, roughness],
        specular=specular,
        diffuse=diffuse,
    )


def _text(shape: tuple[int, ...]) -> str:
    return f"{shape[1]} x {shape[0]}"
