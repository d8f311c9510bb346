"""Procedural objects: determinism, disjoint splits, closed outward meshes, charts, textures."""

from dataclasses import replace

import numpy as np
import pytest

from unirender.errors import UnirenderError
from unirender_reference.shapes import HELD_OUT_FAMILIES, TRAIN_FAMILIES, MeshObject, Split, make_object, unit_sphere
from unirender_reference.shapes.generator import FAMILIES, _part_texture, draw_family
from unirender_reference.shapes.implicit import mesh_field
from unirender_reference.shapes.material_maps import ROUGHEST, SMOOTHEST, normal_from_height, random_material
from unirender_reference.shapes.mesh_object import signed_volume
from unirender_reference.shapes.noise import soft_step, value_noise
from unirender_reference.shapes.parametric import revolution, rounded_box_part
from unirender_reference.shapes.surface import Part, corner_normals, grid_part
from unirender_reference.textures import random_color, random_palette, random_texture


def parts_of(family: str, seed: int) -> list[Part]:
    made = FAMILIES[family](np.random.default_rng(seed))
    return made if isinstance(made, list) else [made]


@pytest.mark.parametrize("split", ["train", "test"])
def test_object_repeats_and_meets_the_contract(split: Split):
    again = make_object(1, split)
    for seed in range(4):
        obj = make_object(seed, split)
        assert obj.name == f"{split}-{seed:06d}"
        for name in ("vertices", "faces", "normals", "uv", "albedo") * (seed == 1):
            np.testing.assert_array_equal(getattr(obj, name), getattr(again, name))
        assert np.linalg.norm(obj.vertices, axis=1).max() == pytest.approx(1, abs=1e-3)
        assert signed_volume(obj.vertices, obj.faces) > 0
        assert len(obj.faces) < 45_000
        assert obj.provenance["family"] == obj.family
        if obj.uv is not None:
            assert obj.uv.min() >= 0
            assert obj.uv.max() <= 1


def test_splits_draw_other_objects_and_train_has_no_held_out_family():
    train = [draw_family(seed, "train") for seed in range(300)]
    test = [draw_family(seed, "test") for seed in range(300)]
    assert {name for name, _ in train} == set(TRAIN_FAMILIES)
    assert {name for name, _ in test[::2]} == set(HELD_OUT_FAMILIES)
    assert {name for name, _ in test[1::2]} <= set(TRAIN_FAMILIES)
    assert not set(TRAIN_FAMILIES) & set(HELD_OUT_FAMILIES)
    assert len({rng.random() for _, rng in train + test}) == 600  # no stream is shared
    assert make_object(0, "train").family == train[0][0]
    assert [make_object(seed, "test").family for seed in (4, 5)] == [test[4][0], test[5][0]]


@pytest.mark.parametrize("family", sorted(FAMILIES))
def test_every_family_is_closed_and_outward(family):
    for seed in range(2):
        for part in parts_of(family, seed):
            edges = np.sort(part.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
            _, uses = np.unique(edges, axis=0, return_counts=True)
            assert (uses % 2 == 0).all(), "an open edge"
            directed = part.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
            forward = np.unique(directed[directed[:, 0] < directed[:, 1]], axis=0, return_counts=True)[1].sum()
            assert 2 * forward == len(directed), "neighbours of opposite orientation"
            assert signed_volume(part.vertices, part.faces) > 0
            assert np.isfinite(part.corner_uv).all()
            assert part.corner_uv.min() >= 0
            assert part.corner_uv.max() <= 1


@pytest.mark.parametrize("family", sorted(set(FAMILIES) - {"assembly"}))  # it moves its parts after baking
def test_position_map_lies_on_the_surface_it_textures(family):
    for part in parts_of(family, 11):
        h, w, _ = part.position_map.shape
        center_uv = part.corner_uv.mean(1)
        column, row = np.floor(center_uv * [w, h]).astype(int).T
        found = part.position_map[row, column]
        truth = part.vertices[part.faces].mean(1)
        edges = np.linalg.norm(np.diff(part.vertices[part.faces], axis=1), axis=2).max(1)
        extent = np.ptp(part.vertices, axis=0).max()
        # half a texel of parameter away, at most; pinched superquadrics stretch a texel over several percent
        distance = np.linalg.norm(found - truth, axis=1) / (extent + edges)
        assert np.median(distance) < 0.02
        assert np.quantile(distance, 0.95) < 0.08


def test_signed_volume_of_a_box_and_its_twin_that_must_fail():
    part = rounded_box_part(np.array([0.5, 1.0, 1.5]), 0.0)
    assert signed_volume(part.vertices, part.faces) == pytest.approx(8 * 0.75, rel=1e-5)
    assert signed_volume(part.vertices, part.faces[:, ::-1]) == pytest.approx(-8 * 0.75, rel=1e-5)
    assert signed_volume(part.vertices, part.faces[1:]) != pytest.approx(8 * 0.75, rel=1e-5)


def test_creases_keep_a_box_flat_and_a_sphere_smooth():
    box = rounded_box_part(np.array([1.0, 1.0, 1.0]), 0.0)
    normals = corner_normals(box.vertices, box.faces, 30)
    assert np.abs(normals).max(-1) == pytest.approx(1, abs=1e-6)  # every corner normal is an axis
    smooth = corner_normals(box.vertices, box.faces, 180)
    assert np.abs(smooth).max(-1).min() < 0.8  # the twin: without creases the corners are rounded

    theta, phi = np.linspace(0, np.pi, 41)[:, None], np.linspace(0, 2 * np.pi, 81)[None]
    ball = np.stack(np.broadcast_arrays(np.sin(theta) * np.cos(phi), np.cos(theta), np.sin(theta) * np.sin(phi)), -1)
    part = grid_part(ball)
    normals = corner_normals(part.vertices, part.faces, 40)
    cosine = (normals * part.vertices[part.faces]).sum(-1)
    assert cosine.min() > 0.999


def test_marching_cubes_of_a_ball_has_its_volume():
    part = mesh_field(lambda p: np.linalg.norm(p, axis=-1) - 0.8)
    assert signed_volume(part.vertices, part.faces) == pytest.approx(4 / 3 * np.pi * 0.8**3, rel=5e-3)
    normals = corner_normals(part.vertices, part.faces, 180)
    assert ((normals * part.vertices[part.faces]).sum(-1) / 0.8).min() > 0.99


def test_unit_sphere_of_a_regular_tetrahedron_is_its_circumsphere():
    points = np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]], float) * 3 + [5, 6, 7]
    found = unit_sphere(points)
    assert np.linalg.norm(found, axis=1) == pytest.approx(1, abs=2e-2)
    with pytest.raises(UnirenderError, match="zero extent"):
        unit_sphere(np.ones((4, 3)))


def test_colors_are_varied_and_physical():
    rng = np.random.default_rng(0)
    colors = np.stack([random_color(rng) for _ in range(2000)])
    assert colors.min() >= 0.015
    assert colors.max() <= 0.95
    value, saturation = colors.max(1), 1 - colors.min(1) / colors.max(1)
    assert np.mean(value < 0.1) > 0.05
    assert np.mean((value > 0.75) & (saturation < 0.15)) > 0.02
    assert np.mean((value > 0.05) & (value < 0.7) & (saturation < 0.15)) > 0.05
    assert np.mean(saturation > 0.8) > 0.25
    assert np.bincount(colors.argmax(1), minlength=3).min() > 300
    assert 2 <= len(random_palette(rng)) <= 4


def test_textures_are_solid_functions_of_position():
    points = np.random.default_rng(1).uniform(-1, 1, (8, 16, 3)).astype(np.float32)
    kinds = set()
    for seed in range(60):
        kind, texture = random_texture(np.random.default_rng(seed))
        kinds.add(kind)
        color = texture(points)
        assert color.shape == (8, 16, 3)
        assert color.dtype == np.float32
        assert color.min() >= 0.0149
        assert color.max() <= 0.9501
        np.testing.assert_array_equal(texture(points[::-1]), color[::-1])
    assert len(kinds) == 10


def test_noise_meets_its_lattice_and_is_smooth_between():
    noise = replace(value_noise(np.random.default_rng(2)), offset=np.zeros(3, np.float32))
    at, right = np.random.default_rng(3).integers(-40, 40, (50, 3)), np.array([1, 0, 0])
    known, beside = (noise.lattice[tuple(place.T % 32)] for place in (at, at + right))
    for step, share in ((0.0, 0), (0.25, 0.103515625), (0.5, 0.5), (0.9999, 1)):  # t^3 (6 t^2 - 15 t + 10)
        np.testing.assert_allclose(noise(at + step * right), known + share * (beside - known), atol=1e-4)
    points = at + np.random.default_rng(4).random((50, 3))
    octaves = sum(0.5**k * noise(points * 2**k + 7.31 * k) for k in range(3))
    np.testing.assert_allclose(noise.fractal(points, 3), octaves / 1.75, atol=1e-5)
    np.testing.assert_allclose(soft_step(np.array([-1, -0.05, 0, 0.05, 1]), 0.2), [0, 0.25, 0.5, 0.75, 1])


def test_a_vase_is_as_wide_as_its_knots():
    """Its wall is a mean of radii in [0.2, 1]."""
    for seed in range(5):
        around = revolution(np.random.default_rng(seed)).vertices[:, [0, 2]]
        assert 0.3 < np.linalg.norm(around, axis=1).max() <= 1


def test_checks_are_equally_large_on_both_sides_of_zero():
    drawn = (random_texture(np.random.default_rng(seed)) for seed in range(99))
    checker = next(texture for kind, texture in drawn if kind == "checker")
    points = np.zeros((1, 8001, 3), np.float32)
    points[0, :, 0] = np.linspace(-2, 2, 8001)
    steps = np.flatnonzero(np.abs(np.diff(checker(points)[0], axis=0)).max(-1))
    assert len(steps) >= 4
    assert np.ptp(np.diff(steps)) <= 2


def test_a_texture_has_the_place_and_the_size_of_its_part():
    """A part that is moved and enlarged looks the same."""
    part = rounded_box_part(np.array([1.0, 0.6, 0.4]), 0.1)
    moved = replace(part, position_map=3 * part.position_map + np.array([5, 1, -2], np.float32))
    kinds = set()
    for seed in range(6):
        (kind, own), (_, same) = (_part_texture(np.random.default_rng(seed), each, True) for each in (part, moved))
        assert np.isclose(own, same, atol=1e-3).mean() > 0.99, kind
        kinds.add(kind)
    assert len(kinds - {"constant"}) >= 3


# Split, seed, family, texture -> spread of the vertices along each axis, and mean albedo of every 97th texel: one of
# each family, two assemblies, and one of most textures.
OF_SEED = {
    ("train", 0, "smooth_union", "checker"): ((0.479, 0.380, 0.381), (0.449, 0.228, 0.288)),
    ("train", 1, "turned", "cells"): ((0.361, 0.291, 0.555), (0.376, 0.274, 0.336)),
    ("train", 2, "rounded_box", "cells"): ((0.501, 0.503, 0.539), (0.327, 0.143, 0.332)),
    ("train", 7, "prism", "constant"): ((0.552, 0.262, 0.476), (0.452, 0.632, 0.217)),
    ("train", 8, "cylinder", "constant"): ((0.385, 0.370, 0.600), (0.375, 0.253, 0.191)),
    ("train", 10, "revolution", "constant"): ((0.533, 0.323, 0.392), (0.253, 0.227, 0.236)),
    ("train", 11, "assembly", "constant+constant+cells"): ((0.365, 0.275, 0.414), (0.302, 0.257, 0.295)),
    ("train", 12, "shell", "cells"): ((0.293, 0.147, 0.553), (0.039, 0.114, 0.083)),
    ("train", 14, "assembly", "checker+bands+clouds"): ((0.324, 0.359, 0.311), (0.148, 0.256, 0.127)),
    ("train", 16, "displaced_sphere", "gradient"): ((0.435, 0.451, 0.427), (0.413, 0.383, 0.445)),
    ("train", 19, "smooth_difference", "cells"): ((0.499, 0.488, 0.437), (0.152, 0.152, 0.113)),
    ("train", 23, "displaced_sphere", "spots"): ((0.320, 0.665, 0.331), (0.119, 0.118, 0.127)),
    ("train", 38, "displaced_union", "wood"): ((0.474, 0.390, 0.308), (0.202, 0.213, 0.226)),
    ("train", 50, "turned", "stripes"): ((0.377, 0.412, 0.428), (0.378, 0.419, 0.333)),
    ("test", 0, "gyroid", "constant"): ((0.373, 0.375, 0.364), (0.349, 0.015, 0.287)),
    ("test", 1, "displaced_union", "gradient"): ((0.329, 0.395, 0.529), (0.250, 0.102, 0.063)),
    ("test", 2, "stacked_blobs", "speckle"): ((0.201, 0.296, 0.534), (0.489, 0.401, 0.079)),
    ("test", 4, "supershape", "marble"): ((0.502, 0.437, 0.484), (0.390, 0.113, 0.128)),
}


@pytest.mark.parametrize("which", OF_SEED, ids=str)
def test_the_object_of_a_seed_is_what_it_was(which):
    """A data set says no more of an object than its seed."""
    split, seed, family, texture = which
    obj = make_object(seed, split)
    assert (obj.family, obj.provenance["texture"]) == (family, texture)
    spread, color = OF_SEED[which]
    np.testing.assert_allclose(obj.vertices.std(axis=0), spread, rtol=0, atol=2e-3)
    np.testing.assert_allclose(obj.albedo.reshape(-1, 3)[::97].mean(axis=0), color, rtol=0, atol=2e-3)


def test_share_of_textured_objects():
    textured = [make_object(seed, "train").albedo.ndim == 3 for seed in range(12)]
    assert 0.4 < np.mean(textured) < 0.95


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"name": "a.b"}, "rename"),
        ({"faces": np.array([[0, 1, 9]], np.int32)}, "outside the 4 vertices"),
        ({"normals": np.zeros((4, 3), np.float32)}, "unit vectors"),
        ({"albedo": np.full(3, 1.5, np.float32)}, r"within \[0, 1\]"),
        ({"albedo": np.array([0.5, -0.1, 0.5], np.float32)}, r"within \[0, 1\]"),
        ({"albedo": np.array([0.5, np.nan, 0.5], np.float32)}, r"within \[0, 1\]"),
        ({"albedo": np.full((4, 4, 3), 0.5, np.float32)}, "uv absent"),
        ({"vertices": np.full((4, 3), np.nan, np.float32)}, "finite"),
        ({"vertices": np.full((4, 3), 0.1, np.float32)}, "radius 1"),
    ],
)
def test_broken_objects_are_refused(change, message):
    vertices = unit_sphere(np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], float))
    good = {
        "name": "a",
        "family": "mesh",
        "vertices": vertices,
        "faces": np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]], np.int32),
        "normals": np.tile(np.array([[0, 0, 1]], np.float32), (4, 1)),
        "uv": None,
        "albedo": np.full(3, 0.5, np.float32),
    }
    MeshObject(**good)
    with pytest.raises(UnirenderError, match=message):
        MeshObject(**{**good, **change})


def test_negative_seeds_are_refused():
    with pytest.raises(UnirenderError, match="expected seed >= 0"):
        make_object(-1, "train")


def test_maps_leave_shape_and_base_colour_alone():
    """Textured or made of several parts, an object keeps its vertices; a plain one gets texture coordinates."""
    kinds = set()
    for seed in range(4):
        bare, obj = make_object(seed, "train"), make_object(seed, "train", maps=True)
        np.testing.assert_array_equal(obj.albedo, bare.albedo)
        assert (obj.name, len(obj.faces)) == (bare.name, len(bare.faces))
        np.testing.assert_array_equal(obj.vertices[obj.faces], bare.vertices[bare.faces])
        np.testing.assert_array_equal(obj.normals[obj.faces], bare.normals[bare.faces])
        if bare.uv is not None:
            np.testing.assert_array_equal(obj.uv, bare.uv)
        assert bare.roughness is None
        assert bare.metallic is None
        assert bare.normal_map is None
        kinds |= set(obj.provenance["materials"].split("+"))
    assert len(kinds) >= 3


def test_maps_repeat_and_are_those_of_real_materials():
    """Metallic mostly 0 or 1, roughness between polished and matte, normals that lean but do not fold over."""
    steep, two_level = [], []
    again = make_object(1, "test", maps=True)
    for seed in range(5):
        obj = make_object(seed, "test", maps=True)
        for name in ("roughness", "metallic", "normal_map") * (seed == 1):
            np.testing.assert_array_equal(getattr(obj, name), getattr(again, name))
        assert obj.roughness is not None
        assert obj.metallic is not None
        assert obj.normal_map is not None
        assert obj.roughness.shape == obj.metallic.shape == obj.normal_map.shape[:2]
        assert obj.roughness.min() >= SMOOTHEST
        assert obj.roughness.max() <= ROUGHEST
        assert obj.normal_map[..., 2].min() > 0.75
        steep.append(obj.normal_map[..., 2].min() < 0.98)
        two_level.append(((obj.metallic < 0.02) | (obj.metallic > 0.98)).mean())
    assert any(steep)
    assert np.mean(two_level) > 0.8
    other, split = again.roughness, make_object(1, "train", maps=True).roughness
    assert other is not None
    assert split is not None
    assert other.shape != split.shape or not np.array_equal(other, split)


def test_normal_from_height_is_the_slope_in_tangent_space():
    """A tilted, stretched and sheared plane with a ramp on it: the closed form; a wrong sign must fail."""
    u, v = np.meshgrid(np.linspace(0, 1, 20), np.linspace(0, 1, 24))
    along_u, along_v = np.array([2.0, 0, 0]), np.array([0.5, 0, -1.5])  # v runs towards -z and is sheared
    positions = (u[..., None] * along_u + v[..., None] * along_v).astype(np.float32)
    slope = np.array([0.3, 0, -0.2])  # height = slope . position; tangent x = +x, and y = +z (against v)
    expected = np.array([-0.3, 0.2, 1]) / np.linalg.norm([0.3, 0.2, 1])
    normal = normal_from_height(positions @ slope.astype(np.float32), positions)
    np.testing.assert_allclose(normal, np.broadcast_to(expected, normal.shape), atol=1e-4)
    assert np.abs(normal - expected * [1, -1, 1]).min(axis=(0, 1)).max() > 0.3
    np.testing.assert_array_equal(normal_from_height(positions[..., 0], 0 * positions)[..., 2], 1)  # a pole


@pytest.mark.parametrize(
    ("positions", "message"),
    [
        (
            np.random.default_rng(0).random((1, 5, 3)).astype(np.float32),
            r"got \(1, 5\) texels, expected at least \(2, 2\)",
        ),
        (np.full((4, 4, 3), 0.5, np.float32), r"all points are \[0.5, 0.5, 0.5\], expected a surface"),
    ],
)
def test_maps_of_no_surface_are_refused(positions: np.ndarray, message: str):
    with pytest.raises(UnirenderError, match=message):
        random_material(np.random.default_rng(0)).bake(positions)


def test_an_object_without_its_maps_is_the_same_shape():
    obj = make_object(1, "train", maps=True)
    bare = obj.without_maps()
    assert (bare.roughness, bare.metallic, bare.normal_map) == (None, None, None)
    for name in ("vertices", "faces", "normals", "uv", "albedo"):
        assert getattr(bare, name) is getattr(obj, name)
