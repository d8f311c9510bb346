"""Files whose header states other primaries than Rec.709 (OpenEXR, Radiance): their colours brought to it."""

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float

from unirender.errors import UnirenderError

REC709 = (0.64, 0.33, 0.30, 0.60, 0.15, 0.06, 0.3127, 0.3290)  # x, y of red, green, blue and white
SAME_PRIMARIES = 2e-3  # difference in x or y: rounded numbers of one space


def in_rec709(
    channels: Mapping[str, np.ndarray], chromaticities: Sequence[float], colors: Sequence[str], name: str
) -> dict[str, np.ndarray]:
    """Channels with those of colours converted where the primaries or the white are others than Rec.709's.

    The white of the file becomes that of Rec.709 (Bradford). Colours outside Rec.709 have negative values then.

    Args:
        channels: `[h w]` by name.
        chromaticities: as in the file's header, in the order of `REC709`.
        colors: what is a colour: "" for `R`, `G`, `B`, else the part before `.R`, `.G`, `.B`.
        name: of the file, for messages.

    Raises:
        UnirenderError: the chromaticities are those of no colour space.
    """
    converted = dict(channels)
    if np.abs(np.subtract(chromaticities, REC709)).max() <= SAME_PRIMARIES:
        return converted
    matrix = _to_rec709(chromaticities, name)
    for color in colors:
        keys = [f"{color}.{component}" if color else component for component in "RGB"]
        if channels.keys() >= set(keys):
            rgb = np.stack([channels[key] for key in keys], axis=-1).astype(np.float64) @ matrix.T
            converted |= {key: np.ascontiguousarray(rgb[..., i], np.float32) for i, key in enumerate(keys)}
    return converted


def _to_rec709(chromaticities: Sequence[float], name: str) -> Float[np.ndarray, "3 3"]:
    """The matrix from linear colours of these x, y of red, green, blue and white to linear Rec.709 (Bradford)."""
    import colour

    points = np.asarray(chromaticities, np.float64).reshape(4, 2)
    try:
        stated = colour.RGB_Colourspace(name, points[:3], points[3])
        ours = colour.RGB_Colourspace("Rec.709", np.reshape(REC709[:6], (3, 2)), np.asarray(REC709[6:]))
        matrix = colour.matrix_RGB_to_RGB(stated, ours, chromatic_adaptation_transform="Bradford")
    except np.linalg.LinAlgError:
        matrix = np.full((3, 3), np.nan)
    if not np.isfinite(matrix).all() or points[3, 1] <= 0:
        raise UnirenderError(
            f"{name}: its chromaticities {tuple(round(float(x), 4) for x in chromaticities)} are those of no colour "
            "space, expected x, y of red, green, blue and white; convert the file to linear Rec.709"
        )
    return matrix
