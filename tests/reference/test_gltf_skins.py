"""Skinned glTF meshes stand where their joints carry them; what else a file has beside its scene is told."""

import json
from typing import Any

import numpy as np
import pytest
from gltf_files import CORNERS, WIDTHS, GltfWriter

from unirender.errors import UnirenderError
from unirender_reference.meshes import load_mesh
from unirender_reference.meshes.load import read_model
from unirender_reference.meshes.surface import Piece

WIDTHS[16] = "MAT4"
BIND = np.array([[0, 2, 0, 1], [-1, 0, 0, 0], [0, 0, 3, 0], [0, 0, 0, 1]], float)  # row by row, as one reads it
JOINT: dict[str, Any] = {"translation": [3, 0, 0], "rotation": [0, 0.6, 0, 0.8], "scale": [1, 2, 1]}


def skinned(tmp_path, joints: list, weights: list, *nodes: dict[str, Any], bind: np.ndarray = BIND) -> Piece:
    """The quad, its corners on joints whose nodes follow that of the mesh, which stands elsewhere."""
    writer = GltfWriter()
    primitive = writer.quad(None)
    primitive["attributes"] |= {
        "NORMAL": writer.accessor(np.tile(np.array([0.6, 0, 0.8], np.float32), (4, 1))),
        "JOINTS_0": writer.accessor(np.array(joints, np.uint8)),
        "WEIGHTS_0": writer.accessor(np.array(weights, np.float32)),
    }
    stored = np.tile(bind.T.reshape(1, 16), (len(nodes), 1)).astype(np.float32)
    writer.json["skins"] = [
        {"joints": [1 + i for i in range(len(nodes))], "inverseBindMatrices": writer.accessor(stored)}
    ]
    writer.mesh(primitive, skin=0, translation=[9, 9, 9], scale=[1, 5, 1])
    writer.json["nodes"] += nodes
    document = writer.document
    writer.document = lambda: document() | {"scenes": [{"nodes": [0]}]}
    return read_model(writer.glb(tmp_path / "skinned.glb")).pieces[0]


def placed(tmp_path, joint: dict[str, Any], bind: np.ndarray = BIND) -> Piece:
    """The same quad in a node below the joint that has its bind matrix: what a rigid skin means."""
    writer = GltfWriter()
    primitive = writer.quad(None)
    primitive["attributes"]["NORMAL"] = writer.accessor(np.tile(np.array([0.6, 0, 0.8], np.float32), (4, 1)))
    writer.mesh(primitive, matrix=bind.T.reshape(-1).tolist())
    writer.json["nodes"].append({**joint, "children": [0]})
    document = writer.document
    writer.document = lambda: document() | {"scenes": [{"nodes": [1]}]}
    return read_model(writer.glb(tmp_path / "placed.glb")).pieces[0]


@pytest.mark.parametrize("mirror", [1, -1])
def test_a_skin_of_one_joint_is_a_node(tmp_path, mirror):
    """They stood where the mesh's own node does, which the format says not to look at."""
    bind = BIND @ np.diag([mirror, 1, 1, 1])
    found = skinned(tmp_path, [[0, 0, 0, 0]] * 4, [[0.5, 0.25, 0.25, 0]] * 4, JOINT, bind=bind)
    expected = placed(tmp_path, JOINT, bind)
    assert found.vertices == pytest.approx(expected.vertices, abs=1e-5)
    assert np.array_equal(found.faces, expected.faces)
    assert found.normals == pytest.approx(expected.normals, abs=1e-5)


def test_a_vertex_between_joints_is_their_weighted_mean(tmp_path):
    weights = np.array([[1, 0], [0.25, 0.75], [0, 2], [0.5, 0.5]])  # of any sum
    found = skinned(
        tmp_path,
        [[0, 1, 0, 0]] * 4,
        [[*pair, 0, 0] for pair in weights],
        {"translation": [1, 0, 0]},
        {"translation": [0, 4, 0]},
        bind=np.eye(4),
    )
    shift = weights / weights.sum(1, keepdims=True) @ [[1, 0, 0], [0, 4, 0]]
    assert found.vertices == pytest.approx(CORNERS + shift, abs=1e-6)
    assert found.normals == pytest.approx(np.tile([0.6, 0, 0.8], (2, 3, 1)), abs=1e-6)


def test_a_joint_without_weight_may_have_any_number(tmp_path):
    """Some exporters leave what was there before."""
    found = skinned(tmp_path, [[0, 7, 0, 0]] * 4, [[1, 0, 0, 0]] * 4, JOINT)
    expected = skinned(tmp_path, [[0, 0, 0, 0]] * 4, [[1, 0, 0, 0]] * 4, JOINT)
    assert np.array_equal(found.vertices, expected.vertices)


def test_broken_skins_are_refused(tmp_path):
    for joints, weights, said in (
        ([7, 0, 0, 0], [1, 0, 0, 0], "its vertices name joint 7, its skin has 1"),
        ([0, 0, 0, 0], [0, 0, 0, 0], "weights of joints are all 0"),
    ):
        with pytest.raises(UnirenderError, match=said):
            skinned(tmp_path, [joints] * 4, [weights] * 4, JOINT)
    with pytest.raises(UnirenderError, match=r"nodes\[1\] is its own parent, expected a tree"):
        skinned(tmp_path, [[0] * 4] * 4, [[1, 0, 0, 0]] * 4, JOINT | {"children": [1]})


def quad(tmp_path, **more: Any) -> Any:
    """The quad as a .gltf with more in its JSON."""
    writer = GltfWriter()
    writer.mesh(writer.quad(writer.material(pbrMetallicRoughness={"baseColorTexture": {"index": 0}})))
    path = writer.gltf(tmp_path / "quad.gltf", external=False)
    document = json.loads(path.read_text())
    document |= {"images": [{"uri": "x.ktx2"}], "textures": [{"extensions": {"KHR_texture_basisu": {"source": 0}}}]}
    path.write_text(json.dumps(document | more))
    return path


def test_what_is_packed_in_another_way_is_named(tmp_path):
    """It said `names images[None], but has 1 of them`, `has no data`, and to export it without."""
    with pytest.raises(UnirenderError, match=r"textures\[0\] has KHR_texture_basisu, expected a PNG, JPEG"):
        load_mesh(quad(tmp_path))
    packed = [{"byteLength": 9, "extensions": {"EXT_meshopt_compression": {"fallback": True}}}]
    with pytest.raises(UnirenderError, match=r"buffers\[0\] stands for EXT_meshopt_compression.* without compression"):
        load_mesh(quad(tmp_path, buffers=packed, materials=[{}]))
    with pytest.raises(UnirenderError, match="requires KHR_texture_basisu, not read here; export its textures as PNG"):
        load_mesh(quad(tmp_path, extensionsRequired=["KHR_texture_basisu"]))


def test_other_scenes_and_variants_are_listed(tmp_path):
    path = quad(tmp_path, materials=[{}])
    document = json.loads(path.read_text())
    document["scenes"].append({"nodes": []})
    document["meshes"][0]["primitives"][0]["extensions"] = {"KHR_materials_variants": {"mappings": []}}
    path.write_text(json.dumps(document))
    assert load_mesh(path).provenance["ignored"] == "material variants, other scenes"
