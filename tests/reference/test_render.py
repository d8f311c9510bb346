"""The renderer: framing, buffers, seeds, variance, repair of NaN pixels."""

import dataclasses
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import reference_scenes as scenes
from scipy.stats import chi2

from unirender.camera import Camera
from unirender.errors import UnirenderError
from unirender_reference import backend, editable_scene, materials, passes, sample_counts, scene
from unirender_reference.envmap import MOST_RADIANCE, envmap_data
from unirender_reference.lights import Light
from unirender_reference.multiview import orbit, pose_towards
from unirender_reference.render import (
    DIRECT_DEPTH,
    IMAGE_DEPTH,
    Renderer,
    SceneSpec,
    render_sample,
    renderer_provenance,
    scene_hash,
    scene_hashes,
)
from unirender_reference.sensors import sensor_at, sensor_dict
from unirender_reference.shapes import bounding_sphere

SIZE = 32


@pytest.fixture(scope="module")
def renderer() -> Renderer:
    return Renderer(scenes.sphere(), resolution=SIZE)


def test_sphere_fills_the_stated_part_of_the_frame() -> None:
    mask = Renderer(scenes.sphere(), resolution=64).geometry(64).mask
    assert mask is not None
    diameter = 2 * np.sqrt(mask.sum() / np.pi)
    assert abs(diameter - 0.9 * 64) < 0.15
    rows, columns = np.nonzero(mask[..., 0] > 0.5)
    assert abs(rows.mean() - 31.5) < 0.05
    assert abs(columns.mean() - 31.5) < 0.05


def test_principal_point_moves_the_object_as_the_camera_says() -> None:
    mask = Renderer(scenes.sphere(), Camera(principal=(0.6, 0.55)), SIZE).geometry(64).mask
    assert mask is not None
    weights = mask[..., 0] / mask.sum()
    centre = (weights.sum(0) @ (np.arange(SIZE) + 0.5), weights.sum(1) @ (np.arange(SIZE) + 0.5))
    # A sphere off the axis is seen as an ellipse whose centre lies slightly further out than its own.
    np.testing.assert_allclose(centre, (0.6 * SIZE, 0.55 * SIZE), atol=0.02 * SIZE)


def test_normals_of_a_sphere_are_the_closed_form(renderer: Renderer) -> None:
    geometry = renderer.geometry(64)
    assert geometry.normal is not None
    assert geometry.mask is not None
    assert geometry.albedo is not None
    rays = renderer.camera.rays(SIZE, SIZE).astype(np.float64)
    origin = np.array([0, 0, renderer.camera.distance()])
    half = rays @ origin
    reach = np.sqrt(np.maximum(half**2 - (origin @ origin - 1), 0))
    point = origin + (-half - reach)[..., None] * rays
    inner = geometry.normal[..., 2] > 0.5
    assert np.abs((geometry.normal * point).sum(-1)[inner] - 1).max() < 2e-3
    np.testing.assert_allclose(
        geometry.albedo[geometry.mask[..., 0] > 0.5],
        [[0.7, 0.4, 0.2]] * int((geometry.mask[..., 0] > 0.5).sum()),
        atol=1e-5,
    )
    outside = geometry.mask[..., 0] == 0
    assert not geometry.normal[outside].any()
    assert not geometry.albedo[outside].any()


def test_texture_rows_follow_uv() -> None:
    """uv counts from the first row of the texture: a quad's v = 0 corner shows row 0."""
    obj = scenes.sphere()
    uv = np.stack([np.full(len(obj.vertices), 0.5), 0.5 - 0.45 * obj.vertices[:, 1]], axis=-1).astype(np.float32)
    ramp = np.repeat(np.linspace(1, 0, 64, dtype=np.float32)[:, None, None], 3, axis=2).repeat(2, axis=1)
    textured = type(obj)("ramp", "sphere", obj.vertices, obj.faces, obj.normals, uv, np.ascontiguousarray(ramp))
    albedo = Renderer(textured, resolution=SIZE).geometry(64).albedo
    assert albedo is not None
    assert albedo[5, SIZE // 2, 0] > 0.75
    assert albedo[-6, SIZE // 2, 0] < 0.25


def test_image_is_premultiplied_and_hides_the_light(renderer: Renderer) -> None:
    image = renderer.image(scenes.environment(), 0.4, 0.5, 16, batches=1).mean
    mask = renderer.geometry(64).mask
    assert mask is not None
    assert not image[image[..., 3] == 0].any()  # no light behind the object
    assert np.abs(image[..., 3:] - mask).max() < 0.3
    assert image[..., 3].max() <= 1 + 1e-5


def test_equal_seeds_are_bit_identical_and_others_differ(renderer: Renderer) -> None:
    light = scenes.environment()
    first = renderer.image(light, 0.3, 0.2, 16, seed=5, batches=1).mean
    renderer.image(scenes.environment(1), 0.9, 1.0, 16, seed=6, batches=1)
    assert np.array_equal(first, renderer.image(light, 0.3, 0.2, 16, seed=5, batches=1).mean)
    assert not np.array_equal(first, renderer.image(light, 0.3, 0.2, 16, seed=7, batches=1).mean)


def test_edited_scene_equals_a_loaded_one(renderer: Renderer) -> None:
    """Surfaces, parameters and lights of other sizes leave nothing behind."""
    obj, other, light = renderer.obj, scenes.environment(3, (8, 16)), scenes.environment(3, (20, 40))
    for bsdf, depth, part, render in (
        (
            materials.principled_bsdf(obj.albedo, 0.1, 0.9),
            IMAGE_DEPTH,
            "image",
            lambda light, r: renderer.image(light, r, 0.9, 16, batches=1),
        ),
        (
            materials.mirror_bsdf(0.1),
            DIRECT_DEPTH,
            "specular",
            lambda light, r: renderer.specular(light, r, 16, batches=1),
        ),
        (
            materials.white_bsdf(),
            DIRECT_DEPTH,
            "diffuse",
            lambda light, _: renderer.diffuse(light, 16, batches=1),
        ),
    ):
        loaded = scene.load_scene(obj, bsdf, light, renderer.camera, SIZE)
        drawn = passes.render_passes(loaded, depth, 16, passes.derive_seed(0, part), 1, passes.Counters())
        estimate = passes.mean_estimate if part == "image" else passes.ratio_estimate
        expected = estimate(*drawn, 1).mean
        assert not np.array_equal(render(other, 0.7).mean, expected), part
        assert np.array_equal(render(light, 0.1).mean, expected), part


def test_all_buffers_share_one_scene(renderer: Renderer, monkeypatch: pytest.MonkeyPatch) -> None:
    """Loading builds an acceleration structure: once for an object, whatever is rendered of it."""
    loaded = []
    genuine = scene.load_scene
    monkeypatch.setattr(editable_scene, "load_scene", lambda *args: loaded.append(args) or genuine(*args))
    light = scenes.environment()
    renderer.geometry(16)
    for environment in (light, 2 * light):
        renderer.diffuse(environment, 16, batches=1)
        renderer.specular(environment, 0.5, 16, batches=1)
        renderer.image(environment, 0.5, 0.5, 16, batches=1)
    assert not loaded
    Renderer(scenes.sphere(), resolution=8).geometry(16)
    assert len(loaded) == 1


def test_geometry_reads_the_object_whatever_was_rendered_last(renderer: Renderer) -> None:
    """Base colour is the principled surface's, although the mirror and the white one share its scene."""
    albedo = Renderer(scenes.sphere(), resolution=SIZE).geometry(64, 3).albedo
    for render in (
        lambda: renderer.diffuse(scenes.environment(), 16, batches=1),
        lambda: renderer.specular(scenes.environment(), 0.5, 16, batches=1),
    ):
        render()
        np.testing.assert_array_equal(renderer.geometry(64, 3).albedo, albedo)


def test_render_seconds_are_those_of_mitsuba_render(monkeypatch: pytest.MonkeyPatch) -> None:
    """What `unirender dataset` divides by: neither loading nor tracing the geometry counts."""
    mi = backend.mitsuba()
    genuine, inside = mi.render, []

    def render(*args: object, **options: object) -> object:
        start = time.perf_counter()
        picture = np.array(genuine(*args, **options))
        inside.append(time.perf_counter() - start)
        return picture

    loads = mi.load_dict

    def load(*args: object, **options: object) -> object:
        time.sleep(0.3)
        return loads(*args, **options)

    monkeypatch.setattr(mi, "render", render)
    monkeypatch.setattr(mi, "load_dict", load)
    renderer, start = Renderer(scenes.sphere(), resolution=SIZE), time.perf_counter()
    renderer.geometry(64)
    assert (renderer.counters.render_seconds, renderer.counters.renders) == (0, 0)
    for roughness in (0.2, 0.6):
        renderer.image(scenes.environment(), roughness, 0.5, 16, batches=1)
    assert renderer.counters.renders == 2
    assert sum(inside) <= renderer.counters.render_seconds < sum(inside) + 0.5
    assert renderer.counters.render_seconds < time.perf_counter() - start


def test_scene_hashes_are_those_of_the_scenes_in_any_order() -> None:
    objects, lights = (scenes.sphere(), scenes.sphere()), (scenes.light(1), scenes.light(2))
    moved = dataclasses.replace(objects[1], vertices=objects[1].vertices[::-1].copy())
    specs = [
        SceneSpec(obj, light, roughness, 0.5)
        for roughness in (0.1, 0.9)
        for light in lights
        for obj in (objects[0], moved)
    ]
    by_object = sorted(specs, key=lambda spec: spec.obj is moved)  # which is then read once for each light, or once
    by_both = sorted(specs, key=lambda spec: (spec.obj is moved, spec.light is lights[0]))
    for order in (specs, specs[::-1], by_object, by_both):
        assert list(scene_hashes(order)) == [scene_hash(spec) for spec in order]
    assert len(set(scene_hashes(specs))) == len(specs)


def test_envmap_parameter_is_what_mitsuba_makes_of_a_bitmap() -> None:
    mi = backend.mitsuba()
    light = scenes.environment(2)
    emitter = mi.load_dict({"type": "envmap", "bitmap": mi.Bitmap(light)})
    np.testing.assert_array_equal(np.array(mi.traverse(emitter)["data"]), envmap_data(light))


@pytest.mark.long
@pytest.mark.parametrize("buffer", ["image", "diffuse", "specular"])
def test_stated_variance_is_the_variance_between_seeds(buffer: str) -> None:
    """Chi-square of the spread of 24 estimates against the variance that they state."""
    renderer = Renderer(scenes.sphere(), resolution=12)
    light = scenes.environment(peaks=0)
    estimates = [
        {
            "image": lambda s=seed: renderer.image(light, 0.5, 0.5, 128, s),
            "diffuse": lambda s=seed: renderer.diffuse(light, 128, s),
            "specular": lambda s=seed: renderer.specular(light, 0.5, 128, s),
        }[buffer]()
        for seed in range(24)
    ]
    means = np.stack([estimate.mean[..., :3] for estimate in estimates]).astype(np.float64)
    stated = np.mean([estimate.variance[..., :3] for estimate in estimates if estimate.variance is not None], axis=0)
    full = renderer.geometry(256).require("mask")["mask"][..., 0] > 0.999
    ratio = (means.var(axis=0, ddof=1) / np.maximum(stated, 1e-20))[full]
    # Mean over independent pixels (channels are correlated: count pixels only); 24 - 1 degrees of freedom each.
    freedom = 23 * len(ratio)
    low, high = chi2.ppf([1e-4, 1 - 1e-4], freedom) / freedom
    assert low * 0.9 < ratio.mean() < high * 1.1
    assert not low * 0.9 < 2 * ratio.mean() < high * 1.1  # the twin: twice the variance is noticed


def test_one_batch_states_no_variance(renderer: Renderer) -> None:
    assert renderer.diffuse(scenes.environment(), 16, batches=1).variance is None


def test_nan_pixels_are_rendered_again_and_counted(renderer: Renderer, monkeypatch: pytest.MonkeyPatch) -> None:
    """A Mitsuba that returns NaN in one pixel of its first render, as it does about once in 500 renders."""
    mi = backend.mitsuba()
    genuine, calls = mi.render, []

    def render(*args: object, **options: object) -> object:
        picture = np.array(genuine(*args, **options))
        calls.append(options["seed"])
        if len(calls) == 1:
            picture[10, 11, 1] = np.nan
        return picture

    before = renderer.counters.nan_pixels
    clean = renderer.image(scenes.environment(), 0.5, 0.5, 16, batches=1)
    monkeypatch.setattr(mi, "render", render)
    repaired = renderer.image(scenes.environment(), 0.5, 0.5, 16, batches=1)
    assert (clean.nan_pixels, repaired.nan_pixels, renderer.counters.nan_pixels - before) == (0, 1, 1)
    assert len(set(calls)) == 2
    differs = np.argwhere((clean.mean != repaired.mean).any(axis=-1))
    assert differs.tolist() == [[10, 11]]
    assert repaired.mean[10, 11, 1] > 0


def test_pixels_that_stay_nan_are_an_error(renderer: Renderer, monkeypatch: pytest.MonkeyPatch) -> None:
    mi = backend.mitsuba()
    genuine = mi.render
    monkeypatch.setattr(mi, "render", lambda *args, **options: np.array(genuine(*args, **options)) * np.nan)
    with pytest.raises(UnirenderError, match="stay NaN after 8 seeds"):
        renderer.diffuse(scenes.environment(), 16, batches=1)


def test_the_camera_in_the_header_is_that_of_the_contract() -> None:
    camera = Camera(100 / 3, (0.25, 2 / 3))
    for given, text in ((Camera(), "fov_deg=36 principal=0.5,0.5"), (camera, camera.describe())):
        header = renderer_provenance(Renderer(scenes.sphere(), given, resolution=8))["camera"]
        assert header == text
        assert Camera.parse(header) == given


@pytest.mark.parametrize(
    "call",
    [
        lambda r: r.image(scenes.environment(), 1.2, 0.5, 4, batches=1),
        lambda r: r.image(scenes.environment(), 0.2, float("nan"), 4, batches=1),
        lambda r: r.image(scenes.environment(), 0.5, 0.5, 4),
        lambda r: r.diffuse(-scenes.environment(), 8),
        lambda r: r.diffuse(0 * scenes.environment(), 8),
        lambda r: r.diffuse(np.full((4, 8, 3), np.inf, np.float32), 8),
        lambda r: Renderer(r.obj, resolution=0),
        lambda r: r.image(scenes.environment(), 0.5, 0.5, 16, depth=2**31),  # Mitsuba counts no further
        lambda r: r.image(scenes.environment(), 0.5, 0.5, 16, pose=np.diag([2.0, 2, 2, 1])),
        lambda r: r.image(scenes.environment(), 0.5, 0.5, 16, pose=np.diag([-1.0, 1, 1, 1])),
        lambda r: r.image(scenes.environment(), 0.5, 0.5, 16, pose=np.full((4, 4), np.nan)),
        lambda r: SceneSpec(r.obj, Light("a", scenes.environment()), 0.5, 0.5, exposure_seed=-1),
        lambda r: r.image(scenes.environment(), 0.5, 0.5, 16, depth=1),  # black: light has to bounce once
        lambda r: pose_towards(0, 100, r.camera),  # the picture would stand on its head
        lambda r: pose_towards(float("nan"), 0, r.camera),
        lambda r: orbit(0, r.camera),
        lambda r: bounding_sphere(np.full((3, 3), np.nan)),
        lambda r: bounding_sphere(np.zeros((0, 3))),
    ],
    ids=[
        *("roughness", "metallic", "batches", "negative", "black", "infinite", "resolution", "endless"),
        *("scaled pose", "mirroring pose", "nan pose", "exposure seed"),
        *("no bounce", "above the zenith", "nan azimuth", "no view", "nan vertices", "no vertices"),
    ],
)
def test_bad_arguments_are_refused(renderer: Renderer, call: Callable[[Renderer], object]) -> None:
    with pytest.raises(UnirenderError, match="expected"):
        call(renderer)


def test_a_picture_that_no_machine_holds_is_refused(renderer: Renderer) -> None:
    with pytest.raises(UnirenderError, match=r"got 1000000000000 pixels a side, which would take about .*; render"):
        Renderer(renderer.obj, resolution=10**12)


def test_paths_without_an_end_are_mitsubas(renderer: Renderer) -> None:
    """On a ball light bounces once."""
    direct, endless = (renderer.image(scenes.environment(), 0.5, 0.0, 256, depth=depth).mean for depth in (2, -1))
    np.testing.assert_allclose(direct.mean(), endless.mean(), rtol=0.01)


def test_sample_is_complete_and_shares_exposure_between_materials_and_seeds(renderer: Renderer) -> None:
    spec = SceneSpec(renderer.obj, scenes.light(1), 0.3, 0.6, resolution=SIZE, exposure_seed=4)
    sample = render_sample(spec, 128, 0, renderer)
    maps = sample.intrinsics
    assert set(maps.present) == {
        "albedo",
        "normal",
        "roughness",
        "metallic",
        "specular",
        "diffuse",
        "environment",
        "mask",
    }
    assert sample.image_linear.shape == (SIZE, SIZE, 3)
    assert set(sample.variance) == {"image", "diffuse", "specular"}
    for name in ("roughness", "metallic", "specular", "diffuse"):
        assert not maps.require(name)[name][maps.require("mask")["mask"][..., 0] == 0].any()
    edited = SceneSpec(renderer.obj, scenes.light(1), 0.9, 0.0, resolution=SIZE, exposure_seed=4)
    other = render_sample(edited, 128, 9, renderer)
    assert np.array_equal(
        other.intrinsics.require("environment")["environment"], maps.require("environment")["environment"]
    )
    assert sample.provenance["exposure_factor"] == other.provenance["exposure_factor"]
    assert scene_hash(spec) == sample.provenance["scene"] != scene_hash(edited)
    assert {"mitsuba", "variant", "spp", "seed", "camera", "nan_pixels"} <= set(sample.provenance)


def test_a_renderer_of_another_scene_is_refused(renderer: Renderer) -> None:
    """An object of another colour has the same name, and is another object."""
    obj = renderer.obj
    spec = SceneSpec(obj, scenes.light(1), 0.3, 0.6, resolution=SIZE)
    changes: dict[str, dict[str, Any]] = {
        "object": {"obj": dataclasses.replace(obj, albedo=obj.albedo / 2)},
        "camera": {"camera": Camera(20.0)},
        "resolution": {"resolution": 9},
    }
    for other, change in changes.items():
        wrong = dataclasses.replace(spec, **change)
        assert wrong.obj.name == obj.name
        assert scene_hash(wrong) != scene_hash(spec)
        with pytest.raises(UnirenderError, match=f"another: {other}.*leave `renderer` out"):
            render_sample(wrong, 16, 0, renderer)
    copied = dataclasses.replace(spec, obj=dataclasses.replace(obj, vertices=obj.vertices.copy()))
    assert render_sample(copied, 128, 0, renderer).provenance["scene"] == scene_hash(spec)


def test_the_hash_does_not_depend_on_the_type_of_a_number() -> None:
    plain = SceneSpec(scenes.sphere(), scenes.light(1), 1.0, 0.5, Camera(40.0, (0.5, 1.0)), 64, 3)
    camera = Camera(40, (np.float64(0.5), 1))
    typed = SceneSpec(plain.obj, plain.light, 1, np.float64(0.5), camera, 64, 3)
    assert scene_hash(typed) == scene_hash(plain)
    assert scene_hash(dataclasses.replace(typed, roughness=0)) != scene_hash(plain)


@pytest.mark.parametrize("spp", [67, 704])
def test_geometry_takes_the_next_full_grid(renderer: Renderer, spp: int) -> None:
    """Any number of samples that an image takes: 704 in 8 batches are 11 passes of 64, but no full grid in one."""
    taken = sample_counts.next_spp(spp, 1, sample_counts.SAMPLES_PER_PASS // SIZE**2)
    assert spp < taken < 1.1 * spp
    for name, picture in renderer.geometry(spp, 1).require("mask", "normal", "albedo").items():
        np.testing.assert_array_equal(picture, renderer.geometry(taken, 1).require(name)[name])


def test_the_brightest_light_has_a_finite_variance(renderer: Renderer) -> None:
    light = np.full((4, 8, 3), MOST_RADIANCE, np.float32)
    variance = renderer.image(light, 0.2, 1.0, 128).variance
    assert variance is not None
    assert np.isfinite(variance).all()
    with pytest.raises(UnirenderError, match="at most 1e"):
        renderer.image(light * np.float32(1.01), 0.2, 1.0, 128)


@pytest.mark.parametrize("fov_deg", [0.001, 168.0])
def test_objects_between_the_clips_of_extreme_cameras(fov_deg: float) -> None:
    """Mitsuba's far clip lies nearer than a camera of 0.01 degrees, its near clip behind the front of the object."""
    renderer = Renderer(scenes.sphere((1.0, 1.0, 1.0), subdivisions=4), Camera(fov_deg), 16)
    mask = renderer.geometry(64).require("mask")["mask"]
    assert mask.mean() == pytest.approx(np.pi / 4 * 0.81, rel=0.1)
    found = renderer.diffuse(np.ones((4, 8, 3), np.float32), 16).mean
    assert found[mask[..., 0] == 1].mean() == pytest.approx(1, abs=0.02)


def test_clips_of_ordinary_cameras_are_mitsubas_own() -> None:
    """Rays begin at the near clip: another one would change their bits."""
    for fov_deg in (0.02, 10.0, 36.0, 90.0, 160.0):
        sensor = sensor_dict(Camera(fov_deg), 8, 8)
        assert sensor["near_clip"] == 0.01
        assert "far_clip" not in sensor
    near, far = np.eye(4), np.eye(4)
    near[2, 3], far[2, 3] = 2, 2e4
    assert "far_clip" not in sensor_at(near, Camera(0.001), 8, 8)
    assert sensor_at(far, Camera(), 8, 8)["far_clip"] > 2e4 + 1
