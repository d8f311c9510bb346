"""The transport of a picture against Mitsuba's own shading, and against closed forms."""

import numpy as np
import pytest
import reference_scenes as scenes
from occluders import torus

from unirender.camera import Camera
from unirender.errors import UnirenderError
from unirender.intrinsics import Intrinsics
from unirender_reference.optimize.picture_transport import (
    NODES,
    Transport,
    build_transport,
    mapped_points,
    mesh_points,
)
from unirender_reference.render import Renderer
from unirender_reference.shade import shade
from unirender_reference.shapes import MeshObject

SIZE, SHAPE = 24, (8, 16)
CAMERA = Camera()


def geometry_of(obj: MeshObject) -> Intrinsics:
    return Renderer(obj, resolution=SIZE).geometry(64)


def transport_of(maps: Intrinsics, geometry: MeshObject | None) -> Transport:
    assert maps.mask is not None
    assert maps.normal is not None
    if geometry is not None:
        return build_transport(mesh_points(maps.mask, geometry, CAMERA, (SIZE, SIZE)), SHAPE)
    return build_transport(mapped_points(maps.mask, maps.normal, CAMERA.view_directions(SIZE, SIZE)), SHAPE)


def image(transport: Transport, maps: Intrinsics, node: int, metallic: float, light: np.ndarray) -> np.ndarray:
    """The picture's equation of the module, at a node, premultiplied."""
    assert maps.albedo is not None
    assert maps.mask is not None
    albedo, mask = (x.reshape(-1, x.shape[-1])[transport.pixel] for x in (maps.albedo, maps.mask))
    radiance, r = light.reshape(-1, 3), NODES[node]
    diffuse = (transport.diffuse[0] + r * transport.diffuse[1] + r * r * transport.diffuse[2]) @ radiance
    lobe, grazing = transport.lobe[node] @ radiance, transport.grazing[node] @ radiance
    f0 = 0.04 * (1 - metallic) + albedo * metallic
    return mask * ((1 - metallic) * albedo * diffuse + f0 * (lobe - grazing) + grazing)


def error(transport: Transport, maps: Intrinsics, node: int, metallic: float, geometry: MeshObject | None) -> float:
    """Relative root mean square against `shade` over the pixels that are covered whole."""
    light = scenes.environment(3, SHAPE)
    assert maps.mask is not None
    even = np.ones_like(maps.mask)
    complete = maps.replace(roughness=even * NODES[node], metallic=even * metallic)
    truth = shade(complete, light, spp=256, geometry=geometry).reshape(-1, 3)[transport.pixel]
    whole = maps.mask.reshape(-1)[transport.pixel] > 0.99
    found = image(transport, maps, node, metallic, light)
    return float(np.sqrt(np.square(found - truth)[whole].mean() / np.square(truth[whole]).mean()))


@pytest.mark.parametrize(("node", "metallic"), [(1, 0.0), (3, 1.0), (5, 0.5), (8, 0.0)])
def test_of_normals_it_is_what_mitsuba_shades(node: int, metallic: float) -> None:
    maps = geometry_of(scenes.sphere())
    transport = transport_of(maps, None)
    assert error(transport, maps, node, metallic, None) < 0.05
    rougher = Transport(
        transport.pixel,
        transport.white,
        transport.diffuse * 1.1,
        np.roll(transport.lobe, 2, axis=0),
        np.roll(transport.grazing, 2, axis=0),
        SHAPE,
    )
    assert error(rougher, maps, node, metallic, None) > 0.05


def test_a_mesh_hides_light() -> None:
    obj = torus()
    maps = geometry_of(obj)
    shadowed = transport_of(maps, obj)
    assert error(shadowed, maps, 6, 0.5, obj) < 0.06
    light = np.ones((SHAPE[0] * SHAPE[1], 3), np.float32)
    open_sky = transport_of(maps, None)
    assert (shadowed.white @ light).mean() < 0.97 * (open_sky.white @ light).mean()


def test_under_even_light_a_white_lambertian_is_white_and_a_lobe_keeps_its_energy() -> None:
    normal = np.zeros((4, 4, 3), np.float32)
    normal[..., 2] = 1
    mask = np.ones((4, 4, 1), np.float32)
    transport = build_transport(mapped_points(mask, normal, CAMERA.view_directions(4, 4)), SHAPE)
    np.testing.assert_allclose(transport.white.sum(axis=1), 1, rtol=0, atol=0.01)
    energy = transport.lobe.sum(axis=2)
    np.testing.assert_allclose(energy[:2], 1, rtol=0, atol=0.03)
    assert (energy < 1.03).all()
    assert (transport.grazing <= transport.lobe + 1e-6).all()


def test_what_shows_no_surface_is_refused() -> None:
    mask = np.ones((4, 4, 1), np.float32)
    with pytest.raises(UnirenderError, match="normal for each"):
        mapped_points(mask, np.zeros((4, 4, 3), np.float32), CAMERA.view_directions(4, 4))
    corner = np.zeros((SIZE, SIZE, 1), np.float32)
    corner[0, 0] = 1
    with pytest.raises(UnirenderError, match="in no covered pixel"):
        mesh_points(corner, scenes.sphere(), CAMERA, (SIZE, SIZE))
