"""Maps as the key of what is kept of the last pictures: equal to others with the same values, not the same arrays."""

import hashlib

from unirender.intrinsics import Intrinsics


class MapsKey:
    """Maps and camera as they were when this was made."""

    def __init__(self, intrinsics: Intrinsics) -> None:
        self.intrinsics = intrinsics
        digests = (
            (name, value.shape, value.dtype.str, hashlib.sha256(value.tobytes()).digest())
            for name, value in intrinsics.maps.items()
        )
        self._key = (intrinsics.camera, *digests)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, MapsKey) and self._key == other._key

    def __hash__(self) -> int:
        return hash(self._key)
