"""Light factors, mirror images and turns: group laws, what moves with what, and errors."""

from collections.abc import Callable

import numpy as np
import pytest

from unirender.errors import UnirenderError
from unirender.intrinsics import Intrinsics
from unirender.light.surface_light import diffuse_light
from unirender.light.symmetries import LIGHT_MAPS, mirror, quarter_turn, scale_light, turn_rotation


def equal(a: dict[str, np.ndarray], b: dict[str, np.ndarray]) -> bool:
    return a.keys() == b.keys() and all(np.array_equal(a[name], b[name]) for name in a)


def without_environment(maps: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    return {name: value for name, value in maps.items() if name != "environment"}


def test_mirror_is_an_involution(maps: dict[str, np.ndarray]) -> None:
    assert equal(mirror(mirror(maps)), maps)
    assert not any(np.array_equal(mirror(maps)[name], maps[name]) for name in ("image", "albedo", "environment"))


def test_four_quarter_turns_are_the_identity(maps: dict[str, np.ndarray]) -> None:
    turned = without_environment(maps)
    for _ in range(4):
        turned = quarter_turn(turned, 1)
    assert equal(turned, without_environment(maps))
    assert equal(quarter_turn(turned, 4), turned)


@pytest.mark.parametrize("turns", [2, 3, 5, -1])
def test_turns_add_up(maps: dict[str, np.ndarray], turns: int) -> None:
    once = without_environment(maps)
    for _ in range(turns % 4):
        once = quarter_turn(once, 1)
    assert equal(quarter_turn(without_environment(maps), turns), once)


def test_mirror_reverses_a_turn(maps: dict[str, np.ndarray]) -> None:
    flat = without_environment(maps)
    assert equal(mirror(quarter_turn(flat, 1)), quarter_turn(mirror(flat), 3))
    assert not equal(mirror(quarter_turn(flat, 1)), quarter_turn(mirror(flat), 1))


def test_a_turn_takes_right_to_up(maps: dict[str, np.ndarray]) -> None:
    """Counter-clockwise for the viewer: the right edge of the ball, normal +x, becomes its top, normal +y."""
    turned = quarter_turn(maps, 1)
    right, top = maps["normal"][8, -3], turned["normal"][2, 8]
    assert right[0] > 0.7
    np.testing.assert_array_equal(top, [-right[1], right[0], right[2]])
    np.testing.assert_array_equal(turned["image"][2, 8], maps["image"][8, -3])
    np.testing.assert_allclose(turn_rotation(1) @ [1, 0, 0], [0, 1, 0], atol=1e-7)


@pytest.mark.parametrize("change", [lambda m: quarter_turn(m, 1), lambda m: quarter_turn(m, 2), mirror])
def test_normals_and_environment_move_together(maps: dict[str, np.ndarray], change) -> None:
    """The light arriving along each normal, and d, stay with their pixel."""
    changed = change(maps)
    pixel = change({"diffuse": maps["diffuse"]})["diffuse"]
    again = diffuse_light(changed["normal"], changed["environment"])
    np.testing.assert_allclose(again, pixel, atol=0.02)
    left = diffuse_light(change({"mask": maps["normal"]})["mask"], changed["environment"])  # normals moved, not turned
    assert np.abs(left - pixel).max() > 5 * 0.02


def test_a_factor_reaches_all_light_and_nothing_else(maps: dict[str, np.ndarray]) -> None:
    scaled = scale_light(maps, 2.0)
    assert {name for name in maps if not np.array_equal(scaled[name], maps[name])} == set(LIGHT_MAPS)
    assert all(np.array_equal(scaled[name], 2 * maps[name]) for name in LIGHT_MAPS)


def test_intrinsics_change_through_their_maps(maps: dict[str, np.ndarray]) -> None:
    intrinsics = Intrinsics().replace(**{name: value for name, value in maps.items() if name != "image"})
    assert equal(intrinsics.maps, {name: getattr(intrinsics, name) for name in intrinsics.present})
    assert equal(intrinsics.replace(**quarter_turn(intrinsics.maps)).maps, quarter_turn(intrinsics.maps))


def test_a_frame_that_is_not_square_cannot_turn() -> None:
    with pytest.raises(UnirenderError, match="square"):
        quarter_turn({"image": np.ones((4, 6, 3), np.float32)})


@pytest.mark.parametrize("change", [mirror, quarter_turn])
def test_a_batch_of_lights_changes_as_each_of_them(change: Callable[..., dict[str, np.ndarray]]) -> None:
    lights = np.random.default_rng(1).random((2, 8, 16, 3)).astype(np.float32)
    together = change({"environment": lights})["environment"]
    for light, changed in zip(lights, together, strict=True):
        np.testing.assert_array_equal(changed, change({"environment": light})["environment"])
