"""glTF files with known texels: what the loaded object holds at every point is what the specification says."""

import io
import sys
from typing import Any

import numpy as np
import pytest
from gltf_files import (
    CORNERS,
    GOOD,
    QUAD_UV,
    GltfWriter,
    bilinear,
    quad_uv,
    random_pixels,
    unit,
    write_metallic_roughness,
    write_normal_mapped,
)
from PIL import ExifTags, Image
from scipy.spatial.transform import Rotation
from sixteen_bit_files import write_tiff16
from trimesh.visual.gloss import specular_to_pbr

from unirender.color import srgb_decode
from unirender.errors import UnirenderError
from unirender_reference.meshes import images, load_mesh
from unirender_reference.meshes.folder import ModelFolder
from unirender_reference.meshes.gloss import metallic_roughness
from unirender_reference.meshes.gltf_accessors import read_accessor
from unirender_reference.meshes.gltf_document import Document
from unirender_reference.shapes import MeshObject
from unirender_reference.shapes.surface import face_normals

GRID = (np.arange(16) + 0.5) / 8 - 1  # the centres of 8 x 8 texels and points between them
POINTS = np.stack(np.meshgrid(GRID, GRID), axis=-1).reshape(-1, 2)


def shown(obj: MeshObject, points: np.ndarray) -> dict[str, np.ndarray]:
    """What a renderer finds at points (x, y) of the quad: the object's maps through its uv, bilinear."""
    assert obj.uv is not None
    corners = obj.vertices[obj.faces][..., :2].astype(float) * np.sqrt(2)
    weights = np.linalg.solve(
        np.stack([corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]], -1)[None],
        (points[:, None] - corners[None, :, 0])[..., None],
    )[..., 0]
    weights = np.concatenate([1 - weights.sum(-1, keepdims=True), weights], -1)
    face = weights.min(-1).argmax(1)
    assert weights.min(-1).max(1).min() > -1e-6, "a point lies outside the quad"
    uv = np.einsum("nk,nkc->nc", weights[np.arange(len(points)), face], obj.uv[obj.faces[face]])
    found = {}
    for name in ("albedo", "roughness", "metallic", "normal_map"):
        texels = getattr(obj, name)
        if texels is not None and texels.shape != (3,):
            found[name] = bilinear(texels if texels.ndim == 3 else texels[..., None], uv)
        elif texels is not None:
            found[name] = np.tile(texels, (len(points), 1))
    if "normal_map" in found:
        found["normal"] = unit(found.pop("normal_map"))
    return found


@pytest.mark.parametrize("write", GOOD)
def test_every_texel_is_what_the_file_says(tmp_path, write):
    file = write(tmp_path)
    obj = load_mesh(file.path)
    assert obj.normals == pytest.approx(np.tile([0, 0, 1], (len(obj.normals), 1)), abs=1e-6)
    assert face_areas(obj).min() > 0, "faces are turned away"
    found = shown(obj, POINTS)
    assert set(found) == set(file.channels)
    for name, expected in file.channels.items():
        assert found[name] == pytest.approx(expected(POINTS), abs=2e-5), name
        if "color" not in file.path.stem and np.ptp(expected(POINTS)) > 0:  # twin: half a texel away it is not
            assert np.abs(found[name] - expected(POINTS * 0.93)).max() > 0.05, name


def face_areas(obj: MeshObject) -> np.ndarray:
    a, b, c = np.moveaxis(obj.vertices[obj.faces], 1, 0)
    return np.cross(b - a, c - a)[:, 2]


def test_maps_are_the_file_s_texels(tmp_path):
    """Without any resampling: the tile is the picture and one wrapped texel around it."""
    file = write_metallic_roughness(tmp_path)
    obj = load_mesh(file.path)
    inner = np.s_[1:-1, 1:-1]
    assert obj.roughness is not None
    assert obj.metallic is not None
    assert obj.roughness[inner] == pytest.approx(file.pixels["both"][..., 1] / 255 * 0.75, abs=1e-6)
    assert obj.metallic[inner] == pytest.approx(file.pixels["both"][..., 2] / 255 * 0.5, abs=1e-6)
    linear = srgb_decode(file.pixels["base"] / 255) * [0.5, 1.0, 0.25]
    assert obj.albedo == pytest.approx(np.pad(linear, ((1, 1), (1, 1), (0, 0)), mode="wrap"), abs=1e-6)
    told = {name: obj.provenance[name] for name in ("textures", "textures_averaged", "textures_baked")}
    assert told == {"textures": "1", "textures_averaged": "0", "textures_baked": "0"}


def test_mirrored_coordinates_keep_the_picture_s_vectors(tmp_path):
    """The two halves share texels; which way y points is the renderer's to know, from uv (`MeshObject.normal_map`)."""
    obj = load_mesh(write_normal_mapped(tmp_path).path)
    assert obj.normal_map is not None
    assert obj.normal_map.shape == (10, 10, 3)
    points = np.array([[-0.3, 0.2], [0.3, 0.2]])
    left, right = shown(obj, points)["normal"]
    assert left == pytest.approx(right, abs=1e-5)


def quad_glb(tmp_path, fill, extensions=()):
    writer = GltfWriter()
    fill(writer)
    if extensions:
        writer.json["extensionsUsed"] = writer.json["extensionsRequired"] = list(extensions)
    return writer.glb(tmp_path / "quad.glb")


def test_defaults_are_the_specification_s(tmp_path):
    obj = load_mesh(quad_glb(tmp_path, lambda w: w.mesh(w.quad(None))))
    assert obj.albedo == pytest.approx([1, 1, 1])
    assert obj.roughness == pytest.approx(np.ones((2, 2)))
    assert obj.metallic == pytest.approx(np.ones((2, 2)))
    assert obj.normal_map is None


def test_unlit_is_base_color_alone(tmp_path):
    pbr = {"baseColorFactor": [0.2, 0.3, 0.4, 1]}
    unlit = {"KHR_materials_unlit": {}}
    path = quad_glb(tmp_path, lambda w: w.mesh(w.quad(w.material(pbrMetallicRoughness=pbr, extensions=unlit))))
    obj = load_mesh(path)
    assert obj.albedo == pytest.approx([0.2, 0.3, 0.4])
    assert obj.metallic == pytest.approx(np.zeros((2, 2)))
    assert obj.provenance["ignored"] == "", "it is converted"


def test_what_is_ignored_is_listed(tmp_path):
    def fill(w: GltfWriter) -> None:
        material = w.material(
            alphaMode="BLEND",
            emissiveFactor=[1, 0, 0],
            occlusionTexture={"index": 0},
            extensions={"KHR_materials_clearcoat": {"clearcoatFactor": 1}},
        )
        line = {"attributes": {"POSITION": w.accessor(CORNERS)}, "mode": 1}
        w.mesh(w.quad(material), line)

    obj = load_mesh(quad_glb(tmp_path, fill))
    assert obj.provenance["ignored"] == "alpha, clearcoat, emission, occlusion, points and lines"


def test_colors_times_texture_and_several_sets_are_baked(tmp_path):
    """Colours at the corners times a picture, a normal map on turned coordinates: one block of texels for each face."""
    base = np.repeat(np.repeat(random_pixels(7, 2, 2), 32, 0), 32, 1)
    tilt = np.full((4, 4, 3), [255 * 0.8, 127.5, 255 * 0.9]).astype(np.uint8)
    turned = np.array([[1, 1], [1, 0], [0, 0], [0, 1]], np.float32)  # u of the second set runs along -v of the first

    def fill(w: GltfWriter) -> None:
        material = w.material(
            pbrMetallicRoughness={"baseColorTexture": {"index": w.texture(base)}},
            normalTexture={"index": w.texture(tilt), "texCoord": 1},
        )
        primitive = w.quad(material)
        primitive["attributes"]["TEXCOORD_1"] = w.accessor(turned)
        primitive["attributes"]["COLOR_0"] = w.accessor(
            np.array([[1, 1, 1], [1, 1, 1], [0.5, 1, 1], [0.5, 1, 1]], np.float32)
        )
        w.mesh(primitive)

    obj = load_mesh(quad_glb(tmp_path, fill))
    assert obj.provenance["textures_baked"] == "1"
    points = np.array([[-0.5, -0.5], [0.5, 0.2], [-0.4, 0.6]])
    found = shown(obj, points)
    shade = np.stack([1 - 0.25 * (points[:, 1] + 1), np.ones(3), np.ones(3)], -1)
    assert found["albedo"] == pytest.approx(bilinear(srgb_decode(base / 255), quad_uv(points)) * shade, abs=0.02)
    # In space: x of the picture points down and its upward direction to the right, whatever the frame of each block.
    x, y, z = unit(tilt[0, 0] / 255 * 2 - 1)
    in_space = np.array([y, -x, z])
    for point, tangent in zip(points, found["normal"], strict=True):
        assert world(obj, point, tangent) == pytest.approx(in_space, abs=0.01)


def world(obj: MeshObject, point: np.ndarray, tangent: np.ndarray) -> np.ndarray:
    """A tangent vector in space: x along +u, y across it on the side against +v, z the normal of the plane z = 0."""
    assert obj.uv is not None
    for face in obj.faces:
        a, b, c = obj.vertices[face][:, :2] * np.sqrt(2)
        weights = np.linalg.solve(np.stack([b - a, c - a], 1), point - a)
        if weights.min() >= -1e-6 and weights.sum() <= 1 + 1e-6:
            to_uv = np.stack([obj.uv[face[1]] - obj.uv[face[0]], obj.uv[face[2]] - obj.uv[face[0]]], 1)
            jacobian = np.stack([b - a, c - a], 1) @ np.linalg.inv(to_uv)  # d(x, y) / d(u, v)
            x = unit(jacobian[:, 0])
            y = np.array([-x[1], x[0]]) * np.sign(np.array([-x[1], x[0]]) @ -jacobian[:, 1])
            return np.array([*(tangent[0] * x + tangent[1] * y), tangent[2]])
    raise AssertionError("outside")


def test_pictures_of_several_sizes(tmp_path):
    """One material: every picture keeps its texels. Beside another material they share a grid and are interpolated."""
    base, both, bumps = random_pixels(8, 16, 32), random_pixels(9, 8, 8), random_pixels(10, 24, 8)
    bumps[..., 2] = 255
    ramp = np.repeat(np.repeat(np.arange(8, dtype=np.uint8)[None] * 32, 8, 0)[..., None], 3, -1)

    def fill(w: GltfWriter, scalars: np.ndarray, bumpy: bool, beside: bool) -> None:
        pbr = {
            "baseColorTexture": {"index": w.texture(base, (33071, 33071))},
            "metallicRoughnessTexture": {"index": w.texture(scalars, (33071, 33071))},
        }
        normal = {"normalTexture": {"index": w.texture(bumps, (33071, 33071))}} if bumpy else {}
        w.mesh(w.quad(w.material(pbrMetallicRoughness=pbr, **normal)))
        if beside:
            w.mesh(w.quad(None, CORNERS * np.array([0.1, 0.1, 1], np.float32) + np.array([0, 0, 0.1], np.float32)))

    clamp = ("clamp", "clamp")
    for bumpy in (False, True):
        obj = load_mesh(quad_glb(tmp_path, lambda w, bumpy=bumpy: fill(w, both, bumpy, False)))
        found = shown(obj, POINTS)
        expected = {
            "albedo": srgb_decode(base / 255),
            "roughness": both[..., 1:2] / 255,
            "metallic": both[..., 2:] / 255,
        }
        for name, texels in expected.items():
            assert found[name] == pytest.approx(bilinear(texels, quad_uv(POINTS), clamp), abs=2e-5), name
        if bumpy:
            vectors = bilinear(unit(bumps / 255 * 2 - 1), quad_uv(POINTS), clamp)
            assert found["normal"] == pytest.approx(unit(vectors), abs=2e-5)
    obj = load_mesh(quad_glb(tmp_path, lambda w: fill(w, ramp, True, True)))
    inside = POINTS[(np.abs(POINTS).max(1) < 0.8) & (np.abs(POINTS).min(1) > 0.2)]
    smooth = bilinear(ramp[..., 1:2] / 255, quad_uv(inside), clamp)
    assert shown_flat(obj, inside) == pytest.approx(smooth, abs=1e-5)


def shown_flat(obj: MeshObject, points: np.ndarray) -> np.ndarray:
    """The roughness of the larger quad, which is not centred in the unit sphere."""
    assert obj.roughness is not None
    assert obj.uv is not None
    largest = np.ptp(obj.vertices[obj.faces][..., 0], axis=1) > 0.5
    corners = np.unique(obj.faces[largest])
    place = obj.vertices[corners][:, :2] / np.abs(obj.vertices[corners][:, :2]).max(0)
    affine = np.linalg.lstsq(np.column_stack([place, np.ones(len(place))]), obj.uv[corners].astype(float), rcond=None)[
        0
    ]
    return bilinear(obj.roughness[..., None], np.column_stack([points, np.ones(len(points))]) @ affine)


@pytest.mark.parametrize("wrap", [10497, 33648, 33071])
def test_wrap_modes_are_unrolled(tmp_path, wrap):
    base = random_pixels(9, 4, 4)
    uv = QUAD_UV * 2.5 - np.array([0.7, 0.4], np.float32)

    def fill(w: GltfWriter) -> None:
        info = {"index": w.texture(base, (wrap, 10497))}
        w.mesh(w.quad(w.material(pbrMetallicRoughness={"baseColorTexture": info}), uv=uv))

    obj = load_mesh(quad_glb(tmp_path, fill))
    mode = {10497: "repeat", 33648: "mirror", 33071: "clamp"}[wrap]
    expected = bilinear(srgb_decode(base / 255), quad_uv(POINTS) * 2.5 - [0.7, 0.4], (mode, "repeat"))
    assert shown(obj, POINTS)["albedo"] == pytest.approx(expected, abs=2e-5)


def test_quantized_sparse_and_fan(tmp_path):
    """KHR_mesh_quantization's integer positions with a scaling node, one corner moved by a sparse accessor, a fan."""

    def fill(w: GltfWriter) -> None:
        corners = (CORNERS[:, :3] * 100).astype(np.int16)
        corners[2] = 0
        position = w.accessor(np.concatenate([corners, np.zeros((4, 1), np.int16)], 1)[:, :3])
        at, values = w.view(np.array([2], np.uint16).tobytes()), w.view(np.array([100, 100, 0], np.int16).tobytes())
        w.json["accessors"][position]["sparse"] = {
            "count": 1,
            "indices": {"bufferView": at, "componentType": 5123},
            "values": {"bufferView": values},
        }
        w.mesh({"attributes": {"POSITION": position}, "mode": 6}, scale=[0.01] * 3, rotation=[0, 0, 1, 0])

    obj = load_mesh(quad_glb(tmp_path, fill, ["KHR_mesh_quantization"]))
    assert len(obj.faces) == 2
    assert face_areas(obj).sum() / 2 == pytest.approx(2.0, rel=1e-5)


def test_a_node_turns_by_its_quaternion(tmp_path):
    """About an axis of its own: each entry of the matrix counts."""
    quaternion = np.array([0.2, -0.5, 0.4, 0.7]) / np.sqrt(0.94)
    obj = load_mesh(quad_glb(tmp_path, lambda w: w.mesh(w.quad(None), rotation=quaternion.tolist())))
    turned = Rotation.from_quat(quaternion)
    found, expected = (points[points[:, 0].argsort()] for points in (obj.vertices * np.sqrt(2), turned.apply(CORNERS)))
    assert found == pytest.approx(expected, abs=1e-5)
    assert obj.normals == pytest.approx(np.tile(turned.apply([0, 0, 1]), (4, 1)), abs=1e-5)


def test_a_quaternion_of_another_length_is_refused(tmp_path):
    """It sheared and turned by another angle: 131 degrees for these 90."""
    with pytest.raises(UnirenderError, match=r"rotation has the length 2\.83, expected a unit quaternion"):
        load_mesh(quad_glb(tmp_path, lambda w: w.mesh(w.quad(None), rotation=[0, 0, 2, 2])))
    for half, rel in ((0.707, 1e-3), (0.7122, 2e-2)):  # of few digits; of signed bytes
        rounded = load_mesh(quad_glb(tmp_path, lambda w, half=half: w.mesh(w.quad(None), rotation=[0, 0, half, half])))
        assert face_areas(rounded).sum() / 2 == pytest.approx(2.0, rel=rel)


def test_that_texels_are_not_sharp_is_told(tmp_path):
    def fill(w: GltfWriter) -> None:
        texture = w.texture(random_pixels(0, 4, 4), (10497, 10497))
        w.json["samplers"][0]["magFilter"] = 9728
        w.mesh(w.quad(w.material(pbrMetallicRoughness={"baseColorTexture": {"index": texture}})))

    assert load_mesh(quad_glb(tmp_path, fill)).provenance["ignored"] == "sharp texels of textures"


class TwoRoots(GltfWriter):
    """Nodes beyond the second are children."""

    def document(self) -> dict[str, Any]:
        return super().document() | {"scenes": [{"nodes": [0, 1]}]}


def test_hidden_nodes_and_what_is_below_them_are_left_out(tmp_path):
    """They were drawn."""
    writer = TwoRoots()
    for y, node in enumerate(({}, {"children": [2]}, {})):
        extension = {"KHR_node_visibility": {"visible": y != 1}}
        writer.mesh(writer.quad(None), translation=[0, 5 * y, 0], extensions=extension, **node)
    writer.json["extensionsUsed"] = writer.json["extensionsRequired"] = ["KHR_node_visibility"]
    assert len(load_mesh(writer.glb(tmp_path / "hidden.glb")).faces) == 2


def test_a_texture_is_refined_to_the_nearest_texels():
    texels = np.arange(6, dtype=np.float32).reshape(2, 3, 1)
    np.testing.assert_array_equal(images.nearest(texels, 4, 9), texels.repeat(2, axis=0).repeat(3, axis=1))


def test_specular_glossiness_is_converted_as_trimesh_does(tmp_path):
    rng = np.random.default_rng(3)
    diffuse, specular, gloss = rng.random((5, 4, 3)), rng.random((5, 4, 3)) * 0.6, rng.random((5, 4, 1))
    ours = metallic_roughness(*(a.astype(np.float32) for a in (diffuse, specular, gloss)))
    theirs = [
        specular_to_pbr(
            specularFactor=specular[i, j], glossinessFactor=gloss[i, j, 0], diffuseFactor=[*diffuse[i, j], 1.0]
        )
        for i in range(5)
        for j in range(4)
    ]
    assert ours[0].reshape(-1, 3) == pytest.approx(np.array([t["baseColorFactor"][:3] for t in theirs]), abs=1e-4)
    assert ours[1].ravel() == pytest.approx([t["roughnessFactor"] for t in theirs], abs=1e-5)
    assert ours[2].ravel() == pytest.approx([t["metallicFactor"] for t in theirs], abs=1e-4)
    extension = {"diffuseFactor": [0.5, 0.4, 0.3, 1], "specularFactor": [0, 0, 0], "glossinessFactor": 0.3}
    gloss_only = {"KHR_materials_pbrSpecularGlossiness": extension}
    obj = load_mesh(quad_glb(tmp_path, lambda w: w.mesh(w.quad(w.material(extensions=gloss_only)))))
    assert obj.metallic == pytest.approx(np.zeros((2, 2)))
    assert obj.roughness == pytest.approx(np.full((2, 2), 0.7))


def test_draco(tmp_path, monkeypatch):
    draco = pytest.importorskip("DracoPy")
    ball = np.random.default_rng(0).random((30, 3)).astype(np.float32)
    faces = np.arange(30, dtype=np.uint32).reshape(10, 3)
    data = draco.encode(ball, faces, quantization_bits=20, preserve_order=True)

    def fill(w: GltfWriter) -> None:
        position = w.json["accessors"]
        position += [
            {"componentType": 5126, "count": 30, "type": "VEC3"},
            {"componentType": 5125, "count": 30, "type": "SCALAR"},
        ]
        extension = {"bufferView": w.view(data), "attributes": {"POSITION": 0}}
        packed = {"KHR_draco_mesh_compression": extension}
        w.mesh({"attributes": {"POSITION": 0}, "indices": 1, "extensions": packed})

    path = quad_glb(tmp_path, fill, ["KHR_draco_mesh_compression"])
    obj = load_mesh(path)
    a, b, c = np.moveaxis(obj.vertices[obj.faces], 1, 0)
    p, q, r = np.moveaxis(ball[faces], 1, 0)
    ratio = np.linalg.norm(np.cross(b - a, c - a), axis=1) / np.linalg.norm(np.cross(q - p, r - p), axis=1)
    assert sorted(ratio) == pytest.approx([np.median(ratio)] * 10, rel=1e-3)
    monkeypatch.setitem(sys.modules, "DracoPy", None)
    with pytest.raises(UnirenderError, match="compressed with Draco: install DracoPy"):
        load_mesh(path)
    monkeypatch.undo()
    packed, data = (
        data,
        draco.encode(ball, np.vstack([faces, faces[:, ::-1]]), quantization_bits=20, preserve_order=True),
    )
    with pytest.raises(UnirenderError, match="its Draco data holds 60 indices, expected 30"):
        load_mesh(quad_glb(tmp_path, fill, ["KHR_draco_mesh_compression"]))
    data = packed[: len(packed) // 2] + b"\0" * (len(packed) // 2)
    with pytest.raises(UnirenderError, match="its Draco data is damaged"):
        load_mesh(quad_glb(tmp_path, fill, ["KHR_draco_mesh_compression"]))


def test_jpeg_palette_and_grey_pictures(tmp_path):
    for mode, suffix in (("RGB", "JPEG"), ("P", "PNG"), ("L", "PNG"), ("LA", "PNG"), ("I;16", "PNG"), ("RGB", "WEBP")):
        stream = io.BytesIO()
        grey = Image.fromarray(np.full((16, 16), 188, np.uint8))
        picture = Image.fromarray(np.full((16, 16), 188 * 257, np.uint16)) if mode == "I;16" else grey.convert(mode)
        picture.save(stream, suffix)

        def fill(w: GltfWriter, data: bytes = stream.getvalue()) -> None:
            index = w._add("textures", {"source": w._add("images", {"bufferView": w.view(data)})})
            w.mesh(w.quad(w.material(pbrMetallicRoughness={"baseColorTexture": {"index": index}})))

        obj = load_mesh(quad_glb(tmp_path, fill))
        assert obj.albedo == pytest.approx(np.full_like(obj.albedo, srgb_decode(np.array(188 / 255))), abs=8e-3), mode


def checkerboard(side: int) -> np.ndarray:
    """Black and white texels in turn; the mean of their light is 0.5, of their sRGB coding 0.216."""
    return np.repeat((np.indices((side, side)).sum(0) % 2 * 255).astype(np.uint8)[..., None], 3, axis=-1)


@pytest.mark.parametrize("side", [1536, 2048])
def test_large_picture_is_reduced_in_linear_light(tmp_path, side):
    def fill(w: GltfWriter) -> None:
        w.mesh(w.quad(w.material(pbrMetallicRoughness={"baseColorTexture": {"index": w.texture(checkerboard(side))}})))

    obj = load_mesh(quad_glb(tmp_path, fill))
    assert obj.albedo.shape == (1026, 1026, 3)
    assert obj.albedo.mean() == pytest.approx(0.5, abs=1e-3)
    if side == 2048:  # whole texels in every mean
        assert np.abs(obj.albedo - 0.5).max() < 1e-5


def test_large_data_are_reduced_as_numbers_and_vectors(tmp_path):
    """Two roughnesses and two slopes in turn: the mean number, and the direction of the mean vector."""
    board = checkerboard(2100)[..., :1] > 0
    both = np.where(board, [0, 40, 0], [0, 200, 100]).astype(np.uint8)
    bumps = np.where(board, [255, 128, 255], [128, 128, 255]).astype(np.uint8)

    def fill(w: GltfWriter) -> None:
        pbr = {"metallicRoughnessTexture": {"index": w.texture(both)}}
        normal = {"index": w.texture(bumps), "scale": 0.5}
        w.mesh(w.quad(w.material(pbrMetallicRoughness=pbr, normalTexture=normal)))

    obj = load_mesh(quad_glb(tmp_path, fill))
    assert obj.roughness is not None
    assert obj.metallic is not None
    assert obj.normal_map is not None
    assert obj.roughness.mean() == pytest.approx(120 / 255, abs=1e-4)
    assert obj.metallic.mean() == pytest.approx(50 / 255, abs=1e-4)
    mean = (np.array([255 + 128, 256, 510]) / 255 - 1) * [0.5, 0.5, 1]
    assert obj.normal_map.mean((0, 1), dtype=float) == pytest.approx(unit(mean), abs=2e-3)


def test_strips_are_the_whole_picture(monkeypatch):
    """A picture decoded in strips of a few rows, to a size that does not divide its own: exact means of area."""
    stored = random_pixels(0, 301, 173)
    linear_light = srgb_decode(stored / 255).astype(np.float64)
    weights = [
        np.clip(np.minimum(i + 1, edge + n / k) - np.maximum(i, edge), 0, None) * k / n
        for n, k in ((301, 100), (173, 57))
        for i, edge in [(np.arange(n), np.arange(k)[:, None] * n / k)]
    ]
    expected = np.einsum("ai,bj,ijc->abc", *weights, linear_light, optimize=True)
    for strip in (500_000, 1000):
        monkeypatch.setattr(images, "STRIP", strip)
        found = images.texels_of(Image.fromarray(stored), "a", 100, "RGB", srgb_decode)
        assert np.abs(found - expected).max() < 1e-6
    same = images.texels_of(Image.fromarray(stored), "a", 301, "RGB", srgb_decode)
    assert np.abs(same - linear_light).max() < 1e-6


@pytest.mark.parametrize("orientation", [1, 3, 6])
def test_texels_lie_as_they_are_stored_in_every_format(orientation):
    """As other programs take them; Pillow turns a TIFF as its EXIF says."""
    stored, exif = random_pixels(0, 7, 5), Image.Exif()
    exif[ExifTags.Base.Orientation] = orientation
    for kind in ("PNG", "TIFF"):
        data = io.BytesIO()
        Image.fromarray(stored).save(data, kind, exif=exif)
        image = images.ImageBudget().open(data.getvalue(), "a")
        texels = images.texels_of(image, "a", 99, "RGB", images.linear)
        np.testing.assert_allclose(texels, stored / 255, atol=1e-6, err_msg=kind)


def test_a_texture_of_which_noise_would_be_made_is_refused(tmp_path):
    """As a picture is; the compressed one loses its low bytes alone."""
    stored = np.random.default_rng(0).integers(0, 65536, (8, 9, 3))
    for compressed in (True, False):
        write_tiff16(tmp_path / "a.tif", stored, planar=True, compressed=compressed)
        image = images.ImageBudget().open((tmp_path / "a.tif").read_bytes(), "a")
        if compressed:
            texels = images.texels_of(image, "a", 99, "RGB", images.linear)
            np.testing.assert_allclose(texels, stored / 65535, rtol=0, atol=0.5 / 128)
        else:
            with pytest.raises(UnirenderError, match="texture a: its channels are stored one after the other"):
                images.texels_of(image, "a", 99, "RGB", images.linear)


def test_only_textured_materials_share_the_atlas(tmp_path):
    """99 plain materials take no room from the picture of the hundredth, whatever they are called."""

    def fill(w: GltfWriter) -> None:
        picture = {"index": w.texture(random_pixels(0, 512, 512))}
        w.mesh(w.quad(w.material(pbrMetallicRoughness={"baseColorTexture": picture})))
        for i in range(99):
            plain = w.material(name="someTexture'", pbrMetallicRoughness={}, occlusionTexture=picture)
            w.mesh(w.quad(plain, CORNERS + np.array([0, 0, i + 1], np.float32)))

    assert min(load_mesh(quad_glb(tmp_path, fill)).albedo.shape[:2]) >= 512


def test_meshes_without_normals_are_flat(tmp_path):
    """Two faces that meet at 11 degrees: flat in glTF as its specification has it, smooth in an OBJ."""
    bent = CORNERS + np.array([[0, 0, 0], [0, 0, 0.2], [0, 0, 0], [0, 0, 0.2]], np.float32)
    obj = load_mesh(quad_glb(tmp_path, lambda w: w.mesh(w.quad(None, bent), scale=[-2, 1, 1])))
    faces = face_normals(obj.vertices, obj.faces)
    faces /= np.linalg.norm(faces, axis=1, keepdims=True)
    assert faces[0] @ faces[1] < 0.99
    assert obj.normals[obj.faces] == pytest.approx(np.repeat(faces[:, None], 3, axis=1), abs=1e-3)
    lines = [f"v {x} {y} {z}" for x, y, z in bent]
    (tmp_path / "bent.obj").write_text("\n".join([*lines, "f 1 2 3", "f 1 3 4", ""]))
    assert len(load_mesh(tmp_path / "bent.obj").vertices) == 4


def test_rows_of_an_accessor(tmp_path):
    """Some elements are those of the whole: dense, normalised, and with sparse values inside and outside of them."""
    writer = GltfWriter()
    dense = np.random.default_rng(0).integers(0, 2**16, (50, 2), dtype=np.uint16)
    index = writer.accessor(dense, normalized=True)
    at, new = np.array([3, 7, 20, 49], np.uint16), np.random.default_rng(1).integers(0, 9, (4, 2), dtype=np.uint16)
    writer.json["accessors"][index]["sparse"] = {
        "count": 4,
        "indices": {"bufferView": writer.view(at.tobytes()), "componentType": 5123},
        "values": {"bufferView": writer.view(new.tobytes())},
    }
    path = writer.glb(tmp_path / "a.glb")
    document = Document(path, ModelFolder(path))
    whole = read_accessor(document, index)
    dense[at] = new
    assert whole == pytest.approx(dense / 65535, abs=1e-7)
    for rows in (np.array([0, 3, 4, 21, 49]), np.array([5]), np.zeros(0, int)):
        assert np.array_equal(read_accessor(document, index, rows), whole[rows])


def test_required_extension_is_a_reason(tmp_path):
    path = quad_glb(tmp_path, lambda w: w.mesh(w.quad(None)), ["KHR_texture_basisu", "EXT_meshopt_compression"])
    with pytest.raises(UnirenderError, match="requires EXT_meshopt_compression, KHR_texture_basisu, not read"):
        load_mesh(path)


def test_faces_share_normals_and_places_through_nodes(tmp_path):
    """A child node's matrix and its parent's scale; the same mesh twice."""

    def fill(w: GltfWriter) -> None:
        mesh = w._add("meshes", {"primitives": [w.quad(None)]})
        w.json["nodes"] = [
            {"children": [1, 2], "scale": [2, 2, 2]},
            {"mesh": mesh, "matrix": [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 3, 0, 0, 1]},
            {"mesh": mesh, "translation": [-3, 0, 0]},
        ]

    writer = GltfWriter()
    fill(writer)
    document = writer.document
    writer.document = lambda: document() | {"scenes": [{"nodes": [0]}]}
    obj = load_mesh(writer.glb(tmp_path / "nodes.glb"))
    assert len(obj.faces) == 4
    assert np.ptp(obj.vertices[:, 0]) / np.ptp(obj.vertices[:, 1]) == pytest.approx(4.0, rel=1e-3)


def textured_quad(tmp_path, sizes: tuple[int, int], texcoord: int = 0, **node: Any) -> MeshObject:
    def fill(w: GltfWriter) -> None:
        first, second = (w.texture(random_pixels(size, size, size)) for size in sizes)
        maps = {"baseColorTexture": {"index": first}, "metallicRoughnessTexture": {"index": second}}
        maps["baseColorTexture"]["texCoord"] = texcoord
        w.mesh(w.quad(w.material(pbrMetallicRoughness=maps)), **node)

    return load_mesh(quad_glb(tmp_path, fill))


def test_what_a_picture_lost_is_listed(tmp_path):
    """Of a smaller picture the contrast, of one whose coordinates are missing everything but its mean."""
    assert textured_quad(tmp_path, (8, 8)).provenance["ignored"] == ""
    assert textured_quad(tmp_path, (8, 1)).provenance["ignored"] == ""
    assert textured_quad(tmp_path, (8, 6)).provenance["ignored"] == "sharpness of smaller textures"
    assert textured_quad(tmp_path, (8, 8), texcoord=3).provenance["ignored"] == "textures of faces without coordinates"


def test_instances_stand_where_nodes_would(tmp_path):
    """Turned, mirrored and stretched instances, of a node that is so, against a matrix for each."""
    quad = CORNERS + np.array([[0, 0, 0], [0, 0, 0.3], [0, 0, 0], [0.5, 0, 0]], np.float32)
    shift = np.array([[0, 0, 0], [3, 1, 0], [0, 2, -4]], np.float32)
    turn = np.array([[0, 0, 0, 32767], [0, 32767, 0, 0], [23170, 0, 0, 23170]], np.int16)
    stretch = np.array([[1, 1, 1], [2, 1, -1], [1, 0.5, 3]], np.float32)
    above = affine([1, 2, 3], Rotation.from_euler("xyz", [0.3, 0.5, 0.1]).as_quat(), [1, 2, 1])

    def nodes(w: GltfWriter) -> None:
        w.json["meshes"] = [{"primitives": [w.quad(None, quad)]}]
        matrices = [above @ affine(*own) for own in zip(shift, turn, stretch, strict=True)]
        w.json["nodes"] = [{"mesh": 0, "matrix": matrix.T.ravel().tolist()} for matrix in matrices]

    def instances(w: GltfWriter, count: int = 3) -> None:
        values = {"TRANSLATION": w.accessor(shift[:count]), "ROTATION": w.accessor(turn, normalized=True)}
        extension = {"EXT_mesh_gpu_instancing": {"attributes": values | {"SCALE": w.accessor(stretch)}}}
        w.mesh(w.quad(None, quad), matrix=above.T.ravel().tolist(), extensions=extension)

    expected = load_mesh(quad_glb(tmp_path, nodes))
    obj = load_mesh(quad_glb(tmp_path, instances, ["EXT_mesh_gpu_instancing"]))
    assert len(obj.faces) == 6
    assert obj.vertices[obj.faces] == pytest.approx(expected.vertices[expected.faces], abs=2e-4)
    assert obj.normals[obj.faces] == pytest.approx(expected.normals[expected.faces], abs=2e-4)
    assert obj.provenance["ignored"] == ""
    with pytest.raises(UnirenderError, match="ROTATION of its instances is 3 times 4, expected 2 times 4"):
        load_mesh(quad_glb(tmp_path, lambda w: instances(w, count=2)))


def affine(translation, quaternion, scale) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_quat(quaternion).as_matrix() * scale
    matrix[:3, 3] = translation
    return matrix


def test_what_is_scaled_to_nothing_takes_no_room(tmp_path):
    """glTF 2.0, 3.5.3: a mesh is hidden so. One scaled to a plane is not."""

    def two(w: GltfWriter, scale: list[int]) -> None:
        w.mesh(w.quad(None))
        w.mesh(w.quad(None), translation=[0, 100, 0], scale=scale)

    alone = load_mesh(quad_glb(tmp_path, lambda w: w.mesh(w.quad(None))))
    hidden = load_mesh(quad_glb(tmp_path, lambda w: two(w, [0, 0, 0])))
    assert hidden.vertices == pytest.approx(alone.vertices, abs=1e-6)
    assert len(load_mesh(quad_glb(tmp_path, lambda w: two(w, [1, 1, 0]))).faces) == 4


@pytest.mark.parametrize("normalized", [False, True])
@pytest.mark.parametrize(("kind", "white"), [(np.uint8, 255), (np.uint16, 65535)])
def test_colors_that_are_whole_numbers_are_of_their_type(tmp_path, normalized, kind, white):
    """Also where their accessor does not say `normalized`, which the specification asks for; and dark ones, too."""

    def fill(w: GltfWriter) -> None:
        quad = w.quad(None)
        color = np.array([[51, 0, 255, white]], kind)
        quad["attributes"]["COLOR_0"] = w.accessor(np.tile(color, (4, 1)), normalized)
        w.mesh(quad)

    albedo = load_mesh(quad_glb(tmp_path, fill)).albedo.reshape(-1, 3)
    assert albedo == pytest.approx(np.tile(np.array([51, 0, 255]) / white, (len(albedo), 1)), abs=1e-6)


@pytest.mark.parametrize("normals", [False, True])
def test_morph_targets_move_by_their_weights(tmp_path, normals):
    """By those of the node, which go before the mesh's; without normals of the file the moved faces are flat."""
    first, second = np.zeros((4, 3), np.float32), np.zeros((4, 3), np.float32)
    first[2] = [0.5, 0, 2]
    second[3] = [0, 0, -1]
    leaning = np.tile(np.array([0.3, 0, 0], np.float32), (4, 1))
    up = np.tile(np.array([0, 0, 1], np.float32), (4, 1))

    def morphed(w: GltfWriter, of_mesh: list[float], **node: Any) -> None:
        quad = w.quad(None)
        quad["targets"] = [{"POSITION": w.accessor(first)}, {"POSITION": w.accessor(second)}]
        if normals:
            quad["attributes"]["NORMAL"] = w.accessor(up)
            quad["targets"][0]["NORMAL"] = w.accessor(leaning)
        w.mesh(quad, **node)
        w.json["meshes"][0]["weights"] = of_mesh

    def moved(w: GltfWriter, a: float, b: float) -> None:
        quad = w.quad(None, CORNERS + np.float32(a) * first + np.float32(b) * second)
        if normals:
            quad["attributes"]["NORMAL"] = w.accessor(up + np.float32(a) * leaning)
        w.mesh(quad)

    for of_mesh, node, result in (
        ([0.0, 0.0], {}, (0, 0)),
        ([0.5, 0.25], {}, (0.5, 0.25)),
        ([1.0, 1.0], {"weights": [0, -0.5]}, (0, -0.5)),
    ):
        obj = load_mesh(quad_glb(tmp_path, lambda w, of_mesh=of_mesh, node=node: morphed(w, of_mesh, **node)))
        expected = load_mesh(quad_glb(tmp_path, lambda w, result=result: moved(w, *result)))
        assert obj.vertices[obj.faces] == pytest.approx(expected.vertices[expected.faces], abs=1e-6)
        assert obj.normals[obj.faces] == pytest.approx(expected.normals[expected.faces], abs=1e-6)
        assert obj.provenance["ignored"] == ""
    with pytest.raises(UnirenderError, match="has 2 morph targets and 3 weights, expected one for each"):
        load_mesh(quad_glb(tmp_path, lambda w: morphed(w, [0.0, 0.0, 1.0])))
