"""One object in another's colours, by the closed form: the one augmentation that is not exact.

A picture's split-sum composite is linear in the albedo, so that the difference between two of them is

    (a' - a) ((1 - metallic) d + metallic A / (A + B) s)

with A and B of `unirender.composite`. Added to the picture, it leaves out how the new colours would change the light
between parts of the object: 31 to 39 dB against Mitsuba's render where two cubes that face each other get the opposite
colours (17 to 20 unedited; tests/physics/test_repaint.py). What it buys: a training object's material and shape are no
longer bound to its colour.
"""

import numpy as np
from jaxtyping import Float

from unirender.camera import Camera
from unirender.environment_brdf import environment_brdf
from unirender.light.symmetries import Maps

CHANNEL_RANGE = (0.02, 0.98)  # of an object's mean colour: a power takes neither 0 nor 1 elsewhere
POWER_RANGE = (0.25, 4.0)


def mean_colour(albedo: Float[np.ndarray, "h w 3"], mask: Float[np.ndarray, "h w 1"]) -> Float[np.ndarray, " 3"]:
    """Geometric mean over the object of each channel, in `CHANNEL_RANGE`."""
    inside = np.clip(albedo[mask[..., 0] > 0], *CHANNEL_RANGE)
    return np.exp(np.log(inside).mean(axis=0)) if len(inside) else np.full(3, 0.5)


def recoloured(
    albedo: Float[np.ndarray, "h w 3"], mask: Float[np.ndarray, "h w 1"], colour: Float[np.ndarray, " 3"]
) -> Float[np.ndarray, "h w 3"]:
    """A power of each channel, by which the object's mean colour becomes `colour` (within `POWER_RANGE`).

    Powers keep [0, 1] and the object's own pattern, and an object takes on the colours that objects have.
    """
    power = np.log(np.clip(colour, *CHANNEL_RANGE)) / np.log(mean_colour(albedo, mask))
    return np.power(np.clip(albedo, 0, 1), np.clip(power, *POWER_RANGE).astype(np.float32))


def repaint(maps: Maps, albedo: Float[np.ndarray, "h w 3"]) -> Maps:
    """The picture (linear, premultiplied) and the albedo map of a repainted object; all other maps as they are.

    Args:
        maps: image, albedo, normal, roughness, metallic, specular, diffuse, mask; in the contract's frame and camera.
        albedo: the new one, linear, in [0, 1].
    """
    height, width = albedo.shape[:2]
    n_v = np.sum(maps["normal"] * Camera().view_directions(height, width), axis=-1, keepdims=True)
    scale, bias = environment_brdf(n_v, maps["roughness"])
    metallic = maps["metallic"]
    light = (1 - metallic) * maps["diffuse"] + metallic * scale / (scale + bias) * maps["specular"]
    image = maps["image"] + maps["mask"] * (albedo - maps["albedo"]) * light
    inside = (maps["mask"] > 0).astype(np.float32)
    return maps | {"image": np.maximum(image, 0).astype(np.float32), "albedo": albedo * inside}
