"""Pictures of 16 bits a channel, by the letter of their formats: Pillow writes none in colour."""

import struct
import zlib
from collections.abc import Mapping
from pathlib import Path

import numpy as np

COLOUR_TYPES = {1: 0, 2: 4, 3: 2, 4: 6}  # of a PNG: channels -> grey, colour, and both with alpha
FORMATS = {3: "H", 4: "I"}  # of a TIFF's values, by their type


def write_png16(path: Path, values: np.ndarray, filter_type: int = 0, chunks: Mapping[bytes, bytes] = {}) -> None:
    """A PNG of `[h w c]` whole numbers.

    Args:
        path: where.
        values: 1 to 4 channels.
        filter_type: of its rows: 0 none, 1 Sub.
        chunks: between its header and its pixels.
    """
    height, width, channels = values.shape
    raw = values.astype(">u2").view(np.uint8).reshape(height, width, 2 * channels)
    rows = raw if filter_type == 0 else np.diff(raw, axis=1, prepend=np.zeros_like(raw[:, :1]))
    data = b"".join(bytes([filter_type]) + row.tobytes() for row in rows)
    header = struct.pack(">IIBBBBB", width, height, 16, COLOUR_TYPES[channels], 0, 0, 0)
    every = {b"IHDR": header, **chunks, b"IDAT": zlib.compress(data), b"IEND": b""}
    parts = [struct.pack(">I", len(v)) + k + v + struct.pack(">I", zlib.crc32(k + v)) for k, v in every.items()]
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + b"".join(parts))


def write_tiff16(
    path: Path,
    values: np.ndarray,
    order: str = "<",
    *,
    extra: int | None = None,
    compressed: bool = False,
    orientation: int = 1,
) -> None:
    """A TIFF of `[h w c]` whole numbers, in one strip.

    Args:
        path: where.
        values: 3 or 4 channels.
        order: of its bytes: `<` or `>`.
        extra: what it says of a fourth channel: 0 nothing, 1 premultiplied alpha, 2 straight alpha.
        compressed: by Deflate.
        orientation: as EXIF counts them.
    """
    height, width, channels = values.shape
    data = values.astype(f"{order}u2").tobytes()
    data = zlib.compress(data) if compressed else data
    tags = [(256, 3, [width]), (257, 3, [height]), (258, 3, [16] * channels), (259, 3, [8 if compressed else 1])]
    tags += [(262, 3, [2]), (273, 4, [0]), (274, 3, [orientation]), (277, 3, [channels]), (278, 3, [height])]
    tags += [(279, 4, [len(data)])] + ([] if extra is None else [(338, 3, [extra])])
    first = 8 + 2 + 12 * len(tags) + 4
    bits = struct.pack(f"{order}{channels}H", *[16] * channels)
    entries = b""
    for tag, kind, numbers in tags:
        if len(numbers) > 1:  # too long for its entry
            value = struct.pack(f"{order}I", first)
        elif tag == 273:  # where the pixels are
            value = struct.pack(f"{order}I", first + len(bits))
        else:
            value = struct.pack(f"{order}{FORMATS[kind]}", *numbers).ljust(4, b"\0")
        entries += struct.pack(f"{order}HHI", tag, kind, len(numbers)) + value
    head = struct.pack(f"{order}2sHIH", b"II" if order == "<" else b"MM", 42, 8, len(tags))
    path.write_bytes(head + entries + bytes(4) + bits + data)
