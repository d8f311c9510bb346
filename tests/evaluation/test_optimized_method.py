"""Optimisation of one picture as a method: asked once for a picture, edits and relights what it found, starts where it
is told, and sees the mesh only where its row says so."""

from types import MappingProxyType
from typing import Any

import numpy as np
import pytest
from reference_scenes import environment, sphere

from unirender.camera import Camera
from unirender.intrinsics import Intrinsics
from unirender_evaluation.engine import answer
from unirender_evaluation.methods.decompositions import KEPT
from unirender_evaluation.methods.method import quantise, seen_linear
from unirender_evaluation.methods.optimized import OptimizedMethod
from unirender_evaluation.methods.optimized_rows import optimized_rows
from unirender_evaluation.metrics import psnr
from unirender_evaluation.rows import make_row
from unirender_evaluation.suites.objects import GREY
from unirender_evaluation.suites.spec import read_spec
from unirender_evaluation.suites.suite import Suite
from unirender_evaluation.tasks import tasks
from unirender_reference.optimize.single.config import SingleConfig
from unirender_reference.render import Renderer
from unirender_reference.shapes import MeshObject

SIZE = 24
QUICK = SingleConfig(steps=(2,), noise=(0.05,), fine_steps=1, coarse_pixels=150, light_rows=8)


class Guess:
    """A start: dark red, rough, in even light."""

    name = "guess"
    config = MappingProxyType({"guess": 1})

    def decompose(self, image_srgb: np.ndarray, mask: np.ndarray, camera: Camera) -> Intrinsics:
        inside = (mask > 0).astype(np.float32)
        return Intrinsics(
            albedo=inside * np.array([0.3, 0.05, 0.05], np.float32),
            roughness=inside * np.float32(0.9),
            metallic=inside * np.float32(0.1),
            normal=inside * np.array([0, 0, 1], np.float32),
            environment=np.full((8, 16, 3), 0.5, np.float32),
            mask=mask,
            camera=camera,
        )


@pytest.fixture(scope="module")
def seen() -> dict[str, Any]:
    """A picture of a ball as a method is shown it."""
    renderer = Renderer(sphere(subdivisions=3), resolution=SIZE)
    mask = renderer.geometry(64).require("mask")["mask"]
    image = renderer.image(0.6 * environment(3, (8, 16)), 0.5, 0.2, 64).mean[..., :3]
    return {"image_srgb": quantise(image, mask), "mask": mask, "camera": renderer.camera}


@pytest.fixture(scope="module")
def method(seen: dict[str, Any]) -> OptimizedMethod:
    return OptimizedMethod("optimiser", config=QUICK)


def test_a_picture_is_optimised_once(method: OptimizedMethod, seen: dict[str, Any]) -> None:
    found = method.decompose(**seen)
    assert {"albedo", "roughness", "metallic", "normal", "specular", "diffuse", "environment"} <= set(found.present)
    assert method.decompose(**seen) is found


def test_of_many_pictures_the_last_are_kept(seen: dict[str, Any], monkeypatch: pytest.MonkeyPatch) -> None:
    """By picture and mesh; what was found in thousands of photographs would not fit into memory."""
    method, asked, mesh = OptimizedMethod("optimiser"), [], sphere(subdivisions=1)
    monkeypatch.setattr(
        method, "_optimize", lambda *given: asked.append(given[-1] is None) or Intrinsics(mask=seen["mask"])
    )
    others = [{**seen, "image_srgb": seen["image_srgb"] / (2 + index)} for index in range(KEPT)]
    first = method.decompose(**seen)
    assert method.decompose(**seen) is first
    assert method.decompose(**seen, geometry=mesh) is not first
    assert len({id(method.decompose(**other)) for other in others}) == KEPT
    assert asked == [True, False] + [True] * KEPT
    assert method.decompose(**others[0]) is method.decompose(**others[0])
    assert len(asked) == KEPT + 2
    method.decompose(**seen)
    assert len(asked) == KEPT + 3


def test_what_it_finds_looks_like_the_picture_and_edits_do_not(method: OptimizedMethod, seen: dict[str, Any]) -> None:
    picture, mask = seen_linear(seen["image_srgb"], seen["mask"]), seen["mask"]
    same = psnr(np.clip(method.edit(**seen), 0, 1), picture, mask)
    assert same > 20
    assert psnr(np.clip(method.edit(**seen, metallic=1.0), 0, 1), picture, mask) < same - 3
    assert not np.array_equal(method.edit(**seen, roughness=0.1), method.edit(**seen, roughness=0.9))


def test_relighting_uses_the_light_that_is_given(method: OptimizedMethod, seen: dict[str, Any]) -> None:
    light = method.decompose(**seen).require("environment")["environment"]
    assert np.array_equal(method.relight(**seen, environment=light), method.edit(**seen))
    bright = method.relight(**seen, environment=2 * light)
    assert bright.sum() == pytest.approx(2 * method.edit(**seen).sum(), rel=0.05)
    flat = np.where(seen["mask"] > 0, 0.4, 0.0) * np.ones(3, np.float32)
    lit = method.relight(**seen, specular=flat.astype(np.float32), diffuse=flat.astype(np.float32))
    inside = seen["mask"][..., 0] > 0.99
    assert (lit[inside] > 0).all()
    assert (lit[inside] < 0.4).all(), "no surface reflects more than it gets"


def test_the_start_is_a_prediction(seen: dict[str, Any]) -> None:
    """With a prediction the result stays nearer to it than without, and the record says whose it is."""
    warm = OptimizedMethod("warm", base=Guess(), config=QUICK)
    cold = OptimizedMethod("cold", config=QUICK)
    start = Guess().decompose(**seen).require("roughness", "normal")
    inside = seen["mask"][..., 0] > 0.99
    found = [method.decompose(**seen).require("roughness", "normal") for method in (warm, cold)]
    distances = [np.abs(maps["roughness"] - start["roughness"])[inside].mean() for maps in found]
    assert distances[0] < 0.1 < distances[1]
    assert warm.config["start"] == {"guess": 1}
    assert "start" not in cold.config
    assert np.array_equal(found[0]["normal"], start["normal"])


def test_a_row_that_does_not_look_for_a_material_says_so(method: OptimizedMethod, seen: dict[str, Any]) -> None:
    """Without a prediction metallic is a constant, that of the pictures which the suite edits; roughness is found."""
    maps = method.decompose(**seen).require("roughness", "metallic")
    inside = seen["mask"][..., 0] > 0
    base = read_spec("tiny").base
    assert set(np.unique(maps["metallic"][inside])) == {base[0]}
    assert abs(maps["roughness"][inside] - base[1]).min() > 1e-3
    for row in optimized_rows(None, ours=Guess()):
        held = "metallic is held at 0.5" in row.info.note
        assert held == (row.method.base is None)
        assert "roughness is held" not in row.info.note


class Witness:
    """A method that keeps what it is handed."""

    name = "witness"
    config = MappingProxyType({"witness": 1})

    def __init__(self) -> None:
        self.handed: list[dict[str, Any]] = []

    def decompose(self, **inputs: Any) -> Intrinsics:
        self.handed.append(inputs)
        return Intrinsics(albedo=inputs["image_srgb"])


def test_the_mesh_is_told_to_rows_that_declare_it(suite: Suite) -> None:
    task = next(tasks(suite, "inverse", "single-image", list(suite.scenes)))
    for told in (frozenset(), frozenset({"geometry"})):
        row = make_row(Witness(), "optimisation", told=told)
        answer(row, task)
        handed = row.method.handed[0]
        assert set(handed) == {"image_srgb", "mask", "camera", *told}
        if told:
            mesh = handed["geometry"]
            assert isinstance(mesh, MeshObject)
            assert (mesh.albedo == GREY).all()
            assert len(mesh.vertices) > 100
