"""A folder of somebody's predictions as a benchmark row: `--predictions NAME=FOLDER`.

One subfolder per picture, named as in the folder that `unirender bench export` writes (`<scene>_m050_r050`: the suite's
own name of the picture):

    <picture>/intrinsics.exr            maps under the contract's channel names (albedo.R .. roughness.Y ..), linear;
                                        or single maps:
    <picture>/albedo.png                sRGB-encoded, 8 or 16 bits
    <picture>/normal.png                (n + 1) / 2, unit normal in camera axes: +x right, +y up, +z to the viewer
    <picture>/roughness.png             linear values, perceptual roughness; likewise metallic.png
    <picture>/specular.png              sRGB-encoded, clipped; likewise diffuse.png; use EXR for the full range
    <picture>/edit_m100_r050.exr|png    the picture with metallic 1.0, roughness 0.5
    <picture>/relight_l1_sd.exr|png     the picture under the object's light 1, its s and d given
    <picture>/relight_l1_hdri.exr|png   the same, the light given
    <picture>/render_given.exr|png      the picture from true maps, s and d; `render_given-light`: from maps and light

Rendered pictures are premultiplied: black outside the object. EXR is linear, PNG sRGB-encoded. Absent files are absent
numbers, never errors; a file that is there and unreadable, of another size or not finite is an error.
"""

import hashlib
from pathlib import Path

import numpy as np
from jaxtyping import Float

from unirender.color import srgb_decode
from unirender.errors import UnirenderError
from unirender.exr import channels_rgb, intrinsics_from_channels, read_exr
from unirender.intrinsics import MAPS, Intrinsics
from unirender_evaluation.methods import Image
from unirender_evaluation.tasks import Task

PNG_MAPS = ("albedo", "normal", "roughness", "metallic", "specular", "diffuse")


class PredictionFolder:
    """A folder of predictions; see the module for its layout.

    Raises:
        UnirenderError: it does not exist or has no subfolder.
    """

    def __init__(self, folder: Path) -> None:
        if not folder.is_dir() or not any(p.is_dir() for p in folder.iterdir()):
            raise UnirenderError(
                f"predictions: {folder} is not a folder with one subfolder per picture; "
                "`unirender bench export` writes the inputs and their names"
            )
        self.folder = folder

    def sha256(self) -> str:
        """Over names and contents of all files."""
        digest = hashlib.sha256()
        for path in sorted(p for p in self.folder.rglob("*") if p.suffix in (".exr", ".png")):
            digest.update(str(path.relative_to(self.folder)).encode() + hashlib.sha256(path.read_bytes()).digest())
        return digest.hexdigest()

    def has(self, task: Task) -> bool:
        """Whether there is an answer to the task."""
        return self._picture(task) is not None or ("decompose" in task.asks and bool(self._map_files(task)))

    def answer(self, task: Task) -> tuple[Image | None, Intrinsics | None]:
        """The picture and the maps that answer a task, as far as they are there.

        Raises:
            UnirenderError: a file is broken, has the wrong size, or values outside the contract.
        """
        path = self._picture(task)
        image = None if path is None else self._read_image(path, task.mask.shape[:2])
        maps = self._read_maps(task) if "decompose" in task.asks and self._map_files(task) else None
        return image, maps

    def _picture(self, task: Task) -> Path | None:
        for suffix in (".exr", ".png"):
            path = self.folder / task.folder / f"{task.answer}{suffix}"
            if task.answer != "intrinsics" and path.is_file():
                return path
        return None

    def _map_files(self, task: Task) -> list[Path]:
        folder = self.folder / task.folder
        return [p for p in (folder / "intrinsics.exr", *(folder / f"{name}.png" for name in PNG_MAPS)) if p.is_file()]

    def _read_image(self, path: Path, size: tuple[int, ...]) -> Image:
        image = channels_rgb(read_exr(path)[0])[..., :3] if path.suffix == ".exr" else srgb_decode(read_png(path, 3))
        if image.shape[:2] != size:
            raise UnirenderError(
                f"predictions: {path} has {image.shape[:2]} pixels, expected {tuple(size)}; resample it"
            )
        return image

    def _read_maps(self, task: Task) -> Intrinsics:
        folder = self.folder / task.folder
        camera = task.inputs["decompose"]["camera"]
        maps: dict[str, np.ndarray] = {}
        if (folder / "intrinsics.exr").is_file():
            read = intrinsics_from_channels(read_exr(folder / "intrinsics.exr")[0], camera=camera)
            maps = {name: getattr(read, name) for name in read.present}
        for name in PNG_MAPS:
            path = folder / f"{name}.png"
            if name in maps or not path.is_file():
                continue
            value = read_png(path, MAPS[name])
            if name == "normal":
                value = 2 * value - 1
                length = np.linalg.norm(value, axis=-1, keepdims=True)
                value = np.divide(value, length, out=np.zeros_like(value), where=(length > 1e-3) & (task.mask > 0))
            elif MAPS[name] == 3:
                value = srgb_decode(value)
            maps[name] = value
        for name, value in maps.items():
            if name != "environment" and value.shape[:2] != task.mask.shape[:2]:
                raise UnirenderError(
                    f"predictions: {name} in {folder} has {value.shape[:2]} pixels, expected {task.mask.shape[:2]}; "
                    "resample it"
                )
        return Intrinsics(**{**maps, "mask": task.mask}, camera=camera)


def read_png(path: Path, channels: int) -> Float[np.ndarray, "h w c"]:
    """Values in [0, 1] of an 8- or 16-bit PNG; alpha is dropped, grey and colour are converted to `channels`.

    Raises:
        UnirenderError: not a readable PNG.
    """
    from PIL import Image as Pil

    try:
        with Pil.open(path) as picture:
            if picture.mode.startswith("I"):
                value = np.asarray(picture, np.float32) / 65535.0
            else:
                value = np.asarray(picture.convert("RGB" if channels == 3 else "L"), np.float32) / 255.0
    except OSError as error:
        raise UnirenderError(f"predictions: {path} is not a readable PNG ({error})") from None
    value = value if value.ndim == 3 else value[..., None]
    return np.repeat(value, 3, axis=-1) if channels == 3 and value.shape[-1] == 1 else value.astype(np.float32)
