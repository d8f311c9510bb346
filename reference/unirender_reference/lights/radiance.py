"""Radiance's RGBE files and PFM: Mitsuba reads their pixels, and what their headers say is done here.

Pixels of a Radiance file are divided by what its header says they were multiplied by (`EXPOSURE`, `COLORCORR`), and
their colours brought to Rec.709 where it states other `PRIMARIES`.
"""

import math
import re
from pathlib import Path

import numpy as np
from jaxtyping import Float

from unirender.blocks import by_rows
from unirender.errors import UnirenderError
from unirender.exr import channels_rgb, image_channels
from unirender.picture_files.primaries import REC709, in_rec709
from unirender_reference.backend import mitsuba

PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
MOST_HEADER_BYTES = 2**16
# Pixels in another order than by rows from the top left, which alone Mitsuba reads.
RGBE_TURNED = re.compile(rb"#\?.*?\n\n(?!-Y \d+ \+X )([-+][XY] \d+ [-+][XY] \d+)\s*\n", re.DOTALL)
OLD_RUNS = "its pixels are run-length coded as Radiance did before 1991"
NEW_RUNS = b"\2\2"  # how rows begin that are coded as since then
CODED_ROW, CODED_COLUMNS = re.compile(NEW_RUNS + rb"[\0-\x7f]"), range(8, 0x8000)  # so many columns can be coded
XYZE = "32-bit_rle_xyze"  # Mitsuba takes its white for one of D65, which Radiance's is not
HEADER_NUMBERS = {  # how many, and what
    "EXPOSURE": (1, "a number above 0"),
    "COLORCORR": (3, "three numbers above 0"),
    "PRIMARIES": (8, "x, y of red, green, blue and white"),
}
SIZES = re.compile(rb"#\?.*?\n-Y +(\d+) +\+X +(\d+)\s*\n|P[Ff]\s+(\d+)\s+(\d+)\s", re.DOTALL)  # of RGBE, of PFM


def read_radiance(path: Path) -> Float[np.ndarray, "h w 3"]:
    """The radiance of a file, linear Rec.709.

    Raises:
        UnirenderError: it is of another kind, cut off, or its pixels are stored otherwise than by rows from the top.
    """
    mi = mitsuba()
    try:
        with path.open("rb") as file:
            if file.read(len(PNG_SIGNATURE)) == PNG_SIGNATURE:
                raise UnirenderError(
                    f"light {path}: is a PNG under another name, expected radiance (RGBE, PFM or EXR); name it .png"
                )
            file.seek(0)
            turned = RGBE_TURNED.match(file.read(MOST_HEADER_BYTES))
        if turned:
            raise UnirenderError(
                f"light {path}: its pixels are stored as {turned[1].decode()!r}, expected '-Y height +X width' (from "
                "the top left, by rows); write the file again"
            )
        _check_rows(path)
        bitmap = mi.Bitmap(str(path)).convert(mi.Bitmap.PixelFormat.RGB, mi.Struct.Type.Float32, srgb_gamma=False)
    except UnirenderError:
        raise
    except (OSError, RuntimeError, ValueError) as error:  # ValueError: of a size that is no number
        reason = OLD_RUNS if _has_old_runs(path) else str(error).strip().splitlines()[-1]
        raise UnirenderError(
            f"light {path}: not a readable HDR map ({reason}), expected RGBE, PFM or EXR; save it as EXR"
        ) from error
    return _as_its_header_says(np.array(bitmap), path)


def header_texels(path: Path) -> int:
    """How many pixels a file has by its header; 0 where that cannot be read."""
    with path.open("rb") as file:
        found = SIZES.match(file.read(MOST_HEADER_BYTES))
    return math.prod(int(side) for side in found.groups() if side) if found else 0


def _has_old_runs(path: Path) -> bool:
    """Whether a Radiance file repeats pixels by others of 1, 1, 1 and a count, and has all of them then.

    Of such pixels in a row each has the next eight bits of the count.
    """
    data = path.read_bytes()
    header = SIZES.match(data[:MOST_HEADER_BYTES])
    if header is None or header[1] is None or data.startswith(NEW_RUNS, header.end()):
        return False
    start = header.end()
    pixels = np.frombuffer(data, np.uint8, (len(data) - start) // 4 * 4, start).reshape(-1, 4)
    run, place = (pixels[:, :3] == 1).all(axis=1), np.arange(len(pixels))
    digit = place - np.maximum.accumulate(np.where(run, -1, place)) - 1  # of a count, from the lowest
    lengths = np.where(run, pixels[:, 3] * 256.0 ** np.minimum(digit, 4), 1)
    return bool(run.any() and lengths.sum() == int(header[1]) * int(header[2]))


def _check_rows(path: Path) -> None:
    """Looks whether each row of a Radiance file begins where the one above ends. Where one does not, Mitsuba takes the
    rest for pixels that are not coded, and writes them beyond the end of its picture.

    Raises:
        UnirenderError: one does not, or the header has no size.
    """
    data = path.read_bytes()
    if not data.startswith(b"#?"):
        return
    header = SIZES.match(data[:MOST_HEADER_BYTES])
    if header is None:
        raise UnirenderError(f"light {path}: its header has no size, expected '-Y height +X width'; write it again")
    rows, columns, place = int(header[1]), int(header[2]), header.end()
    if columns not in CODED_COLUMNS or not CODED_ROW.match(data, place):
        return
    for row in range(1, rows + 1):
        if not CODED_ROW.match(data, place):
            raise UnirenderError(
                f"light {path}: row {row} of {rows} does not begin where the one above ends: the file is damaged or "
                "cut off; copy it again"
            )
        place += 4
        left = 4 * columns  # bytes of the row
        while left > 0 and place < len(data):
            code = data[place]
            left -= code & 127 if code > 128 else code
            place += 2 if code > 128 else 1 + code


def _as_its_header_says(pixels: Float[np.ndarray, "h w 3"], path: Path) -> Float[np.ndarray, "h w 3"]:
    """Radiance in Rec.709 from the pixels of a Radiance file; those of any other file as they are."""
    factor, primaries = np.ones(3), REC709
    with path.open("rb") as file:
        header = file.read(MOST_HEADER_BYTES)
    lines = header.split(b"\n\n", 1)[0].decode(errors="replace").split("\n") if header.startswith(b"#?") else []
    for line in lines:
        name, _, text = line.partition("=")
        name = name.rstrip()  # indented lines belong to the pictures that this one was made of
        if name == "FORMAT" and text.strip() == XYZE:
            raise UnirenderError(f"light {path}: got {XYZE}, expected RGB; convert the file (Radiance: ra_xyze -r)")
        if name not in HEADER_NUMBERS:
            continue
        count, expected = HEADER_NUMBERS[name]
        try:
            values = [float(word) for word in text.split()]
        except ValueError:
            values = []
        least = -math.inf if name == "PRIMARIES" else 0
        if len(values) != count or not all(least < value < math.inf for value in values):
            raise UnirenderError(
                f"light {path}: its header has {line[:60]!r}, expected {expected}; write the file again"
            )
        if name != "PRIMARIES":
            factor *= values
        elif any(values):  # Photoshop writes zeros
            primaries = values
    channels = image_channels(by_rows(lambda rows: (rows / factor).astype(np.float32), pixels))
    return channels_rgb(in_rec709(channels, primaries, ("",), f"light {path}"))
