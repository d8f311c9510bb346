"""What a PNG (chunk cICP) or an AVIF says by two numbers of ITU-T H.273 of its colours; Pillow does not read it.

Of the chunks that a PNG may have, the first of cICP, iCCP (an ICC profile), sRGB, and gAMA with cHRM counts. Of an AVIF
a profile counts before the numbers.
"""

import struct
from pathlib import Path
from typing import NamedTuple

SIGNATURE = b"\x89PNG\r\n\x1a\n"
AVIF_BRAND, AVIF_HEAD = b"ftyp", 2**16  # where its kind stands behind 4 bytes, and how far its description may reach
AVIF_NUMBERS, AVIF_PROFILES = b"colrnclx", (b"colrprof", b"colrrICC")
UNSPECIFIED = 2
PRIMARIES = {1: "Rec.709", 9: "Rec.2020", 11: "DCI-P3", 12: "Display P3"}
TRANSFERS = {1: "Rec.709", 4: "gamma 2.2", 8: "linear", 13: "sRGB", 16: "PQ", 18: "HLG"}
SAME_PRIMARIES = (1, UNSPECIFIED)
SAME_TRANSFERS = (1, UNSPECIFIED, 6, 13, 14, 15)  # sRGB's, and video's, which is shown as sRGB


class Cicp(NamedTuple):
    """Colour primaries and transfer function, as numbers of ITU-T H.273."""

    primaries: int
    transfer: int

    @property
    def is_srgb(self) -> bool:
        """Whether values of such a picture are those of sRGB."""
        return self.primaries in SAME_PRIMARIES and self.transfer in SAME_TRANSFERS

    def __str__(self) -> str:
        primaries = PRIMARIES.get(self.primaries, f"number {self.primaries}")
        return f"{primaries} primaries and {TRANSFERS.get(self.transfer, f'number {self.transfer}')} transfer (cICP)"


def read_cicp(path: Path) -> Cicp | None:
    """What the numbers say; None where a file has none, or is neither a PNG nor an AVIF, or one with a profile."""
    with path.open("rb") as file:
        start = file.read(len(SIGNATURE))
        if start[4:] == AVIF_BRAND:
            return _avif_numbers(file.read(AVIF_HEAD))
        if start != SIGNATURE:
            return None
        while len(head := file.read(8)) == 8:
            length, name = struct.unpack(">I4s", head)
            if name == b"IDAT":  # behind it the chunk does not count
                return None
            if name == b"cICP" and len(body := file.read(2)) == 2:
                return Cicp(*body)
            file.seek(length + 4, 1)  # and the sum
    return None


def _avif_numbers(head: bytes) -> Cicp | None:
    place = head.find(AVIF_NUMBERS)
    body = head[place + len(AVIF_NUMBERS) :][:4]
    if place < 0 or len(body) < 4 or any(profile in head for profile in AVIF_PROFILES):
        return None
    return Cicp(*struct.unpack(">HH", body))
