"""The exported scene: what the files hold, read back by trimesh and by hand; and where `--export` may write."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from PIL import Image

from unirender.camera import Camera
from unirender.cli import main
from unirender.color import srgb_encode
from unirender.errors import UnirenderError, UsageError
from unirender.exr import channels_rgb, read_exr
from unirender.intrinsics import Intrinsics
from unirender.new_folders import folder_beside, new_folder
from unirender.scene_export import export_scene
from unirender.scene_export.card import Card
from unirender.scene_export.gltf import document
from unirender.scene_export.mitsuba_scene import MOST_VERTICES, ply_bytes

FILES = {
    *("card.gltf", "base_color.png", "metallic_roughness.png", "normal.png", "meta.json"),
    *("scene.xml", "card.ply", "roughness.png", "metallic.png", "opacity.png", "environment.exr", "latlong.exr"),
    "environment.pfm",
}


@pytest.fixture
def intrinsics(maps: dict[str, np.ndarray]) -> Intrinsics:
    """The lopsided ball, with every map that a scene needs."""
    return Intrinsics(**{name: value for name, value in maps.items() if name != "image"}, camera=Camera(40.0))


def pixels(path: Path) -> np.ndarray:
    """A picture in [0, 1]."""
    return np.asarray(Image.open(path), np.float32) / 255


def test_trimesh_reads_the_card_and_its_textures(intrinsics: Intrinsics, tmp_path: Path) -> None:
    export_scene(tmp_path / "scene", intrinsics)
    assert {path.name for path in (tmp_path / "scene").iterdir()} == FILES
    scene = trimesh.load_scene(tmp_path / "scene" / "card.gltf", process=False)
    (mesh,) = scene.geometry.values()
    material = mesh.visual.material
    maps = intrinsics.require("albedo", "roughness", "metallic", "normal", "mask")
    inside = maps["mask"][..., 0] == 1
    color = np.asarray(material.baseColorTexture, np.float32) / 255
    np.testing.assert_allclose(color[inside, :3], srgb_encode(maps["albedo"][inside]), rtol=0, atol=0.003)
    np.testing.assert_array_equal(color[..., 3:], maps["mask"])
    packed = np.asarray(material.metallicRoughnessTexture, np.float32) / 255
    np.testing.assert_allclose(packed[inside, 1:2], maps["roughness"][inside], rtol=0, atol=0.003)
    np.testing.assert_allclose(packed[inside, 2:], maps["metallic"][inside], rtol=0, atol=0.003)
    normal = np.asarray(material.normalTexture, np.float32) / 255 * 2 - 1
    front = inside & ((maps["normal"] * intrinsics.camera.view_directions(16, 16)).sum(axis=-1) > 0.05)
    assert front.sum() > 0.9 * inside.sum()  # the others are bent
    np.testing.assert_allclose(normal[front], maps["normal"][front], rtol=0, atol=0.01)
    # Up in the picture is up in the scene: v of trimesh counts from below.
    top_left = mesh.vertices[np.argmax(mesh.vertices[:, 1] - mesh.vertices[:, 0])]
    assert mesh.visual.uv[np.argmax(mesh.vertices[:, 1] - mesh.vertices[:, 0])].tolist() == [0, 1]
    assert top_left[0] < 0 < top_left[1]
    assert (mesh.face_normals @ [0, 0, 1] > 0.999).all()


@pytest.mark.parametrize("camera", [Camera(50.0), Camera(30.0, (0.3, 0.8))])
def test_the_card_fills_the_frame_of_the_camera(intrinsics: Intrinsics, camera: Camera) -> None:
    card = Card.of(intrinsics.replace(camera=camera))
    v, u = ((np.mgrid[:16, :16] + 0.5) / 16).astype(np.float32)
    towards = card.points(u.ravel(), v.ravel()) - [0, 0, card.distance]
    towards /= np.linalg.norm(towards, axis=-1, keepdims=True)
    rays = camera.rays(16, 16).reshape(-1, 3)
    np.testing.assert_allclose(towards, rays, rtol=0, atol=1e-6)
    assert np.abs(towards - Camera(35.0).rays(16, 16).reshape(-1, 3)).max() > 0.02  # the twin
    assert ("cameras" in document(card)) == (camera.principal == (0.5, 0.5))


def test_outside_the_mask_maps_go_on(intrinsics: Intrinsics) -> None:
    card = Card.of(intrinsics)
    outside = card.opacity[..., 0] == 0
    assert outside.any()
    assert intrinsics.roughness is not None
    assert (intrinsics.roughness[outside] == 0).all()
    np.testing.assert_allclose(card.roughness, 0.3, rtol=0, atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(card.normal, axis=-1), 1, rtol=0, atol=1e-6)


def test_normals_that_face_away_are_bent(intrinsics: Intrinsics) -> None:
    maps = intrinsics.require("normal", "mask")
    away = np.broadcast_to(np.array([0.8, 0, -0.6], np.float32), maps["normal"].shape) * maps["mask"]
    card = Card.of(intrinsics.replace(normal=away))
    cosine = (card.normal * card.camera.view_directions(16, 16)).sum(axis=-1)
    assert (cosine > 0).all()
    assert (card.tangent_normal()[..., 2] > 0.5).all()
    assert card.normal[8, 8, 0] > 0.95  # and still to the right


def test_a_grid_of_a_large_picture_is_bounded(intrinsics: Intrinsics) -> None:
    wide = MOST_VERTICES + 200
    maps = {"albedo": 3, "normal": 3, "roughness": 1, "metallic": 1}
    normal = np.tile(np.array([0, 0, 1], np.float32), (3, wide, 1))
    values: dict[str, Any] = {name: np.full((3, wide, channels), 0.5, np.float32) for name, channels in maps.items()}
    card = Card.of(intrinsics.replace(**values | {"normal": normal, "mask": None, "specular": None, "diffuse": None}))
    data = ply_bytes(card)
    assert f"element vertex {(MOST_VERTICES + 2) * 5}\n".encode() in data
    corners = np.frombuffer(data.split(b"end_header\n")[1], "<f4", (MOST_VERTICES + 2) * 5 * 8).reshape(-1, 8)
    edges = card.points(np.array([0, 1], np.float32), np.array([0, 1], np.float32))
    np.testing.assert_allclose(corners[[0, -1], :3], edges, rtol=0, atol=1e-5)


def test_the_light_is_stored_as_it_is(intrinsics: Intrinsics, tmp_path: Path) -> None:
    export_scene(tmp_path / "scene", intrinsics)
    stored = channels_rgb(read_exr(tmp_path / "scene" / "environment.exr")[0])
    np.testing.assert_array_equal(stored, intrinsics.require("environment")["environment"])
    texels = (tmp_path / "scene" / "environment.pfm").read_bytes()[-stored.nbytes :]
    np.testing.assert_array_equal(np.frombuffer(texels, "<f4").reshape(stored.shape)[::-1], stored)
    meta = json.loads((tmp_path / "scene" / "meta.json").read_text())
    assert (meta["fov_deg"], meta["width"], meta["distance"]) == (40.0, 16, Camera(40.0).distance())


def test_a_light_is_finer_only_where_mitsuba_would_miss_its_pole(intrinsics: Intrinsics, tmp_path: Path) -> None:
    light = np.full((128, 256, 3), 0.05, np.float32)
    light[-1] = 2000
    for number, (given, rows) in enumerate(((light, 255), (light[::-1], 255), (light[:-1], 127), (0 * light, 128))):
        export_scene(tmp_path / str(number), intrinsics.replace(environment=given))
        stored = channels_rgb(read_exr(tmp_path / str(number) / "environment.exr")[0])
        assert len(stored) == rows
        np.testing.assert_array_equal(stored[:: 2 if rows > len(given) else 1], given)


def test_what_cannot_be_exported_is_refused_and_leaves_nothing(intrinsics: Intrinsics, tmp_path: Path) -> None:
    normal = intrinsics.require("normal")["normal"]
    several: dict[str, Any] = {name: value[None] for name, value in intrinsics.maps.items()}
    for broken, said in (
        (intrinsics.replace(environment=None), "environment missing"),
        (intrinsics.replace(normal=0 * normal), "no pixel is covered"),
        (Intrinsics(**several), r"expected one picture \(h, w, c\)"),
    ):
        with pytest.raises(UnirenderError, match=said):
            export_scene(tmp_path / "scene", broken)
    assert not list(tmp_path.iterdir())
    export_scene(tmp_path / "scene", intrinsics)
    with pytest.raises(UnirenderError, match="--overwrite"):
        export_scene(tmp_path / "scene", intrinsics)
    export_scene(tmp_path / "scene", intrinsics, overwrite=True)


def test_a_second_folder_appears_with_the_first(tmp_path: Path) -> None:
    out = tmp_path / "out"
    for path in ("beside", "out/in/side"):
        with new_folder(out, overwrite=True) as folder, folder_beside(tmp_path / path, out, folder) as second:
            (folder / "meta.json").write_text("{}")
            (second / "file").write_text(path)
            assert not (tmp_path / path).exists()
        assert (tmp_path / path / "file").read_text() == path
    for path in ("out", ".", "scene.xml"):
        with (
            pytest.raises(UsageError, match=r"output folder|named like a file"),
            new_folder(out, overwrite=True) as folder,
            folder_beside(tmp_path / path, out, folder),
        ):
            pass
    assert {path.name for path in tmp_path.iterdir()} == {"out", "beside"}


def run(*arguments: str | Path) -> int:
    with pytest.raises(SystemExit) as stop:
        main([str(argument) for argument in arguments])
    return int(stop.value.code or 0)


@pytest.mark.slow
def test_decompose_exports(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    picture = np.full((24, 20, 4), (180, 120, 60, 255), np.uint8)
    Image.fromarray(picture).save(tmp_path / "card.png")
    arguments = ("decompose", tmp_path / "card.png", "--output", tmp_path / "out", "--fov", "30")
    assert run(*arguments, "--export", tmp_path / "out" / "scene") == 0
    scene = tmp_path / "out" / "scene"
    assert {path.name for path in scene.iterdir()} == FILES
    assert json.loads((scene / "meta.json").read_text())["fov_deg"] == 30
    np.testing.assert_allclose(pixels(scene / "roughness.png"), pixels(tmp_path / "out" / "roughness.png"), atol=0.005)
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "mine").write_text("")
    capsys.readouterr()
    assert run(*arguments, "--overwrite", "--export", tmp_path / "full") == 1  # before anything is computed
    assert "no meta.json" in capsys.readouterr().err
    assert scene.is_dir()  # the earlier result is as it was
    assert run(*arguments, "--overwrite", "--export", tmp_path / "out") == 2
    capsys.readouterr()
    assert run("decompose", tmp_path, "--output", tmp_path / "all", "--export", tmp_path / "scenes") == 1
    assert "one picture for --export" in capsys.readouterr().err
    assert {path.name for path in tmp_path.iterdir()} == {"card.png", "out", "full"}
