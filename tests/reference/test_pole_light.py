"""A light in the first row of its map alone, of which Mitsuba would draw no texel; every other light is passed on."""

import numpy as np
import pytest
import reference_scenes as scenes

from unirender.lighting import sample_environment
from unirender_reference.render import Renderer
from unirender_reference.scene import envmap_data, envmap_rows
from unirender_reference.shade import shade, shade_gradients

SIZE, SPP = 24, 1024


def pole_light(*rows: int) -> np.ndarray:
    environment = np.zeros((16, 32, 3), np.float32)
    environment[list(rows)] = 40
    return environment


@pytest.fixture(scope="module")
def ball() -> Renderer:
    """White, so that its picture is its d, nearly."""
    return Renderer(scenes.sphere((1.0, 1.0, 1.0), subdivisions=4), resolution=SIZE)


def closed_diffuse(normal: np.ndarray, environment: np.ndarray) -> float:
    """Mean d of unit normals, by quadrature over the sphere."""
    rows, columns = 720, 1440
    theta, phi = np.meshgrid(
        (np.arange(rows) + 0.5) * np.pi / rows, (np.arange(columns) + 0.5) * 2 * np.pi / columns, indexing="ij"
    )
    towards = np.stack([np.sin(theta) * np.sin(phi), np.cos(theta), -np.sin(theta) * np.cos(phi)], -1).reshape(-1, 3)
    radiance = sample_environment(environment, towards.astype(np.float32))[:, 0].astype(float)
    lit = radiance > 0
    weight = (radiance * np.sin(theta).ravel() * (np.pi / rows) * (2 * np.pi / columns))[lit]
    return float((np.maximum(normal.astype(float) @ towards[lit].T, 0) @ weight).mean() / np.pi)


@pytest.mark.parametrize("rows", [(0,), (-1,), (0, -1)])
def test_a_light_at_the_poles_is_seen(ball: Renderer, rows: tuple[int, ...]) -> None:
    environment = pole_light(*rows)
    geometry = ball.geometry(64, 0, (1.0, 0.0))
    mask = geometry.require("mask")["mask"]
    inside = mask[..., 0] == 1
    right = closed_diffuse(geometry.require("normal")["normal"][inside], environment)
    assert right == pytest.approx(0.1 * len(rows), rel=0.04)
    assert ball.diffuse(environment, SPP).mean[inside].mean() == pytest.approx(right, rel=0.01)
    # The picture and `shade` against the same light over a dim sky, which Mitsuba could always sample.
    dim = environment + np.float32(1e-3)
    for name, buffer in (
        ("image", lambda light: ball.image(light, 1.0, 0.0, SPP).mean[..., :3]),
        ("specular", lambda light: ball.specular(light, 0.5, SPP).mean),
        ("shade", lambda light: shade(geometry, light, 256)),
    ):
        found, expected = (float(buffer(light)[inside].mean()) for light in (environment, dim))
        assert found == pytest.approx(expected, rel=0.04), name
        assert found > 0.5 * right, name


def test_the_gradient_of_such_a_light(ball: Renderer) -> None:
    """The image is linear in the light: its derivative along the light is the image itself."""
    environment = pole_light(0)
    geometry = ball.geometry(64, 0, (1.0, 0.0))
    image = shade(geometry, environment, 256)
    found = shade_gradients(geometry, np.ones_like(image), environment, spp=256, wrt=("environment",)).environment
    assert found is not None
    assert float((found * environment).sum()) == pytest.approx(float(image.sum()), rel=0.01)


def test_every_other_light_is_passed_on_bit_for_bit() -> None:
    below = pole_light(0)
    below[1, 5, 2] = 1e-9
    for environment in (scenes.environment(), pole_light(-1), pole_light(0, -1), pole_light(0, 7), below):
        np.testing.assert_array_equal(envmap_rows(environment), environment)
        np.testing.assert_array_equal(envmap_data(environment)[:, 1:-1], environment)
    given = pole_light(0)
    changed = envmap_rows(given)
    assert not given[1:].any(), "the caller's array is left alone"
    assert np.abs(changed - given).max() <= 1e-6 * given.max()
    assert changed[1].any()
    assert not changed[2:].any()
