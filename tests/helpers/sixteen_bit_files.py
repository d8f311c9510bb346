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
    _write_png(path, struct.pack(">IIBBBBB", width, height, 16, COLOUR_TYPES[channels], 0, 0, 0), chunks, data)


def write_small_grey_png(path: Path, values: np.ndarray, bits: int, chunks: Mapping[bytes, bytes] = {}) -> None:
    """A grey PNG of `[h w]` whole numbers of 1, 2 or 4 bits; `chunks` as in `write_png16`."""
    every_bit = (values[..., None] >> np.arange(bits)[::-1] & 1).reshape(len(values), -1).astype(np.uint8)
    data = b"".join(b"\0" + row.tobytes() for row in np.packbits(every_bit, axis=1))
    _write_png(path, struct.pack(">IIBBBBB", values.shape[1], len(values), bits, 0, 0, 0, 0), chunks, data)


def _write_png(path: Path, header: bytes, chunks: Mapping[bytes, bytes], data: bytes) -> None:
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
    planar: bool = False,
    bits: int = 16,
    photometric: int = 2,
    signed: bool = False,
) -> None:
    """A TIFF of `[h w c]` whole numbers, in one strip.

    Args:
        path: where.
        values: 1, 3 or 4 channels.
        order: of its bytes: `<` or `>`.
        extra: what it says of a fourth channel: 0 nothing, 1 premultiplied alpha, 2 straight alpha.
        compressed: by Deflate.
        orientation: as EXIF counts them.
        planar: channels one after the other, each in a strip.
        bits: of a channel: 16, 12 or 8; of 12 in an even number of columns.
        photometric: 2 colour, 1 grey, 0 grey whose 0 is white.
        signed: whether it says that they are.
    """
    height, width, channels = values.shape
    parts = [values[..., k] for k in range(channels)] if planar else [values]
    if bits == 12:
        strips = [
            np.packbits((part[..., None] >> np.arange(12)[::-1] & 1).astype(np.uint8)).tobytes() for part in parts
        ]
    else:
        strips = [part.astype(f"{order}u{bits // 8}").tobytes() for part in parts]
    strips = [zlib.compress(strip) if compressed else strip for strip in strips]
    tags = [(256, 3, [width]), (257, 3, [height]), (258, 3, [bits] * channels), (259, 3, [8 if compressed else 1])]
    tags += [(262, 3, [photometric]), (273, 4, [0] * len(strips)), (274, 3, [orientation]), (277, 3, [channels])]
    tags += [(278, 3, [height]), (279, 4, [len(strip) for strip in strips]), (284, 3, [2 if planar else 1])]
    tags += [] if extra is None else [(338, 3, [extra])]
    tags += [(339, 3, [2])] if signed else []
    first = 8 + 2 + 12 * len(tags) + 4
    beside = sum(len(numbers) * struct.calcsize(FORMATS[kind]) for _, kind, numbers in tags if len(numbers) > 1)
    starts = np.cumsum([first + beside, *(len(strip) for strip in strips[:-1])]).tolist()
    entries, long_values = b"", b""
    for tag, kind, numbers in tags:
        value = struct.pack(f"{order}{len(numbers)}{FORMATS[kind]}", *(starts if tag == 273 else numbers))
        if len(numbers) > 1:  # too long for its entry
            place, long_values = struct.pack(f"{order}I", first + len(long_values)), long_values + value
        else:
            place = value.ljust(4, b"\0")
        entries += struct.pack(f"{order}HHI", tag, kind, len(numbers)) + place
    head = struct.pack(f"{order}2sHIH", b"II" if order == "<" else b"MM", 42, 8, len(tags))
    path.write_bytes(head + entries + bytes(4) + long_values + b"".join(strips))
