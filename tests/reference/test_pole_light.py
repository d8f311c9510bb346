"""Lights in the first or the last row of their map, which Mitsuba would hardly draw; every other light is passed on."""

import numpy as np
import pytest
import reference_scenes as scenes
import torch

from unirender.light.environment import environment_directions, sample_environment, texel_solid_angles
from unirender.light.for_mitsuba import has_bright_pole
from unirender_reference import principled
from unirender_reference.envmap import envmap_data, envmap_rows
from unirender_reference.lights import bundled_lights, make_light
from unirender_reference.render import Renderer
from unirender_reference.shade import shade, shade_gradients

SIZE, SPP = 24, 1024
SKY = 0.05


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


@pytest.mark.parametrize("rows", [(0,), pytest.param((0, -1), marks=pytest.mark.long)])
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


def quadrature(height: int, row: int) -> tuple[np.ndarray, np.ndarray]:
    """Directions and weights (radiance times solid angle) of `bright_pole`, finest where its radiance changes."""
    step = np.pi / (height - 1)
    edges = np.concatenate([np.linspace(0, step, 25), np.linspace(step, np.pi, 61)[1:]])
    theta, phi = np.meshgrid((edges[1:] + edges[:-1]) / 2, (np.arange(48) + 0.5) * np.pi / 24, indexing="ij")
    radiance = SKY + (pole_radiance(height) - SKY) * np.maximum(1 - theta / step, 0)
    weight = radiance * np.sin(theta) * np.diff(edges)[:, None] * (np.pi / 24)
    up = np.cos(theta) * (1 if row == 0 else -1)
    towards = np.stack([np.sin(theta) * np.sin(phi), up, np.sin(theta) * np.cos(phi)], -1)
    return towards.reshape(-1, 3), weight.ravel()


def pole_radiance(height: int) -> float:
    return float(3 / texel_solid_angles(height, 2 * height)[0].sum())


def bright_pole(height: int, row: int) -> np.ndarray:
    environment = np.full((height, 2 * height, 3), SKY, np.float32)
    environment[row] = pole_radiance(height)
    return environment


@pytest.mark.parametrize(("height", "row"), [(16, 0), (16, -1), (64, 0), (512, -1)])
def test_a_small_bright_pole_in_a_dim_sky(ball: Renderer, height: int, row: int) -> None:
    """Most samples missed it: d was 5 % (16 rows) to 76 % (512) too dark, without a word."""
    environment = bright_pole(height, row)
    towards, weight = quadrature(height, row)
    geometry = ball.geometry(64, 0, (1.0, 0.0))
    maps = geometry.require("mask", "normal", "albedo")
    inside = maps["mask"][..., 0] > 0.99
    normal = maps["normal"][inside].astype(float)
    diffuse = np.maximum(normal @ towards.T, 0) @ weight / np.pi
    assert ball.diffuse(environment, 256).mean[inside][:, 0].mean() == pytest.approx(diffuse.mean(), rel=0.01)
    # shade: our own BSDF over the same directions
    view = ball.camera.view_directions(SIZE, SIZE)[inside].astype(float)[::5]
    z = normal[::5] / np.linalg.norm(normal[::5], axis=-1, keepdims=True)
    x = np.cross(z, view)
    x /= np.linalg.norm(x, axis=-1, keepdims=True)
    frame = torch.from_numpy(np.stack([x, np.cross(z, x), z], axis=1))
    wi = (frame @ torch.from_numpy(view)[..., None])[..., 0]
    wo = torch.einsum("pij,dj->pdi", frame, torch.from_numpy(towards))
    one = torch.ones(1, dtype=torch.float64)
    found = principled.evaluate(wi[:, None].expand_as(wo), wo, one.expand(1, 1, 3), one[None], 0 * one[None])
    expected = float((found[..., 0] @ torch.from_numpy(weight)).mean())
    assert shade(geometry, environment, 256)[inside][::5, 0].mean() == pytest.approx(expected, rel=0.01)


def test_every_other_light_is_passed_on_bit_for_bit() -> None:
    lights = [light.environment for light in bundled_lights("test")]
    lights += [make_light(seed, "train").environment for seed in (0, 3, 158, 347)]  # the last has the brightest pole
    for environment in (scenes.environment(), np.ones((3, 4, 3), np.float32), *lights):
        assert envmap_rows(environment) is environment
        np.testing.assert_array_equal(envmap_data(environment)[:, 1:-1], environment)


def test_a_light_with_a_bright_pole_is_the_same_light_on_a_finer_grid() -> None:
    nearly_dark = pole_light(0)
    nearly_dark[1, 5, 2] = 1e-9
    towards = environment_directions(61, 90)
    for environment in (pole_light(0), pole_light(-1), pole_light(0, -1), pole_light(0, 7), nearly_dark):
        given = environment.copy()
        assert has_bright_pole(environment)
        finer = envmap_rows(environment)
        assert finer.shape == (31, 32, 3)
        np.testing.assert_array_equal(finer[::2], environment)
        found, expected = (sample_environment(light, towards) for light in (finer, environment))
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-4)
        np.testing.assert_array_equal(environment, given)
