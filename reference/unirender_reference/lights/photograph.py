"""A photograph as a light: it is neither high dynamic range nor a whole sphere, so a rule makes it one.

1. *Range.* Display values are decoded to linear and expanded above `KNEE`: with m the largest linear channel,
   `rgb * (1 + (PEAK - 1) * t^2)`, t = clip((m - KNEE) / (1 - KNEE), 0, 1). White becomes PEAK; all below KNEE stays.
2. *Sphere.* The picture fills azimuths of 180 degrees about +z (behind the camera, where a frontal object sees it) and,
   cropped if need be, elevations -45 to +45 degrees; its mirror image fills the other half, so that both borders meet.
   Above and below, its edge row runs on and fades over 30 degrees to that row's mean colour; below, the light is
   multiplied by `FLOOR` as it fades (a floor is darker than what stands on it).

A lat-long LDR panorama gets step 1 only.
"""

import numpy as np
from jaxtyping import Float
from PIL import Image

from unirender_reference.lights.light import area_resampled

KNEE, PEAK, FLOOR = 0.8, 16.0, 0.5
WINDOW_DEG, FADE_DEG = 45.0, 30.0
PHOTOGRAPH_SHAPE = (128, 256)  # rows and columns of the light
RULE = f"photograph: knee {KNEE:g}, peak {PEAK:g}, window {WINDOW_DEG:g} deg, floor {FLOOR:g}"


def expand_range(linear: Float[np.ndarray, "h w 3"]) -> Float[np.ndarray, "h w 3"]:
    """Step 1 of the photograph rule: linear [0, 1] -> [0, PEAK], colour kept."""
    t = np.clip((linear.max(-1, keepdims=True) - KNEE) / (1 - KNEE), 0, 1)
    return (linear * (1 + (PEAK - 1) * t * t)).astype(np.float32)


def shown_rows(height: int, width: int) -> float:
    """The share of a photograph's rows that the window holds: equal angles per pixel both ways."""
    return min(1.0, width * WINDOW_DEG / 90 / height)


def photograph_environment(pixels: Float[np.ndarray, "h w 3"], shape: tuple[int, int]) -> Float[np.ndarray, "h2 w2 3"]:
    """Step 2 of the photograph rule: a linear picture on the sphere."""
    rows, half = 2 * shape[0], shape[1]  # drawn at twice the size, then averaged on to the grid
    window = round(rows * 2 * WINDOW_DEG / 180)
    h, w = pixels.shape[:2]
    wanted = min(h, max(1, round(w * window / half)))  # equal angles per pixel both ways; the middle is kept
    crop = pixels[(h - wanted) // 2 : (h - wanted) // 2 + wanted]
    image = _box_resize(crop, (window, half))
    image = np.concatenate([image[:, : half // 2][:, ::-1], image, image[:, half // 2 :][:, ::-1]], axis=1)
    top = (rows - window) // 2
    bottom = rows - window - top
    fade = rows * FADE_DEG / 180
    up = np.clip((np.arange(top)[::-1] + 0.5) / fade, 0, 1)[:, None, None]
    down = np.clip((np.arange(bottom) + 0.5) / fade, 0, 1)[:, None, None]
    sky = image[:1] * (1 - up) + image[0].mean(0) * up
    floor = (image[-1:] * (1 - down) + image[-1].mean(0) * down) * (1 - (1 - FLOOR) * down)
    return area_resampled(np.concatenate([sky, image, floor]), shape)


def _box_resize(pixels: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    size = (shape[1], shape[0])
    channels = [
        np.asarray(Image.fromarray(np.ascontiguousarray(pixels[..., k], np.float32)).resize(size, Image.Resampling.BOX))
        for k in range(3)
    ]
    return np.stack(channels, -1)
