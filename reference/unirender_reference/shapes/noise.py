"""Smooth random fields on R^3, for displacement and for solid textures."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

LATTICE = 32


@dataclass(frozen=True)
class ValueNoise:
    """Value noise on a periodic lattice with quintic interpolation; values in [-1, 1]."""

    lattice: Float[np.ndarray, "k k k"]
    offset: Float[np.ndarray, "3"]

    def __call__(self, points: Float[np.ndarray, "*shape 3"]) -> Float[np.ndarray, "*shape"]:
        position = points.astype(np.float32) + self.offset
        cell = np.floor(position)
        t = position - cell
        t = t * t * t * (t * (t * 6 - 15) + 10)
        low = cell.astype(np.int32) % LATTICE
        high = (low + 1) % LATTICE
        corner = [(low[..., axis], high[..., axis]) for axis in range(3)]
        tx, ty, tz = t[..., 0], t[..., 1], t[..., 2]

        def along_x(iy: int, iz: int) -> np.ndarray:
            y, z = corner[1][iy], corner[2][iz]
            a, b = self.lattice[corner[0][0], y, z], self.lattice[corner[0][1], y, z]
            return a + (b - a) * tx

        near = along_x(0, 0) + (along_x(1, 0) - along_x(0, 0)) * ty
        far = along_x(0, 1) + (along_x(1, 1) - along_x(0, 1)) * ty
        return near + (far - near) * tz

    def fractal(self, points: Float[np.ndarray, "*shape 3"], octaves: int) -> Float[np.ndarray, "*shape"]:
        """Sum of `octaves` copies, each at twice the frequency and half the amplitude, scaled into [-1, 1]."""
        total = np.zeros(points.shape[:-1], np.float32)
        amplitude = 1.0
        for octave in range(octaves):
            total += amplitude * self(points * 2.0**octave + 7.31 * octave)
            amplitude *= 0.5
        return total * (0.5 / (1 - 0.5**octaves))


def value_noise(rng: np.random.Generator) -> ValueNoise:
    """Draws a noise field."""
    lattice = rng.uniform(-1, 1, (LATTICE,) * 3).astype(np.float32)
    return ValueNoise(lattice, rng.uniform(0, LATTICE, 3).astype(np.float32))


def random_direction(rng: np.random.Generator) -> Float[np.ndarray, "3"]:
    """A unit vector, uniform over the sphere."""
    vector = rng.normal(size=3)
    return vector / np.linalg.norm(vector)


def soft_step(value: np.ndarray, width: float) -> np.ndarray:
    """0 to 1 as the value goes from -width / 2 to width / 2, linear between."""
    return np.clip(value / width + 0.5, 0, 1)
