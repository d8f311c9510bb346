"""What a visitor hands in: a picture, a mask, a light. Files are looked at before they are decoded.

An upload lives in memory. The file that the web server wrote is deleted when it is taken; the readers of the package
want files again, so they get one in a temporary folder that is gone when they are done. Messages name the file as its
owner does.
"""

import contextlib
import io
import re
import tempfile
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import OpenEXR
from jaxtyping import Float
from PIL import Image

from unirender.command_line.input_picture import read_input
from unirender.errors import UnirenderError
from unirender.light.resampling import resample_environment
from unirender.pictures import Picture
from unirender_evaluation.figures.pictures import framed
from unirender_reference.lights import load_light

BYTES_A_PIXEL = 50  # of memory: what it takes to read a picture and bring it to the square
SIDES = (64, 128)  # pixels of the square in which the page works
LIGHT_SHAPE = (128, 256)  # rows and columns to which a larger light is brought: finer ones do not show at these sides
RADIANCE_SIZE = re.compile(rb"^[-+]Y +(\d+) +[-+]X +(\d+)\s*$", re.MULTILINE)
FLOAT_MAP_SIZE = re.compile(rb"^P[Ff]\s+(\d+)\s+(\d+)\s")
HEAD = 4096  # bytes in which the sizes of .hdr and .pfm files stand


@dataclass(frozen=True)
class Limits:
    """What is taken, and for how long a request may run."""

    megabytes: float  # size of a file, in millions of bytes
    pixels: int  # width times height
    seconds: float  # of a single request


@dataclass(frozen=True)
class Upload:
    """A file in memory."""

    name: str  # as its owner calls it, without folders
    data: bytes

    @classmethod
    def take(cls, path: str | Path) -> "Upload":
        """Reads a file and deletes it."""
        path = Path(path)
        try:
            data = path.read_bytes()
        except OSError as error:
            raise UnirenderError(f"{path.name}: did not arrive ({error.strerror}); drop it in again") from error
        path.unlink(missing_ok=True)
        return cls(path.name, data)


def read_upload(picture: Upload, mask: Upload | None, limits: Limits) -> tuple[Picture, tuple[str, ...]]:
    """A picture with a mask (None: its alpha channel, else the whole frame), and remarks on what was assumed and what
    it cannot show.

    Raises:
        UnirenderError: a file is too large, or no readable picture; or the mask does not fit or is empty.
    """
    with contextlib.ExitStack() as files:
        path = files.enter_context(_as_file(picture, limits))
        beside = None if mask is None else files.enter_context(_as_file(mask, limits))
        found, remarks = read_input(path, beside, option="", bytes_a_pixel=BYTES_A_PIXEL)
    return found, tuple(f"{remark[0].upper()}{remark[1:]}." for remark in remarks.values())


def square(picture: Picture, side: int) -> Picture:
    """The object in the middle of a square of `side` pixels."""
    if side not in SIDES:
        raise UnirenderError(f"resolution: got {side}, expected one of {', '.join(map(str, SIDES))} pixels")
    return framed(picture, side)


def read_light(light: Upload, limits: Limits) -> Float[np.ndarray, "eh ew 3"]:
    """Radiance of a lat-long HDR, EXR or PFM, or of a photograph as a light; at most `LIGHT_SHAPE` large.

    Raises:
        UnirenderError: the file is too large or cannot be used as a light.
    """
    with _as_file(light, limits) as path:
        environment = load_light(path).environment
    if environment.shape[0] > LIGHT_SHAPE[0]:
        return resample_environment(environment, LIGHT_SHAPE)
    return environment


@contextlib.contextmanager
def _as_file(upload: Upload, limits: Limits) -> Iterator[Path]:
    """The upload as a file of its name, for readers; its errors name no folder."""
    check_size(upload, limits)
    with tempfile.TemporaryDirectory(prefix="unirender-demo-") as folder:
        path = Path(folder) / upload.name
        path.write_bytes(upload.data)
        try:
            yield path
        except UnirenderError as error:
            raise UnirenderError(str(error).replace(f"{folder}/", "")) from error


def check_size(upload: Upload, limits: Limits) -> None:
    """Looks at the size of a file and of the picture in it, without decoding it."""
    if len(upload.data) > limits.megabytes * 1e6:
        raise UnirenderError(
            f"{upload.name}: {len(upload.data) / 1e6:.1f} MB, expected at most {limits.megabytes:g} MB; scale it down "
            "first"
        )
    size = pixel_size(upload)
    if size is not None and size[0] * size[1] > limits.pixels:
        raise UnirenderError(
            f"{upload.name}: {size[0]} x {size[1]} pixels, expected at most {limits.pixels:,}; scale it down first"
        )


def pixel_size(upload: Upload) -> tuple[int, int] | None:
    """Width and height as the file's head says; None where it has none: whoever reads it will say so."""
    suffix, head = Path(upload.name).suffix.lower(), upload.data[:HEAD]
    if suffix == ".exr":
        try:
            window = OpenEXR.File(io.BytesIO(upload.data), header_only=True).header()["dataWindow"]
        except Exception:  # the binding raises several types for broken data
            return None
        width, height = (int(value) for value in window[1] - window[0] + 1)
        return width, height
    if found := RADIANCE_SIZE.search(head):
        return int(found[2]), int(found[1])
    if found := FLOAT_MAP_SIZE.match(head):
        return int(found[1]), int(found[2])
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)
            with Image.open(io.BytesIO(upload.data)) as file:
                return file.size
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError):
        return None
