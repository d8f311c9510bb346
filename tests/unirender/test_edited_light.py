"""s and d after an edit of the normals or the roughness in a folder of maps."""

import numpy as np
import pytest
from seen_shapes import as_maps, ball

from unirender.intrinsics import Intrinsics
from unirender.pipelines.derived_light import derived_light
from unirender.pipelines.edited_light import with_edited_light
from unirender.pipelines.editing import specular_for_roughness


def found(light: np.ndarray) -> Intrinsics:
    """A ball with the s and d of its light, times a detail that the light does not explain."""
    normal, mask, _ = ball(32)
    maps = as_maps(normal, mask).replace(environment=light)
    maps = maps.replace(albedo=0.5 * np.repeat(mask, 3, axis=-1), metallic=0.2 * mask)
    detail = 1 + 0.3 * np.sin(np.arange(32, dtype=np.float32))[:, None, None]
    lit = derived_light(maps, light, ("specular", "diffuse"), shadows=False)
    return maps.replace(**{name: value * detail for name, value in lit.items()})


@pytest.fixture
def maps() -> Intrinsics:
    light = np.full((16, 32, 3), 0.3, np.float32)
    light[:8, 8:16] = 2
    return found(light)


def tilted(maps: Intrinsics) -> Intrinsics:
    """Some of the ball's normals turned up by 20 degrees."""
    normal = maps.require("normal")["normal"].copy()
    part = normal[12:20, 12:20]
    cos, sin = np.cos(0.35), np.sin(0.35)
    y, z = part[..., 1].copy(), part[..., 2].copy()
    part[..., 1], part[..., 2] = cos * y + sin * z, cos * z - sin * y
    return maps.replace(normal=normal)


def test_turned_normals_receive_other_light_and_keep_the_detail(maps: Intrinsics) -> None:
    edited = tilted(maps)
    after = with_edited_light(maps, edited)
    environment = maps.require("environment")["environment"]
    old, new = (derived_light(each, environment, ("specular", "diffuse"), shadows=False) for each in (maps, edited))
    turned = np.zeros((32, 32), bool)
    turned[12:20, 12:20] = True
    for name in ("specular", "diffuse"):
        before, value = maps.maps[name], after.maps[name]
        np.testing.assert_array_equal(value[~turned], before[~turned])
        wanted = before * new[name] / np.maximum(old[name], 1e-6)
        np.testing.assert_allclose(value[turned], wanted[turned], rtol=0.05)
        assert np.abs(wanted[turned] / before[turned] - 1).max() > 0.1  # the edit is none that the tolerance hides


def test_a_painted_roughness_changes_s_as_an_edit_does(maps: Intrinsics, caplog: pytest.LogCaptureFixture) -> None:
    roughness = maps.require("roughness")["roughness"].copy()
    roughness[12:20, 12:20] = 0.2
    after = with_edited_light(maps, maps.replace(roughness=roughness))
    expected, _ = specular_for_roughness(maps, roughness)
    np.testing.assert_array_equal(after.require("specular")["specular"], expected)
    assert (after.require("specular")["specular"] != maps.specular).any()
    assert after.diffuse is maps.diffuse
    covered = int((maps.require("mask")["mask"] > 0).sum())
    assert f"too coarse to show what the edited roughness reflects on {100 * 64 / covered:.0f}% of" in caplog.text


def test_what_was_painted_itself_or_cannot_follow_stays(maps: Intrinsics, caplog: pytest.LogCaptureFixture) -> None:
    edited = tilted(maps)
    painted = edited.replace(diffuse=0.5 * edited.require("diffuse")["diffuse"])
    after = with_edited_light(maps, painted)
    assert after.diffuse is painted.diffuse
    assert after.specular is not painted.specular
    assert with_edited_light(maps, maps.replace(albedo=0 * maps.require("albedo")["albedo"])).specular is maps.specular
    dark, edited = maps.replace(environment=None), edited.replace(environment=None)
    assert with_edited_light(dark, edited) is edited
    assert "specular and diffuse stay as they were" in caplog.text
    assert "environment missing" in caplog.text
