"""`unirender reference exposure`: does the gauge keep pictures neither black nor clipped? Measured on random scenes."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

from unirender.system.wording import counted
from unirender_reference.option_checks import require_least

if TYPE_CHECKING:
    import numpy as np

RESOLUTION = 32
BLACK_SRGB = 0.01
WORST = 8  # scenes that are named, of each tail
LARGE = 0.25  # share of an object's pixels that a viewer misses
HEADERS = (
    *("scenes", "n", "clipped %\n50 / 95", "black %\n50 / 95", "mean sRGB %\n5 / 50 / 95"),
    *(f"clipped\n> {LARGE:.0%}", f"black\n> {LARGE:.0%}"),
)
BANDS = {"dielectric": (0.0, 0.5), "metal": (0.5, 1.01)}  # metallic from, below


@dataclass(frozen=True)
class SceneExposure:
    """The tails of one picture: shares of the object's pixels, [0, 1].

    Attributes:
        scene: object, light and material, to make it again.
        light: kind of the light, as `make_light` names it.
        metallic: of the material.
        clipped: pixels with a channel above display white.
        black: pixels whose every channel is below `BLACK_SRGB` on the display.
        mean_srgb: mean display value over the object's pixels and channels.
    """

    scene: str
    light: str
    metallic: float
    clipped: float
    black: float
    mean_srgb: float


@dataclass(frozen=True)
class Exposure:
    """The gauge on random scenes: which share of an object's pixels is clipped, which is black."""

    objects: int = 60
    """Random objects."""
    lights: int = 5
    """Random lights for each; every light comes with a material of its own, uniform in roughness and metallic."""
    spp: int = 64
    """Samples per pixel; with few, noise counts as clipping."""
    split: Literal["train", "test"] = "train"
    """Objects and lights of this side."""
    seed: int = 0
    """Another seed, other scenes."""

    def run(self) -> int:
        """Prints the table; returns the exit status."""
        from rich import box
        from rich.console import Console
        from rich.table import Table

        require_least(self, "", {"objects": 1, "lights": 1, "spp": 1, "seed": 0})
        scenes = list(self.scenes())
        groups = {"all": scenes}
        for kind in sorted({scene.light for scene in scenes}):
            groups[kind] = [scene for scene in scenes if scene.light == kind]
        for title, (low, high) in BANDS.items():
            groups[title] = [scene for scene in scenes if low <= scene.metallic < high]
        how = f"{RESOLUTION} px, {self.spp} spp, split {self.split}, seed {self.seed}"
        title = f"{counted(len(scenes), 'scene')}, {how}"
        table = Table(*HEADERS, title=title, box=box.SIMPLE)
        for title, group in groups.items():
            if group:
                table.add_row(title, str(len(group)), *_cells(group))
        console = Console()
        console.print(table)
        console.print(
            "Pixels of the object that are clipped (a channel above display white) or black (every channel below "
            f"{BLACK_SRGB} sRGB), and its mean display value: percentiles over the scenes. Last columns: scenes in "
            f"which more than {LARGE:.0%} of the object is. Metal: metallic of 0.5 or more."
        )
        for name in ("clipped", "black"):
            for scene in sorted(scenes, key=lambda scene: -getattr(scene, name))[:WORST]:
                console.print(f"{name} {getattr(scene, name):.0%}: {scene.scene}", highlight=False)
        return 0

    def scenes(self) -> Iterator[SceneExposure]:
        """Renders the scenes one by one."""
        import numpy as np

        from unirender_reference.exposure import scene_exposure
        from unirender_reference.lights import make_light
        from unirender_reference.passes import derive_seed
        from unirender_reference.render import Renderer
        from unirender_reference.shapes import make_object

        rng = np.random.default_rng(derive_seed(self.seed, "exposure", self.split))
        for _ in range(self.objects):
            renderer = Renderer(make_object(int(rng.integers(1 << 31)), self.split), resolution=RESOLUTION)
            for _ in range(self.lights):
                light = make_light(int(rng.integers(1 << 31)), self.split)
                roughness, metallic = (float(value) for value in rng.uniform(0, 1, 2))
                factor = scene_exposure(renderer, light.environment, int(rng.integers(1 << 31)))
                environment = (light.environment * factor).astype(np.float32)
                image = renderer.image(environment, roughness, metallic, self.spp, batches=1).mean
                scene = f"{renderer.obj.name}, {light.name}, roughness {roughness:.2f}, metallic {metallic:.2f}"
                yield picture_exposure(image, scene, light.provenance["kind"], metallic)


def picture_exposure(image: "np.ndarray", scene: str, light: str, metallic: float) -> SceneExposure:
    """The tails of a premultiplied linear RGBA picture `[h w 4]`, over the pixels covered by at least one half."""
    from unirender.color import image_srgb

    inside = image[..., 3] >= 0.5
    radiance = image[inside][:, :3] / image[inside][:, 3:]
    display = image_srgb(radiance)
    return SceneExposure(
        scene=scene,
        light=light,
        metallic=metallic,
        clipped=float((radiance.max(axis=1) > 1).mean()),
        black=float((display.max(axis=1) < BLACK_SRGB).mean()),
        mean_srgb=float(display.mean()),
    )


def _cells(group: list[SceneExposure]) -> list[str]:
    import numpy as np

    clipped, black, mean = (
        np.array([getattr(scene, name) for scene in group]) for name in ("clipped", "black", "mean_srgb")
    )
    cells = [
        " / ".join(f"{100 * value:.1f}" for value in np.percentile(values, (50, 95))) for values in (clipped, black)
    ]
    cells.append(" / ".join(f"{100 * value:.0f}" for value in np.percentile(mean, (5, 50, 95))))
    return [*cells, f"{(clipped > LARGE).mean():.1%}", f"{(black > LARGE).mean():.1%}"]
