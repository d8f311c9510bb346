"""The census of bad pixels: what Mitsuba gave is counted before the repair, what we hand out after it."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from unirender_reference import backend
from unirender_reference.measure.census import KINDS, census_of_object, classify, draw_renders
from unirender_reference.measure.census_command import Census, band
from unirender_reference.render import Renderer
from unirender_reference.shapes import make_object

SIZE = 12


def test_kinds_of_bad_pixels_are_told_apart() -> None:
    picture = np.zeros((2, 3, 4), np.float32)
    picture[0, 0, 1], picture[0, 1, 2], picture[1, 2, 0] = np.nan, np.inf, -1e-9
    kinds = dict(zip(KINDS, classify(picture), strict=True))
    assert {name: np.argwhere(found).tolist() for name, found in kinds.items()} == {
        "nan": [[0, 0]],
        "infinite": [[0, 1]],
        "negative": [[1, 2]],
    }


@pytest.fixture
def broken_mitsuba(monkeypatch: pytest.MonkeyPatch) -> list[tuple[int, int]]:
    """Mitsuba whose first pass of every image has a NaN in the middle and an infinite value in the corner."""
    mi = backend.mitsuba()
    original, seeds, spoilt = mi.render, set(), [(SIZE // 2, SIZE // 2), (0, 0)]

    def render(*arguments: Any, **options: Any) -> Any:
        picture = np.array(original(*arguments, **options))
        if len(seeds) % 2 == 0:
            picture[spoilt[0]][0], picture[spoilt[1]][1] = np.nan, np.inf
        seeds.add(options["seed"])
        return mi.TensorXf(picture)

    monkeypatch.setattr(mi, "render", render)
    return spoilt


def test_bad_pixels_are_counted_placed_and_not_handed_out(broken_mitsuba: list[tuple[int, int]]) -> None:
    census = census_of_object(4, 2, SIZE, 16)
    assert (census.renders, census.calls, census.written, census.repaired) == (2, 4, 0, 4)
    assert [(pixel.kind, (pixel.row, pixel.column)) for pixel in census.bad] == [
        ("nan", broken_mitsuba[0]),
        ("infinite", broken_mitsuba[1]),
    ] * 2
    assert {pixel.place for pixel in census.bad if pixel.kind == "infinite"} == {"edge"}
    assert {pixel.spp for pixel in census.bad} == {16}


def test_bad_values_that_get_through_are_noticed(monkeypatch: pytest.MonkeyPatch) -> None:
    """The twin: a renderer that hands out a negative value."""
    image = Renderer.image

    def wrong(*arguments: Any, **options: Any) -> Any:
        estimate = image(*arguments, **options)
        estimate.mean[3, 3, 0] = -1.0
        return estimate

    monkeypatch.setattr(Renderer, "image", wrong)
    assert census_of_object(4, 2, SIZE, 4).written == 2


def test_materials_cover_the_corners_of_the_cube() -> None:
    drawn = draw_renders(make_object(2, "train"), 2, 400)
    exact = [draw.roughness in (0.0, 1.0) for draw in drawn]
    assert 0.2 < np.mean(exact) < 0.4
    assert {draw.depth for draw in drawn} == {2, 4}
    assert drawn == draw_renders(make_object(2, "train"), 2, 400)


def test_bands_cover_the_range() -> None:
    assert [band(value) for value in (None, 0.0, 1.0, 0.1, 0.25, 0.99)] == [
        "map",
        "= 0",
        "= 1",
        "0 to 0.25",
        "0.25 to 0.5",
        "0.75 to 1",
    ]


@pytest.mark.slow
def test_command_counts_in_worker_processes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "bad.json"
    assert Census(renders=3, resolution=SIZE, spp=4, workers=10**12, json=out).run() == 0
    printed = " ".join(capsys.readouterr().out.split())
    assert "3 renders of 1 objects (3 calls of mi.render, 1.73e+03 camera paths)" in printed
    assert "0 bad values in what was handed out" in printed
    assert json.loads(out.read_text()) == []
