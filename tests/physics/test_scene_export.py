"""The exported scene against the truth: Mitsuba's render of `scene.xml` is what `shade` makes of the same maps."""

from pathlib import Path

import numpy as np
import pytest
from environments import smooth_environment

from unirender.camera import Camera
from unirender.intrinsics import Intrinsics
from unirender.light.environment import rotate_environment
from unirender.scene_export import export_scene
from unirender_reference.backend import mitsuba
from unirender_reference.shade import shade

HEIGHT, WIDTH = 32, 40
WITHIN = 0.04  # mean relative error; what there is comes of the grid between pixel centres and of 8-bit textures


def ball() -> Intrinsics:
    """A ball under an off-centre camera: colours, roughness and metallic vary, an edge is covered by half."""
    camera = Camera(40.0, (0.45, 0.6))
    rays, centre = camera.rays(HEIGHT, WIDTH), np.array([0, 0, -camera.distance()], np.float32)
    along = rays @ centre
    discriminant = along**2 - centre @ centre + 1
    hit = (discriminant > 0)[..., None]
    normal = rays * (along - np.sqrt(np.maximum(discriminant, 0)))[..., None] - centre
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    y, x = (np.mgrid[:HEIGHT, :WIDTH][..., None] / HEIGHT).astype(np.float32)
    mask = hit * np.where(x > 0.9, 0.5, 1).astype(np.float32)
    albedo = np.concatenate([0.2 + 0.6 * x, 0.8 - 0.5 * y, np.full_like(x, 0.3)], axis=-1).clip(0, 1)
    return Intrinsics(
        albedo=albedo * hit,
        normal=normal * hit,
        roughness=(0.3 + 0.4 * y) * hit,
        metallic=(x > 0.6) * hit,
        environment=smooth_environment(16, 32) ** 3,
        mask=mask,
        camera=camera,
    )


def rendered(intrinsics: Intrinsics, folder: Path) -> np.ndarray:
    """The exported scene as Mitsuba renders it: linear, premultiplied, (h, w, 4)."""
    export_scene(folder, intrinsics)
    mi = mitsuba()
    return np.array(mi.render(mi.load_file(str(folder / "scene.xml")), spp=576))


def relative(image: np.ndarray, truth: np.ndarray, pixels: np.ndarray) -> float:
    """Mean absolute error of the chosen pixels (h, w), as a share of their mean."""
    return float(np.abs(image[pixels] - truth[pixels]).mean() / truth[pixels].mean())


@pytest.fixture(scope="module")
def truth() -> np.ndarray:
    return shade(ball(), spp=1024)


def test_mitsuba_renders_the_scene_as_shade_does(truth: np.ndarray, tmp_path: Path) -> None:
    intrinsics = ball()
    image = rendered(intrinsics, tmp_path / "scene")
    mask = intrinsics.require("mask")["mask"][..., 0]
    assert image.shape == (HEIGHT, WIDTH, 4)
    np.testing.assert_allclose(image[..., 3], mask, rtol=0, atol=0.005)
    assert (image[mask == 0] == 0).all()
    assert relative(image[..., :3], truth, mask > 0) < WITHIN
    assert relative(image[..., :3], truth, mask == 0.5) < WITHIN  # and nothing shines through the half-covered edge


@pytest.mark.parametrize("fault", ["light turned", "normals upside down", "roughness squared", "half the coverage"])
def test_a_wrong_scene_would_not_pass(truth: np.ndarray, tmp_path: Path, fault: str) -> None:
    intrinsics = ball()
    maps = intrinsics.require("environment", "normal", "roughness", "mask")
    quarter = np.array([[0, 0, 1], [0, 1, 0], [-1, 0, 0]], np.float32)
    wrong = {
        "light turned": {"environment": rotate_environment(maps["environment"], quarter)},
        "normals upside down": {"normal": maps["normal"] * np.array([1, -1, 1], np.float32)},
        "roughness squared": {"roughness": maps["roughness"] ** 2},
        "half the coverage": {"mask": maps["mask"] / 2},
    }
    image = rendered(intrinsics.replace(**wrong[fault]), tmp_path / "scene")
    assert relative(image[..., :3], truth, maps["mask"][..., 0] > 0) > 2 * WITHIN


def test_a_bright_pole_lights_the_scene(tmp_path: Path) -> None:
    """Most samples missed it: pixels were off by 80 % in the mean."""
    light = np.full((128, 256, 3), 0.05, np.float32)
    light[0] = 2000
    maps = ball().replace(environment=light)
    image, covered = rendered(maps, tmp_path / "scene")[..., :3], maps.require("mask")["mask"][..., 0] > 0
    assert relative(image, shade(maps, spp=1024), covered) < WITHIN


def test_a_card_beyond_mitsubas_far_clip_is_seen(tmp_path: Path) -> None:
    maps = ball().replace(camera=Camera(0.01))
    assert rendered(maps, tmp_path / "far")[..., 3].mean() > 0.4
    assert "far_clip" in (tmp_path / "far" / "scene.xml").read_text()
    export_scene(tmp_path / "near", ball())
    assert "far_clip" not in (tmp_path / "near" / "scene.xml").read_text()
