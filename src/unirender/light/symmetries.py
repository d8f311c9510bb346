"""What light does whatever the scene: factors of the light, exchanged colour channels, mirror images and turns about
the view axis.

`Maps` is a dict of arrays `[..., H, W, C]` by name: those of `Intrinsics` (its `maps`) and `image`, the premultiplied
linear picture. Each function gives the maps of another scene that could be rendered, exactly (a turned environment is
resampled). An `Intrinsics` changes with `intrinsics.replace(**mirror(intrinsics.maps))`; its camera stays as it is, so
for `mirror` and `quarter_turn` the principal point has to be in the middle.
"""

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float

from unirender.errors import UnirenderError
from unirender.light.environment import mirror_environment, rotate_environment

Maps = dict[str, np.ndarray]

LIGHT_MAPS = ("image", "specular", "diffuse", "environment")  # linear in the light
COLOUR_MAPS = (*LIGHT_MAPS, "albedo")
_COSINE = tuple(np.float32(c) for c in (1, 0, -1, 0))  # of 0, 90, 180, 270 degrees; sin(a) = cos(a - 90)


def scale_light(maps: Mapping[str, np.ndarray], factor: float) -> Maps:
    """Multiplies the light, and all that is linear in it, by `factor`: how the gauge is applied."""
    return {name: value * np.float32(factor) if name in LIGHT_MAPS else value for name, value in maps.items()}


def permute_channels(maps: Mapping[str, np.ndarray], order: tuple[int, int, int]) -> Maps:
    """Channel c of the result is channel `order[c]` of every colour map.

    Raises:
        UnirenderError: the order is no permutation.
    """
    if sorted(order) != [0, 1, 2]:
        raise UnirenderError(f"channel order: got {order}, expected a permutation of (0, 1, 2)")
    if tuple(order) == (0, 1, 2):
        return dict(maps)
    return {name: value[..., list(order)] if name in COLOUR_MAPS else value for name, value in maps.items()}


def mirror(maps: Mapping[str, np.ndarray]) -> Maps:
    """The scene reflected in x -> -x: left and right change places."""
    flipped: Maps = {}
    for name, value in maps.items():
        flipped[name] = mirror_environment(value) if name == "environment" else value[..., ::-1, :]
    if "normal" in flipped:
        flipped["normal"] = flipped["normal"] * np.array([-1, 1, 1], dtype=np.float32)
    return flipped


def quarter_turn(maps: Mapping[str, np.ndarray], turns: int = 1) -> Maps:
    """The scene turned counter-clockwise about the view axis by `turns` * 90 degrees, as the viewer sees it.

    The environment is resampled at its own resolution; everything else is exact to the bit.

    Raises:
        UnirenderError: the frame is not square.
    """
    turns %= 4
    if turns == 0:
        return dict(maps)
    turned: Maps = {}
    for name, value in maps.items():
        if name == "environment":
            lights = value.reshape(-1, *value.shape[-3:])
            rotated = [rotate_environment(light, turn_rotation(turns)) for light in lights]
            turned[name] = np.stack(rotated).reshape(value.shape)
            continue
        if value.shape[-3] != value.shape[-2]:
            raise UnirenderError(f"{name}: got {value.shape[-3]}x{value.shape[-2]}, expected a square frame to turn")
        turned[name] = np.rot90(value, turns, axes=(-3, -2))
    if "normal" in turned:
        normal = turned["normal"]
        cosine, sine = _COSINE[turns], _COSINE[turns - 1]
        x, y = normal[..., 0], normal[..., 1]
        turned["normal"] = np.stack([cosine * x - sine * y, sine * x + cosine * y, normal[..., 2]], axis=-1)
    return turned


def turn_rotation(turns: int) -> Float[np.ndarray, "3 3"]:
    """The rotation about +z (towards the viewer) by `turns` * 90 degrees: +x goes to +y."""
    cosine, sine = _COSINE[turns % 4], _COSINE[turns % 4 - 1]
    return np.array([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1]], dtype=np.float32)
