"""The file format of a suite's truth: a tar of OpenEXR members with the contract's channel names, and `suite.json`.

    suite.json                                     how it was made: samples, noise ceilings, exposures, materials;
                                                   seeds, or files with their sha256, of objects and lights; of a
                                                   suite of one's own what its TOML file said (`definition`)
    light_<name>.exr                               R,G,B: a light as rendered, before exposure and turn (float32)
    <object>.shared.exr                            albedo.R/G/B, normal.X/Y/Z, mask.Y
    <object>_l<k>.diffuse.exr                      diffuse.R/G/B (d)                        and std.R/G/B
    <object>_l<k>.r050.specular.exr                specular.R/G/B (s) at roughness 0.50     and std.R/G/B
    <object>_l<k>.m050_r030.exr                    R,G,B,A: image, premultiplied            and std.R/G/B
    ceiling/<one of the last three>                the same scene, independently, with `ceiling_factor` times the
                                                   samples: a stand-in for the noise-free picture; without std

`A` is the object's traced coverage, in every image the `mask.Y` of `shared.exr`: the mask that scores use. Where it is
0, so is all else. `std` is the standard deviation of the stored mean relative to `max(|mean|, STD_FLOOR)`, so that half
floats neither underflow nor overflow.

Header attributes, `unirender:*`. Every member has `mitsuba`, `variant`, `camera`, `object` and `scene` (sha256 of what
defines the scene; where a member belongs to several, over theirs in order), and `exposure_factor`, but for the shared
maps, whose scenes differ in it (1 for the stored lights). Every render has `resolution`, `spp`, `seed`; image, s and d
also `light`, `turn_columns`, `depth`, `batches`, `nan_pixels` (rendered again with another seed), `noise_ceiling_db`,
and what they depend on of `metallic` and `roughness`. `seed` is the first render's; where samples were added, each
further render took the next. `camera` of a light says the frame that its directions are in.
"""

import io
import os
import tarfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, Literal

import numpy as np
from jaxtyping import Float

from unirender.errors import UnirenderError
from unirender.exr import Channels
from unirender.system.whole_files import aside
from unirender_evaluation.suites.stratification import MetallicRoughness, material_key, roughness_key

Kind = Literal["image", "specular", "diffuse"]
Rgb = Float[np.ndarray, "h w 3"]
STD_FLOOR = 1e-3
STD_MANTISSA_BITS = 4  # of the stored std: 3 % steps, far inside its own sampling error, and it compresses
CEILING = "ceiling/"
PREFIX: Mapping[Kind, str] = {"image": "", "specular": "specular.", "diffuse": "diffuse."}


def image_member(scene_key: str, material: MetallicRoughness) -> str:
    return f"{scene_key}.{material_key(material)}.exr"


def specular_member(scene_key: str, roughness: float) -> str:
    return f"{scene_key}.{roughness_key(roughness)}.specular.exr"


def diffuse_member(scene_key: str) -> str:
    return f"{scene_key}.diffuse.exr"


def shared_member(object_name: str) -> str:
    return f"{object_name}.shared.exr"


def light_member(light_name: str) -> str:
    return f"light_{light_name}.exr"


def member_kind(name: str) -> Kind:
    """What an image, s or d member holds."""
    return "diffuse" if name.endswith(".diffuse.exr") else "specular" if name.endswith(".specular.exr") else "image"


def estimate_channels(kind: Kind, mean: Rgb, variance: Rgb | None, mask: Float[np.ndarray, "h w 1"]) -> Channels:
    """The channels of an image, s or d member, 0 outside the mask, as they are read back from half floats.

    Args:
        kind: names the channels; an image gets the mask as A.
        mean: linear; an image premultiplied by coverage.
        variance: of `mean`; None leaves `std` out.
        mask: coverage.
    """
    mean = np.where(mask > 0, mean, 0)
    variance = None if variance is None else np.where(mask > 0, variance, 0)
    mean = _half(mean)  # the std is relative to what is stored
    channels = {f"{PREFIX[kind]}{c}": mean[..., i] for i, c in enumerate("RGB")}
    if kind == "image":
        channels["A"] = mask[..., 0]
    if variance is not None:
        std = _half(_coarse(np.sqrt(variance) / np.maximum(np.abs(mean), STD_FLOOR)))
        channels |= {f"std.{c}": std[..., i] for i, c in enumerate("RGB")}
    return channels


def estimate_mean(kind: Kind, channels: Channels) -> Rgb:
    """The stored mean of an image, s or d member."""
    return np.stack([channels[f"{PREFIX[kind]}{c}"] for c in "RGB"], axis=-1)


def estimate_variance(kind: Kind, channels: Channels) -> Rgb:
    """Variance of the stored mean, same units squared."""
    std = np.stack([channels[f"std.{c}"] for c in "RGB"], axis=-1)
    return np.square(std * np.maximum(np.abs(estimate_mean(kind, channels)), STD_FLOOR))


def _coarse(relative_std: Rgb) -> Rgb:
    mantissa, exponent = np.frexp(relative_std)
    return np.ldexp(np.round(mantissa * 2**STD_MANTISSA_BITS) / 2**STD_MANTISSA_BITS, exponent)


def _half(value: Rgb) -> Rgb:
    return value.astype(np.float16).astype(np.float32)


@dataclass(frozen=True)
class Stored:
    """A member of a tar file, read when it is asked for: the truth of a large suite does not fit into memory."""

    path: Path  # of the tar file
    offset: int  # of the member, bytes
    size: int  # the same
    state: tuple[int, int]  # (inode, time of the last change) of the tar file when it was listed

    def read(self) -> bytes:
        """The member's bytes.

        Raises:
            UnirenderError: the tar file was replaced or removed since it was listed.
        """
        try:
            with self.path.open("rb") as stream:
                if _state(stream) == self.state:
                    stream.seek(self.offset)
                    return stream.read(self.size)
        except FileNotFoundError:
            pass
        raise UnirenderError(f"{self.path} was replaced while it was in use; run the command again")


def write_tar(path: Path, members: Mapping[str, bytes] | Mapping[str, bytes | Stored]) -> None:
    """Writes a reproducible tar (sorted, no times or owners), moved into place when complete."""
    temporary = aside(path)
    try:
        with temporary.open("xb") as stream:
            with tarfile.open(fileobj=stream, mode="w") as tar:
                for name in sorted(members):
                    member = members[name]
                    data = member.read() if isinstance(member, Stored) else member
                    info = tarfile.TarInfo(name)
                    info.size = len(data)
                    tar.addfile(info, io.BytesIO(data))
            stream.flush()
            os.fsync(stream.fileno())
        temporary.replace(path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise


def list_tar(path: Path) -> dict[str, Stored]:
    """The members of a tar file by name.

    Raises:
        UnirenderError: it is no tar file.
    """
    try:
        with path.open("rb") as stream, tarfile.open(fileobj=stream) as tar:
            state = _state(stream)
            return {m.name: Stored(path, m.offset_data, m.size, state) for m in tar.getmembers()}
    except tarfile.TarError as error:
        raise UnirenderError(f"{path}: is no tar file ({error}); remove it, and make it again") from error


def _state(stream: BinaryIO) -> tuple[int, int]:
    found = os.fstat(stream.fileno())
    return found.st_ino, found.st_mtime_ns
