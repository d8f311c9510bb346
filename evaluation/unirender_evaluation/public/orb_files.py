"""What Stanford-ORB's files hold, at the resolution of a run: masks, photographs, truths and lights."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from unirender.color import srgb_decode
from unirender.errors import UnirenderError
from unirender.exr import channels_rgb, read_exr
from unirender_evaluation.methods.method import quantise
from unirender_evaluation.public.files import block_mean, read_array, read_display, read_photograph
from unirender_evaluation.public.metrics import eroded
from unirender_evaluation.public.orb_frames import HDR, Photograph
from unirender_evaluation.public.orb_scoring import check_truth

MAP_TRUTHS = {"normal": ("surface_normal", (".npy",)), "depth": ("z_depth", (".npy",)),
              "albedo": ("pseudo_gt_albedo", (".png", ".npy"))}  # fmt: skip


@dataclass(frozen=True)
class OrbFiles:
    """A folder of the set, read with so many columns."""

    folder: Path
    resolution: int

    def mask(self, frame: Photograph) -> Float[np.ndarray, "h w 1"]:
        """Coverage in [0, 1]."""
        path = frame.mask(self.folder)
        full = read_display(path, 1)
        if full.shape[0] != full.shape[1]:
            raise UnirenderError(f"{path}: is {_size(full)} pixels, expected a square, as all pictures of the set are")
        mask = block_mean(full, self.resolution, str(path))
        if not eroded(mask).any():
            raise UnirenderError(
                f"{path}: shows no object larger than its edge, which is left out, at {self.resolution} pixels, "
                "expected white on the object; check the file, or pass a larger --resolution"
            )
        return mask

    def picture(self, frame: Photograph, mask: Float[np.ndarray, "h w 1"]) -> Float[np.ndarray, "h w 3"]:
        """The photograph in 8 bits, sRGB."""
        path = frame.photo(self.folder)
        linear = srgb_decode(read_photograph(path))
        full = read_display(frame.mask(self.folder), 1)
        if full.shape[:2] != linear.shape[:2]:
            raise UnirenderError(
                f"{frame.mask(self.folder)}: is {_size(full)} pixels, expected {_size(linear)} as its photograph {path}"
            )
        return quantise(block_mean(linear * full, self.resolution, str(path)), mask)

    def light(self, frame: Photograph) -> Float[np.ndarray, "h w 3"]:
        """The light where it was taken, in the size of its file."""
        return contract_environment(read_radiance(light_file(self.folder, frame)))

    def relit(self, frame: Photograph) -> Float[np.ndarray, "h w 3"]:
        """The linear photograph, which a relit picture is compared with."""
        path = frame.photo(self.folder, HDR)
        return self._reduced(read_radiance(path), path, frame)

    def maps(self, frame: Photograph, mask: Float[np.ndarray, "h w 1"]) -> dict[str, Float[np.ndarray, "h w c"]]:
        """The maps that a decomposition is compared with."""
        found = frame_truths(self.folder, frame)
        return {name: self._map(name, path, frame, eroded(mask)) for name, path in found.items()}

    def _reduced(
        self, value: Float[np.ndarray, "h w c"], path: Path, frame: Photograph
    ) -> Float[np.ndarray, "h2 w2 c"]:
        """A map at the run's resolution, which has to be a square like the mask of its frame."""
        if value.shape[0] != value.shape[1]:
            raise UnirenderError(
                f"{path}: is {_size(value)} pixels, expected a square like its mask {frame.mask(self.folder)}"
            )
        return block_mean(value, self.resolution, str(path))

    def _map(
        self, name: str, path: Path, frame: Photograph, counted: Float[np.ndarray, "h w 1"]
    ) -> Float[np.ndarray, "h w c"]:
        """One of them, with a look at the values that count: those of the eroded mask."""
        if path.suffix == ".png":
            return srgb_decode(self._reduced(read_display(path, 3), path, frame))
        full = read_array(path, 1 if name == "depth" else 3)
        found = self._reduced(full, path, frame)
        block = len(full) // len(found)  # means of unit vectors are shorter: what is stored is looked at
        inside = np.kron(counted[..., 0] > 0, np.ones((block, block), bool))
        check_truth(name, full[: len(inside), : len(inside)][inside], str(path))
        return found


def _size(value: Float[np.ndarray, "h w c"]) -> str:
    return f"{value.shape[1]} x {value.shape[0]}"


def frame_truths(folder: Path, frame: Photograph) -> dict[str, Path]:
    """The truths of a photograph whose folder is there, by map; a file may still be missing in it."""
    found = {}
    for name, (kind, suffixes) in MAP_TRUTHS.items():
        paths = [frame.truth(folder, kind, suffix) for suffix in suffixes]
        if paths[0].parent.is_dir():
            found[name] = next((path for path in paths if path.is_file()), paths[0])
    return found


def light_file(folder: Path, frame: Photograph) -> Path:
    """The light where a photograph was taken; it may be missing."""
    return frame.truth(folder, "env_map", ".exr")


def read_radiance(path: Path) -> Float[np.ndarray, "h w 3"]:
    """R, G, B of an EXR file, negative values as 0 (the benchmark does the same).

    Raises:
        UnirenderError: no readable file, no such channels, or values that are not finite.
    """
    try:
        rgb = channels_rgb(read_exr(path)[0])
    except UnirenderError as error:
        raise UnirenderError(str(error) if str(path) in str(error) else f"{path}: {error}") from None
    if not np.isfinite(rgb).all():
        bad = int((~np.isfinite(rgb)).any(axis=-1).sum())
        raise UnirenderError(f"{path}: {bad} pixels are NaN or infinite, expected finite radiance; repair them first")
    return np.maximum(rgb, 0)


def contract_environment(stored: Float[np.ndarray, "h w 3"]) -> Float[np.ndarray, "h w 3"]:
    """An env_map on the contract's grid.

    Both have +y up and rows on the poles. There the middle column looks along -z, into the scene, and the first and
    last column, both behind the camera, are one direction; here -z is at the border, and columns are centres.
    """
    width = stored.shape[1]
    turn = (np.arange(width) + 0.5) / width  # of the contract's columns, from -z over +x
    position = np.mod(turn + 0.5, 1.0) * (width - 1)
    first = np.minimum(position.astype(np.int64), width - 2)
    share = (position - first)[:, None]
    return (stored[:, first] * (1 - share) + stored[:, first + 1] * share).astype(np.float32)
