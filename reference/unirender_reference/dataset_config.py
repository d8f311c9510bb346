"""`DatasetConfig`: what `unirender dataset` was asked for, and every reason to refuse it."""

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, get_args

from unirender.errors import UnirenderError
from unirender_reference.sample_counts import SAMPLES_PER_PASS, pass_count

if TYPE_CHECKING:
    from unirender_reference.lights import LightPool

Vary = Literal["basis", "independent", "one-at-a-time", "paper", "sweep", "visibility"]
Materials = Literal["scalar", "maps"]
Split = Literal["train", "test"]
MAX_LIGHTS = 8
METALLIC_PERCENTS = (0, 50, 100)
PERCENTS = 101  # 0 .. 100
MAX_TILT_DEG = 20.0  # of turned objects
GRID = tuple(range(0, PERCENTS, 10))
DEFAULT_OBJECTS = 20
MOST_FLOOR_DB = 80.0
MOST_SPP = 8192  # a noise floor that is not reached by then is not: what was reached is stored and reported
LIGHT_HEIGHTS = (16, 2048)

# What `lights` is used with, and how unless that is said.
LIGHT_OPTIONS: dict[str, Any] = {"light_share": 0.5, "light_holdout": 8, "turn_lights": True, "light_height": 64}


@dataclass(frozen=True)
class DatasetConfig:
    """A data set to generate.

    Attributes:
        objects: number of objects; None: `DEFAULT_OBJECTS` procedural ones, or all meshes.
        pairs: pictures per object.
        resolution: height and width in pixels.
        vary: what the pictures of an object differ in.
        out: folder of the shards.
        seed: another seed gives other objects, lights and materials.
        split: "train" or "test": disjoint objects and lights.
        spp: samples per pixel of every picture, s and d (batches are not kept: training data has no variance); with a
            noise floor, the samples that each begins with.
        workers: processes; 0 means one for each CPU core.
        meshes: a folder of mesh files or a glob, instead of procedural objects.
        holdout: every how many mesh files one belongs to the test split; 0: all belong to the split asked for.
        turn_objects: each object is turned about +y by any angle and tilted by up to `MAX_TILT_DEG`, by the seed.
        materials: "scalar": one roughness and metallic per picture; "maps": the object's own.
        noise_floor: dB (masked sRGB PSNR of a noise-free prediction) up to which each picture, s and d is sampled.
        denoise: denoise every picture, s and d.
        lights: a folder of the user's own, from which lights are drawn (`lights.light_pool`).
        light_share: of all lights, in (0, 1]: those drawn from that folder.
        light_holdout: every so many-th place of that folder is for test.
        turn_lights: what is drawn from that folder is turned, mirrored and tilted at random; False: as it is.
        light_height: rows of the maps that are drawn from that folder.
        cluster: where to render, see `cluster.connect`; None: in processes of this machine.
        lights_digest: `LightPool.digest` where the data set is written; workers that find another stop the run.
    """

    objects: int | None
    pairs: int
    resolution: int
    vary: Vary
    out: Path
    seed: int = 0
    split: Split = "train"
    spp: int = 64
    workers: int = 0
    meshes: str | Path | None = None
    holdout: int = 0
    materials: Materials = "scalar"
    noise_floor: float | None = None
    denoise: bool = False
    lights: Path | None = None
    light_share: float = LIGHT_OPTIONS["light_share"]
    light_holdout: int = LIGHT_OPTIONS["light_holdout"]
    turn_lights: bool = LIGHT_OPTIONS["turn_lights"]
    light_height: int = LIGHT_OPTIONS["light_height"]
    cluster: str | None = None
    lights_digest: str | None = None
    turn_objects: bool = False

    def __post_init__(self) -> None:
        object.__setattr__(self, "out", Path(self.out))
        if self.lights is not None:  # absolute: a cluster's workers may be in another folder
            object.__setattr__(self, "lights", Path(self.lights).expanduser().absolute())
        for name in ("objects", "pairs", "resolution", "spp"):
            if (value := getattr(self, name)) is not None and value < 1:
                raise UnirenderError(f"dataset {name}: got {value}, expected at least 1")
        for name in ("seed", "workers"):
            if getattr(self, name) < 0:
                raise UnirenderError(f"dataset {name}: got {getattr(self, name)}, expected 0 or more")
        if self.noise_floor is None:  # else they are rounded up to full grids
            pass_count(self.spp, 1, SAMPLES_PER_PASS // self.resolution**2)
        if self.materials == "maps" and self.vary != "independent":
            raise UnirenderError(
                f"dataset vary: got {self.vary}, but --materials maps needs --vary independent: an object's own maps "
                "do not vary, so each light has one picture"
            )
        _check_pairs(self.vary, self.pairs)
        if self.holdout < 0 or self.holdout == 1 or (self.holdout and self.meshes is None):
            raise UnirenderError(
                f"dataset holdout: got {self.holdout}, expected 0 or at least 2, and that only with --meshes"
            )
        self._check_lights()
        self._check_noise()

    def _check_lights(self) -> None:
        if self.lights is None:
            given = [name for name, value in LIGHT_OPTIONS.items() if getattr(self, name) != value]
            if given:
                option = "no-turn-lights" if given[0] == "turn_lights" else given[0].replace("_", "-")
                raise UnirenderError(f"dataset --{option}: got it without --lights, expected a folder of lights too")
        if not 0 < self.light_share <= 1:
            raise UnirenderError(
                f"dataset --light-share: got {self.light_share:g}, expected more than 0 and at most 1 (only these)"
            )
        if self.light_holdout < 2:
            raise UnirenderError(
                f"dataset --light-holdout: got {self.light_holdout}, expected at least 2 (every 2nd place is for test)"
            )
        if not LIGHT_HEIGHTS[0] <= self.light_height <= LIGHT_HEIGHTS[1]:
            raise UnirenderError(
                f"dataset --light-height: got {self.light_height}, expected {LIGHT_HEIGHTS[0]} to {LIGHT_HEIGHTS[1]} "
                "rows"
            )

    def _check_noise(self) -> None:
        if self.vary == "visibility":
            given = {"noise-floor": self.noise_floor is not None, "denoise": self.denoise, "lights": self.lights}
            if names := [name for name, value in given.items() if value]:
                raise UnirenderError(
                    f"dataset --{names[0]}: got it with --vary visibility, which has no lights and no pictures; "
                    "expected none"
                )
        if self.noise_floor is not None and not 0 < self.noise_floor <= MOST_FLOOR_DB:
            raise UnirenderError(
                f"dataset noise floor: got {self.noise_floor} dB, expected more than 0 and at most {MOST_FLOOR_DB:g}"
            )
        if self.noise_floor is not None and self.vary == "sweep":
            raise UnirenderError(
                "dataset noise floor: got one with --vary sweep, whose pictures share their samples; choose --spp, or "
                "--vary paper for a floor of each picture"
            )
        if self.denoise and self.split == "test":
            raise UnirenderError(
                "dataset denoise: got --split test, expected train: truth is never denoised; leave --denoise out"
            )
        if self.denoise and self.noise_floor is not None:
            raise UnirenderError(
                "dataset denoise: got a noise floor too, which says nothing about a denoised picture; choose one"
            )

    def content(self) -> dict[str, Any]:
        """The part that decides the bytes of a group, JSON-serialisable; `objects` may grow later.

        Of `meshes` only that there are any: shards list the files that they hold, and a folder may move.
        """
        values = dataclasses.asdict(self)
        left_out = ("out", "workers", "objects", "cluster", "lights", "lights_digest")
        kept = {name: value for name, value in values.items() if name not in left_out}
        if not self.turn_objects:  # data sets that are older than the option go on
            del kept["turn_objects"]
        return kept | {"meshes": self.meshes is not None, "lights": self._lights_hash()}

    def _lights_hash(self) -> str | None:
        """sha256 over the user's light files and their share.

        Raises:
            UnirenderError: there are none.
        """
        pool = self.light_pool()
        return None if pool is None else pool.digest

    def light_pool(self) -> "LightPool | None":
        """The user's lights on this side of their division; only their names are read.

        Raises:
            UnirenderError: there are none.
        """
        if self.lights is None:
            return None
        from unirender_reference.lights import light_pool

        return light_pool(
            self.lights, self.split, self.light_holdout, self.light_share, self.turn_lights, self.light_height
        )


def basis_shape(pairs: int) -> tuple[int, int]:
    """(lights, roughness values) with lights * roughness values * 3 = pairs, lights >= roughness, nearly square.

    Raises:
        UnirenderError: `pairs` has no such form with at most `MAX_LIGHTS` lights.
    """
    product = pairs // len(METALLIC_PERCENTS)
    shapes = [
        (lights, product // lights)
        for lights in range(1, MAX_LIGHTS + 1)
        if pairs % len(METALLIC_PERCENTS) == 0 and product and product % lights == 0 and lights >= product // lights
    ]
    if not shapes:
        raise UnirenderError(
            f"dataset pairs: got {pairs} with --vary basis, expected 3 x lights x roughness values with at most "
            f"{MAX_LIGHTS} lights and no more roughness values than lights: 3, 6, 12, 18, 27, 36, 48, 75, 108, ..."
        )
    return min(shapes, key=lambda shape: shape[0] - shape[1])


def _check_pairs(vary: str, pairs: int) -> None:
    if vary not in get_args(Vary):
        raise UnirenderError(f"dataset vary: got {vary!r}, expected one of {', '.join(get_args(Vary))}")
    if vary == "basis":
        basis_shape(pairs)
    if vary == "visibility" and pairs != 1:
        raise UnirenderError(
            f"dataset pairs: got {pairs} with --vary visibility, which renders no pictures; leave --pairs out"
        )
    if vary in ("paper", "sweep") and pairs != len(GRID) ** 2:
        raise UnirenderError(f"dataset pairs: got {pairs}, expected {len(GRID) ** 2} with --vary {vary}")
    if vary == "independent" and pairs > PERCENTS**2:
        raise UnirenderError(
            f"dataset pairs: got {pairs}, expected at most {PERCENTS**2} materials of whole percents with "
            "--vary independent"
        )
    if vary == "one-at-a-time" and not 3 <= pairs <= 3 * PERCENTS**2:
        raise UnirenderError(
            f"dataset pairs: got {pairs}, expected at least 3 and at most {3 * PERCENTS**2} with --vary one-at-a-time"
        )
