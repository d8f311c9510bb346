"""glTF files through the renderer: its buffers show the file's texels, and its image is that of a hand-made scene."""

import numpy as np
import pytest
from gltf_files import (
    CORNERS,
    GOOD,
    GltfWriter,
    QuadFile,
    mirrored_uv,
    random_pixels,
    unit,
    write_metallic_roughness,
    write_normal_mapped,
    write_two_materials,
)
from reference_scenes import environment

from unirender.camera import Camera
from unirender_reference.backend import mitsuba
from unirender_reference.meshes import load_mesh
from unirender_reference.passes import Estimate
from unirender_reference.render import IMAGE_DEPTH, Renderer
from unirender_reference.statistics import ZTest, z_test

SIZE = 40
FRAME = 1 / np.sqrt(2)  # half the side of the quad in the unit sphere
LIGHT = environment(5)
SPP = 256  # of a batch


def pixel_points(samples: int = 4) -> np.ndarray:
    """(SIZE, SIZE, samples^2, 2): points of the quad's plane, in units of its half side, inside each pixel."""
    camera = Camera()
    half = camera.distance() * np.tan(np.radians(camera.fov_deg) / 2) / FRAME
    edge = (np.arange(SIZE * samples) + 0.5) / (SIZE * samples) * 2 - 1
    x, y = np.meshgrid(edge * half, -edge * half)
    grid = np.stack([x, y], -1).reshape(SIZE, samples, SIZE, samples, 2)
    return grid.swapaxes(1, 2).reshape(SIZE, SIZE, samples**2, 2)


def expected_buffers(file: QuadFile) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Means over the pixels that the quad covers completely, and which pixels those are."""
    points = pixel_points()
    inside = np.abs(points).max((2, 3)) < 0.99
    flat = points[inside].reshape(-1, 2)
    values = {
        name: channel(flat).reshape(inside.sum(), -1, channel(flat).shape[-1])
        for name, channel in file.channels.items()
    }
    if "normal" in values:  # mirrored on the right half: x along +u points to the left there, y up in the picture
        values["normal"][..., 0] *= np.where(flat[:, 0] < 0, 1, -1).reshape(inside.sum(), -1)
    means = {name: value.mean(1) for name, value in values.items()}
    if "normal" in means:
        means["normal"] = unit(means["normal"])
    return means, inside


@pytest.mark.parametrize("write", GOOD)
def test_buffers_show_the_file_s_texels(tmp_path, write):
    file = write(tmp_path)
    buffers = Renderer(load_mesh(file.path), resolution=SIZE).geometry(256, 0, material=(None, None))
    expected, inside = expected_buffers(file)
    assert inside.sum() > 500
    for name, values in expected.items():
        tolerance = 0.01 if file.pixels else 5e-4  # texels, or one slope over each triangle
        assert getattr(buffers, name)[inside] == pytest.approx(values, abs=tolerance), name
        if np.ptp(values) > 0:  # twin: the neighbouring pixel is another one
            neighbours = getattr(buffers, name)[np.roll(inside, 1, axis=1)]
            assert np.abs(neighbours - values).max() > 10 * tolerance, name


def test_plain_material_beside_a_normal_map_stays_flat(tmp_path):
    """Its faces look up one texel, so they have no tangents; the map is (0, 0, 1) there."""
    bumps = random_pixels(1, 8, 8)
    bumps[..., 2] = 255
    left, right = CORNERS.copy(), CORNERS.copy()
    left[[1, 2], 0] = 0
    right[[0, 3], 0] = 0
    writer = GltfWriter()
    bumpy = writer.material(normalTexture={"index": writer.texture(bumps)})
    writer.mesh(writer.quad(bumpy, left), writer.quad(writer.material(pbrMetallicRoughness={}), right))
    buffers = Renderer(load_mesh(writer.glb(tmp_path / "quads.glb")), resolution=SIZE).geometry(64, 0)
    assert buffers.mask is not None
    assert buffers.normal is not None
    full = buffers.mask[..., 0] == 1
    tilt = np.abs(buffers.normal - [0, 0, 1]).max(-1)
    columns = np.arange(SIZE) < SIZE // 2
    assert tilt[full & ~columns].max() < 1e-5
    assert tilt[full & columns].mean() > 0.1


def bitmap(pixels: np.ndarray) -> dict:
    """A hand-made texture for Mitsuba's rectangle, whose v runs upwards."""
    picture = mitsuba().Bitmap(np.ascontiguousarray(pixels[::-1], np.float32))
    return {"type": "bitmap", "bitmap": picture, "raw": True, "filter_type": "bilinear", "wrap_mode": "repeat"}


def srgb_to_linear(stored: np.ndarray) -> np.ndarray:
    value = stored / 255
    return np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)


def hand_made(shapes: list[dict], light: np.ndarray, batches: int, spp: int) -> tuple[np.ndarray, np.ndarray]:
    """Mean and its variance of a scene in which nothing of ours takes part but the camera's numbers."""
    mi = mitsuba()
    camera = Camera()
    origin = [0, 0, camera.distance()]
    scene = mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "path", "max_depth": IMAGE_DEPTH, "hide_emitters": True},
            "sensor": {
                "type": "perspective",
                "fov": camera.fov_deg,
                "to_world": mi.ScalarTransform4f().look_at(origin, [0, 0, 0], [0, 1, 0]),
                "film": {
                    "type": "hdrfilm",
                    "width": SIZE,
                    "height": SIZE,
                    "pixel_format": "rgba",
                    "rfilter": {"type": "box"},
                },
            },
            "light": {"type": "envmap", "bitmap": mi.Bitmap(light)},
            **{f"shape{i}": shape for i, shape in enumerate(shapes)},
        }
    )
    renders = np.stack([np.array(mi.render(scene, spp=spp, seed=1000 + i)) for i in range(batches)])
    return renders.mean(0), renders.var(0, ddof=1) / batches


def rectangle(bsdf: dict, x: float = 0.0, width: float = 1.0) -> dict:
    transform = mitsuba().ScalarTransform4f()
    place = transform.translate([x * FRAME, 0, 0]) @ transform.scale([width * FRAME, FRAME, 1])
    return {"type": "rectangle", "to_world": place, "bsdf": bsdf}


def rendered(file: QuadFile) -> Estimate:
    return Renderer(load_mesh(file.path), resolution=SIZE).image(LIGHT, None, None, spp=8 * SPP, seed=1, batches=8)


def compared(ours: Estimate, shapes: list[dict]) -> ZTest:
    assert ours.variance is not None
    mean, variance = hand_made(shapes, LIGHT, batches=8, spp=SPP)
    inside = (np.abs(pixel_points()).max((2, 3)) < 0.99)[..., None].astype(np.float32)
    test = z_test(ours.mean[..., :3], ours.variance[..., :3], mean[..., :3], variance[..., :3], inside)
    assert test.values > 1500
    return test


def test_metallic_roughness_is_the_hand_made_scene(tmp_path):
    file = write_metallic_roughness(tmp_path)
    both = file.pixels["both"] / 255

    def scene(roughness: np.ndarray, metallic: np.ndarray, color: np.ndarray) -> list[dict]:
        inner = {
            "type": "principled",
            "base_color": bitmap(color),
            "roughness": bitmap(roughness[..., None]),
            "metallic": bitmap(metallic[..., None]),
        }
        return [rectangle({"type": "twosided", "bsdf": inner})]

    color = srgb_to_linear(file.pixels["base"]) * [0.5, 1.0, 0.25]
    ours = rendered(file)
    test = compared(ours, scene(both[..., 1] * 0.75, both[..., 2] * 0.5, color))
    assert test.passed, str(test)
    twin = scene(srgb_to_linear(both[..., 1] * 255) * 0.75, both[..., 2] * 0.5, color)  # roughness taken for sRGB
    failed = compared(ours, twin)
    assert not failed.passed, str(failed)


def test_normal_map_is_the_hand_made_scene(tmp_path):
    file = write_normal_mapped(tmp_path)
    vectors = unit((file.pixels["normal"] / 255 * 2 - 1) * [0.5, 0.5, 1])

    def half(picture: np.ndarray, x: float) -> dict:
        inner = {"type": "principled", "base_color": {"type": "rgb", "value": 0.5}, "roughness": 0.5, "metallic": 0.0}
        bumped = {
            "type": "normalmap",
            "normalmap": bitmap((picture + 1) / 2),
            "use_shadowing_function": False,
            "flip_invalid_normals": True,
            "bsdf": {"type": "twosided", "bsdf": inner},
        }
        return rectangle(bumped, x, 0.5)

    left, right = half(vectors, -0.5), half(vectors[:, ::-1] * [-1, 1, 1], 0.5)  # mirrored by hand
    ours = rendered(file)
    test = compared(ours, [left, right])
    assert test.passed, str(test)
    assert mirrored_uv(np.array([[0.25, 0.0]]))[0, 0] == 0.75
    failed = compared(ours, [left, half(vectors[:, ::-1], 0.5)])  # mirrored picture, vectors left as they are
    assert not failed.passed, str(failed)


def test_image_is_that_of_one_rectangle(tmp_path):
    """An atlas of two materials, against pictures of 768 x 768 texels."""
    file = write_two_materials(tmp_path)
    edge = (np.arange(768) + 0.5) / 384 - 1
    points = np.stack(np.meshgrid(edge, -edge), -1).reshape(-1, 2)
    pictures = {name: channel(points).reshape(768, 768, -1) for name, channel in file.channels.items()}

    def scene(turn: slice) -> list[dict]:
        maps = {name: bitmap(picture[:, turn]) for name, picture in pictures.items()}
        inner = {"type": "principled", "base_color": maps.pop("albedo"), **maps}
        return [rectangle({"type": "twosided", "bsdf": inner})]

    ours = rendered(file)
    test = compared(ours, scene(np.s_[:]))
    assert test.passed, str(test)
    assert not compared(ours, scene(np.s_[::-1])).passed
