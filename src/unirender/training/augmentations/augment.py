"""Exact augmentations: each turns one scene's buffers into those of another scene that could be rendered.

Light is additive (`mix_lights`), radiance is a quadratic in metallic at depth 4 (`interpolate_metallic`), and the
renderer treats the colour channels, mirror images and turns about the view axis alike (`permute_channels`, `mirror` and
`quarter_turn` of `light.symmetries`, where `Maps` is explained). tests/physics/test_augmentation.py holds each
against a Mitsuba render of the augmented scene.
"""

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from unirender.errors import UnirenderError
from unirender.intrinsics import Intrinsics
from unirender.light.exposure import draw_target
from unirender.light.symmetries import LIGHT_MAPS, Maps
from unirender.training.augmentations.moving import ROLL_DEG, SHIFT, ZOOM, Move
from unirender.training.config import Augmentation

METALLIC_NODES = (0.0, 0.5, 1.0)


def to_maps(image_linear: Float[np.ndarray, "*batch h w 3"], intrinsics: Intrinsics) -> Maps:
    """The picture and the known maps of `intrinsics` in one dict (no copies)."""
    return {"image": image_linear} | intrinsics.maps


def from_maps(maps: Maps) -> tuple[Float[np.ndarray, "*batch h w 3"], Intrinsics]:
    """The inverse of `to_maps`, with the contract's camera."""
    return maps["image"], Intrinsics().replace(**{name: value for name, value in maps.items() if name != "image"})


def mix_lights(maps: Maps, weights: Float[np.ndarray, "l 3"]) -> Maps:
    """Adds lights up: `sum_l weights[l] * map[l]` for the maps that are linear in the light.

    Args:
        maps: the `LIGHT_MAPS` present have a leading axis over the same L lights; all others pass through.
        weights: non-negative, per light and colour channel.

    Raises:
        UnirenderError: weights of another shape, negative or not finite; or not one for each light.
    """
    if weights.ndim != 2 or weights.shape[1] != 3 or (weights < 0).any() or not np.isfinite(weights).all():
        raise UnirenderError(
            f"light weights: got {weights!r}, expected non-negative finite values of shape (lights, 3)"
        )
    mixed = dict(maps)
    for name in LIGHT_MAPS:
        if name in maps:
            stack = maps[name]
            if len(stack) != len(weights):
                raise UnirenderError(
                    f"{name}: got {len(stack)} lights, expected {len(weights)}, one per row of weights"
                )
            total = stack[0] * weights[0]
            for light in range(1, len(weights)):
                total += stack[light] * weights[light]
            mixed[name] = total
    return mixed


def interpolate_metallic(
    nodes: Float[np.ndarray, "3 *batch h w c"], metallic: float
) -> Float[np.ndarray, "*batch h w c"]:
    """The picture at any metallic in [0, 1] from those at 0, 0.5 and 1 (Lagrange; exact for a quadratic).

    Monte Carlo noise can make a value slightly negative; it is not clipped, which would bias the mean.

    Raises:
        UnirenderError: not three pictures, or a value outside [0, 1].
    """
    if len(nodes) != len(METALLIC_NODES) or not 0.0 <= metallic <= 1.0:
        raise UnirenderError(
            f"metallic: got {len(nodes)} pictures and the value {metallic}, expected {METALLIC_NODES} and [0, 1]"
        )
    low, middle, high = metallic_weights(metallic)
    return nodes[0] * np.float32(low) + nodes[1] * np.float32(middle) + nodes[2] * np.float32(high)


def metallic_weights(metallic: float) -> Float[np.ndarray, " 3"]:
    """Lagrange's weights of the pictures at `METALLIC_NODES`."""
    m = metallic
    return np.array([(2 * m - 1) * (m - 1), 4 * m * (1 - m), m * (2 * m - 1)])


DEFAULT_AUGMENTATION = Augmentation()
NO_AUGMENTATION = Augmentation(mix=0.0, tint=0.0, metallic=False, permute=0.0, mirror=0.0, turn=0.0, expose=False)


@dataclass(frozen=True)
class Draw:
    """One sample's augmentation, fully resolved."""

    lights: tuple[int, ...]  # which of the group's lights are on
    weights: Float[np.ndarray, "l 3"]  # their weights and tints
    roughness_index: int  # which of the group's stored roughness values
    metallic: float
    order: tuple[int, int, int] = (0, 1, 2)
    turns: int = 0
    mirror: bool = False
    exposure_target: float | None = None  # None: the stored exposure
    derived: bool = False  # whether s and d come as they are derived from the light, too
    shadowed: bool = False  # whether those have the shadows that the picture shows
    paint: int | None = None  # number of the group whose mean colour the object takes on; None: it keeps its own
    move: Move | None = None  # to another place in the frame, done last, with the batch; None: it stays


def draw(rng: np.random.Generator, config: Augmentation, lights: int, roughnesses: int, groups: int = 1) -> Draw:
    """Draws an augmentation for one of `groups` groups, which has so many lights and stored roughness values."""
    on = 1
    if rng.random() < config.mix and min(lights, config.max_lights) > 1:
        on = int(rng.integers(2, min(lights, config.max_lights) + 1))
    chosen = tuple(int(light) for light in rng.permutation(lights)[:on])
    share = rng.dirichlet(np.ones(on))[:, None]
    tint = np.exp(rng.normal(size=(on, 3)) * rng.uniform(0, config.tint)) if config.tint > 0 else np.ones((on, 3))
    # 5 % beyond each end, clipped: fully dielectric and fully metallic objects are as common as they are in use
    metallic = float(np.clip(rng.uniform(-0.05, 1.05), 0, 1)) if config.metallic else float(rng.choice(METALLIC_NODES))
    order = (0, 1, 2)
    if rng.random() < config.permute:
        order = _PERMUTATIONS[rng.integers(len(_PERMUTATIONS))]
    turns = int(rng.integers(1, 4)) if rng.random() < config.turn else 0
    flip = bool(rng.random() < config.mirror)
    target = draw_target(rng) if config.expose else None
    level = int(rng.integers(roughnesses))
    # last, and only where asked for: without them nothing else changes
    derived = bool(config.derived) and bool(rng.random() < config.derived)
    shadowed = derived and bool(config.shadowed) and bool(rng.random() < config.shadowed)
    painted = bool(config.repaint) and bool(rng.random() < config.repaint)
    paint = int(rng.integers(groups)) if painted else None
    move = _draw_move(rng) if config.move and rng.random() < config.move else None
    return Draw(
        lights=chosen,
        weights=(share * tint).astype(np.float32),
        roughness_index=level,
        metallic=metallic,
        order=order,
        turns=turns,
        mirror=flip,
        exposure_target=target,
        derived=derived,
        shadowed=shadowed,
        paint=paint,
        move=move,
    )


def _draw_move(rng: np.random.Generator) -> Move:
    roll, zoom, right, down = rng.uniform(-1, 1, 4)
    return Move(math.radians(ROLL_DEG) * roll, math.exp(ZOOM * zoom), (SHIFT * right, SHIFT * down))


_PERMUTATIONS = ((0, 2, 1), (1, 0, 2), (1, 2, 0), (2, 0, 1), (2, 1, 0))
