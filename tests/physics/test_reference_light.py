"""The reference renderer obeys light: furnace, superposition, orientation, gauge. Tests have twins that must fail."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import reference_scenes as scenes

from unirender.camera import Camera
from unirender.exr import image_channels, write_exr
from unirender.light.environment import mirror_environment, sample_environment
from unirender.light.surface_light import diffuse_light, specular_light
from unirender_reference import backend
from unirender_reference.render import Renderer, SceneSpec, render_sample
from unirender_reference.scene import load_scene
from unirender_reference.sensors import sensor_dict
from unirender_reference.shapes import make_object

SIZE = 24
SPP = 256  # 16 passes of 16: every test runs the same compiled kernels
BATCHES = 16


@pytest.fixture(scope="module")
def ball() -> Renderer:
    return Renderer(scenes.sphere(), resolution=SIZE)


@pytest.fixture(scope="module")
def concave() -> Renderer:
    """An object with shadows and interreflection."""
    return Renderer(make_object(5, "train"), resolution=SIZE)


def full(renderer: Renderer) -> np.ndarray:
    return renderer.geometry(64).require("mask")["mask"][..., 0] == 1


def test_white_furnace(ball: Renderer) -> None:
    """Under a constant light a white Lambertian and a sharp white mirror on a convex object look like the light."""
    light = np.full((8, 16, 3), (0.5, 0.8, 1.3), np.float32)
    inside = full(ball)
    diffuse = ball.diffuse(light, SPP, batches=BATCHES)
    specular = ball.specular(light, 0.05, SPP, batches=BATCHES)
    for estimate in (diffuse, specular):
        np.testing.assert_allclose(estimate.mean[inside].mean(axis=0), light[0, 0], rtol=5e-3)
    np.testing.assert_allclose(diffuse.mean[inside], np.broadcast_to(light[0, 0], (inside.sum(), 3)), rtol=0.03)


def emitted(environment: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Radiance that Mitsuba's `envmap` sends from the given directions."""
    mi = backend.mitsuba()
    import drjit as dr

    emitter = mi.load_dict({"type": "envmap", "bitmap": mi.Bitmap(environment)})
    hit = dr.zeros(mi.SurfaceInteraction3f, len(directions))
    hit.wi = -mi.Vector3f(np.ascontiguousarray(directions.T))
    return np.array(emitter.eval(hit)).T


def random_directions(count: int) -> np.ndarray:
    directions = np.random.default_rng(0).normal(size=(count, 3))
    return (directions / np.linalg.norm(directions, axis=-1, keepdims=True)).astype(np.float32)


@pytest.mark.parametrize("shape", [(3, 4), (9, 16), (16, 32), (33, 70)])
def test_environment_is_mitsubas_between_texels(shape: tuple[int, int]) -> None:
    environment, directions = scenes.environment(7, shape, peaks=0), random_directions(4000)
    ours, theirs = sample_environment(environment, directions), emitted(environment, directions)
    np.testing.assert_allclose(ours, theirs, atol=2e-3)
    for wrong in (mirror_environment(environment), np.roll(environment, 1, axis=1), environment[::-1]):
        assert np.abs(sample_environment(wrong, directions) - theirs).mean() > 0.02


def test_environment_file_is_read_by_mitsuba_as_it_is_by_us(tmp_path: Path) -> None:
    """A round trip: our EXR, Mitsuba's reader and emitter."""
    mi = backend.mitsuba()
    environment = scenes.environment(8)
    write_exr(tmp_path / "environment.exr", image_channels(environment), half=False)
    emitter = mi.load_dict({"type": "envmap", "filename": str(tmp_path / "environment.exr")})
    data = np.array(mi.traverse(emitter)["data"])
    np.testing.assert_array_equal(data[:, 1:-1], environment)


def test_camera_sees_the_environment_along_its_rays() -> None:
    """Rays, axes, field of view and principal point at once: the sky without an object, pixel by pixel."""
    mi = backend.mitsuba()
    environment, camera = scenes.environment(9, (9, 16), peaks=0), Camera(70.0, (0.4, 0.55))
    light = {"type": "envmap", "bitmap": mi.Bitmap(environment)}
    scene = mi.load_dict({"type": "scene", "sensor": sensor_dict(camera, 32, 48), "light": light})
    seen = np.array(mi.render(scene, integrator=mi.load_dict({"type": "path", "max_depth": 2}), spp=64, seed=0))
    np.testing.assert_allclose(seen[..., :3], sample_environment(environment, camera.rays(32, 48)), atol=0.02)
    flipped = sample_environment(environment, Camera(70.0, (0.6, 0.55)).rays(32, 48))
    assert np.abs(seen[..., :3] - flipped).mean() > 0.02


def test_convex_object_sees_the_closed_form_light(ball: Renderer) -> None:
    """Without shadows d and s are `unirender.light.environment`'s integrals; a light turned by one column is not."""
    light = scenes.environment(5, (12, 24), peaks=1)
    geometry = ball.geometry(64)
    normal = geometry.require("normal")["normal"]
    inner = normal[..., 2] > 0.5
    rendered = {
        "diffuse": ball.diffuse(light, 512, batches=32).mean,
        "specular": ball.specular(light, 0.5, 512, batches=32).mean,
    }

    def error(name: str, environment: np.ndarray) -> float:
        closed = diffuse_light(normal, environment) if name == "diffuse" else specular_light(normal, 0.5, environment)
        return float(np.abs(closed - rendered[name])[inner].mean() / rendered[name][inner].mean())

    for name in rendered:
        assert error(name, light) < 0.02, name
        assert error(name, np.roll(light, 1, axis=1)) > 0.04, name


def test_twice_the_light_and_half_the_exposure_give_the_same_sample(concave: Renderer) -> None:
    light = scenes.light(6)
    sample, brighter = (
        render_sample(
            SceneSpec(concave.obj, type(light)(light.name, light.environment * scale, {}), 0.4, 0.7, resolution=SIZE),
            128,
            0,
            concave,
        )
        for scale in (np.float32(1), np.float32(2))
    )
    assert float(brighter.provenance["exposure_factor"]) == float(sample.provenance["exposure_factor"]) / 2
    assert np.array_equal(sample.image_linear, brighter.image_linear)
    for name in sample.intrinsics.present:
        assert np.array_equal(getattr(sample.intrinsics, name), getattr(brighter.intrinsics, name)), name


def test_background_is_hidden_and_object_is_not() -> None:
    scene = load_scene(scenes.sphere(), {"type": "diffuse"}, np.ones((4, 8, 3), np.float32), Camera(), 8)
    mi = backend.mitsuba()
    path = mi.load_dict({"type": "path", "max_depth": 2, "hide_emitters": True})
    picture = np.array(mi.render(scene, integrator=path, spp=16, seed=0))
    assert not picture[0, 0].any()
    assert picture[4, 4, 3] == 1
    assert picture[4, 4, :3].min() > 0.4


def test_buffers_first_in_a_fresh_process() -> None:
    """`geometry` as the very first call: drjit must not have been imported (with the system's LLVM) before."""
    code = (
        "import numpy as np\n"
        "from unirender_reference.shapes import make_object\n"
        "from unirender_reference.render import Renderer\n"
        "renderer = Renderer(make_object(0, 'train'), resolution=8)\n"
        "assert renderer.geometry(16).mask.max() == 1\n"
        "print(renderer.image(np.ones((4, 8, 3), np.float32), 0.5, 0.5, 16, batches=1).mean.max())\n"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert run.returncode == 0, run.stderr
    assert float(run.stdout) > 0
