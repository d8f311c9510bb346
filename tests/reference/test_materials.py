"""Materials: textures texel by texel in the buffers, normal maps against shading normals, maps against scalars."""

import dataclasses
import hashlib
from typing import Any

import numpy as np
import pytest
import reference_scenes as scenes
from scipy import ndimage

from unirender.errors import UnirenderError
from unirender.intrinsics import Intrinsics
from unirender.light.environment import environment_directions
from unirender.light.surface_light import diffuse_light
from unirender_reference import effects, materials
from unirender_reference.backend import mitsuba
from unirender_reference.integrators import python_integrator
from unirender_reference.passes import Estimate, integrator_passes, ratio_estimate
from unirender_reference.render import Renderer, SceneSpec, render_sample, scene_hash
from unirender_reference.scene import object_scene
from unirender_reference.shapes import MeshObject
from unirender_reference.statistics import ZTest, z_test

SIZE, GRID = 48, 33
HALF = 2**-0.5  # half the side of a square whose corners lie on the unit sphere


def quad(mirrored: bool = False, normals: np.ndarray | None = None, /, **maps: np.ndarray) -> MeshObject:
    """A square that faces the camera; `mirrored` lays the picture on it the wrong way round (u runs to the left).

    Args:
        mirrored: u runs to the left.
        normals: (GRID, GRID, 3) shading normals of its vertices, first row on top.
        maps: fields of `MeshObject`.
    """
    row, column = np.indices((GRID, GRID)).reshape(2, -1) / (GRID - 1)
    vertices = np.stack([(2 * column - 1) * HALF, (1 - 2 * row) * HALF, 0 * row], -1).astype(np.float32)
    uv = np.stack([1 - column if mirrored else column, row], -1).astype(np.float32)
    index = np.arange(GRID**2).reshape(GRID, GRID)
    a, b, c, d = index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]
    faces = np.concatenate([np.stack(t, -1).reshape(-1, 3) for t in ((a, b, c), (a, c, d))]).astype(np.int32)
    shading = np.tile(np.array([0, 0, 1], np.float32), (GRID**2, 1)) if normals is None else normals.reshape(-1, 3)
    fields = {"albedo": np.full(3, 0.6, np.float32), **maps}
    return MeshObject("quad", "mesh", vertices, faces, shading, uv, **fields)


def texture(seed: int, *shape: int) -> np.ndarray:
    return np.random.default_rng(seed).uniform(0.1, 0.9, shape).astype(np.float32)


def bumps(seed: int, height: int = 9, width: int = 11) -> np.ndarray:
    """A normal map whose normals lean up to about 25 degrees."""
    lean = np.random.default_rng(seed).uniform(-0.33, 0.33, (height, width, 2))
    normal = np.concatenate([lean, np.ones((height, width, 1))], axis=-1)
    return (normal / np.linalg.norm(normal, axis=-1, keepdims=True)).astype(np.float32)


def seen(picture: np.ndarray, renderer: Renderer, per_pixel: int = 16) -> tuple[np.ndarray, np.ndarray]:
    """What the camera sees of a picture on the square: bilinear samples (h, w, k, c), and where pixels are filled."""
    size = renderer.resolution
    reach = renderer.camera.distance() * np.tan(np.radians(renderer.camera.fov_deg / 2))
    at = (np.arange(size * per_pixel) + 0.5) / (size * per_pixel)
    place = 0.5 + (at - 0.5) * reach / HALF  # u along columns, v along rows
    filled = ((place > 0.06) & (place < 0.94)).reshape(size, per_pixel).all(1)  # wrapped borders aside
    h, w, c = picture.shape
    row, column = np.meshgrid(place * h - 0.5, place * w - 0.5, indexing="ij")
    channels = [ndimage.map_coordinates(picture[..., k].astype(float), [row, column], order=1) for k in range(c)]
    fine = np.stack(channels, -1).reshape(size, per_pixel, size, per_pixel, c)
    return fine.swapaxes(1, 2).reshape(size, size, -1, c), filled[:, None] & filled[None]


def unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-12)


def worst(maps: Intrinsics, name: str, expected: np.ndarray, filled: np.ndarray) -> float:
    return float(np.abs(maps.require(name)[name] - expected)[filled].max())


@pytest.mark.parametrize("name", ["albedo", "roughness", "metallic"])
def test_textures_come_back_texel_by_texel(name: str) -> None:
    maps = {"albedo": texture(1, 8, 7, 3), "roughness": texture(2, 9, 6), "metallic": texture(3, 7, 8)}
    renderer = Renderer(quad(**maps), resolution=SIZE)
    picture = maps[name] if name == "albedo" else maps[name][..., None]
    samples, filled = seen(picture, renderer)
    buffers = renderer.geometry(256, 3, (None, None))
    assert worst(buffers, name, samples.mean(2), filled) < 4e-3
    for twin in (picture[::-1], picture[:, ::-1], np.roll(picture, 1, axis=1)):
        assert worst(buffers, name, seen(twin, renderer)[0].mean(2), filled) > 0.1


def test_arrays_that_are_read_only_are_rendered() -> None:
    """As numpy hands out what it broadcasts, or maps of a file."""
    flat = np.broadcast_to(np.array([0, 0, 1], np.float32), (4, 4, 3))
    maps = {"albedo": texture(1, 8, 7, 3), "roughness": texture(2, 9, 6), "normal_map": flat}
    for array in maps.values():
        array.flags.writeable = False
    light = scenes.environment()
    light.flags.writeable = False
    object_scene(quad(**maps), environment=light)
    read_only, own = (Renderer(quad(**given), resolution=8) for given in (maps, {k: v.copy() for k, v in maps.items()}))
    shown = [renderer.image(light, None, 0.5, 4, batches=1).mean for renderer in (read_only, own)]
    assert np.array_equal(shown[0], shown[1])
    assert shown[0].any()


@pytest.mark.parametrize("mirrored", [False, True])
def test_normal_map_comes_back_texel_by_texel_in_camera_axes(mirrored: bool) -> None:
    """x along +u, y up in the picture (against +v), also where u runs to the left."""
    tangent = bumps(4)
    renderer = Renderer(quad(mirrored, normal_map=tangent), resolution=SIZE)
    buffers = renderer.geometry(256, 3)

    def world(tangent: np.ndarray) -> np.ndarray:
        picture = tangent[:, ::-1] * [-1, 1, 1] if mirrored else tangent
        return unit(unit(seen(picture, renderer)[0]).mean(2))

    filled = seen(tangent, renderer)[1]
    assert worst(buffers, "normal", world(tangent), filled) < 5e-3
    for twin in (tangent * [1, -1, 1], tangent * [-1, 1, 1], tangent[..., [1, 0, 2]]):
        assert worst(buffers, "normal", world(twin), filled) > 0.2


def test_a_value_overrides_the_map_in_buffers_and_picture() -> None:
    obj = quad(roughness=texture(2, 8, 8), metallic=texture(3, 8, 8))
    renderer, bare = Renderer(obj, resolution=SIZE), Renderer(quad(), resolution=SIZE)
    buffers = renderer.geometry(16, 0, (0.3, None)).require("roughness", "metallic", "mask")
    inside = buffers["mask"][..., 0] > 0
    np.testing.assert_allclose(buffers["roughness"][inside], 0.3, atol=1e-6)
    assert np.ptp(buffers["metallic"][inside]) > 0.3
    assert not buffers["roughness"][~inside].any()
    assert renderer.geometry(16).roughness is None
    light = scenes.environment()
    same = [r.image(light, 0.3, 0.6, 16, batches=1).mean for r in (renderer, bare)]
    np.testing.assert_array_equal(same[0], same[1])
    assert np.abs(renderer.image(light, None, 0.6, 16, batches=1).mean - same[0]).max() > 0.05  # the twin


def compare(a: Estimate, b: Estimate, mask: np.ndarray) -> ZTest:
    assert a.variance is not None
    assert b.variance is not None
    parts = (a.mean[..., :3], a.variance[..., :3], b.mean[..., :3], b.variance[..., :3])
    return z_test(*parts, mask, rounding=2e-3, alpha=1e-3)


def wavy_normals() -> np.ndarray:
    """Normals of a smooth surface at the square's vertices; the world's axes, first row on top."""
    row, column = np.meshgrid(*[np.linspace(0, 1, GRID)] * 2, indexing="ij")
    x, y = 0.4 * np.sin(2 * np.pi * column + 1), 0.35 * np.sin(2 * np.pi * (row + 0.6 * column))
    return unit(np.stack([x, y, np.ones_like(x)], -1)).astype(np.float32)


def resampled(at_vertices: np.ndarray, texels: int = 8 * GRID) -> np.ndarray:
    """Unit vectors interpolated from the square's vertices to the texel centres of a finer picture."""
    place = (np.arange(texels) + 0.5) / texels * (GRID - 1)
    at = np.meshgrid(place, place, indexing="ij")
    return unit(np.stack([ndimage.map_coordinates(at_vertices[..., k], at, order=1) for k in range(3)], -1)).astype(
        np.float32
    )


@pytest.fixture(scope="module")
def front_light() -> np.ndarray:
    """Light from the front only: light from behind a single sheet would leak past its shading normals."""
    light = scenes.environment(5, (16, 32))
    light[environment_directions(16, 32)[..., 2] < 0.1] = 0
    return light


@pytest.mark.slow
def test_surfaces_are_shaded_at_the_mapped_normal(front_light: np.ndarray) -> None:
    """A normal map, here on a mirrored square, renders like a mesh with its normals at the vertices."""
    world = wavy_normals()
    tangent = resampled(world)[:, ::-1] * np.array([-1, 1, 1], np.float32)
    mapped = Renderer(quad(True, normal_map=np.ascontiguousarray(tangent)), resolution=16)
    twin = Renderer(quad(True, normal_map=tangent * np.array([1, -1, 1], np.float32)), resolution=16)
    bent = Renderer(quad(False, world), resolution=16)
    mask = (bent.geometry(16).require("mask")["mask"] > 0.999).astype(np.float32)
    normal = bent.geometry(256).require("normal")["normal"]
    assert worst(mapped.geometry(256), "normal", normal, mask[..., 0] > 0) < 5e-3
    right = bent.image(front_light, 0.4, 0.5, 128, seed=2)
    result = compare(mapped.image(front_light, 0.4, 0.5, 128, seed=1), right, mask)
    assert result.passed, str(result)
    assert not compare(twin.image(front_light, 0.4, 0.5, 128, seed=1), right, mask).passed


@pytest.mark.parametrize("surface", ["principled", "mirror", "white"])
def test_every_surface_is_seen_by_its_normal_map(surface: materials.Surface) -> None:
    """eval of the surface as shown: light that the mapped normal mirrors, and light that the square's own mirrors."""
    mi = mitsuba()
    lean = np.radians(20)
    tangent = np.tile(np.array([np.sin(lean), 0, np.cos(lean)], np.float32), (2, 2, 1))
    values = {"roughness": 0.3} if surface == "mirror" else {"roughness": 0.3, "metallic": 1.0}
    hit = facing_hit()
    hit.wi = mi.Vector3f(0, 0, 1)

    def value(obj: MeshObject, degrees: float) -> float:
        shown = Renderer(obj, resolution=4).scene.show(surface, {} if surface == "white" else values)
        angle = np.radians(degrees)
        towards = mi.Vector3f(float(np.sin(angle)), 0.0, float(np.cos(angle)))
        return float(np.array(shown.shapes()[0].bsdf().eval(mi.BSDFContext(), hit, towards))[0, 0])

    assert value(quad(), 0) > value(quad(), 40)
    assert value(quad(normal_map=tangent), 40) > value(quad(normal_map=tangent), -5)
    if surface == "white":
        assert value(quad(normal_map=tangent), 40) == pytest.approx(np.cos(lean) / np.pi, rel=1e-4)


def facing_hit() -> Any:
    """A point on a square in the plane z = 0, u to the right and v down."""
    mi = mitsuba()
    hit: Any = mi.SurfaceInteraction3f()
    hit.uv, hit.n, hit.sh_frame = [0.5, 0.5], [0, 0, 1], mi.Frame3f([1, 0, 0], [0, 1, 0], [0, 0, 1])
    hit.dp_du, hit.dp_dv = [1, 0, 0], [0, -1, 0]
    return hit


def test_mapped_normal_is_the_one_that_the_surface_uses_also_from_behind_and_when_it_faces_away() -> None:
    """A white Lambertian surface returns max(n . wo, 0) / pi: five directions give n."""
    mi = mitsuba()
    rng = np.random.default_rng(0)
    turned = 0
    for _ in range(24):
        tangent = unit(rng.normal(size=3) * [1, 1, 0.6])
        tangent[2] = abs(tangent[2])
        loaded = materials.normal_texture_of(np.tile(tangent.astype(np.float32), (2, 2, 1)))
        bsdf = materials.with_normal_map(mi.load_dict(materials.white_bsdf()), loaded)
        hit = facing_hit()
        hit.wi = mi.Vector3f(*unit(rng.normal(size=3)).tolist())
        normal = np.array(materials.mapped_normal(hit, loaded, True)).ravel()
        outgoing = unit(rng.normal(size=(200, 3)))
        value = np.array(bsdf.eval(mi.BSDFContext(), hit, mi.Vector3f(outgoing.T.astype(np.float32))))[0] * np.pi
        lit = outgoing[:, 2] * np.array(hit.wi.z)[0] > 0  # light of the viewer's side
        np.testing.assert_allclose(value[lit], np.maximum(outgoing[lit] @ normal, 0), atol=2e-5)
        assert not value[~lit].any()
        turned += not np.allclose(normal, tangent, atol=1e-3)
    assert 8 < turned < 24  # some are the map's own, some are turned: the twin of ignoring the turn


def low_poly_sphere(**maps: np.ndarray) -> MeshObject:
    """80 triangles with the normals of a sphere: near the silhouette, they lean away from the viewer."""
    base = scenes.sphere((0.6, 0.6, 0.6), subdivisions=1)
    uv = np.random.default_rng(0).random((len(base.vertices), 2)).astype(np.float32)
    return dataclasses.replace(base, uv=uv, **maps)


def side_of_the_triangle(hit: Any) -> Any:
    """The wrong rule: the shading normal, turned where the camera sees the triangle from behind."""
    import drjit as dr

    return dr.select(dr.dot(hit.n, hit.to_world(hit.wi)) < 0, -hit.sh_frame.n, hit.sh_frame.n)


def test_facing_normal_is_the_one_that_the_surface_uses() -> None:
    """A white surface returns max(n . wo, 0) / pi at every hit, for light of the viewer's side."""
    mi = mitsuba()
    renderer = Renderer(low_poly_sphere(), resolution=4)
    scene = renderer.scene.show("white")
    rng = np.random.default_rng(0)
    place, outgoing = rng.random((2, 5000)), unit(rng.normal(size=(5000, 3)))
    ray, _ = scene.sensors()[0].sample_ray(0.0, 0.5, mi.Point2f(place.astype(np.float32)), mi.Point2f(0.5))
    hit = scene.ray_intersect(ray)
    wo = hit.to_local(mi.Vector3f(outgoing.T.astype(np.float32)))
    value = np.array(hit.bsdf().eval(mi.BSDFContext(), hit, wo, hit.is_valid()))[0] * np.pi
    met = np.array(hit.is_valid())

    def expected(normal: Any) -> np.ndarray:
        return np.maximum((np.array(normal).T * outgoing).sum(-1), 0)

    np.testing.assert_allclose(value[met], expected(materials.facing_normal(hit))[met], atol=2e-5)
    assert (np.abs(value - expected(side_of_the_triangle(hit)))[met] > 0.1).sum() > 20


def test_normals_face_the_viewer_by_one_rule_with_and_without_a_normal_map(monkeypatch: pytest.MonkeyPatch) -> None:
    """Unshadowed light of a white surface is that of the buffer's normals."""
    flat = np.tile(np.array([0, 0, 1], np.float32), (2, 2, 1))
    renderer, mapped = (Renderer(low_poly_sphere(**maps), resolution=SIZE) for maps in ({}, {"normal_map": flat}))
    normal = renderer.geometry(256).require("normal")["normal"]
    np.testing.assert_allclose(normal, mapped.geometry(256).require("normal")["normal"], atol=1e-5)
    monkeypatch.setattr(materials, "facing_normal", side_of_the_triangle)
    twin = renderer.geometry(256).require("normal")["normal"]
    differs = np.abs(normal - twin).max(-1) > 0.3
    assert differs.sum() > 10
    sideways = np.exp(4 * (environment_directions(32, 64)[..., 1:2] - 1)).repeat(3, -1).astype(np.float32)
    white = renderer.scene.show("white", {}, sideways)
    unshadowed = python_integrator(effects._unshadowed)
    light = ratio_estimate(*integrator_passes(white, unshadowed, 1024, 5, 8, renderer.counters), 8).mean
    # The mean of the light is not the light of the mean normal where samples of a pixel are turned and others are not.
    error, wrong = (np.abs(light - diffuse_light(n, sideways))[differs].mean() for n in (normal, twin))
    assert error < 0.6 * wrong


def test_a_sample_of_maps_says_so_and_hashes_them() -> None:
    obj = quad(roughness=texture(2, 8, 8), metallic=texture(3, 8, 8))
    spec = SceneSpec(obj, scenes.light(1), None, 0.5, resolution=16)
    sample = render_sample(spec, 64)
    assert (sample.provenance["roughness"], sample.provenance["metallic"]) == ("map", "0.5")
    assert np.ptp(sample.intrinsics.require("roughness")["roughness"]) > 0.3
    obj = dataclasses.replace(obj, normal_map=bumps(4))
    hashes = {scene_hash(dataclasses.replace(spec, obj=obj))}
    for name in ("roughness", "metallic", "normal_map"):
        other = getattr(obj, name).copy()
        other[[0, 1]] = other[[1, 0]]
        hashes.add(scene_hash(dataclasses.replace(spec, obj=dataclasses.replace(obj, **{name: other}))))
        hashes.add(scene_hash(dataclasses.replace(spec, obj=dataclasses.replace(obj, **{name: None}))))
    assert len(hashes) == 7


def test_the_hash_of_an_object_without_maps_is_over_its_mesh_and_base_colour_alone() -> None:
    obj, light = quad(), scenes.light(1)
    spec = SceneSpec(obj, light, 0.25, 0.5, resolution=SIZE)
    digest = hashlib.sha256()
    for array in (obj.vertices, obj.faces, obj.normals, obj.uv, obj.albedo, light.environment):
        digest.update(np.ascontiguousarray(array).tobytes())
    digest.update(repr((0.25, 0.5, spec.camera, SIZE, 0)).encode())
    assert scene_hash(spec) == digest.hexdigest()


@pytest.mark.parametrize(
    ("surface", "outgoing"),
    [("principled", -1.2), ("mirror", -1.2), ("diffuse_lobe", 1.5), ("dielectric_lobe", -1.2), ("schlick_lobe", -1.2)],
)
def test_surfaces_follow_values_and_maps(surface: materials.Surface, outgoing: float) -> None:
    """eval of the surface as shown: back towards grazing light (retro-reflection), or near its mirror direction."""
    mi = mitsuba()
    constant = {"roughness": np.full((2, 2), 0.3, np.float32), "metallic": np.full((2, 3), 0.7, np.float32)}
    renderer = Renderer(quad(**constant), resolution=4)

    def value(roughness: float | None, metallic: float | None = None) -> float:
        hit = facing_hit()
        hit.wi = unit_direction(2.0)
        values = {"roughness": roughness} | ({"metallic": metallic} if surface == "principled" else {})
        bsdf = renderer.scene.show(surface, values).shapes()[0].bsdf()
        return float(np.array(bsdf.eval(mi.BSDFContext(), hit, unit_direction(outgoing)))[0, 0])

    def unit_direction(x: float) -> object:
        return mi.Vector3f(*unit(np.array([x, 0.1, 1.0])).tolist())

    assert value(None) == pytest.approx(value(0.3, 0.7), rel=1e-5)
    assert value(0.3, 0.7) > 0
    assert value(0.8, 0.7) != pytest.approx(value(0.3, 0.7), rel=1e-2)
    assert (value(None, 0.1) == pytest.approx(value(None), rel=1e-2)) == (surface != "principled")


@pytest.mark.parametrize(
    ("surface", "values", "message"),
    [
        ("principled", {"metallic": None}, "quad has none"),
        ("mirror", {"metallic": 0.5}, "expected"),
        ("white", {"roughness": 0.5}, "expected"),
        ("principled", {"roughness": 1.5}, "expected a value in"),
    ],
)
def test_what_a_surface_does_not_have_is_refused(surface: materials.Surface, values: dict, message: str) -> None:
    renderer = Renderer(quad(roughness=texture(0, 4, 4)), resolution=4)
    with pytest.raises(UnirenderError, match=message):
        renderer.scene.show(surface, values)
