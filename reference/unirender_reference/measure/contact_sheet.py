"""`unirender reference sheet`: objects x buffers on one picture, to look at."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from unirender.errors import UsageError
from unirender.system.wording import counted
from unirender_reference.option_checks import require_least
from unirender_reference.output_files import check_file, png_bytes, write_file

if TYPE_CHECKING:
    import numpy as np

    from unirender_reference.render import Sample, SceneSpec

COLUMNS = ("image", "albedo", "normal", "roughness", "metallic", "specular s", "diffuse d", "environment", "mask")
MATERIALS = ((0.1, 1.0), (0.5, 0.0), (0.2, 0.0), (0.35, 1.0), (0.8, 0.0), (0.05, 0.5), (0.6, 1.0), (0.3, 0.5))
CHECKS, CHECK_CONTRAST = 12, 0.08  # squares along a tile's side, and their difference in display grey
TINT = (-0.08, 0.0, 0.08)  # of the checks about a map of one channel: no grey of it looks like them


@dataclass(frozen=True)
class Sheet:
    """Contact sheet: every buffer of the contract for a few objects under lights of the pool."""

    out: Path
    """PNG file to write."""
    objects: int = 8
    """Procedural objects; every second one has roughness, metallic and normal maps, the others one value each."""
    mesh: tuple[Path, ...] = ()
    """Mesh files (GLB, glTF, OBJ, PLY, STL, OFF) for more rows, with their own materials where they have some."""
    resolution: int = 112
    """Pixels along each side of a tile."""
    spp: int = 512
    """Samples per pixel."""
    seed: int = 0
    """First seed of objects and lights."""

    def run(self) -> int:
        """Renders and writes the sheet; returns the exit status."""
        from unirender_reference.render import render_sample
        from unirender_reference.sheets import table_sheet

        require_least(self, "", {"objects": 0 if self.mesh else 1, "resolution": 16, "spp": 8, "seed": 0})
        if self.spp % 8:
            raise UsageError(f"--spp {self.spp}: expected a multiple of 8")
        check_file("--out", self.out)
        if self.out.suffix.lower() != ".png":
            raise UsageError(f"--out {self.out}: expected the name of a PNG file, like {self.out.with_suffix('.png')}")
        specs = list(self.specs())  # a mesh that cannot be read is told before anything is rendered
        rows, labels = [], []
        for spec in specs:
            rows.append(buffer_tiles(render_sample(spec, self.spp)))
            labels.append(_label(spec))
        write_file("--out", self.out, png_bytes(table_sheet(rows, labels, COLUMNS)))
        print(f"{self.out}: {counted(len(rows), 'object')} x {len(COLUMNS)} buffers, {self.spp} spp")
        return 0

    def specs(self) -> "Iterator[SceneSpec]":
        """The scenes, row by row."""
        from unirender_reference.lights import make_light
        from unirender_reference.meshes import load_mesh
        from unirender_reference.render import SceneSpec
        from unirender_reference.shapes import make_object

        for row in range(self.objects + len(self.mesh)):
            if row < self.objects:
                obj = make_object(self.seed + row, "train", maps=row % 2 == 1)
            else:
                obj = load_mesh(self.mesh[row - self.objects])
            light, (roughness, metallic) = make_light(self.seed + row, "train"), MATERIALS[row % len(MATERIALS)]
            yield SceneSpec(
                obj,
                light,
                roughness=roughness if obj.roughness is None else None,
                metallic=metallic if obj.metallic is None else None,
                resolution=self.resolution,
                exposure_seed=self.seed + row,
            )


def buffer_tiles(sample: "Sample") -> "list[np.ndarray]":
    """Display values of the buffers in the order of `COLUMNS`.

    The image is composited in linear light over the background; the maps stand on checks about it, those of one channel
    on bluish ones, so that no value is mistaken for the page. s and d are clipped at display white like the image;
    roughness, metallic and mask are shown as their values, normals as (n + 1) / 2; the environment is exposed for
    itself (`sheets.environment_preview`).

    Args:
        sample: a complete sample.
    """
    import numpy as np

    from unirender.color import image_srgb, srgb_decode
    from unirender.light.resampling import resample_environment
    from unirender_reference.sheets import BACKGROUND, environment_preview

    maps = sample.intrinsics.maps
    mask = maps["mask"]
    grey = srgb_decode(np.array(BACKGROUND))
    shown = {
        "albedo": image_srgb(maps["albedo"]),
        "normal": (maps["normal"] + 1) / 2,
        "roughness": maps["roughness"],
        "metallic": maps["metallic"],
        "specular": image_srgb(maps["specular"]),
        "diffuse": image_srgb(maps["diffuse"]),
    }
    size = mask.shape[1]
    odd = (np.indices(mask.shape[:2]) // (size // CHECKS)).sum(axis=0)[..., None] % 2
    under = BACKGROUND + CHECK_CONTRAST * (odd - 0.5) + np.zeros(3)
    return [
        image_srgb(sample.image_linear + (1 - mask) * grey),
        *(mask * value + (1 - mask) * (under + TINT if value.shape[2] == 1 else under) for value in shown.values()),
        environment_preview(resample_environment(maps["environment"], (size // 2, size))),
        np.repeat(mask, 3, axis=2),
    ]


def _label(spec: "SceneSpec") -> str:
    """Object, material and light of a row."""
    material = [
        f"{name} {'map' if value is None else format(value, 'g')}"
        for name, value in (("roughness", spec.roughness), ("metallic", spec.metallic))
    ]
    return "\n".join([f"object {spec.obj.name}", *material, f"light {spec.light.name}"])
