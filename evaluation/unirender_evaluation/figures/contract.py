"""The two figures of the data contract: every map of a scene, and the camera with its axes. No method is asked.

What the second one says is computed by the code that it explains: the pixels' rays and the texels' directions.
"""

from io import BytesIO
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from unirender.camera import DEFAULT_FILL, Camera
from unirender.color import image_srgb
from unirender.light.environment import environment_directions
from unirender.visualization import map_picture
from unirender_evaluation.figures.grid import over_white
from unirender_evaluation.suites.suite import Scene, Suite

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# What stands in the row of the contract's table: channels and range.
SAID = {
    "albedo": "3, [0, 1], linear",
    "normal": "3, unit, camera axes",
    "roughness": "1, [0, 1], perceptual",
    "metallic": "1, [0, 1]",
    "specular": "3, ≥ 0: s",
    "diffuse": "3, ≥ 0: d",
    "environment": "3, ≥ 0: lat-long",
    "mask": "1, [0, 1]: coverage",
}
AXIS_COLOURS = {"+x": "#c23b22", "+y": "#2e7d32", "+z": "#1f5fbf"}
INK, SOFT = "#222222", "#888888"
WIDTH, DPI = 5, 120  # inches, pixels an inch


def maps_figure(suite: Suite, scene: Scene) -> "Figure":
    """The picture of a scene's base material and all maps that explain it, each as `map_picture` shows it."""
    figure, maps = _figure(5.9), suite.intrinsics(scene, suite.spec.base)
    mask = maps.require("mask")["mask"]
    image = image_srgb(suite.image(scene, suite.spec.base) + (1 - mask))  # premultiplied, so over white by a sum
    shown = {"image": (image, "3, linear, premultiplied")}
    for name, said in SAID.items():
        value = map_picture(name, maps.require(name)[name])
        alone = name in ("environment", "mask")  # not aligned with the picture, or about where it is
        shown[name] = (value if alone else over_white(value, mask), said)
    for place, (name, (value, said)) in enumerate(shown.items(), start=1):
        axes = figure.add_subplot(3, 3, place)
        axes.imshow(np.clip(value, 0, 1), cmap="gray", vmin=0, vmax=1, interpolation="nearest")
        axes.set_title(f"{name}\n", fontsize=11, color=INK)
        axes.text(0.5, 1.03, said, transform=axes.transAxes, ha="center", va="bottom", fontsize=8, color=SOFT)
        axes.set_xticks([])
        axes.set_yticks([])
        axes.spines[:].set_color("#cccccc")
    return figure


def camera_figure(camera: Camera) -> "Figure":
    """The scene from above, the picture as the camera takes it, and the directions of an environment's texels."""
    figure = _figure(9.2)
    grid = figure.add_gridspec(3, 1, height_ratios=(1.1, 1.05, 1))
    _from_above(figure.add_subplot(grid[0]), camera)
    _picture(figure.add_subplot(grid[1]), camera)
    _environment(figure.add_subplot(grid[2]))
    return figure


def png(figure: "Figure") -> bytes:
    """The figure's file: the same bytes whenever it is drawn."""
    content = BytesIO()
    figure.savefig(content, format="png", dpi=DPI, metadata={"Software": None})
    return content.getvalue()


def ball(camera: Camera, side: int) -> Float[np.ndarray, "side side 3"]:
    """Normals of the unit sphere as the camera sees it where the contract puts it; 0 beside it."""
    rays, centre = camera.rays(side, side).astype(float), np.array([0.0, 0.0, -camera.distance()])
    along = rays @ centre
    under = along**2 - (centre @ centre - 1)
    hits = rays * (along - np.sqrt(np.maximum(under, 0)))[..., None] - centre
    return np.where((under > 0)[..., None], hits, 0).astype(np.float32)


def _figure(height: float) -> "Figure":
    from matplotlib.figure import Figure

    return Figure((WIDTH, height), layout="constrained", facecolor="white")


def _from_above(axes: "Axes", camera: Camera) -> None:
    """Looked at along -y: +x to the right, +z, where the camera is, downwards."""
    far, half = camera.distance(), np.tan(np.radians(camera.fov_deg) / 2)
    angle = np.linspace(0, 2 * np.pi, 200)
    axes.fill(np.cos(angle), np.sin(angle), color="#e8e8e8")
    axes.plot(1.55 * np.cos(angle), 1.55 * np.sin(angle), ":", color=SOFT, linewidth=1)
    for side in (-1, 1):
        axes.plot([0, side * half * (far + 1)], [far, -1], color=SOFT, linewidth=0.8)
    axes.plot([0], [far], marker="^", markersize=10, color=INK)
    axes.text(0.25, far, f"camera, looks along -z\nfov {camera.fov_deg:g}° (vertical)", fontsize=8, va="center")
    for name, (x, z) in {"+x": (1, 0), "-x": (-1, 0), "+z": (0, 1), "-z": (0, -1)}.items():
        places = " and ".join(f"{u:g}" for u, _ in texel_of(name))
        axes.plot([1.47 * x, 1.63 * x], [1.47 * z, 1.63 * z], color=SOFT, linewidth=1)
        axes.text(2.25 * x, 1.85 * z, f"u = {places}", fontsize=8, color=SOFT, ha="center", va="center")
    _axis(axes, "+x", (0.55, 0))  # its name ends before the edge of the view
    _axis(axes, "+z", (0, 0.55))
    axes.text(0, -0.3, "+y: towards you", fontsize=8, color=AXIS_COLOURS["+y"], ha="center")
    axes.set(xlim=(-2.8, 2.8), ylim=(far + 0.4, -2.1), aspect="equal")
    axes.set_title("from above; u: columns of the light", fontsize=10)
    axes.axis("off")


def _picture(axes: "Axes", camera: Camera) -> None:
    """The normals of a ball, which shows what the colours of a normal map mean."""
    side = 192
    normal = ball(camera, side)
    axes.imshow(over_white(map_picture("normal", normal), np.any(normal != 0, axis=-1, keepdims=True) * np.float32(1)))
    middle, reach = camera.principal[0] * side, 0.28 * side
    _axis(axes, "+x", (middle + reach, middle), (middle, middle))
    _axis(axes, "+y", (middle, middle - reach), (middle, middle))
    axes.text(middle + 4, middle + 12, "+z: towards you", fontsize=8, color=INK)
    axes.set_xticks([0, side - 1], ["column 0", "w - 1"], fontsize=8)
    axes.set_yticks([0, side - 1], ["row 0", "h - 1"], fontsize=8)
    axes.set_title(
        f"the picture: a ball's normals, (n + 1) / 2\nbounding sphere: {DEFAULT_FILL:g} of the height", fontsize=10
    )


def _environment(axes: "Axes") -> None:
    """Each texel in the colour of its direction, as a normal map would show it."""
    height, width = 64, 128
    axes.imshow(environment_directions(height, width) / 2 + 0.5, extent=(0, 1, 1, 0), aspect=0.5)
    for direction in ("+x", "-x", "+y", "-y", "+z", "-z"):
        for u, v in texel_of(direction):
            inside = (min(max(u, 0.035), 0.965), min(max(v, 0.07), 0.93))
            axes.text(*inside, direction, color=INK, **_name())
    axes.set_xticks([0, 0.25, 0.5, 0.75, 1])
    axes.set_yticks([0, 1], ["row 0", "row H - 1"])
    axes.tick_params(labelsize=8)
    axes.set_xlabel("u = φ / 2π;  left half: light from the right", fontsize=8)
    axes.set_title("the light: direction of each texel", fontsize=10)


def texel_of(direction: str) -> list[tuple[float, float]]:
    """Where an axis lies in a lat-long map, as fractions of its width and height; at a border, at both ends of it."""
    sign, axis = (1 if direction[0] == "+" else -1), "xyz".index(direction[1])
    height, width = 65, 256
    nearest = sign * environment_directions(height, width)[..., axis]
    rows, columns = np.nonzero(nearest > nearest.max() - 1e-4)
    row = rows[0] / (height - 1)
    if len(columns) == width:  # a pole: the whole row
        return [(0.5, row)]
    u = (columns + 0.5) / width
    return [(0.0, row), (1.0, row)] if u.max() - u.min() > 0.5 else [(float(u.mean()), row)]


def _axis(axes: "Axes", name: str, end: tuple[float, float], start: tuple[float, float] = (0, 0)) -> None:
    colour = AXIS_COLOURS[name]
    axes.annotate("", end, start, arrowprops={"arrowstyle": "-|>", "color": colour, "linewidth": 2})
    x, y = np.subtract(end, start) * 13 / np.hypot(*np.subtract(end, start))
    beside = {"xytext": (x, -y), "textcoords": "offset points"}  # of the tip; these axes have y downwards
    axes.annotate(name, end, **beside, color=colour, **_name())


def _name() -> dict[str, Any]:
    """How the name of an axis is set: with a white rim, since it lies on any colour."""
    from matplotlib.patheffects import withStroke

    rim = [withStroke(linewidth=3, foreground="white")]
    return {"fontsize": 11, "ha": "center", "va": "center", "weight": "bold", "path_effects": rim}
