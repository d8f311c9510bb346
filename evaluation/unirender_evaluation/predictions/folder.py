"""A folder of somebody's predictions as a benchmark row: `--predictions NAME=FOLDER`.

One subfolder per picture, under the neutral name that it has in the folder that `unirender bench export` writes:

    <picture>/intrinsics.exr            maps under the contract's channel names (albedo.R .. roughness.Y ..), linear;
                                        or single maps:
    <picture>/albedo.png                sRGB-encoded
    <picture>/normal.png                (n + 1) / 2, unit normal in camera axes: +x right, +y up, +z to the viewer
    <picture>/roughness.png             linear values, perceptual roughness; likewise metallic.png
    <picture>/specular.png              sRGB-encoded, clipped; likewise diffuse.png; use EXR for the full range
    <picture>/edit_m100_r050.exr|png    the picture with metallic 1.0, roughness 0.5
    <picture>/relight_l1_sd.exr|png     the picture under the object's light 1, its s and d given
    <picture>/relight_l1_hdri.exr|png   the same, the light given
    <picture>/environment.exr|hdr       the light, lat-long, linear, in camera axes; of the pictures that are relit
    <picture>/render_given.exr|png      the picture from true maps, s and d; `render_given-light`: from maps and light

A mask in `intrinsics.exr` (`mask.Y`) is the method's own, and whole-frame figures of its maps are taken with it.
Rendered pictures are premultiplied: black outside the object. EXR is linear, PNG sRGB-encoded. Other habits are
declared in a `conventions.toml` (see `conventions`). Absent files are absent numbers, never errors; a file that is
there and unreadable, of another size or not finite is an error, which `predictions.check` finds before a run begins.
"""

import hashlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from jaxtyping import Float

from unirender.arguments import as_path
from unirender.camera import Camera
from unirender.errors import UnirenderError
from unirender.exr import MAP_CHANNELS, channels_rgb, intrinsics_from_channels, read_exr
from unirender.intrinsics import MAPS, Intrinsics
from unirender.map_files import normals_of_picture
from unirender_evaluation.methods.method import Image, Mask
from unirender_evaluation.methods.plausible import picture_doubt
from unirender_evaluation.predictions.conventions import FILE, Conventions, read_conventions
from unirender_evaluation.predictions.png import is_transparent, read_png
from unirender_evaluation.task import LIGHT_ANSWER, Task

PNG_MAPS = ("albedo", "normal", "roughness", "metallic", "specular", "diffuse")
COLOURS = ("albedo", "specular", "diffuse")
MAP_FILES = ("intrinsics.exr", *(f"{name}.png" for name in PNG_MAPS))
LIGHT_FILES = (f"{LIGHT_ANSWER}.exr", f"{LIGHT_ANSWER}.hdr")
SUFFIXES = (".exr", ".png")
READ = tuple(channel for channels in MAP_CHANNELS.values() for channel in channels)
HARMLESS = ("R", "G", "B", "A", "depth.Z")  # a picture beside the maps; depth, which public sets ask for
BRIGHTEST = 1e30  # divided by an edge's coverage, much brighter values are no float32 any more


class PredictionFolder:
    """A folder of predictions; see the module for its layout.

    Args:
        folder: where it is.
        conventions: how its files are to be read; None = as its `conventions.toml` says.

    Raises:
        UnirenderError: it does not exist or has no subfolder.
    """

    def __init__(self, folder: str | Path, conventions: Conventions | None = None) -> None:
        folder = as_path(folder, "predictions")
        if not folder.is_dir():
            found = "a file, unpack it if it is an archive" if folder.is_file() else "no such folder"
            raise UnirenderError(f"predictions: {folder}: {found}; expected a folder with a subfolder per picture")
        if not any(p.is_dir() for p in folder.iterdir()):
            raise UnirenderError(
                f"predictions: {folder} has no subfolders, expected one per picture, each named as in the inputs "
                "that `unirender bench export` writes"
            )
        self.folder = folder
        self._conventions = conventions

    @property
    def conventions(self) -> Conventions:
        """How the files are to be read.

        Raises:
            UnirenderError: `conventions.toml` is not readable, or says what it cannot say.
        """
        if self._conventions is None:
            self._conventions = read_conventions(self.folder)
        return self._conventions

    def sha256(self) -> str:
        """Over names and contents of all files that are read, also of those in folders that are links."""
        digest = hashlib.sha256()
        beside = [self.folder / FILE]
        answers = (p for p in self.folder.glob("*/*") if p.suffix in SUFFIXES or p.name in LIGHT_FILES)
        for path in sorted(p for p in (*beside, *answers) if p.is_file()):
            digest.update(str(path.relative_to(self.folder)).encode() + hashlib.sha256(path.read_bytes()).digest())
        return digest.hexdigest()

    def has(self, task: Task) -> bool:
        """Whether there is an answer to the task."""
        if task.asks_light:
            return self._light(task) is not None
        return self._picture(task) is not None or ("decompose" in task.asks and bool(self._map_files(task)))

    def answer(self, task: Task) -> tuple[Image | None, Intrinsics | None]:
        """The picture and the maps that answer a task, as far as they are there.

        Raises:
            UnirenderError: a file is broken, has the wrong size, or values outside the contract.
        """
        if task.asks_light:
            light = self._light(task)
            return None, None if light is None else Intrinsics(environment=self.read_light(light))
        path = self._picture(task)
        image = None if path is None else self.read_picture(path, task.mask)
        files = self._map_files(task) if "decompose" in task.asks else []
        if not files:
            return image, None
        camera = task.inputs["decompose"]["camera"]
        maps: dict[str, np.ndarray] = {}
        for file in files:
            maps = self.read_maps(file, task.mask, camera) | maps
        own = self.read_mask(files[0])
        return image, Intrinsics(**maps, mask=task.mask if own is None else own, camera=camera)

    def _picture(self, task: Task) -> Path | None:
        for suffix in SUFFIXES:
            path = self.folder / task.folder / f"{task.answer}{suffix}"
            if task.answer != "intrinsics" and path.is_file():
                return path
        return None

    def _light(self, task: Task) -> Path | None:
        return next((p for p in (self.folder / task.folder / name for name in LIGHT_FILES) if p.is_file()), None)

    def _map_files(self, task: Task) -> list[Path]:
        return [path for path in (self.folder / task.folder / name for name in MAP_FILES) if path.is_file()]

    def read_picture(self, path: Path, mask: Mask) -> Image:
        """A rendered picture, linear and premultiplied.

        Raises:
            UnirenderError: the file is broken, has another size than the mask, values that are not finite or beyond
                `BRIGHTEST`, is transparent, or is no linear, premultiplied radiance (`plausible.picture_doubt`).
        """
        with _named(path):
            stored = channels_rgb(read_exr(path)[0]) if path.suffix == ".exr" else self._read_png(path, 3, "image")
            if path.suffix == ".png" and self.conventions.premultiplied and is_transparent(path):
                raise UnirenderError(
                    "the picture has transparent pixels, whose colour in a PNG is straight, expected a premultiplied "
                    f"picture; say premultiplied = false in {FILE}, or write it without alpha if it is premultiplied"
                )
            _check_size(path, "the picture", stored, mask)
            if not np.isfinite(stored).all():
                raise UnirenderError(f"predictions: {path} has NaN or infinite values, expected finite radiance")
            with np.errstate(over="ignore"):  # an overflow is brighter than the bound
                image = self.conventions.linear(stored, path.suffix)
            _check_brightness("the picture", image)
            image = image if self.conventions.premultiplied else (image * mask).astype(np.float32)
            if (doubt := picture_doubt(image, mask)) is not None:
                raise UnirenderError(
                    f"the picture is no linear, premultiplied radiance: {doubt}; make it so, or say in {FILE} what it "
                    "is (premultiplied = false: straight colour, not mixed with what is behind)"
                )
        return image

    def read_light(self, path: Path) -> Float[np.ndarray, "eh ew 3"]:
        """A light on the contract's grid: a map that unirender wrote as it is, another one's pixels taken as areas.

        Raises:
            UnirenderError: the file is broken, black, more negative than ringing is, not finite, beyond `BRIGHTEST` or
                not twice as wide as high.
        """
        from unirender_reference.lights import load_light

        with _named(path):
            light = load_light(path, photograph=False, normalise=False).environment
            _check_brightness("the light", light)
        return light

    def read_maps(self, path: Path, mask: Mask, camera: Camera) -> dict[str, np.ndarray]:
        """The maps of one file, in the contract's conventions.

        Raises:
            UnirenderError: the file is broken, without maps or with channels that nothing reads, or a map has another
                size than the mask, values outside the contract or, in a PNG, normals that are too long.
        """
        with _named(path):
            return self._read_exr_maps(path, mask, camera) if path.suffix == ".exr" else self._read_png_map(path, mask)

    def read_mask(self, path: Path) -> Mask | None:
        """The method's own mask, from a file of maps; None: it has none, and the true one is pasted."""
        return intrinsics_from_channels(read_exr(path)[0]).mask if path.suffix == ".exr" else None

    def _read_exr_maps(self, path: Path, mask: Mask, camera: Camera) -> dict[str, np.ndarray]:
        """The maps of an `intrinsics.exr` without its mask; unknown channels are refused."""
        channels, _ = read_exr(path)
        read = intrinsics_from_channels(channels, camera=camera)
        maps = {name: getattr(read, name) for name in read.present if name != "mask"}
        if not maps:
            raise UnirenderError(f"predictions: {path} has no map, expected channels like albedo.R or roughness.Y")
        unread = sorted(channels.keys() - {*READ, *HARMLESS})
        if unread:
            raise UnirenderError(
                f"has channels that are not read, {', '.join(unread)}; expected names of {', '.join(READ)}; rename or "
                "remove them"
            )
        for name, value in maps.items():
            _check_size(path, name, value, mask)
            _check_brightness(name, value)
        if "albedo" in maps:
            maps["albedo"] = self.conventions.linear(maps["albedo"], ".exr")
        return self._converted(maps)

    def _read_png_map(self, path: Path, mask: Mask) -> dict[str, np.ndarray]:
        name = path.stem
        value = self._read_png(path, MAPS[name], name)
        _check_size(path, name, value, mask)
        if name == "normal":
            value = normals_of_picture(value, mask)
        elif name in COLOURS:
            value = self.conventions.linear(value, ".png")
        return self._converted({name: value})

    def _read_png(self, path: Path, channels: int, what: str) -> Float[np.ndarray, "h w c"]:
        """Values as stored; a file in colour must not say of itself that it is otherwise encoded than it is read."""
        return read_png(path, channels, what in (*COLOURS, "image") and self.conventions.png_colour == "srgb")

    def _converted(self, maps: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        if "normal" in maps:
            maps["normal"] = self.conventions.camera_normal(maps["normal"])
        if "roughness" in maps:
            maps["roughness"] = self.conventions.perceptual(maps["roughness"])
        return Intrinsics().replace(**maps).maps


@contextmanager
def _named(path: Path) -> Iterator[None]:
    """Errors raised inside name the file."""
    try:
        yield
    except UnirenderError as error:
        raise UnirenderError(str(error) if str(path) in str(error) else f"predictions: {path}: {error}") from None


def _check_brightness(what: str, value: Float[np.ndarray, "h w c"]) -> None:
    largest = float(np.abs(value).max())
    if not largest <= BRIGHTEST:
        raise UnirenderError(f"{what} has values up to {largest:.3g}, expected at most {BRIGHTEST:g}; limit them")


def _check_size(path: Path, what: str, value: Float[np.ndarray, "h w c"], mask: Float[np.ndarray, "mh mw 1"]) -> None:
    if value.shape[:2] != mask.shape[:2]:
        (height, width), (rows, columns) = value.shape[:2], mask.shape[:2]
        raise UnirenderError(
            f"predictions: {path}: {what} is {width} x {height} pixels, expected {columns} x {rows}; resample it"
        )
