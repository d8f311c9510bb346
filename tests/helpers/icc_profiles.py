"""ICC profiles made by hand: three primaries and one exponent."""

import struct

import numpy as np

# Columns: XYZ of red, green and blue under D50, as profiles hold them (Lindbloom; Apple's Display P3).
ADOBE_RGB_D50 = np.array([[0.60976, 0.20524, 0.14922], [0.31112, 0.62566, 0.06322], [0.01948, 0.06089, 0.74484]])
SRGB_D50 = np.array([[0.43607, 0.38506, 0.14308], [0.22250, 0.71688, 0.06062], [0.01393, 0.09710, 0.71417]])
P3_D50 = np.array([[0.51510, 0.29197, 0.15715], [0.24118, 0.69224, 0.06658], [-0.00105, 0.04188, 0.78438]])
WHITE_D50 = (0.9642, 1.0, 0.8249)


def matrix_profile(primaries: np.ndarray, gamma: float) -> bytes:
    """A display profile (version 2): linear = value ** gamma in each channel, XYZ = primaries @ linear."""
    tags = {name: _xyz(primaries[:, i]) for i, name in enumerate((b"rXYZ", b"gXYZ", b"bXYZ"))}
    return _profile(b"RGB ", tags | dict.fromkeys((b"rTRC", b"gTRC", b"bTRC"), _curve(gamma)))


def grey_profile(gamma: float = 1.0) -> bytes:
    """The same of one channel."""
    return _profile(b"GRAY", {b"kTRC": _curve(gamma)})


def _profile(space: bytes, own: dict[bytes, bytes]) -> bytes:
    tags = {b"wtpt": _xyz(WHITE_D50)} | own
    table, body, place = b"", b"", 128 + 4 + 12 * len(tags)
    for name, data in tags.items():
        table += name + struct.pack(">II", place + len(body), len(data))
        body += data
    header = struct.pack(">I4xI4s4s4s12x4s", place + len(body), 0x02400000, b"mntr", space, b"XYZ ", b"acsp")
    header += b"\0" * (68 - len(header)) + b"".join(map(_fixed, WHITE_D50))
    return header.ljust(128, b"\0") + struct.pack(">I", len(tags)) + table + body


def _fixed(value: float) -> bytes:
    return struct.pack(">i", round(float(value) * 65536))


def _xyz(values: np.ndarray | tuple[float, ...]) -> bytes:
    return b"XYZ \0\0\0\0" + b"".join(map(_fixed, values))


def _curve(gamma: float) -> bytes:
    return b"curv\0\0\0\0" + struct.pack(">IH", 1, round(gamma * 256)) + b"\0\0"
