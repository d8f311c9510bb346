"""Families given by a formula on a grid. Each takes a generator and returns a closed `Part` of extent about 1."""

import numpy as np
from jaxtyping import Float

from unirender_reference.shapes.noise import value_noise
from unirender_reference.shapes.surface import Part, box_part, grid_part

COLUMNS = 89
ROWS = 49


def _power(x: np.ndarray, exponent: float) -> np.ndarray:
    return np.sign(x) * np.abs(x) ** exponent


def _angles(columns: int = COLUMNS) -> Float[np.ndarray, " columns"]:
    return np.linspace(0, 2 * np.pi, columns)


def _even(curve: np.ndarray, count: int) -> np.ndarray:
    """Resamples a polyline to `count` points evenly spaced along it, keeping its corners within half a step."""
    step = np.linalg.norm(np.diff(curve, axis=0), axis=1)
    length = np.concatenate([[0], np.cumsum(step)])
    at = np.linspace(0, length[-1], count)
    corners = np.abs(length[:, None] - at[None]).argmin(1)
    at[corners] = length  # every original point stays, so that hard profiles keep their edges
    return np.stack([np.interp(at, length, curve[:, k]) for k in range(curve.shape[1])], -1)


def lathe(profile: Float[np.ndarray, "rows 2"], outline: Float[np.ndarray, "columns 2"], crease_deg: float) -> Part:
    """Profile (radius, height) swept round an outline; the profile starts and ends on the axis."""
    surface = np.empty((len(profile), len(outline), 3))
    surface[..., 0] = profile[:, :1] * outline[None, :, 0]
    surface[..., 2] = profile[:, :1] * outline[None, :, 1]
    surface[..., 1] = profile[:, 1:]
    return grid_part(surface, crease_deg=crease_deg)


def _circle() -> np.ndarray:
    angle = _angles()
    return np.stack([np.cos(angle), np.sin(angle)], -1)


def superquadric(rng: np.random.Generator) -> Part:
    """Barr's superellipsoid: exponents 0.2 (box) to 2.2 (pinched)."""
    e1, e2 = np.exp(rng.uniform(np.log(0.2), np.log(2.2), 2))
    scale = rng.uniform(0.55, 1, 3)
    latitude = np.linspace(-np.pi / 2, np.pi / 2, ROWS)[:, None]
    longitude = _angles()[None, :]
    surface = np.stack(
        np.broadcast_arrays(
            scale[0] * _power(np.cos(latitude), e1) * _power(np.cos(longitude), e2),
            scale[1] * _power(np.sin(latitude), e1),
            scale[2] * _power(np.cos(latitude), e1) * _power(np.sin(longitude), e2),
        ),
        -1,
    )
    surface[0, :, [0, 2]] = surface[-1, :, [0, 2]] = 0
    return grid_part(surface, crease_deg=35)


def rounded_box(rng: np.random.Generator) -> Part:
    """Box with edges rounded by 0 (sharp) to 45 % of its shortest side."""
    half = rng.uniform(0.35, 1, 3)
    radius = half.min() * (0.0 if rng.random() < 0.2 else rng.uniform(0.04, 0.9))
    return rounded_box_part(half, radius)


def rounded_box_part(half: Float[np.ndarray, "3"], radius: float) -> Part:
    """Minkowski sum of a box and a ball: a cube's grid whose outer rings make the quarter-round edges."""
    rings, flat = 6, 10  # cells across half an edge, and along the flat part of a side
    inner = half - radius
    span = np.linspace(-1, 1, flat + 1)  # the flat part of each side, as a fraction of `inner`
    turn = np.tan(np.linspace(-np.pi / 4, np.pi / 4, 2 * rings + 1)) if radius > 0 else np.zeros(1)
    before, after = turn[turn < 0], turn[turn > 0]
    lattice = np.concatenate([before, np.zeros(flat + 1), after])  # how far outside the flat part, as a slope
    side = np.concatenate([-np.ones(len(before)), span, np.ones(len(after))])
    n = len(lattice)
    shape, quads = np.zeros((n, n, n), bool), []
    shape[[0, -1]] = shape[:, [0, -1]] = shape[:, :, [0, -1]] = True
    index = np.full((n, n, n), -1)
    index[shape] = np.arange(shape.sum())
    for axis in range(3):
        for end in (0, -1):
            face = np.take(index, end, axis=axis)
            face = face if (end == -1) != (axis == 1) else face.T
            quads.append(np.stack([face[:-1, :-1], face[1:, :-1], face[1:, 1:], face[:-1, 1:]], -1).reshape(-1, 4))
    i, j, k = np.nonzero(shape)
    direction = np.stack([lattice[i], lattice[j], lattice[k]], -1)
    direction /= np.maximum(np.linalg.norm(direction, axis=1, keepdims=True), 1e-9)
    vertices = np.stack([side[i], side[j], side[k]], -1) * inner + radius * direction
    quad = np.concatenate(quads)
    return box_part(vertices, np.concatenate([quad[:, [0, 1, 2]], quad[:, [0, 2, 3]]]), crease_deg=30)


def torus(rng: np.random.Generator) -> Part:
    """Ring of superelliptic section, possibly oval, fluted or waved."""
    section, ring = rng.uniform(0.12, 0.48), 1.0
    exponent = np.exp(rng.uniform(np.log(0.35), np.log(1.3)))
    flat = rng.uniform(0.6, 1.6)
    waves, amplitude = int(rng.integers(3, 9)), rng.choice([0.0, 0.0, rng.uniform(0.05, 0.25)])
    twist = int(rng.integers(-2, 3)) if exponent < 0.7 or flat > 1.2 else 0
    u, v = _angles(121)[None, :], np.linspace(0, 2 * np.pi, 49)[:, None]
    thickness = section * (1 + amplitude * np.cos(waves * u))
    out, up = thickness * _power(np.cos(v), exponent), thickness * flat * _power(np.sin(v), exponent)
    turn = twist * u
    out, up = out * np.cos(turn) - up * np.sin(turn), out * np.sin(turn) + up * np.cos(turn)
    oval = rng.uniform(0.6, 1)
    surface = np.stack(np.broadcast_arrays((ring + out) * np.cos(u), up, oval * (ring + out) * np.sin(u)), -1)
    return grid_part(surface, wrap_rows=True, crease_deg=50)


def cylinder(rng: np.random.Generator) -> Part:
    """Cylinder, frustum or disc with chamfered rims, sometimes hollowed like a cup."""
    top, height = rng.uniform(0.5, 1), rng.uniform(0.15, 1.6)
    bevel = min(rng.uniform(0.0, 0.12), height / 3)
    points = [(0, -height), (1 - bevel, -height), (1, -height + bevel), (top, height - bevel), (top - bevel, height)]
    if rng.random() < 0.4 and height > 0.4:
        wall = rng.uniform(0.08, 0.2)
        points += [(top - bevel - wall, height), ((1 - wall) * 0.9, -height + 2 * wall), (0, -height + 2 * wall)]
    else:
        points += [(0, height)]
    return lathe(_even(np.array(points), ROWS), _circle(), 30)


def capsule(rng: np.random.Generator) -> Part:
    """Cones with round ends: a sphere swept along a segment while its radius changes."""
    low, high, length = rng.uniform(0.3, 1), rng.uniform(0.02, 0.8), rng.uniform(0.3, 1.6)
    if abs(low - high) >= length:
        length = abs(low - high) + 0.3
    tilt = np.arcsin((low - high) / length)  # latitude at which the common tangent cone touches both spheres
    first = np.linspace(-np.pi / 2, tilt, 20)
    second = np.linspace(tilt, np.pi / 2, 20)
    profile = np.concatenate(
        [
            np.stack([low * np.cos(first), low * np.sin(first)], -1),
            np.stack([high * np.cos(second), length + high * np.sin(second)], -1),
        ]
    )
    profile[[0, -1], 0] = 0
    return lathe(_even(profile, 57), _circle(), 40)


def revolution(rng: np.random.Generator) -> Part:
    """Vase-like solid: a smooth random profile, sometimes open at the top."""
    knots = int(rng.integers(4, 8))
    radius = rng.uniform(0.2, 1, knots)
    at = np.linspace(0, 1, 48)
    kernel = np.exp(-0.5 * ((at[:, None] - np.linspace(0, 1, knots)[None]) * knots / 1.1) ** 2)
    wall = (kernel @ radius) / kernel.sum(1)
    height = rng.uniform(1.2, 3.2)
    outer = np.stack([wall, (at - 0.5) * height], -1)
    if rng.random() < 0.5:
        thickness = 0.12 * wall.mean()
        inner = np.stack([np.maximum(wall - thickness, 0.03), (at - 0.5) * height], -1)[::-1]
        inner = inner[inner[:, 1] > (-0.5 + rng.uniform(0.1, 0.6)) * height]
        profile = np.concatenate([[[0, outer[0, 1]]], outer, inner, [[0, inner[-1, 1]]]])
    else:
        profile = np.concatenate([[[0, outer[0, 1]]], outer, [[0, outer[-1, 1]]]])
    return lathe(_even(profile, 72), _circle(), 45)


def turned(rng: np.random.Generator) -> Part:
    """Turned piece with a hard stepped profile, like a chess piece or a bolt."""
    steps = int(rng.integers(3, 7))
    levels = np.cumsum(rng.uniform(0.15, 0.7, steps + 1))
    points = [(0.0, levels[0])]
    for k in range(steps):
        a = rng.uniform(0.25, 1)
        points += [(a, levels[k]), (a if rng.random() < 0.6 else rng.uniform(0.25, 1), levels[k + 1])]
    points.append((0.0, levels[-1]))
    return lathe(_even(np.array(points), 53), _circle(), 35)


def prism(rng: np.random.Generator) -> Part:
    """Regular or irregular polygon extruded with twist and taper."""
    sides = int(rng.integers(3, 9))
    corners = np.linspace(0, 2 * np.pi, sides + 1)
    polygon = np.stack([np.cos(corners), np.sin(corners)], -1) * rng.uniform(0.75, 1, (sides + 1, 1))
    polygon[-1] = polygon[0]
    outline = _even(polygon, 12 * sides + 1)
    height, taper = rng.uniform(0.25, 1.6), rng.uniform(0.3, 1)
    twist = rng.choice([0.0, rng.uniform(-1.5, 1.5)])
    bevel = 0.05
    points = [(0, -height), (1 - bevel, -height), (1, -height + bevel), (taper, height - bevel)]
    profile = _even(np.array([*points, (max(taper - bevel, 0.1), height), (0, height)]), 44)
    part_surface = np.empty((len(profile), len(outline), 3))
    turn = (twist * (profile[:, 1] / height))[:, None]
    x, z = outline[None, :, 0] * profile[:, :1], outline[None, :, 1] * profile[:, :1]
    part_surface[..., 0] = x * np.cos(turn) - z * np.sin(turn)
    part_surface[..., 2] = x * np.sin(turn) + z * np.cos(turn)
    part_surface[..., 1] = profile[:, 1:]
    return grid_part(part_surface, crease_deg=30)


def displaced_sphere(rng: np.random.Generator) -> Part:
    """Ellipsoid moved along its rays by fractal noise: pebbles, asteroids, fruit."""
    noise, ridged = value_noise(rng), rng.random() < 0.3
    frequency, amplitude = rng.uniform(0.8, 3.0), rng.uniform(0.08, 0.4)
    latitude = np.linspace(-np.pi / 2, np.pi / 2, 61)[:, None]
    longitude = _angles(105)[None, :]
    ball = np.stack(
        np.broadcast_arrays(
            np.cos(latitude) * np.cos(longitude), np.sin(latitude), np.cos(latitude) * np.sin(longitude)
        ),
        -1,
    )
    field = noise.fractal(ball * frequency, 3)
    field = 1 - 2 * np.abs(field) if ridged else field
    ball[:, -1] = ball[:, 0]
    surface = ball * (1 + amplitude * field[..., None]) * rng.uniform(0.6, 1, 3)
    surface[:, -1], surface[0], surface[-1] = surface[:, 0], surface[0, 0], surface[-1, 0]
    return grid_part(surface, crease_deg=60)


def supershape(rng: np.random.Generator) -> Part:
    """Gielis's superformula in both angles (held out of training)."""

    def radius(angle: np.ndarray) -> np.ndarray:
        m, n1, n2, n3 = rng.integers(2, 9), rng.uniform(0.7, 4), rng.uniform(0.8, 3), rng.uniform(0.8, 3)
        value = np.abs(np.cos(m * angle / 4)) ** n2 + np.abs(np.sin(m * angle / 4)) ** n3
        return np.clip(value ** (-1 / n1), 0.35, 2.5)

    latitude, longitude = np.linspace(-np.pi / 2, np.pi / 2, 65), _angles(129)
    r2, r1 = radius(latitude)[:, None], radius(longitude)[None, :]
    r1[:, -1] = r1[:, 0]
    lat, lon = latitude[:, None], longitude[None, :]
    surface = np.stack(
        np.broadcast_arrays(r1 * np.cos(lon) * r2 * np.cos(lat), r2 * np.sin(lat), r1 * np.sin(lon) * r2 * np.cos(lat)),
        -1,
    )
    surface[0, :, [0, 2]] = surface[-1, :, [0, 2]] = 0
    return grid_part(surface, crease_deg=50)


def knot(rng: np.random.Generator) -> Part:
    """Tube along a (2, 3), (3, 2), (2, 5) or (3, 4) torus knot (held out of training)."""
    p, q = [(2, 3), (3, 2), (2, 5), (3, 4)][int(rng.integers(4))]
    t = _angles(241)
    minor = rng.uniform(0.35, 0.55)
    ring = 1 + minor * np.cos(q * t)
    center = np.stack([ring * np.cos(p * t), minor * rng.uniform(0.9, 1.4) * np.sin(q * t), ring * np.sin(p * t)], -1)
    tangent = np.gradient(center[:-1], axis=0)
    tangent[[0, -1]] = center[1] - center[-2], center[0] - center[-3]
    tangent = np.concatenate([tangent, tangent[:1]])
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    out = center - np.stack([np.cos(p * t), 0 * t, np.sin(p * t)], -1)
    out -= (out * tangent).sum(1, keepdims=True) * tangent
    out /= np.linalg.norm(out, axis=1, keepdims=True)
    side = np.cross(tangent, out)
    v = np.linspace(0, 2 * np.pi, 25)[:, None, None]
    tube = rng.uniform(0.10, 0.17)
    return grid_part(center[None] + tube * (np.cos(v) * out[None] + np.sin(v) * side[None]), wrap_rows=True)


def gear(rng: np.random.Generator) -> Part:
    """Toothed wheel with a hub (held out of training)."""
    teeth, depth, height = int(rng.integers(6, 15)), rng.uniform(0.12, 0.3), rng.uniform(0.12, 0.5)
    steps = np.array([0.0, 0.2, 0.32, 0.68, 0.8])
    radii = np.array([1 - depth, 1 - depth, 1.0, 1.0, 1 - depth])
    at = (np.arange(teeth)[:, None] + steps[None]).reshape(-1) / teeth * 2 * np.pi
    polygon = np.stack([np.cos(at), np.sin(at)], -1) * np.tile(radii, teeth)[:, None]
    outline = np.concatenate([polygon, polygon[:1]])
    hub, rise = rng.uniform(0.2, 0.45), rng.uniform(-0.6, 0.9) * height
    points = [(0, -height), (0.95, -height), (1, -height + 0.05), (1, height - 0.05), (0.95, height)]
    points += [(hub, height), (hub, height + rise), (0, height + rise)]
    return lathe(_even(np.array(points), 40), outline, 28)


TRAIN_FAMILIES = {
    f.__name__: f
    for f in (superquadric, rounded_box, torus, cylinder, capsule, revolution, turned, prism, displaced_sphere)
}
HELD_OUT_FAMILIES = {f.__name__: f for f in (supershape, knot, gear)}
