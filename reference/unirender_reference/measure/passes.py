"""`unirender reference passes`: one scene taken apart, by effect and by lobe, and put together again."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from unirender.errors import UnirenderError, UsageError
from unirender.system.writing import writing
from unirender_reference.option_checks import require_least
from unirender_reference.output_files import ELSEWHERE

if TYPE_CHECKING:
    import numpy as np

    from unirender_reference.effects import Effects
    from unirender_reference.lobes import Lobes
    from unirender_reference.passes import Estimate
    from unirender_reference.render import Renderer
    from unirender_reference.shapes import MeshObject
    from unirender_reference.statistics import ZTest

SHEET_COLUMNS = 6
TILE = 160  # pixels that a picture of the sheet has at least


@dataclass(frozen=True)
class Passes:
    """Render a scene's passes by effect and by lobe; test that each set adds up to the render.

    Writes `passes.exr` (every pass as channels, docs/passes.md lists them) and `passes.png`.
    """

    out: Path
    """New folder for the two files."""
    object: int = 14
    """Seed of the procedural object and of its light."""
    split: Literal["train", "test"] = "train"
    """Which side the seed belongs to."""
    maps: bool = False
    """The procedural object with roughness, metallic and normal maps."""
    mesh: Path | None = None
    """A mesh file (GLB, glTF, OBJ, PLY, STL, OFF) in place of the procedural object."""
    light: Path | None = None
    """A lat-long EXR or HDR file, or a photograph, in place of the procedural light."""
    roughness: float | None = 0.3
    """Perceptual, in [0, 1]; the word None: the object's own map."""
    metallic: float | None = 0.5
    """In [0, 1]; the word None: the object's own map."""
    resolution: int = 96
    """Pixels along each side."""
    spp: int = 1152
    """Samples per pixel of each pass."""
    seed: int = 0
    """Of the samples."""

    def run(self) -> int:
        """Returns the exit status: 1 where a sum is not the render."""
        from rich.console import Console

        from unirender.new_folders import new_folder

        require_least(self, "", {"resolution": 8, "spp": 8, "object": 0})
        for name, value in (("roughness", self.roughness), ("metallic", self.metallic)):
            if value is not None and not 0 <= value <= 1:
                raise UsageError(f"--{name} {value}: expected a value in [0, 1], or None for the object's own map")
        if self.maps and self.mesh is not None:
            raise UsageError(
                "--maps: of the procedural object, but --mesh takes its place; for maps of its own: --roughness None "
                "--metallic None"
            )
        if self.out.is_dir() and any(self.out.iterdir()):
            raise UnirenderError(f"{self.out}: exists and is not empty, expected a new folder; choose another --out")
        with new_folder(self.out) as folder:
            renders = self.render()
            with writing(self.out, ELSEWHERE):
                self.write(renders, folder)
        console = Console()
        sums = renders.z_tests()
        console.print(_effects_table(renders))
        console.print(_composition_table(renders))
        for name, result in sums.items():
            print(f"{name}: {result}")
        print(f"{self.out}: passes.exr, passes.png")
        return int(not all(result.passed for result in sums.values()))

    def load(self) -> "tuple[MeshObject, Any]":
        """The object and its light."""
        from unirender_reference.lights import load_light, make_light
        from unirender_reference.meshes import load_mesh
        from unirender_reference.shapes import make_object

        obj = make_object(self.object, self.split, maps=self.maps) if self.mesh is None else load_mesh(self.mesh)
        return obj, make_light(self.object, self.split) if self.light is None else load_light(self.light)

    def render(self) -> "Renders":
        """All passes, and the renders that they have to add up to, under seeds of their own."""
        import numpy as np

        from unirender_reference import exposure
        from unirender_reference.effects import render_effects
        from unirender_reference.lobes import render_lobes
        from unirender_reference.passes import derive_seed
        from unirender_reference.render import DIRECT_DEPTH, Renderer

        obj, light = self.load()
        renderer = Renderer(obj, resolution=self.resolution)
        factor = exposure.scene_exposure(renderer, light.environment, self.object)
        environment = (light.environment * factor).astype(np.float32)
        scene = (environment, self.roughness, self.metallic, self.spp)
        return Renders(
            renderer=renderer,
            light=light.name,
            factor=factor,
            image=renderer.image(*scene, seed=derive_seed(self.seed, "full")),
            direct=renderer.image(*scene, seed=derive_seed(self.seed, "one bounce"), depth=DIRECT_DEPTH),
            effects=render_effects(renderer, *scene, seed=derive_seed(self.seed, "effects")),
            lobes=render_lobes(renderer, *scene, seed=derive_seed(self.seed, "lobes")),
            specular=renderer.specular(environment, self.roughness, self.spp, seed=derive_seed(self.seed, "s")),
            diffuse=renderer.diffuse(environment, self.spp, seed=derive_seed(self.seed, "d")),
            material=(self.roughness, self.metallic),
        )

    def write(self, renders: "Renders", folder: Path) -> None:
        """Writes the two files."""
        from unirender.exr import write_exr
        from unirender_reference.render import material_text, renderer_provenance

        attributes = {
            **renderer_provenance(renders.renderer),
            "light": renders.light,
            "roughness": material_text(self.roughness),
            "metallic": material_text(self.metallic),
            "spp": str(self.spp),
            "seed": str(self.seed),
            "exposure_factor": repr(renders.factor),
        }
        write_exr(folder / "passes.exr", renders.channels(), half=False, attributes=attributes)
        _sheet(renders).save(folder / "passes.png", format="PNG", optimize=True)


@dataclass(frozen=True)
class Renders:
    """A scene's passes, and the renders that they have to add up to."""

    renderer: "Renderer"
    light: str
    factor: float
    image: "Estimate"
    direct: "Estimate"
    effects: "Effects"
    lobes: "Lobes"
    specular: "Estimate"
    diffuse: "Estimate"
    material: tuple[float | None, float | None]

    def composed(self) -> "Estimate":
        """The direct image in closed form."""
        from unirender_reference.lobes import compose

        return compose(self.lobes)

    def z_tests(self) -> "dict[str, ZTest]":
        """Both sums against their renders, where more than half a pixel is covered."""
        from unirender_reference.statistics import z_test

        pairs = {
            "effects, against the image": (self.effects.total(), self.image),
            "lobes, against direct light": (self.composed(), self.direct),
        }
        return {
            name: z_test(
                a.mean[..., :3], a.variance[..., :3], b.mean[..., :3], b.variance[..., :3], self.image.mean[..., 3:]
            )
            for name, (a, b) in pairs.items()
            if a.variance is not None and b.variance is not None
        }

    def channels(self) -> "dict[str, np.ndarray]":
        """The channels of `passes.exr`."""
        from unirender.exr import image_channels
        from unirender_reference.effects import EFFECTS

        channels = dict(image_channels(self.image.mean))
        named = {name: getattr(self.effects, name).mean for name in EFFECTS}
        named |= {"effects": self.effects.total().mean, "direct": self.direct.mean, "composed": self.composed().mean}
        for name, lobe in self.lobes.lobes.items():
            named |= {name: lobe.buffer.mean, f"{name}.weight": lobe.weight}
        named |= {"specular": self.specular.mean, "diffuse": self.diffuse.mean}
        for name, picture in named.items():
            channels |= {f"{name}.{component}": picture[..., i] for i, component in enumerate("RGB")}
        return channels


def _effects_table(renders: Renders) -> Any:
    import numpy as np
    from rich.table import Table

    from unirender_reference.effects import EFFECTS

    table = Table("pass", "mean radiance", "of the image", "standard error", title="By effect")
    rows = [(name, getattr(renders.effects, name)) for name in EFFECTS]
    rows += [("sum", renders.effects.total()), ("image", renders.image)]
    covered = renders.image.mean[..., 3] > 0
    whole = float(renders.image.mean[covered, :3].mean())
    for name, estimate in rows:
        mean = float(estimate.mean[covered, :3].mean())
        error = float(np.sqrt(estimate.variance[covered, :3].mean()))
        table.add_row(name, f"{mean:.5f}", f"{100 * mean / whole:.2f} %", f"{error:.5f}")
    return table


def _composition_table(renders: Renders) -> Any:
    """The closed forms against the direct render: masked PSNR of the displayed picture, mean relative error."""
    import numpy as np
    from rich.table import Table

    from unirender.color import image_srgb, unpremultiply
    from unirender.composite import composite_image, split_sum_image
    from unirender_reference.noise import noise_floor_db

    geometry = renders.renderer.geometry(seed=1, material=renders.material)
    maps = geometry.replace(specular=renders.specular.mean, diffuse=renders.diffuse.mean)
    mask = renders.direct.mean[..., 3:]
    truth = unpremultiply(renders.direct.mean[..., :3], mask)
    table = Table("closed form", "masked PSNR", "mean relative error", title="By lobe, against direct light")
    composed = renders.composed()
    assert composed.variance is not None
    assert renders.direct.variance is not None
    noise = composed.variance + renders.direct.variance[..., :3]
    for name, picture in (
        ("four lobes", composed.mean),
        ("the paper's two", composite_image(maps)),
        ("split sum", split_sum_image(maps)),
    ):
        shown = unpremultiply(picture, mask)
        square = np.square(image_srgb(shown) - image_srgb(truth))
        mse = float((square * mask).sum() / (3 * mask.sum()))
        relative = float((np.abs(shown - truth) * mask).sum() / (truth * mask).sum())
        table.add_row(name, f"{-10 * np.log10(mse):.1f} dB", f"{100 * relative:.2f} %")
    floor = noise_floor_db(renders.direct.mean[..., :3], noise, mask, premultiplied=True)
    relative = float(np.sqrt(noise * 2 / np.pi).sum() / (truth * mask).sum())
    table.add_row("noise of the four lobes and direct light", f"{floor:.1f} dB", f"{100 * relative:.2f} %")
    return table


def _sheet(renders: Renders) -> Any:
    """The passes as a sheet: everything as displayed, over black; the shadow with its sign turned."""
    from unirender.color import image_srgb
    from unirender_reference.sheets import captioned_sheet

    channels, tiles, captions = renders.channels(), [], []
    shown = ["", "effects", "unshadowed", "shadow", "interreflection", "direct"]
    shown += ["composed", *renders.lobes.lobes, "diffuse"]
    titles = {"": "image", "effects": "sum of effects", "shadow": "- shadow", "mirror": "mirror, the paper's s"}
    titles |= {"direct": "direct light", "composed": "composed of lobes", "diffuse": "the paper's d"}
    for name in shown:
        picture = _picture(channels, name) * (-1 if name == "shadow" else 1)
        times = -(-TILE // len(picture))
        tiles.append(image_srgb(picture).repeat(times, axis=0).repeat(times, axis=1))
        captions.append(titles.get(name, name.replace("_", " ")))
    return captioned_sheet(tiles, captions, SHEET_COLUMNS)


def _picture(channels: "dict[str, np.ndarray]", name: str) -> "np.ndarray":
    from unirender.exr import channels_rgb

    return channels_rgb(channels, name)
