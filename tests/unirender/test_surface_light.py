"""The light that a surface receives: closed forms, invariants and Monte Carlo."""

import tracemalloc

import numpy as np
import pytest
from environments import random_directions, smooth_environment

from unirender.camera import Camera
from unirender.color import image_srgb
from unirender.errors import UnirenderError
from unirender.light.environment import environment_directions, sample_environment, texel_solid_angles
from unirender.light.lobes import lobe_matrix
from unirender.light.resampling import resample_environment
from unirender.light.surface_light import SHARP_ROUGHNESS, diffuse_light, lobe_light, specular_light

RNG = np.random.default_rng(4)


def sphere_normals(size: int = 24) -> np.ndarray:
    y, x = np.mgrid[:size, :size]
    x, y = (x - size / 2 + 0.5) / (size * 0.46), -(y - size / 2 + 0.5) / (size * 0.46)
    inside = x**2 + y**2 < 0.95
    normal = np.stack([x, y, np.sqrt(np.maximum(1 - x**2 - y**2, 0))], axis=-1)
    return np.where(inside[..., None], normal, 0).astype(np.float32)


def test_diffuse_light_of_a_constant_and_of_a_gradient() -> None:
    normal = sphere_normals()
    inside = normal.any(axis=-1)
    d = diffuse_light(normal, np.full((16, 32, 3), 2.0, dtype=np.float32))
    np.testing.assert_allclose(d[inside], 2.0, rtol=5e-3)
    assert (d[~inside] == 0).all()
    # radiance 1 + a.l gives irradiance / pi = 1 + 2/3 a.n (second Lambertian coefficient)
    axis = np.array([0.3, 0.5, -0.2], dtype=np.float32)
    environment = np.repeat((1 + environment_directions(64, 128) @ axis)[..., None], 3, axis=-1)
    expected = 1 + 2 / 3 * (normal @ axis)
    np.testing.assert_allclose(diffuse_light(normal, environment)[inside][:, 0], expected[inside], rtol=0, atol=0.01)


def test_mirror_limit_reads_the_reflected_radiance() -> None:
    normal, environment = sphere_normals(), smooth_environment()
    inside = normal.any(axis=-1)
    view = Camera().view_directions(*normal.shape[:2])
    reflected = 2 * np.sum(normal * view, axis=-1, keepdims=True) * normal - view
    s = specular_light(normal, 0.03, environment)
    expected = sample_environment(environment, reflected)
    central = inside & (np.sum(normal * view, axis=-1) > 0.5)
    np.testing.assert_allclose(s[central], expected[central], rtol=0.03)


@pytest.mark.parametrize("roughness", [0.2, 0.4, 0.6])
def test_specular_light_against_monte_carlo(roughness: float) -> None:
    """Uniform directions on the sphere, the GGX formula written out again."""
    normal = np.zeros((2, 2, 3), dtype=np.float32)
    normal[..., :] = np.array([0.5, 0.3, 0.812404])
    normal[0, 1] = [0.0, 0.0, 1.0]
    normal[1, 0] = [-0.6, 0.0, 0.8]
    environment, view = smooth_environment(), Camera().view_directions(2, 2)
    alpha = roughness**2
    light = random_directions(500_000)
    radiance = sample_environment(environment, light)
    s = specular_light(normal, roughness, environment)
    for i, j in np.ndindex(2, 2):
        n, v = normal[i, j], view[i, j]
        h = v + light
        h /= np.linalg.norm(h, axis=-1, keepdims=True)
        cos_l, cos_v = light @ n, v @ n
        d = alpha**2 / (np.pi * ((h @ n) ** 2 * (alpha**2 - 1) + 1) ** 2)
        g = [2 * c / (c + np.sqrt(alpha**2 + (1 - alpha**2) * c**2)) for c in (np.maximum(cos_l, 1e-6), cos_v)]
        f_cos = np.where(cos_l > 0, d * g[0] * g[1] / (4 * cos_v), 0)
        samples = 4 * np.pi * f_cos[:, None] * radiance
        error = samples.std(axis=0) / np.sqrt(len(light))
        np.testing.assert_array_less(np.abs(s[i, j] - samples.mean(axis=0)), 0.015 * s[i, j] + 4 * error)


def test_specular_light_twin_a_rougher_lobe_is_told_apart() -> None:
    normal, environment = sphere_normals(), smooth_environment()
    inside = normal.any(axis=-1)
    a, b = (specular_light(normal, r, environment)[inside] for r in (0.5, 0.56))
    assert np.median(np.abs(a - b) / a) > 0.015


def test_sharp_and_wide_lobes_meet() -> None:
    normal, environment = sphere_normals(48), smooth_environment()
    inside = normal[..., 2] > 0.4
    a, b = (
        image_srgb(0.5 * specular_light(normal, r, environment))[inside]
        for r in (SHARP_ROUGHNESS - 1e-4, SHARP_ROUGHNESS + 1e-4)
    )
    assert -10 * np.log10(np.mean((a - b) ** 2)) > 35


@pytest.mark.parametrize("roughness", [0.1, SHARP_ROUGHNESS - 0.01, SHARP_ROUGHNESS])
def test_no_energy_is_made(roughness: float) -> None:
    """Under uniform light a reflector of F = 1 gives back no more than it gets, at grazing angles too."""
    furnace = specular_light(sphere_normals(48), roughness, np.ones((64, 128, 3), dtype=np.float32))
    assert furnace.max() < 1.03


@pytest.mark.parametrize("roughness", [0.02, 0.15, 0.44, 0.5, 1.0])
def test_a_white_furnace_seen_from_ahead(roughness: float) -> None:
    """Its closed form: with v = n, l is at twice the angle of h, so that f cos is D(theta / 2) G1(theta) / 4.

    Where the lobe is sharp, samples and grid must make up the whole of it between them.
    """
    a2, theta = roughness**4, (np.arange(100_000) + 0.5) * (np.pi / 2 / 100_000)
    d = a2 / (np.pi * (np.cos(theta / 2) ** 2 * (a2 - 1) + 1) ** 2)
    g = 2 * np.cos(theta) / (np.cos(theta) + np.sqrt(a2 + (1 - a2) * np.cos(theta) ** 2))
    expected = (d * g / 4 * 2 * np.pi * np.sin(theta)).mean() * np.pi / 2
    ahead = np.array([[0, 0, 1]], np.float32)
    found = lobe_light(ahead, ahead, roughness, np.ones((64, 128, 3), np.float32))
    np.testing.assert_allclose(found, expected, rtol=0, atol=0.02)
    if roughness == 1:
        assert expected == pytest.approx(1 - np.log(2), abs=1e-6)


@pytest.mark.parametrize("roughness", [0.02, 0.15])
def test_a_sharp_reflector_gives_back_a_white_furnace(roughness: float) -> None:
    normal = sphere_normals(16)[sphere_normals(16)[..., 2] > 0.5]
    view = np.tile(np.array([0, 0, 1], np.float32), (len(normal), 1))
    furnace = lobe_light(normal, view, roughness, np.ones((64, 128, 3), np.float32))
    np.testing.assert_allclose(furnace, 1, rtol=0, atol=0.03)


@pytest.mark.parametrize("roughness", [0.1, 0.6])
def test_the_light_of_a_point_does_not_depend_on_those_beside_it(roughness: float) -> None:
    """Points of similar normals share the texels that they look at: none is left out that one of them sees."""
    normal = random_directions(300).astype(np.float32)
    normal[:, 2] = np.abs(normal[:, 2])
    view = np.tile(np.array([0, 0, 1], np.float32), (300, 1))
    environment = RNG.gamma(0.2, 1, (32, 64, 3)).astype(np.float32)
    together = lobe_light(normal, view, roughness, environment)
    for i in range(0, 300, 10):
        alone = lobe_light(normal[i : i + 1], view[i : i + 1], roughness, environment)
        np.testing.assert_allclose(together[i], alone[0], rtol=1e-3, atol=1e-6)


@pytest.mark.parametrize("alpha", [0.1, 1.0])
def test_reflection_is_reciprocal(alpha: float) -> None:
    """f(l, v) = f(v, l): light and viewer can change places."""
    shape, n = (16, 32), np.tile(np.array([[0], [0.6], [0.8]], np.float32), 40)
    directions = environment_directions(*shape).reshape(-1, 3).T
    cosine = n[:, 0] @ directions
    above = np.flatnonzero(cosine > 0.1)[::3][:40]
    takes = lobe_matrix(n, directions[:, above], np.full(40, alpha, np.float32), shape)
    f = (takes / (texel_solid_angles(*shape).reshape(-1) * np.maximum(cosine, 1e-3)))[:, above]
    np.testing.assert_allclose(f, f.T, rtol=1e-3)
    assert f.max() > 1.2 * f.min()


@pytest.mark.parametrize("roughness", [0.05, 0.5])
def test_the_mirror_image_of_a_scene_has_the_mirrored_light(roughness: float) -> None:
    normal = sphere_normals(30)
    environment = RNG.gamma(0.3, 1, (16, 32, 3)).astype(np.float32)
    seen = specular_light(normal, roughness, environment)
    flipped = normal[:, ::-1] * np.array([-1, 1, 1], dtype=np.float32)
    mirrored = specular_light(flipped, roughness, environment[:, ::-1].copy())
    np.testing.assert_allclose(mirrored[:, ::-1], seen, rtol=0, atol=3e-4 * seen.max())
    assert np.abs(mirrored - seen).max() > 0.05 * seen.max()


def test_a_large_map_costs_little_memory_and_gives_the_light_of_its_small_version() -> None:
    """1024 x 2048 texels with a sun: dense resampling matrices alone would be 2 GB."""
    normal, environment = sphere_normals(), smooth_environment(1024, 2048)
    axis = np.array([0.48, 0.6, 0.64], dtype=np.float32)
    environment += 5 * np.exp(300 * (environment_directions(1024, 2048) @ axis - 1))[..., None]

    def lights(environment: np.ndarray) -> list[np.ndarray]:
        rough = (specular_light(normal, r, environment) for r in (0.15, 0.3, 0.6))
        return [image_srgb(0.5 * light) for light in (diffuse_light(normal, environment), *rough)]

    tracemalloc.start()
    large = lights(environment)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 400e6
    small, twin = lights(resample_environment(environment, (256, 512))), lights(np.roll(environment, 100, axis=1))
    for a, b, other in zip(large, small, twin, strict=True):
        assert -10 * np.log10(np.mean((a - b) ** 2)) > 40
        assert -10 * np.log10(np.mean((a - other) ** 2)) < 40


def test_light_is_linear_and_needs_a_map() -> None:
    normal = sphere_normals()
    a, b = smooth_environment(), RNG.random((32, 64, 3), dtype=np.float32)
    for f in (diffuse_light, lambda n, e: specular_light(n, 0.6, e), lambda n, e: specular_light(n, 0.1, e)):
        np.testing.assert_allclose(f(normal, 2 * a + b), 2 * f(normal, a) + f(normal, b), rtol=1e-3, atol=1e-4)
    with pytest.raises(UnirenderError, match="at least 2 x 2"):
        diffuse_light(normal, np.ones((1, 8, 3), dtype=np.float32))


def sun(height: int = 64) -> np.ndarray:
    """A dim sky and one bright texel, in front of the object and above."""
    environment = np.full((height, 2 * height, 3), 0.2, dtype=np.float32)
    environment[height // 4, height] = 3000.0
    return environment


@pytest.mark.parametrize("roughness", [0.1, 0.3])
def test_sharp_lobes_see_a_sun_in_their_tails(roughness: float) -> None:
    """Against the lobe summed over a map refined 8 times, bilinear as the map itself."""
    directions = np.array([[0, 0, 1], [0.3, 0.3, 0.9], [0, 0.38, 0.92], [0.1, 0.5, 0.85]], dtype=np.float32)
    n = directions / np.linalg.norm(directions, axis=-1, keepdims=True)
    v = np.repeat(np.array([[0, 0, 1]], dtype=np.float32), len(n), axis=0)
    made = lobe_light(n, v, np.full(len(n), roughness, np.float32), sun())
    fine = (8 * 63 + 1, 8 * 128)
    light = environment_directions(*fine).reshape(-1, 3).astype(np.float64)
    radiance = sample_environment(sun(), light.astype(np.float32)) * texel_solid_angles(*fine).reshape(-1, 1)
    alpha = roughness**2
    for normal, view, found in zip(n.astype(np.float64), v.astype(np.float64), made, strict=True):
        h = view + light
        h /= np.maximum(np.linalg.norm(h, axis=-1, keepdims=True), 1e-9)
        cos_l, cos_v = light @ normal, float(view @ normal)
        d = alpha**2 / (np.pi * ((h @ normal) ** 2 * (alpha**2 - 1) + 1) ** 2)
        g = [2 * c / (c + np.sqrt(alpha**2 + (1 - alpha**2) * c**2)) for c in (np.maximum(cos_l, 1e-6), cos_v)]
        expected = np.where(cos_l > 0, d * g[0] * g[1] / (4 * cos_v), 0) @ radiance
        np.testing.assert_allclose(found, expected, rtol=0.12)
    other = lobe_light(n, v, np.full(len(n), 1.3 * roughness, np.float32), sun())
    assert (np.abs(other / made - 1).max(axis=-1) > 0.12).sum() >= 2, "twin: another roughness is told apart"


def test_a_sharp_lobe_is_averaged_over_a_curved_pixel() -> None:
    """The light of a coarse sphere is the mean of a fine one's, and not what its mean normals alone reflect."""
    size, roughness = 24, 0.1
    light = np.random.default_rng(0).random((32, 64, 3), dtype=np.float32) ** 4
    coarse = sphere_normals(size)
    fine = specular_light(sphere_normals(4 * size), roughness, light).reshape(size, 4, size, 4, 3).mean(axis=(1, 3))
    inside = coarse[..., 2] > 0.5
    view = Camera().view_directions(size, size)
    points = lobe_light(coarse[inside], view[inside], np.full(inside.sum(), roughness, np.float32), light)
    error, twin = (np.abs(x - fine[inside]).mean() for x in (specular_light(coarse, roughness, light)[inside], points))
    assert error < 0.6 * twin


def two_sides(tilt: float) -> tuple[np.ndarray, np.ndarray]:
    """A vertical crease between two planes, and its left side alone; convex for a positive tilt."""
    both = np.zeros((8, 8, 3), np.float32)
    both[:, :4], both[:, 4:] = [-tilt, 0, np.sqrt(1 - tilt**2)], [tilt, 0, np.sqrt(1 - tilt**2)]
    left = both.copy()
    left[:, 4:] = 0
    return both, left


@pytest.mark.parametrize("turned", [False, True], ids=["upright", "lying"])
@pytest.mark.parametrize(("tilt", "apart"), [(0.6, True), (0.4, False), (-0.3, True), (-0.2, False)])
def test_pixels_across_an_edge_are_of_different_surfaces(tilt: float, apart: bool, turned: bool) -> None:
    """A crease sharper than the bound does not blur either side; the bound is lower where it is concave."""
    sides = two_sides(tilt)
    if turned:  # clockwise: what looked to the left looks up
        sides = tuple(np.rot90(n, -1) @ np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1]], np.float32) for n in sides)
    inside = np.any(sides[1] != 0, axis=-1)
    both, alone = (specular_light(normal, 0.1, smooth_environment())[inside] for normal in sides)
    assert np.allclose(both, alone, rtol=1e-4) == apart


def rounded_edge(size: int, radius: float) -> np.ndarray:
    """Two planes that meet in a rounded edge of `radius` pixels of a picture 16 wide, drawn at `size`."""
    x = ((np.arange(size) + 0.5) / size - 0.52) * 16
    slope = 0.45 * np.clip(x / radius, -1, 1)
    normal = np.stack([np.sin(slope), np.zeros(size), np.cos(slope)], axis=-1)
    return np.repeat(normal[None], size, axis=0).astype(np.float32)


@pytest.mark.parametrize("roughness", [0.1, 0.5])
def test_light_of_an_edge_as_wide_as_a_pixel(roughness: float) -> None:
    """The light of mean normals is nearer to the mean of a fine picture's light than that of points is."""
    normal = rounded_edge(16 * 16, 0.7)
    mean = normal.reshape(16, 16, 16, 16, 3).mean(axis=(1, 3))
    mean /= np.linalg.norm(mean, axis=-1, keepdims=True)
    light = np.full((64, 128, 3), 0.2, np.float32)
    light[12:50, 60:68] = 5.0
    n, v = (x.reshape(-1, 3) for x in (normal, Camera().view_directions(256, 256)))
    fine = lobe_light(n[::7], v[::7], np.full(len(n[::7]), roughness, np.float32), light)
    total, count = np.zeros((256, 3)), np.zeros((256, 1))
    pixel = (np.arange(len(n))[::7] // 256 // 16) * 16 + np.arange(len(n))[::7] % 256 // 16
    np.add.at(total, pixel, fine)
    np.add.at(count, pixel, 1)
    true = image_srgb((total / count).astype(np.float32))
    coarse_view = Camera().view_directions(16, 16).reshape(-1, 3)
    points = lobe_light(mean.reshape(-1, 3), coarse_view, np.full(256, roughness, np.float32), light)
    made = specular_light(mean, roughness, light).reshape(-1, 3)
    error, twin = (np.sqrt(np.mean((image_srgb(x) - true) ** 2)) for x in (made, points))
    assert error < 0.5 * twin, f"{error:.4f}, points {twin:.4f}"


@pytest.mark.parametrize("roughness", [0.1, 0.5])
def test_noisy_normals_are_not_made_worse(roughness: float) -> None:
    """Of normals with noise of 3 degrees, as a network predicts them, averages are nearer to the truth than points."""
    normal, light = sphere_normals(48), (RNG.random((32, 64, 3), dtype=np.float32) ** 8 * 4).astype(np.float32)
    noise = np.random.default_rng(1).normal(scale=np.deg2rad(3), size=normal.shape)
    there = np.any(normal != 0, axis=-1)
    noisy = normal + noise * there[..., None]
    noisy = (noisy / np.maximum(np.linalg.norm(noisy, axis=-1, keepdims=True), 1e-6)).astype(np.float32)
    true = image_srgb(specular_light(normal, roughness, light))[there]
    made = image_srgb(specular_light(noisy, roughness, light))[there]
    view = Camera().view_directions(48, 48)[there]
    points = image_srgb(lobe_light(noisy[there], view, np.full(len(view), roughness, np.float32), light))
    assert np.mean((made - true) ** 2) < 1.02 * np.mean((points - true) ** 2)


@pytest.mark.parametrize("shape", [(1, 1), (1, 5), (4, 2)])
def test_small_pictures_and_single_pixels(shape: tuple[int, int]) -> None:
    normal = np.zeros((*shape, 3), np.float32)
    assert (specular_light(normal, 0.1, smooth_environment()) == 0).all()
    normal[0, 0] = [0, 0.6, 0.8]
    view = Camera().view_directions(*shape)[:1, 0]
    for roughness in (0.1, 0.5):
        s = specular_light(normal, roughness, smooth_environment())
        point = lobe_light(normal[0, :1], view, np.full(1, roughness, np.float32), smooth_environment())
        np.testing.assert_allclose(s[0, 0], point[0], rtol=0.1)
        assert (s.reshape(-1, 3)[1:] == 0).all()
