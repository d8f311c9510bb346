"""What several tests of the model package look at."""

import numpy as np
import pytest
from synthetic_shards import sphere

from unirender.light.environment import environment_directions
from unirender.light.surface_light import diffuse_light


@pytest.fixture
def maps() -> dict[str, np.ndarray]:
    """A lopsided scene: no symmetry hides a mistake."""
    rng = np.random.default_rng(2)
    shape = sphere(16, rng)
    normal, mask = shape.require("normal", "mask").values()
    environment = rng.uniform(0, 2, (33, 64, 3)).astype(np.float32)
    environment *= 0.2 + np.maximum(environment_directions(33, 64) @ np.array([0.6, 0.5, 0.6]), 0)[..., None]
    environment[0], environment[-1] = environment[0].mean(axis=0), environment[-1].mean(axis=0)
    albedo = (rng.uniform(0, 1, (16, 16, 3)) * mask).astype(np.float32)
    diffuse = diffuse_light(normal, environment)
    intrinsics = shape.replace(
        albedo=albedo,
        roughness=mask * np.float32(0.3),
        metallic=mask * rng.uniform(0, 1, (16, 16, 1)).astype(np.float32),
        specular=diffuse[..., ::-1] * 0.5,
        diffuse=diffuse,
        environment=environment,
    )
    return {"image": albedo * diffuse} | intrinsics.maps
