"""Arrays of other sizes and at other addresses run the kernels that are compiled; each with its twin."""

import dataclasses
import gc
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import reference_scenes as scenes
from posed_spheres import blank_views
from posed_views import textured_object

from unirender.camera import Camera
from unirender.intrinsics import Intrinsics
from unirender_reference.arrays import ALIGNMENT, aligned, components
from unirender_reference.backend import mitsuba
from unirender_reference.optimize.shape.cameras import Cameras
from unirender_reference.optimize.shape.shading import shade_points
from unirender_reference.optimize.solution import Solution
from unirender_reference.optimize.surface.points import blocker, mapped_points, picture_points
from unirender_reference.optimize.transport.light_grid import LightGrid
from unirender_reference.optimize.transport.matrices import light_transport
from unirender_reference.render import Renderer
from unirender_reference.shade import shade, shade_gradients
from unirender_reference.visibility import trace_visible

SIZE = 16


def kernels(work: Callable[[], Any], operations: int = 100) -> set[str]:
    """The kernels that some work runs, of at least so many operations: small ones compile in milliseconds."""
    mitsuba()
    import drjit as dr

    gc.collect()  # what lives is part of a kernel
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
        dr.kernel_history_clear()
        work()
        ran = {entry["hash"]: entry["operation_count"] for entry in dr.kernel_history([dr.KernelType.JIT])}
    found = {name for name, count in ran.items() if count >= operations}
    assert found
    return found


def off_by(array: np.ndarray, offset: int) -> np.ndarray:
    """A copy that begins `offset` bytes after a multiple of `ALIGNMENT`."""
    memory = aligned(np.empty(array.nbytes + offset, np.uint8))
    copy = memory[offset:].view(array.dtype).reshape(array.shape)
    copy[...] = array
    return copy


def disc(radius: float) -> Intrinsics:
    """Maps of a flat disc."""
    y, x = (np.mgrid[:SIZE, :SIZE] + 0.5) / SIZE * 2 - 1
    mask = ((x**2 + y**2) < radius**2).astype(np.float32)[..., None]
    return Intrinsics(
        albedo=0.5 * np.repeat(mask, 3, axis=2),
        normal=mask * np.array([0, 0, 1], np.float32),
        roughness=0.5 * mask,
        metallic=0.5 * mask,
        mask=mask,
        camera=Camera(),
    )


@pytest.mark.parametrize("offset", [0, 16, 32, 48])
def test_a_copy_is_aligned_and_the_same(offset: int) -> None:
    array = off_by(np.random.default_rng(0).random((5, 7, 3)).astype(np.float32), offset)
    assert array.ctypes.data % ALIGNMENT == offset  # twin
    copy = aligned(array)
    assert copy.ctypes.data % ALIGNMENT == 0
    assert copy.dtype == array.dtype
    np.testing.assert_array_equal(copy, array)


def test_vectors_of_other_numbers_run_the_same_kernel() -> None:
    mi = mitsuba()
    import drjit as dr

    rows = np.random.default_rng(0).normal(size=(70, 3)).astype(np.float32)
    np.testing.assert_array_equal(np.array(mi.Vector3f(*components(rows))).T, rows)
    ours, plain = (
        [kernels(lambda made=made, n=n: dr.eval(made(rows[:n]) + 1), operations=1) for n in (33, 70)]
        for made in (lambda some: mi.Vector3f(*components(some)), lambda some: mi.Vector3f(some.T.copy()))
    )
    assert ours[0] == ours[1]
    assert plain[0] != plain[1]  # twin


def test_objects_run_the_same_kernels_wherever_their_texture_coordinates_lie() -> None:
    obj = textured_object(0)
    assert obj.uv is not None

    def traced(uv: np.ndarray) -> set[str]:
        renderer = Renderer(dataclasses.replace(obj, uv=uv), resolution=8)
        return kernels(lambda: renderer.geometry(16))

    assert traced(off_by(obj.uv, 0)) == traced(off_by(obj.uv, 16))


@pytest.mark.parametrize("work", ["shade", "shade_gradients", "trace_visible", "shade_points", "picture_points"])
def test_other_numbers_of_pixels_run_the_same_kernels(work: str) -> None:
    light, image, ball = scenes.environment(), np.ones((SIZE, SIZE, 3), np.float32), scenes.sphere(subdivisions=2)
    renderer, cameras = Renderer(ball, resolution=SIZE), Cameras(blank_views(1, SIZE))
    scene = blocker(ball)

    def run(maps: Intrinsics) -> None:
        inside = maps.require("mask")["mask"][..., 0] > 0
        match work:
            case "shade":
                shade(maps, light, 4)
            case "shade_gradients":
                shade_gradients(maps, image, light, 4)
            case "trace_visible":
                trace_visible(renderer, inside, 0)
            case "shade_points":
                shade_points(Solution(textured_object(0), light), cameras, np.flatnonzero(inside), 1, 0)
            case "picture_points":
                picture_points(scene, maps.require("mask")["mask"], Camera(), (SIZE, SIZE), 4)

    small, large = disc(0.3), disc(0.4)
    assert kernels(lambda: run(small)) == kernels(lambda: run(large))


def test_other_numbers_of_points_run_the_same_kernels_of_the_lights_matrices() -> None:
    view = np.broadcast_to(np.array([0, 0, 1], np.float32), (SIZE, SIZE, 3))

    def run(radius: float) -> set[str]:
        maps = disc(radius).require("mask", "normal")
        points = mapped_points(maps["mask"], maps["normal"], view)
        return kernels(lambda: light_transport(None, points, LightGrid(4, 8), 0))

    assert run(0.3) == run(0.4)


def test_the_rays_of_a_picture_are_traced_by_one_kernel() -> None:
    scene, mask = blocker(scenes.sphere(subdivisions=2)), disc(0.4).require("mask")["mask"]
    assert len(kernels(lambda: picture_points(scene, mask, Camera(), (SIZE, SIZE), 4))) == 1
