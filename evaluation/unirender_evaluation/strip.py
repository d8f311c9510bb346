"""Draws the README's picture: what the shipped model makes of suite pictures, beside Mitsuba.

    python -m unirender_evaluation.strip OUT.png [--scene KEY ...]

Two rows a scene. First the picture and the maps found in it, the true map below each; then edits and a relighting, with
Mitsuba's render of the same scene below.
"""

import argparse
from pathlib import Path

import numpy as np
from jaxtyping import Float
from PIL import Image, ImageDraw, ImageFont

from unirender.color import image_srgb
from unirender.files import map_picture
from unirender.lighting import resample_environment
from unirender_evaluation.suites import Scene, Suite, load_suite
from unirender_evaluation.tasks import picture

CELL, LABEL = 144, 22
MAPS = ("albedo", "normal", "roughness", "metallic", "specular", "diffuse", "environment")
BACKGROUND = 1.0

Panel = tuple[str, Float[np.ndarray, "h w 3"], Float[np.ndarray, "h w 3"]]  # label, ours, Mitsuba's


def over_white(values: Float[np.ndarray, "h w c"], mask: Float[np.ndarray, "h w 1"]) -> Float[np.ndarray, "h w 3"]:
    """A map's picture over the page, three channels."""
    rgb = np.broadcast_to(values, (*values.shape[:2], 3))
    return (rgb * mask + BACKGROUND * (1 - mask)).astype(np.float32)


def scene_panels(pipeline: object, suite: Suite, scene: Scene) -> list[Panel]:
    """All panels of a scene, from its base picture alone."""
    seen, base = picture(suite, scene, suite.spec.base), suite.spec.base
    mask, truth = seen["mask"], suite.intrinsics(scene, base)
    inputs = (seen["image_srgb"], mask)
    decomposition = pipeline.decompose(*inputs, camera=seen["camera"])  # type: ignore[attr-defined] - loaded lazily
    options = {"camera": seen["camera"], "decomposition": decomposition}
    panels: list[Panel] = [("input", over_white(inputs[0], mask), over_white(inputs[0], mask))]
    for name in MAPS:
        ours, true = getattr(decomposition.intrinsics, name), getattr(truth, name)
        if name == "environment":
            shown = [_square(map_picture(name, resample_environment(x, (16, 32)))) for x in (ours, true)]
        else:
            shown = [over_white(map_picture(name, x), mask) for x in (ours, true)]
        panels.append((name, shown[0], shown[1]))
    for target in suite.spec.edits:
        change = {"metallic": target[0]} if target[0] != base[0] else {"roughness": target[1]}
        edited = pipeline.edit(*inputs, **change, **options).image_linear  # type: ignore[attr-defined] - loaded lazily
        label = ", ".join(f"{name} {value:g}" for name, value in change.items())
        panels.append((label, _shown(edited, mask), _shown(suite.image(scene, target), mask)))
    other = suite.other_light(scene)
    environment = suite.environment(other)
    relit = pipeline.relight(  # type: ignore[attr-defined] - loaded lazily
        inputs[0], environment, mask, exposure="keep", **options
    ).image_linear
    panels.append(("relit by an HDRI", _shown(relit, mask), _shown(suite.image(other, base), mask)))
    return panels


def _shown(image_linear: Float[np.ndarray, "h w 3"], mask: Float[np.ndarray, "h w 1"]) -> Float[np.ndarray, "h w 3"]:
    return image_srgb(image_linear + BACKGROUND * (1 - mask))


def _square(lat_long: Float[np.ndarray, "h w 3"]) -> Float[np.ndarray, "w w 3"]:
    """A lat-long map in the middle of a square cell."""
    height, width = lat_long.shape[:2]
    cell = np.full((width, width, 3), BACKGROUND, dtype=np.float32)
    cell[(width - height) // 2 :][:height] = lat_long
    return cell


def draw_strip(scenes: list[list[Panel]]) -> Image.Image:
    """The picture: per scene a row of predictions and a row of truths, labels above."""
    columns = max(len(panels) for panels in scenes)
    margin = 74
    sheet = Image.new("RGB", (margin + columns * CELL, len(scenes) * 2 * CELL + LABEL), "white")
    draw, font = ImageDraw.Draw(sheet), ImageFont.load_default(13)
    for column, (label, _, _) in enumerate(scenes[0]):
        x = margin + column * CELL + CELL // 2
        draw.text((x, LABEL // 2), label, fill="#333333", font=font, anchor="mm")
    for row, panels in enumerate(scenes):
        for line, name in enumerate(("unirender", "Mitsuba")):
            top = LABEL + (2 * row + line) * CELL
            draw.text((margin // 2, top + CELL // 2), name, fill="#333333", font=font, anchor="mm")
            for column, panel in enumerate(panels):
                pixels = np.round(np.clip(panel[1 + line], 0, 1) * 255).astype(np.uint8)
                cell = Image.fromarray(pixels).resize((CELL - 8, CELL - 8), Image.Resampling.NEAREST)
                sheet.paste(cell, (margin + column * CELL + 4, top + 4))
    return sheet


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument(
        "--scene", action="append", help="key of a scene of the suite; repeatable; default: two of them"
    )
    parser.add_argument("--suite", default="tiny")
    arguments = parser.parse_args()

    from unirender.pipelines.unirender_pipeline import UniRenderPipeline

    suite = load_suite(arguments.suite)
    scenes = [suite.scene(key) for key in arguments.scene or (suite.scenes[2].key, suite.scenes[9].key)]
    pipeline = UniRenderPipeline.from_pretrained()
    pipeline.set_progress_bar_config(disable=True)
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    draw_strip([scene_panels(pipeline, suite, scene) for scene in scenes]).save(arguments.out)


if __name__ == "__main__":
    main()
