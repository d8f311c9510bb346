"""Environments and directions that several tests look along."""

import numpy as np

from unirender.light.environment import environment_directions


def smooth_environment(height: int = 32, width: int = 64) -> np.ndarray:
    d = environment_directions(height, width)
    lobes = [np.exp(4 * (d @ axis - 1)) for axis in np.eye(3, dtype=np.float32)]
    return (0.2 + np.stack(lobes, axis=-1)).astype(np.float32)


def random_directions(count: int, seed: int = 3) -> np.ndarray:
    """Uniform on the sphere."""
    d = np.random.default_rng(seed).normal(size=(count, 3))
    return (d / np.linalg.norm(d, axis=-1, keepdims=True)).astype(np.float32)
