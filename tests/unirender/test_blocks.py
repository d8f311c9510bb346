"""Pictures in blocks: the bytes of the whole, and no temporaries of its size."""

import tracemalloc
from collections.abc import Callable

import numpy as np
import pytest

from unirender import blocks
from unirender.camera import Camera
from unirender.color import image_srgb, srgb_decode, srgb_encode, unpremultiply
from unirender.composite import composite_image, split_sum_image
from unirender.intrinsics import Intrinsics
from unirender.pipelines.carried_light import agreement, with_carried_light
from unirender.pipelines.closure import close_decomposition
from unirender.pipelines.editing import anchor
from unirender.pipelines.framing import Frame
from unirender.pipelines.masked_maps import divide, unit_normal
from unirender.pipelines.results import combine

HEIGHT, WIDTH = 45, 61
LIGHT = np.linspace(0, 1, 16 * 32 * 3, dtype=np.float32).reshape(16, 32, 3)


def maps(height: int = HEIGHT, width: int = WIDTH) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(0)
    channels = {"albedo": 3, "specular": 3, "diffuse": 3, "roughness": 1, "metallic": 1, "mask": 1}
    made = {name: rng.random((height, width, count), np.float32) for name, count in channels.items()}
    made["mask"] = np.maximum(made["mask"] - 0.3, 0)
    return made | {"normal": unit_normal(rng.normal(size=(height, width, 3)).astype(np.float32))}


def sample(of: Intrinsics, albedo: str) -> Intrinsics:
    """One whose albedo is another of its maps."""
    return of.replace(albedo=of.require(albedo)[albedo], environment=LIGHT)


def answers() -> dict[str, np.ndarray]:
    """What is made in blocks, of one picture."""
    all_maps = Intrinsics().replace(**maps())
    of = all_maps.maps
    closed = close_decomposition(all_maps, of["diffuse"], of["specular"])
    left = Frame(HEIGHT, WIDTH, 16).leave_maps(
        {"a": of["albedo"][:16, :16], "r": of["roughness"][:16, :16]}, of["mask"]
    )
    found = combine(tuple(sample(all_maps, name) for name in ("albedo", "specular", "diffuse")))
    assert found.std is not None
    return {
        "mean of samples": found.intrinsics.require("albedo")["albedo"],
        "spread of samples": found.std["albedo"],
        "carried": with_carried_light(all_maps, all_maps, ["diffuse"], LIGHT).require("diffuse")["diffuse"],
        "encode": srgb_encode(of["specular"]),
        "decode": srgb_decode(of["specular"]),
        "picture": image_srgb(2 * of["specular"]),
        "straight": unpremultiply(of["specular"], of["mask"]),
        "divided": divide(of["specular"], of["mask"]),
        "unit": unit_normal(of["specular"]),
        "composite": composite_image(all_maps),
        "split sum": split_sum_image(all_maps),
        "anchored": anchor(of["albedo"], of["diffuse"], of["specular"]),
        "rays": Camera(50.0, (0.4, 0.6)).rays(HEIGHT, WIDTH),
        **{f"closed {name}": value for name, value in closed.maps.items()},
        **{f"left {name}": value for name, value in left.items()},
    }


def test_blocks_change_no_byte(monkeypatch: pytest.MonkeyPatch) -> None:
    whole = answers()
    monkeypatch.setattr(blocks, "BLOCK", 200)
    for name, value in answers().items():
        assert (value.dtype, value.tobytes()) == (whole[name].dtype, whole[name].tobytes()), name


def test_what_does_not_lie_in_rows_goes_through_as_one(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(blocks, "BLOCK", 200)
    picture = maps()["albedo"]
    turned = np.moveaxis(np.ascontiguousarray(np.moveaxis(picture, -1, 0)), 0, -1)  # as what comes from a network lies
    assert srgb_encode(turned).tobytes() == srgb_encode(picture).tobytes()
    assert srgb_encode(turned).strides == turned.strides, "sums over it would be rounded otherwise"
    np.testing.assert_array_equal(blocks.by_rows(np.sqrt, np.stack([picture] * 2)), np.sqrt(np.stack([picture] * 2)))
    assert [(rows.start, rows.stop) for rows in blocks.row_blocks(7, 70)] == [(0, 2), (2, 4), (4, 6), (6, 7)]
    assert len(list(blocks.row_blocks(3, 900))) == 3, "a row at least"


def test_temporaries_are_small() -> None:
    given = {name: np.full((600, 800, value.shape[-1]), 0.5, np.float32) for name, value in maps().items()}
    given["normal"] = np.broadcast_to(np.eye(3, dtype=np.float32)[2], (600, 800, 3)).copy()
    all_maps, plane = Intrinsics().replace(**given), given["albedo"].nbytes

    def planes(function: Callable[..., object], *arguments: object) -> float:
        """Most memory that a call takes, answer included, over that of one map of three channels."""
        tracemalloc.start()
        try:
            function(*arguments)
            return tracemalloc.get_traced_memory()[1] / plane
        finally:
            tracemalloc.stop()

    assert planes(srgb_encode, given["albedo"]) < 1.3  # 3 before
    assert planes(Camera().rays, 600, 800) < 1.9  # 6 before
    assert planes(split_sum_image, all_maps) < 5.2  # 12 before
    assert planes(close_decomposition, all_maps, given["albedo"], given["specular"]) < 4.9  # 7 before
    assert planes(composite_image, all_maps) < 1.6  # 5 before
    assert planes(combine, tuple(all_maps.replace(environment=LIGHT) for _ in range(8))) < 13  # 57 before
    assert planes(agreement, given["specular"], given["diffuse"], given["mask"]) < 3.6  # 5 before
