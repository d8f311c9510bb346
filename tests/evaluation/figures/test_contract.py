"""The figures of the data contract: what they say of axes and texels is what the code does, and no method is asked."""

from pathlib import Path

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from PIL import Image

from unirender.camera import Camera
from unirender.color import luminance, srgb_decode
from unirender_evaluation.figures.command import CONTRACT, KINDS, Figures
from unirender_evaluation.figures.contract import SAID, ball, camera_figure, maps_figure, png, texel_of
from unirender_evaluation.suites.suite import Suite

AXES = ("+x", "-x", "+y", "-y", "+z", "-z")


def test_axes_lie_in_the_light_where_the_contract_has_them() -> None:
    """The middle is +z, the right half lights the left of the picture, the first row is +y."""
    expected = {"+z": (0.5, 0.5), "+x": (0.25, 0.5), "-x": (0.75, 0.5), "+y": (0.5, 0.0), "-y": (0.5, 1.0)}
    for direction, place in expected.items():
        (found,) = texel_of(direction)
        np.testing.assert_allclose(found, place, rtol=0, atol=0.003, err_msg=direction)
    assert texel_of("-z") == [(0.0, 0.5), (1.0, 0.5)]


@pytest.mark.parametrize("fov_deg", [36.0, 60.0])
def test_the_ball_fills_the_contracts_share_of_the_height(fov_deg: float) -> None:
    normal = ball(Camera(fov_deg), 200)
    there = np.any(normal != 0, axis=-1)
    assert there.any(axis=1).sum() / 200 == pytest.approx(0.9, abs=0.011)
    np.testing.assert_allclose(np.linalg.norm(normal[there], axis=-1), 1, rtol=0, atol=1e-5)
    assert normal[100, 100, 2] > 0.999
    assert normal[100, there[100].nonzero()[0][-1], 0] > 0.7, "+x is right"
    assert normal[there[:, 100].nonzero()[0][0], 100, 1] > 0.7, "+y is up"


def test_the_names_of_the_axes_are_legible_on_every_colour() -> None:
    """Contrast (WCAG) of what lies in a name's box: red letters on pink have too little, dark ones on purple, too."""
    figure = camera_figure(Camera(36.0))
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    shown = luminance(srgb_decode(np.asarray(canvas.buffer_rgba())[..., :3] / np.float32(255)))
    names = [text for axes in figure.axes for text in axes.texts if text.get_text() in AXES]
    assert len(names) == 4 + 7, "two above, two on the ball, -z at both ends of the light"
    for name in names:
        x0, y0, x1, y1 = np.round(name.get_window_extent().extents).astype(int)
        box = shown[len(shown) - y1 : len(shown) - y0, x0:x1]
        assert (box.max() + 0.05) / (box.min() + 0.05) > 4.5, name


def test_every_map_has_its_picture(suite: Suite) -> None:
    axes = maps_figure(suite, suite.scenes[0]).axes
    assert [each.get_title().strip() for each in axes] == ["image", *SAID]
    shown = {each.get_title().strip(): np.asarray(each.images[0].get_array()) for each in axes}
    centre = shown["mask"].shape[0] // 2
    assert shown["mask"][centre, centre] == pytest.approx(1)
    assert shown["mask"][0, 0] == pytest.approx(0)
    for name in ("image", "albedo", "normal", "specular", "diffuse"):
        np.testing.assert_allclose(shown[name][0, 0], 1, err_msg=f"{name}: white beside the object")
    np.testing.assert_allclose(shown["normal"][centre, centre], (0.5, 0.5, 1), atol=0.05)


def test_the_command_draws_them_without_a_method(suite: Suite, tmp_path: Path) -> None:
    """Not even a checkpoint is looked for; the files are the same bytes whenever they are drawn."""
    assert not set(CONTRACT) & set(KINDS), "only where they are named"
    out = tmp_path / "figures"
    Figures(out=out, suite=str(suite.spec.path), kinds=("camera", "maps"), checkpoint=(tmp_path / "nowhere",)).run()
    assert sorted(path.name for path in out.iterdir()) == ["camera.png", "maps.png"]
    assert (out / "camera.png").read_bytes() == png(camera_figure(suite.spec.camera))
    for path in out.iterdir():
        assert min(Image.open(path).size) > 300
