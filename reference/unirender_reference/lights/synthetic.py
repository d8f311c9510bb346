"""Lights made from numbers: constant, gradient, studio soft boxes, Mitsuba's sun and sky."""

import numpy as np
from jaxtyping import Float

from unirender.errors import UnirenderError
from unirender.light.environment import environment_directions
from unirender.light.resampling import resample_environment
from unirender_reference.backend import mitsuba
from unirender_reference.lights.light import SHAPE, Light, normalized
from unirender_reference.lights.placement import random_turn

FINE = (128, 256)  # synthetic maps are drawn at this size and averaged down


def light_constant(rgb: Float[np.ndarray, "3"] | tuple[float, float, float]) -> Light:
    """The same radiance from everywhere; only the ratio of the channels is kept (mean luminance 1).

    Raises:
        UnirenderError: a channel is negative or not finite.
    """
    color = np.asarray(rgb, np.float32)
    if color.shape != (3,) or not np.isfinite(color).all() or color.min() < 0:
        raise UnirenderError(f"light_constant: got {rgb}, expected three finite numbers >= 0")
    environment = normalized(np.broadcast_to(color, (*SHAPE, 3)), "light_constant")
    return Light("constant", environment, {"source": "constant", "rgb": " ".join(f"{x:g}" for x in color)})


def random_tint(rng: np.random.Generator) -> Float[np.ndarray, "3"]:
    """White from warm to cool (about 2700 K to 10000 K), seldom saturated."""
    if rng.random() < 0.2:
        return rng.uniform(0.05, 1, 3) ** 1.5 + 0.02
    warmth = rng.normal(0, 0.45)
    return np.exp(np.array([warmth * 0.6, 0.0, -warmth * 0.9]) + rng.normal(0, 0.05, 3))


def _direction(rng: np.random.Generator, low: float = -1.0) -> Float[np.ndarray, "3"]:
    """Uniform on the part of the sphere with y >= low."""
    y, angle = rng.uniform(low, 1), rng.uniform(0, 2 * np.pi)
    return np.array([np.sqrt(1 - y * y) * np.sin(angle), y, np.sqrt(1 - y * y) * np.cos(angle)])


def light_gradient(seed: int | np.random.Generator) -> Light:
    """A colour gradient from one side to the other with one to four broad coloured lobes."""
    rng = np.random.default_rng(seed)
    directions = environment_directions(*SHAPE).astype(np.float64)
    along = 0.5 + 0.5 * directions @ _direction(rng)
    environment = along[..., None] * random_tint(rng) + (1 - along[..., None]) * random_tint(rng) * rng.uniform(
        0.02, 0.8
    )
    for _ in range(int(rng.integers(1, 5))):
        sharpness = np.exp(rng.uniform(np.log(2), np.log(60)))
        lobe = np.exp(sharpness * (directions @ _direction(rng, -0.5) - 1))
        environment += lobe[..., None] * random_tint(rng) * np.exp(rng.uniform(np.log(0.5), np.log(20)))
    return Light(f"gradient-{_label(seed)}", normalized(environment), {"source": "gradient", "seed": _label(seed)})


def light_softboxes(seed: int | np.random.Generator) -> Light:
    """A photo studio: one to five rectangular or round area lights with soft edges in a dim room."""
    rng = np.random.default_rng(seed)
    directions = environment_directions(*FINE).astype(np.float64)
    room, floor = random_tint(rng) * np.exp(rng.uniform(np.log(0.01), np.log(0.25))), rng.uniform(0.2, 1)
    blend = np.clip(0.5 - 3 * directions[..., 1:2], 0, 1)
    environment = room * (1 - blend) + room * floor * blend
    count = int(rng.integers(1, 6))
    for k in range(count):
        axis = _direction(rng, -0.3 if k else 0.0)
        up = np.array([0.0, 1.0, 0.0]) if abs(axis[1]) < 0.95 else np.array([1.0, 0.0, 0.0])
        right = np.cross(up, axis)
        right /= np.linalg.norm(right)
        roll = rng.choice([0.0, rng.uniform(0, np.pi)])
        right, up = (
            np.cos(roll) * right + np.sin(roll) * np.cross(axis, right),
            np.cos(roll) * np.cross(axis, right) - np.sin(roll) * right,
        )
        facing = directions @ axis
        x = directions @ right / np.maximum(facing, 1e-3)
        y = directions @ up / np.maximum(facing, 1e-3)
        a, b = np.exp(rng.uniform(np.log(0.12), np.log(0.9), 2))
        edge = 0.04 + 0.1 * rng.random()
        inside = 1 - np.hypot(x / a, y / b) if rng.random() < 0.4 else 1 - np.maximum(np.abs(x) / a, np.abs(y) / b)
        panel = np.clip(inside * min(a, b) / edge + 0.5, 0, 1) * (facing > 0.05)
        falloff = 1 - 0.5 * rng.random() * np.clip(np.hypot(x / a, y / b), 0, 1)
        power = np.exp(rng.normal(0, 0.7)) / np.sqrt(a * b)
        environment += (panel * falloff)[..., None] * random_tint(rng) * 4 * power
    environment = normalized(resample_environment(environment.astype(np.float32), SHAPE))
    provenance = {"source": "softboxes", "seed": _label(seed), "boxes": str(count)}
    return Light(f"softboxes-{_label(seed)}", environment, provenance)


def light_sunsky(seed: int | np.random.Generator) -> Light:
    """Mitsuba's `sunsky` (Hosek-Wilkie) at a random sun, turbidity and haze, over a grey or earthy Lambertian ground.

    The sun's disc is widened to 4-12 degrees at equal energy, about the size of a texel or more: a map of this
    resolution cannot hold the true 0.5 degrees, and no estimator here needs to find so small a light.
    """
    rng = np.random.default_rng(seed)
    mi = mitsuba()
    elevation = np.radians(rng.uniform(4, 80))
    turbidity, aperture = rng.uniform(1.5, 9), rng.uniform(4, 12)
    ground = np.clip(rng.uniform(0.08, 0.45) * (1 + rng.normal(0, 0.15) * np.array([1, 0.2, -1])), 0.02, 0.8)
    sun_scale = rng.choice([1.0, np.exp(rng.uniform(np.log(0.05), 0))])
    emitter = mi.load_dict(
        {
            "type": "sunsky",
            "turbidity": turbidity,
            "albedo": float(ground.mean()),
            "sun_direction": [float(np.cos(elevation)), 0.0, float(np.sin(elevation))],
            "sun_aperture": aperture,
            "sun_scale": float(sun_scale),
        }
    )
    directions = environment_directions(*FINE).reshape(-1, 3)
    # the emitter's up is +z: turn (x, y, z) about x; its interaction looks back along the ray
    sky_axes = np.stack([directions[:, 0], -directions[:, 2], directions[:, 1]], axis=-1)
    interaction = mi.SurfaceInteraction3f()
    interaction.wi = mi.Vector3f(*[mi.Float(np.ascontiguousarray(-sky_axes[:, k])) for k in range(3)])
    sky = np.maximum(np.array(emitter.eval(interaction)).T.reshape(*FINE, 3), 0)
    theta = np.pi * np.arange(FINE[0]) / (FINE[0] - 1)
    upper = (sky * (np.cos(theta) * np.sin(theta) * (theta < np.pi / 2))[:, None, None]).sum((0, 1))
    irradiance = upper * (np.pi / (FINE[0] - 1)) * (2 * np.pi / FINE[1])
    sky[theta >= np.pi / 2] = ground * irradiance / np.pi
    turn = random_turn(rng, SHAPE[1])
    environment = normalized(turn.apply(resample_environment(sky.astype(np.float32), SHAPE)))
    provenance = {
        "source": "mitsuba sunsky",
        "seed": _label(seed),
        "elevation_deg": f"{np.degrees(elevation):.2f}",
        "turbidity": f"{turbidity:.3f}",
        "sun_aperture_deg": f"{aperture:.2f}",
        "sun_scale": f"{sun_scale:.3f}",
        **turn.provenance(),
    }
    return Light(f"sunsky-{_label(seed)}", environment, provenance)


def _label(seed: int | np.random.Generator) -> str:
    return f"{seed:06d}" if isinstance(seed, int) else "drawn"
