"""The transport of a picture against Mitsuba's own shading, and against closed forms."""

from dataclasses import replace

import numpy as np
import pytest
import reference_scenes as scenes
from occluders import torus

from unirender.camera import Camera
from unirender.errors import UnirenderError
from unirender.intrinsics import Intrinsics
from unirender_reference.optimize.single.pixels import POINTS
from unirender_reference.optimize.surface.points import SurfacePoints, blocker, mapped_points, picture_points
from unirender_reference.optimize.transport.light_grid import LightGrid
from unirender_reference.optimize.transport.material_mix import lobes_at, mixed
from unirender_reference.optimize.transport.matrices import Transport, light_transport
from unirender_reference.render import Renderer
from unirender_reference.shade import shade
from unirender_reference.shapes import MeshObject

SIZE, GRID = 24, LightGrid(8, 16)
CAMERA = Camera()


def geometry_of(obj: MeshObject) -> Intrinsics:
    return Renderer(obj, resolution=SIZE).geometry(64)


def traced(maps: Intrinsics, geometry: MeshObject | None) -> tuple[SurfacePoints, Transport]:
    """Points of the covered pixels, and their matrices, premultiplied."""
    assert maps.mask is not None
    assert maps.normal is not None
    if geometry is not None:
        scene = blocker(geometry)
        points = picture_points(scene, maps.mask, CAMERA, (SIZE, SIZE), POINTS)
    else:
        scene, points = None, mapped_points(maps.mask, maps.normal, CAMERA.view_directions(SIZE, SIZE))
    return points, light_transport(scene, points, GRID, 0, points.of([maps.mask])[:, 0], bilinear=True)


def error(
    points: SurfacePoints,
    transport: Transport,
    maps: Intrinsics,
    roughness: float,
    metallic: float,
    geometry: MeshObject | None,
) -> float:
    """Relative root mean square against `shade` over the pixels that are covered whole."""
    light = scenes.environment(3, (GRID.rows, GRID.columns))
    assert maps.mask is not None
    assert maps.albedo is not None
    even, ones = np.ones_like(maps.mask), np.ones(len(points))
    complete = maps.replace(roughness=even * roughness, metallic=even * metallic)
    truth = points.of([shade(complete, light, spp=256, geometry=geometry)])
    u, v = mixed(lobes_at(transport, roughness * ones), metallic * ones)
    found = points.of([maps.albedo]) * (u @ light.reshape(-1, 3)) + v @ light.reshape(-1, 3)
    whole = points.of([maps.mask])[:, 0] > 0.99
    return float(np.sqrt(np.square(found - truth)[whole].mean() / np.square(truth[whole]).mean()))


@pytest.mark.parametrize(("roughness", "metallic"), [(0.1, 0.0), (0.3, 1.0), (0.47, 0.5), (1.0, 0.0)])
def test_of_normals_it_is_what_mitsuba_shades(roughness: float, metallic: float) -> None:
    """At the nodes of the roughness and between them; the twin's lobes belong to other nodes."""
    maps = geometry_of(scenes.sphere())
    points, transport = traced(maps, None)
    assert error(points, transport, maps, roughness, metallic, None) < 0.05
    rougher = replace(
        transport,
        diffuse=tuple(1.1 * part for part in transport.diffuse),
        gloss=transport.gloss[-2:] + transport.gloss[:-2],
        schlick=transport.schlick[-2:] + transport.schlick[:-2],
    )
    assert error(points, rougher, maps, roughness, metallic, None) > 0.05


def test_a_mesh_hides_light() -> None:
    obj = torus()
    maps = geometry_of(obj)
    points, shadowed = traced(maps, obj)
    assert error(points, shadowed, maps, 0.55, 0.5, obj) < 0.06
    reaching = []
    for geometry in (obj, None):
        points, transport = traced(maps, geometry)
        reaching.append(transport.white.sum(axis=1)[points.of([maps.require("mask")["mask"]])[:, 0] > 0.99].mean())
    assert reaching[0] < 0.97 * reaching[1]


def test_under_even_light_a_white_lambertian_is_white_and_a_lobe_keeps_its_energy() -> None:
    normal = np.zeros((4, 4, 3), np.float32)
    normal[..., 2] = 1
    mask = np.ones((4, 4, 1), np.float32)
    points = mapped_points(mask, normal, CAMERA.view_directions(4, 4))
    transport = light_transport(None, points, GRID, 0, bilinear=True)
    np.testing.assert_allclose(transport.white.sum(axis=1), 1, rtol=0, atol=0.01)
    energy = np.stack([matrix.sum(axis=1) for matrix in transport.gloss])
    np.testing.assert_allclose(energy[:2], 1, rtol=0, atol=0.03)
    assert (energy < 1.03).all()
    assert all((part <= whole + 1e-6).all() for part, whole in zip(transport.schlick, transport.gloss, strict=True))


def test_what_shows_no_surface_is_refused() -> None:
    mask = np.ones((4, 4, 1), np.float32)
    with pytest.raises(UnirenderError, match="normal for each"):
        mapped_points(mask, np.zeros((4, 4, 3), np.float32), CAMERA.view_directions(4, 4))
    corner = np.zeros((SIZE, SIZE, 1), np.float32)
    corner[0, 0] = 1
    with pytest.raises(UnirenderError, match="in no covered pixel"):
        picture_points(blocker(scenes.sphere()), corner, CAMERA, (SIZE, SIZE), POINTS)
