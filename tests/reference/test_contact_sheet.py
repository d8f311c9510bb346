"""The contact sheet: what its tiles show."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from unirender.color import image_srgb
from unirender.errors import UnirenderError, UsageError
from unirender_reference.measure.contact_sheet import CHECK_CONTRAST, COLUMNS, TINT, Sheet, buffer_tiles
from unirender_reference.render import Sample, render_sample
from unirender_reference.sheets import BACKGROUND


@pytest.fixture(scope="module")
def sample() -> Sample:
    return render_sample(next(iter(Sheet(Path("unused.png"), objects=1, resolution=24).specs())), spp=8)


def test_tiles_show_the_buffers(sample: Sample) -> None:
    tiles: dict[str, np.ndarray] = dict(zip(COLUMNS, buffer_tiles(sample), strict=True))
    maps = sample.intrinsics.maps
    inside, outside = maps["mask"][..., 0] == 1, maps["mask"][..., 0] == 0
    assert inside.any()
    assert outside.any()
    for column, value in (
        ("image", image_srgb(sample.image_linear)),
        ("albedo", image_srgb(maps["albedo"])),
        ("normal", maps["normal"] / 2 + 0.5),
        ("roughness", np.full((24, 24, 3), 0.1)),
        ("metallic", np.ones((24, 24, 3))),
        ("specular s", image_srgb(maps["specular"])),
        ("diffuse d", image_srgb(maps["diffuse"])),
        ("mask", np.ones((24, 24, 3))),
    ):
        tile = tiles[column]
        assert tile.shape == (24, 24, 3)
        np.testing.assert_allclose(tile[inside], value[inside], rtol=0, atol=1e-3, err_msg=column)
        if column == "mask":
            assert (tile[outside] == 0).all()
        else:  # the page, or checks about it
            tint = TINT if column in ("roughness", "metallic") else 0.0  # no grey looks like them
            assert np.abs(tile[outside] - (BACKGROUND + np.array(tint))).max() <= CHECK_CONTRAST / 2 + 1e-3
    assert tiles["environment"].shape == (12, 24, 3)


def test_an_edge_is_composited_in_linear_light(sample: Sample) -> None:
    """Half covered by black over display grey 0.82: as dark as half its light, not 0.41."""
    maps, half = sample.intrinsics, np.full((24, 24, 1), 0.5, np.float32)
    edge = Sample(np.zeros((24, 24, 3), np.float32), maps.replace(mask=half), {}, {})
    shown = buffer_tiles(edge)[0]
    np.testing.assert_allclose(shown, 0.6005, rtol=0, atol=1e-3)


def test_rows_have_values_or_maps_in_turn() -> None:
    specs = list(Sheet(Path("unused.png"), objects=4).specs())
    assert [spec.roughness is None for spec in specs] == [False, True, False, True]
    assert [spec.metallic is None for spec in specs] == [False, True, False, True]
    assert len({spec.light.name for spec in specs}) == 4


@pytest.mark.long
def test_a_sheet_is_written(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert Sheet(tmp_path / "sheet.png", objects=2, resolution=24, spp=8).run() == 0
    assert "2 objects x 9 buffers" in capsys.readouterr().out
    page = np.asarray(Image.open(tmp_path / "sheet.png"))
    assert page.shape[0] > 2 * 24
    assert page.shape[1] > len(COLUMNS) * 24
    assert (page[-1] == 209).all()  # 0.82 of 255


def test_a_wrong_command_line(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"a\.jpg: expected the name of a PNG file, like .*a\.png"):
        Sheet(tmp_path / "a.jpg").run()
    with pytest.raises(UnirenderError, match=r"missing\.glb"):  # at once, not after the rows before it
        Sheet(tmp_path / "a.png", objects=1, mesh=(tmp_path / "missing.glb",), spp=2**20).run()
