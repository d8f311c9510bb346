"""What `shade` of the true maps scores against the path-traced truth, by roughness and metallic.

`shade` has one bounce, one normal and one material per pixel, and shadows only with geometry. Its error is therefore
missing light (shadows, interreflection) and averaging (highlights narrower than a pixel's spread of normals). A method
whose predictions are shaded again (closed loop) cannot be expected to score better.
"""

from dataclasses import dataclass
from typing import Any

from unirender.errors import UsageError
from unirender_reference.option_checks import require_least

MODES = ("alone", "shadows", "one bounce")


@dataclass(frozen=True)
class ShadeCeiling:
    """Score `shade` of true maps against the path-traced truth: masked sRGB PSNR by roughness and metallic."""

    objects: int = 6
    """Procedural objects of the test split, a light each."""
    resolution: int = 64
    """Pixels along each side."""
    spp: int = 256
    """Samples per pixel of the shaded images."""
    truth_spp: int = 256
    """Samples per pixel of the truths, in eight batches."""
    roughness: tuple[float, ...] = (0.05, 0.1, 0.2, 0.3, 0.5, 0.7, 1.0)
    """Perceptual roughness values."""
    metallic: tuple[float, ...] = (0.0, 0.5, 1.0)
    """Metallic values."""
    seed: int = 0
    """Of the first object."""

    def run(self) -> int:
        """Measures and prints; returns the exit status."""
        from statistics import fmean

        from rich.console import Console
        from rich.table import Table

        require_least(self, "", {"objects": 1, "resolution": 1, "spp": 1, "seed": 0})
        for name in ("roughness", "metallic"):
            values = getattr(self, name)
            if not values or not all(0 <= value <= 1 for value in values):
                shown = " ".join(f"{value:g}" for value in values)
                raise UsageError(f"--{name} {shown}: expected one value or more, all in [0, 1]")
        cells = [measure(self, self.seed + index) for index in range(self.objects)]
        table = Table("metallic", "roughness", *MODES, "noise of truth")
        for metallic in self.metallic:
            for roughness in self.roughness:
                scores = [cell[roughness, metallic] for cell in cells]
                means = (fmean(score[mode] for score in scores) for mode in MODES)
                least = min(score["floor"] for score in scores)
                table.add_row(f"{metallic:g}", f"{roughness:g}", *(f"{mean:.1f}" for mean in means), f"{least:.1f}")
            table.add_section()
        console = Console()
        console.print(table)
        console.print(
            f"Masked sRGB PSNR in dB, mean over {self.objects} objects of the test split at {self.resolution} px. "
            "alone: shade without geometry; shadows: with the true mesh; both against the truth (depth 4). one bounce: "
            "with the mesh, against a truth of one bounce. noise of truth: the least that a noise-free one would score."
        )
        return 0


def measure(config: ShadeCeiling, seed: int) -> dict[tuple[float, float], dict[str, float]]:
    """Scores of one object under its own light, by (roughness, metallic): each mode's, and the truth's noise floor."""
    import numpy as np

    from unirender_reference.exposure import scene_exposure
    from unirender_reference.lights import make_light
    from unirender_reference.noise import noise_floor_db
    from unirender_reference.render import DIRECT_DEPTH, Renderer
    from unirender_reference.shade import shade
    from unirender_reference.shapes import make_object

    obj = make_object(seed, "test")
    renderer = Renderer(obj, resolution=config.resolution)
    light = make_light(seed, "test").environment
    light = (light * np.float32(scene_exposure(renderer, light, seed))).astype(np.float32)
    maps = renderer.geometry()
    assert maps.mask is not None
    scores: dict[tuple[float, float], dict[str, float]] = {}
    for roughness in config.roughness:
        for metallic in config.metallic:
            truth = renderer.image(light, roughness, metallic, config.truth_spp, seed)
            direct = renderer.image(light, roughness, metallic, config.truth_spp, seed, DIRECT_DEPTH)
            assert truth.variance is not None
            true = maps.replace(
                roughness=np.full_like(maps.mask, roughness), metallic=np.full_like(maps.mask, metallic)
            )
            alone = shade(true, light, config.spp, seed)
            shadowed = shade(true, light, config.spp, seed, geometry=obj)
            pairs = zip(MODES, ((alone, truth), (shadowed, truth), (shadowed, direct)), strict=True)
            scores[roughness, metallic] = {
                mode: masked_psnr(image, target.mean[..., :3], maps.mask) for mode, (image, target) in pairs
            }
            scores[roughness, metallic]["floor"] = noise_floor_db(
                truth.mean[..., :3], truth.variance[..., :3], maps.mask, premultiplied=True
            )
    return scores


def masked_psnr(image: Any, truth: Any, mask: Any) -> float:
    """Coverage-weighted sRGB PSNR in dB of two premultiplied linear images, as the benchmark scores them."""
    import numpy as np

    from unirender.color import srgb_encode, unpremultiply
    from unirender_reference.noise import decibels

    a, b = (srgb_encode(np.clip(unpremultiply(linear, mask), 0, 1)).astype(np.float64) for linear in (image, truth))
    error = float((mask * np.square(a - b)).sum() / (3 * mask.sum(dtype=np.float64)))
    return decibels(error)
