"""Depth from normals, and the directions that surfaces hide from one another, against closed forms."""

import math

import numpy as np
import pytest
import torch
from seen_shapes import CAMERA, SIZE, as_maps, ball, gutter, rays

from unirender.camera import Camera
from unirender.intrinsics import Intrinsics
from unirender.light.environment import environment_directions, texel_solid_angles
from unirender.light.exposure import exposure_factor
from unirender.light.lobes import texel_directions, texels
from unirender.light.surface_light import QUADRATURE_SHAPE
from unirender.light.symmetries import mirror, quarter_turn
from unirender.pipelines.derived_light import derived_diffuse, derived_light, derived_specular
from unirender.pipelines.editing import RELIGHT_TARGET, under_light
from unirender.pipelines.normal_integration import RIGHT, TETHER, _neighbours, _system, integrate_normals
from unirender.pipelines.remembered import forget_pictures
from unirender.pipelines.self_shadow import SECTORS, SelfShadow, _angle, _bits, _distance_to_ends, _middles
from unirender.pipelines.shadowed_light import (
    LEAST_ROUGHNESS,
    SHADOW_SIDE,
    SeenShadows,
    _distribution,
    seen_shadows,
    visible_shares,
    visible_shares_under,
)


def sky(rows: int = 16) -> np.ndarray:
    """A lamp to the right before a dim, coloured sky."""
    directions = environment_directions(rows, 2 * rows)
    lamp = 20 * np.exp(15 * (directions @ np.array([0.95, 0.1, 0.3]) - 1))
    return (lamp[..., None] + np.array([0.1, 0.2, 0.3]) * (1.2 + directions[..., 1:2])).astype(np.float32)


@pytest.mark.parametrize("camera", [CAMERA, Camera(fov_deg=60.0), Camera(fov_deg=50.0, principal=(0.4, 0.55))], ids=str)
def test_the_depth_of_a_ball_is_found(camera: Camera) -> None:
    normal, mask, depth = ball(camera=camera)
    inside = mask[..., 0] > 0
    found = integrate_normals(normal, inside, camera)
    assert np.isnan(found[~inside]).all()
    ratio = (found / depth)[inside]
    error = np.abs(ratio / np.median(ratio) - 1)[normal[..., 2][inside] > 0.3]
    assert np.median(error) < 0.003
    assert np.quantile(error, 0.9) < 0.02  # pixels at the rim may be taken for a step
    assert np.abs(np.log(depth[inside]) - np.log(np.median(depth[inside]))).max() > 0.1  # the twin: no plane


def test_planes_that_meet_keep_their_edge() -> None:
    normal, mask, depth = gutter()
    found = integrate_normals(normal, mask[..., 0] > 0, CAMERA)
    ratio = found / depth
    assert np.abs(ratio / np.median(ratio) - 1).max() < 2e-4  # 5e-4 where one side of each pair counts whole


def test_the_normal_equations_are_those_of_the_weighted_differences() -> None:
    """Row by row: w (N (z_neighbour - z) - slope)^2 over the sides on which there is a pixel."""
    rng = np.random.default_rng(0)
    sides = _neighbours(rng.random((4, 5)) > 0.2)
    count = sides.shape[1]
    facing, slopes = rng.random(count), rng.normal(size=(4, count))
    weights = rng.random((4, count)) * (sides < count)
    weights[RIGHT, 2] = 0
    system, right = _system(sides, facing, weights, slopes)
    expected, expected_right = TETHER * np.eye(count), np.zeros(count)
    for side in range(4):
        for pixel in np.flatnonzero(sides[side] < count):
            row = np.zeros(count)
            row[sides[side, pixel]], row[pixel] = facing[pixel], -facing[pixel]
            expected += weights[side, pixel] * np.outer(row, row)
            expected_right += weights[side, pixel] * slopes[side, pixel] * row
    np.testing.assert_allclose(system.toarray(), expected, atol=1e-14)
    np.testing.assert_allclose(right, expected_right, atol=1e-14)


def test_parts_that_do_not_touch_lie_at_one_depth_and_nothing_is_nothing() -> None:
    normal = np.zeros((SIZE, SIZE, 3), np.float32)
    normal[..., 2] = 1
    inside = np.zeros((SIZE, SIZE), bool)
    inside[5:15, 5:15] = inside[30:40, 25:40] = True
    found = integrate_normals(normal, inside, CAMERA)
    np.testing.assert_allclose(found[inside], 1, atol=1e-3)
    assert np.isnan(integrate_normals(normal, np.zeros_like(inside), CAMERA)).all()
    alone = np.zeros_like(inside)
    alone[3, 3] = True
    assert integrate_normals(normal, alone, CAMERA)[3, 3] == 1


def test_a_ball_hides_nothing_from_itself() -> None:
    normal, mask, _ = ball()
    maps, light = as_maps(normal, mask), sky()
    for share in visible_shares(maps, light).values():
        assert share.min() > 0.99
    assert np.allclose(derived_light(maps, light, ["diffuse"])["diffuse"], derived_diffuse(maps, light), rtol=0.01)


def test_a_gutter_hides_what_its_other_side_stands_before() -> None:
    """From a point of one plane all directions are hidden that lie below the other plane's far edge."""
    normal, mask, depth = gutter()
    shadow = SelfShadow.of(normal, mask, CAMERA)
    assert shadow.where.all()
    points = rays() * depth[..., None]
    row, column = SIZE // 2, SIZE // 4  # on the left plane
    number = row * SIZE + column
    edge = points[row, -1] - points[row, column]  # the farthest that is seen of the right plane
    rim = math.atan2(edge[2], edge[0])  # above the picture's plane
    horizon = math.atan2(
        points[row, SIZE // 2, 2] - points[row, column, 2], points[row, SIZE // 2, 0] - points[row, column, 0]
    )
    angles = np.radians(np.arange(-89.5, 90))
    directions = np.stack([np.cos(angles), np.zeros_like(angles), np.sin(angles)])
    (hidden,), (behind,) = shadow.look(slice(number, number + 1), directions)
    visible = ~hidden
    margin = 2 * math.pi / SECTORS
    assert visible[angles > rim + margin].all()
    assert not visible[(angles > horizon + 3 * margin) & (angles < rim - margin)].any()
    assert behind[hidden].all()
    assert not behind[angles > rim + margin].any()
    left = np.stack([-directions[0], directions[1], directions[2]])
    above = angles > -math.pi / 4 + margin  # its own plane rises to the left
    hidden, behind = shadow.look(slice(number, number + 1), left)
    assert not (hidden | behind)[0][above & (angles > math.pi / 4 + margin)].any()


def test_what_lies_behind_a_thin_surface_may_be_hidden() -> None:
    """A surface that leans to the right sees past the back of a narrow strip, if that is as thin as it looks."""
    normal, mask = np.zeros((SIZE, SIZE, 3), np.float32), np.zeros((SIZE, SIZE, 1), np.float32)
    leaning, strip = np.s_[:, 8:20], np.s_[:, 28:31]
    normal[leaning], normal[strip] = (0.8, 0, 0.6), (0, 0, 1)
    mask[leaning] = mask[strip] = 1
    shadow = SelfShadow.of(normal, mask, CAMERA)
    rows, columns = np.nonzero(shadow.where)
    number = int(np.flatnonzero((rows == SIZE // 2) & (columns == 17))[0])
    angles = np.radians(np.arange(-60.0, 30))  # of directions to the right: below 0 away from the viewer
    right = np.stack([np.cos(angles), 0 * angles, np.sin(angles)]).astype(np.float32)
    (hidden,), (behind,) = shadow.look(slice(number, number + 1), right)
    assert 3 < hidden.sum() < 40
    assert behind[hidden].all()
    assert behind[: int(np.argmax(hidden))].all()  # all that is farther from the viewer
    assert not (hidden | behind)[int(np.flatnonzero(hidden)[-1]) + 1 :].any()
    dark = np.full((16, 32, 3), 1e-3, np.float32)
    lamps = environment_directions(16, 32) @ np.array([0.8, 0, -0.6]) > 0.9  # behind the strip, below what it hides
    light = np.where(lamps[..., None], 5, dark).astype(np.float32)
    shares = []
    for part in (mask, np.where(np.arange(SIZE)[:, None] < 24, mask, 0)):  # with the strip, and without it
        share = visible_shares(as_maps((normal * part).astype(np.float32), part.astype(np.float32)), light, ["diffuse"])
        shares.append(float(share["diffuse"][SIZE // 2, 17].mean()))
    assert shares[0] < shares[1] - 0.1


def test_the_light_of_a_gutter_is_less_where_it_is_hidden() -> None:
    normal, mask, _ = gutter()
    maps, light = as_maps(normal, mask), sky()
    shares = visible_shares(maps, light)
    middle = slice(SIZE // 4, -SIZE // 4)
    for name, share in shares.items():
        assert share.shape == normal.shape
        assert 0 <= share.min() < share.max() <= 1
        # the lamp stands to the right: the right plane, which faces left, hides it from the left one
        left, right = share[middle, SIZE // 2 - 6 : SIZE // 2 - 1], share[middle, SIZE // 2 + 1 : SIZE // 2 + 6]
        assert left.mean() < 0.6, name
        assert right.mean() > left.mean() + 0.1, name
    (alone,) = visible_shares(maps.replace(roughness=None), light, ["diffuse"]).items()
    assert alone[0] == "diffuse"
    assert np.array_equal(alone[1], shares["diffuse"])
    lit = derived_light(maps, light, ["specular", "diffuse"])
    without = derived_light(maps, light, ["specular", "diffuse"], shadows=False)
    assert np.array_equal(without["diffuse"], derived_diffuse(maps, light))
    assert np.array_equal(without["specular"], derived_specular(maps, light))
    for name, share in shares.items():
        np.testing.assert_allclose(lit[name], without[name] * share, rtol=1e-6)
    assert set(derived_light(maps, light, ["specular"])) == {"specular"}
    assert derived_light(maps, light, []) == {}
    sharp, least = (
        visible_shares(as_maps(normal, mask, roughness), light, ["specular"])["specular"]
        for roughness in (0.05, LEAST_ROUGHNESS)
    )
    assert np.array_equal(sharp, least)
    assert np.abs(least - shares["specular"]).max() > 0.02


def test_shadows_of_s_are_weighed_by_a_ggx_lobe() -> None:
    """Seen along the normal, D sums to 4 pi / alpha^2 over all directions of light; it is largest in the mirror's."""
    directions, up = texel_directions((128, 256)), np.array([[0, 0, 1]], np.float32)
    for alpha in (0.09, 0.36, 1.0):
        lobe = _distribution(up @ directions, up @ up.T, up @ directions, np.array([[alpha]], np.float32))[0]
        assert lobe @ texel_solid_angles(128, 256).ravel() == pytest.approx(4 * math.pi / alpha**2, rel=0.01)
    tilted = np.array([[0.48, 0.36, 0.8]], np.float32)
    lobe = _distribution(tilted @ directions, tilted @ up.T, up @ directions, np.array([[0.09]], np.float32))[0]
    assert directions[:, lobe.argmax()] @ (2 * 0.8 * tilted[0] - up[0]) > math.cos(math.radians(1.5))


def test_what_is_left_of_s_is_a_mean_over_its_lobe() -> None:
    """By hand, at pixels of both planes: half vectors between view and light, about the normal."""
    normal, mask, _ = gutter()
    seen = seen_shadows(as_maps(normal, mask))
    part, percent = seen._parts[0]
    found = seen.specular_share(np.full_like(mask, 0.5), sky())[seen._where][part]
    directions, (_, radiance) = texel_directions(QUADRATURE_SHAPE), texels(sky(), QUADRATURE_SHAPE)
    for pixel in np.linspace(0, len(found) - 1, 9).astype(int):
        n, v = seen._n[part][pixel], seen._view[part][pixel]
        half = directions + v[:, None]
        n_h = n @ half / np.linalg.norm(half, axis=0)
        weight = np.maximum(n @ directions, 0) / (1 - n_h**2 * (1 - 0.5**4)) ** 2
        lost = (weight * percent[pixel] / 100) @ radiance / (weight @ radiance)
        np.testing.assert_allclose(found[pixel], 1 - lost, atol=1e-4)
    assert np.ptp(found, axis=0).min() > 0.1


def test_shadows_of_d_are_linear_in_the_light() -> None:
    normal, mask, _ = gutter()
    maps, one, other = as_maps(normal, mask), sky(), sky()[:, ::-1].copy()
    a, b, both = (derived_light(maps, light, ["diffuse"])["diffuse"] for light in (one, other, one + other))
    np.testing.assert_allclose(a + b, both, rtol=1e-3, atol=1e-4)
    doubled = derived_light(maps, 2 * one, ["specular", "diffuse"])
    single = derived_light(maps, one, ["specular", "diffuse"])
    for name, value in single.items():
        np.testing.assert_allclose(2 * value, doubled[name], rtol=1e-4, atol=1e-5)


def test_what_is_left_under_a_light_does_not_depend_on_the_others() -> None:
    """To the bit: a light alone is one of several."""
    normal, mask, _ = gutter()
    maps, lights = as_maps(normal, mask), (sky(), np.ones((2, 4, 3), np.float32))
    names = ("specular", "diffuse")
    together = visible_shares_under(maps, lights, names)
    for light, found in zip(lights, together, strict=True):
        for name, alone in visible_shares(maps, light, names).items():
            np.testing.assert_array_equal(found[name], alone)
    assert np.abs(together[0]["diffuse"] - together[1]["diffuse"]).max() > 0.05


def uneven() -> Intrinsics:
    """A gutter that is cut off at one corner."""
    normal, mask, _ = gutter()
    mask = mask.copy()
    mask[: SIZE // 3, : SIZE // 3] = 0
    return as_maps((normal * mask).astype(np.float32), mask)


def test_a_mirrored_and_a_turned_scene_have_mirrored_and_turned_shadows() -> None:
    given = uneven().replace(environment=sky(33))
    shares = visible_shares(given, given.require("environment")["environment"])
    for change in (mirror, quarter_turn):
        changed = given.replace(**{name: np.ascontiguousarray(value) for name, value in change(given.maps).items()})
        found = visible_shares(changed, changed.require("environment")["environment"])
        for name, share in shares.items():
            expected = change({name: share})[name]
            assert np.abs(found[name] - expected).mean() < 0.03, (change.__name__, name)  # learned from examples
            assert np.abs(share - expected).mean() > 2 * np.abs(found[name] - expected).mean()  # the twin


@pytest.mark.long
def test_larger_pictures_have_the_shadows_of_small_ones() -> None:
    size = 2 * SHADOW_SIDE
    normal, mask, _ = gutter(size)
    large = visible_shares(as_maps(normal, mask), sky())
    normal, mask, _ = gutter(SHADOW_SIDE)
    small = visible_shares(as_maps(normal, mask), sky())
    for name, share in large.items():
        assert share.shape == (size, size, 3)
        assert np.abs(share[::2, ::2] - small[name]).mean() < 0.02


@pytest.mark.parametrize("size", [SIZE, pytest.param(2 * SHADOW_SIDE, marks=pytest.mark.long)])
def test_a_strip_has_the_shadows_that_it_has_in_a_square(size: int) -> None:
    normal, mask, _ = gutter(size)
    rows = slice(3 * size // 8, 5 * size // 8)
    alone = np.zeros_like(mask)
    alone[rows] = 1
    square = visible_shares(as_maps(normal * alone, alone), sky())
    narrow = Camera(fov_deg=2 * math.degrees(math.atan(math.tan(math.radians(CAMERA.fov_deg) / 2) / 4)))
    strip = visible_shares(as_maps(normal[rows], mask[rows]).replace(camera=narrow), sky())
    for name, share in strip.items():
        assert share.shape == (size // 4, size, 3)
        # a bit of a mask may fall to either side, and the network sees another frame
        assert np.abs(share - square[name][rows]).mean() < 0.03 < 0.05 < 1 - share.mean()
        assert share.min() < 0.6


@pytest.mark.parametrize("size", [SIZE, pytest.param(2 * SHADOW_SIDE, marks=pytest.mark.long)])
def test_what_is_hardly_covered_has_the_shadow_beside_it(size: int) -> None:
    normal, mask, _ = gutter(size)
    soft = mask.copy()
    soft[size // 2 :] = 0.3
    found = visible_shares(as_maps(normal, soft), sky())["diffuse"]
    above, below = found[size // 2 - 4 : size // 2], found[size // 2 : size // 2 + 4]
    assert np.abs(below - above[-1]).mean() < 0.04 < 1 - above.mean()
    speck = np.zeros_like(mask)
    speck[size // 4 : size // 2, size // 4 : size // 2] = 1
    speck[-1, -1] = 1e-3  # too little to be there at a smaller size
    assert visible_shares(as_maps(normal, speck), sky())["diffuse"][-1, -1].min() > 0.9


@pytest.mark.long
def test_a_picture_is_looked_at_once_for_all_its_materials(monkeypatch: pytest.MonkeyPatch) -> None:
    """And anew for another picture: one value or the camera differs. What is found is what a fresh look finds."""
    normal, mask, _ = gutter()
    looks = []
    of = SelfShadow.of
    monkeypatch.setattr(SelfShadow, "of", lambda *maps: looks.append(1) or of(*maps))
    rough, smooth = as_maps(normal, mask, roughness=0.6), as_maps(normal, mask, roughness=0.4)
    rough = rough.replace(camera=Camera(fov_deg=41.0))
    smooth = smooth.replace(camera=Camera(fov_deg=41.0))
    visible_shares(rough, sky())
    shares = visible_shares(smooth, sky())
    assert len(looks) == 1
    fresh = SeenShadows(smooth)
    assert np.array_equal(shares["specular"], fresh.specular_share(0.4 * mask, sky()))
    assert np.array_equal(shares["diffuse"], fresh.diffuse_share(sky()))
    looks.clear()
    visible_shares(smooth.replace(camera=Camera(fov_deg=42.0)), sky())
    changed = normal.copy()
    changed[len(changed) // 2, len(changed) // 2] = (0, 0, 1)
    visible_shares(smooth.replace(normal=changed), sky())
    assert len(looks) == 2
    forget_pictures()
    visible_shares(smooth.replace(normal=changed), sky())
    assert len(looks) == 3


def test_masks_that_are_empty_or_a_pixel() -> None:
    normal, mask, _ = gutter()
    nothing = as_maps(normal, np.zeros_like(mask))
    assert (visible_shares(nothing, sky())["specular"] == 1).all()
    thin = np.zeros_like(mask)
    thin[10, 10] = 1
    share = visible_shares(as_maps(normal * thin, thin), sky())["diffuse"]
    assert share[10, 10].min() > 0.8
    assert (share[thin[..., 0] == 0] == 1).all()


def test_an_exposure_that_is_chosen_knows_the_shadows() -> None:
    normal, mask, _ = gutter()
    maps = as_maps(normal, mask)
    for shadows in (True, False):
        lit = under_light(maps, sky(), "auto", shadows=shadows).require("diffuse", "environment")
        assert exposure_factor(lit["diffuse"], mask, RELIGHT_TARGET) == pytest.approx(1, abs=1e-3)
        derived = derived_light(maps, lit["environment"], ["diffuse"], shadows=shadows)["diffuse"]
        np.testing.assert_allclose(lit["diffuse"], derived, rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("turn", [False, True])
def test_a_surface_ends_on_both_sides_of_a_step(turn: bool) -> None:
    depth = np.ones((20, 8))
    depth[:, 4:] = 2
    depth = depth.T if turn else depth
    found = _distance_to_ends(depth, np.ones(depth.shape, bool), 0.1)
    np.testing.assert_array_equal((found.T if turn else found)[10], [1, 2, 1, 0, 0, 1, 2, 1])


def test_bits_are_those_of_the_sectors_between_two_angles() -> None:
    cases = np.array([(0, 64), (0, 0), (63, 64), (10, 20), (20, 10), (9.4, 9.6), (9.6, 10.4)], np.float32).T
    found = _bits(*(_middles(np.cos(angles * np.float32(math.pi / SECTORS))) for angles in cases))
    for (first, last), mask in zip(cases.T, found, strict=True):
        expected = sum(1 << sector for sector in range(SECTORS) if first <= sector + 0.5 < last)
        assert int(mask) == expected, (first, last)
    assert _middles(np.array([-1.1, 1.1], np.float32)).tolist() == [SECTORS, 0]  # cosines, but for rounding


@pytest.mark.parametrize("border", [0, 0.5])
def test_angles_fall_on_the_side_of_a_border_on_which_numpy_has_them(border: float) -> None:
    """At cosines within a few last bits of all borders, and anywhere."""
    scale = SECTORS / math.pi
    cosine = np.cos((np.arange(SECTORS) + border) / scale).astype(np.float32)
    near = [cosine + k * np.spacing(cosine) for k in range(-8, 9)]
    cosine = np.clip(np.concatenate([*near, np.linspace(-1, 1, 999, dtype=np.float32)]), -1, 1)
    found = _angle(torch.acos, np.arccos, scale, border, cosine)
    np.testing.assert_array_equal(np.floor(found + border), np.floor(scale * np.arccos(cosine) + border))
