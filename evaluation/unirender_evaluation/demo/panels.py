"""Pictures with captions as HTML; they travel inside the page as data, so that none lies on the server as a file."""

import base64
import html
from collections.abc import Iterable, Mapping

import numpy as np
from jaxtyping import Float

from unirender.color import image_srgb
from unirender.intrinsics import Intrinsics
from unirender.light.resampling import resample_environment
from unirender_evaluation.demo.session import Check, Subject, View
from unirender_evaluation.report.gallery import data_uri, image_picture, map_pictures

LIGHT_SHAPE = (32, 64)  # rows and columns at which lights are shown
MOST_SPREAD = 0.5  # standard deviation of a material at which it is shown white: it is somewhere between 0 and 1

MATERIALS = ("roughness", "metallic")
NAMES = {
    "albedo": "Albedo",
    "normal": "Normal",
    "roughness": "Roughness",
    "metallic": "Metallic",
    "specular": "Specular light (s)",
    "diffuse": "Diffuse light (d)",
    "environment": "Light",
}
MEANINGS = {
    "albedo": "base colour",
    "normal": "red: right, green: up, blue: towards you",
    "roughness": "black: a mirror",
    "metallic": "white: metal",
    "specular": "what a mirror of this roughness shows",
    "diffuse": "what reaches a white, matt surface",
    "environment": "all directions; the middle is behind the camera",
}

CAVEAT = (
    "Mitsuba has the light alone; the model was also given s and d, which, as long as the light is the predicted one, "
    "hold shadows and detail that this light does not explain. Mitsuba's first check includes its compilation."
)

Picture = Float[np.ndarray, "h w 3"]
Mask = Float[np.ndarray, "h w 1"]


def figure(name: str, picture: Picture, mask: Mask | None = None, note: str = "", kind: str = "") -> str:
    """A picture with its name and a note below; what lies outside the mask is transparent."""
    small = f"<small>{html.escape(note)}</small>" if note else ""
    height, width = picture.shape[:2]
    return (
        f'<figure class="{kind}"><img alt="{html.escape(name, quote=True)}" width="{width}" height="{height}" '
        f'src="{data_uri(picture, mask)}"><figcaption>{html.escape(name)}{small}</figcaption></figure>'
    )


def row(figures: Iterable[str], remarks: Iterable[str] = ()) -> str:
    """Figures side by side, as many as there is room for, with remarks below."""
    said = "".join(f'<p class="remark">{html.escape(remark)}</p>' for remark in remarks)
    return f'<div class="figures">{"".join(figures)}</div>{said}'


def light_figure(environment: Float[np.ndarray, "eh ew 3"], note: str = "") -> str:
    """A light as a lat-long picture."""
    shown = image_srgb(resample_environment(environment, LIGHT_SHAPE)).astype(np.float32)
    return figure(NAMES["environment"], shown, note=note, kind="light")


def view_panel(subject: Subject, seen: View) -> str:
    """The picture, what became of it, and the light."""
    result = figure("Result", image_picture(seen.image_linear, subject.mask), subject.mask, kind="result")
    light = light_figure(seen.intrinsics.require("environment")["environment"], MEANINGS["environment"])
    return row([figure("Picture", subject.picture.image_srgb, subject.mask), result, light], seen.remarks)


def maps_panel(subject: Subject) -> str:
    """Every map of a decomposition."""
    found = subject.decomposition
    values = {"roughness": found.roughness, "metallic": found.metallic}
    figures = [
        figure(NAMES[name] + (f" {values[name]:.2f}" if name in values else ""), picture, subject.mask, MEANINGS[name])
        for name, picture in map_pictures(found.intrinsics).items()
    ]
    light = light_figure(found.intrinsics.require("environment")["environment"], MEANINGS["environment"])
    return row([*figures, light])


def check_panel(found: Check, intrinsics: Intrinsics) -> str:
    """The model's rendering, Mitsuba's, and where they differ."""
    mask = intrinsics.require("mask")["mask"]
    figures = [
        figure("Model", image_picture(found.model, mask), mask, "plain rendering of the maps"),
        figure("Mitsuba", image_picture(found.mitsuba, mask), mask, f"the same maps and light, {found.seconds:.2f} s"),
        figure("FLIP", found.flip, mask, f"bright: seen to differ; mean {found.flip_mean:.3f}"),
    ]
    return row(figures, [f"PSNR {found.psnr_db:.1f} dB inside the mask, sRGB; FLIP {found.flip_mean:.3f}.", CAVEAT])


def spread_panel(std: Mapping[str, np.ndarray], mask: Mask, samples: int) -> str:
    """Standard deviations over samples, with what is white below each.

    A material, often one number for the object, is shown against `MOST_SPREAD`, so that black and white say whether it
    is known; every other map against its own largest value, so that it is seen where the samples differ.
    """
    figures = []
    for name, value in std.items():
        grey = value.mean(axis=-1, keepdims=True)
        most = float(grey.max())
        white = MOST_SPREAD if name in MATERIALS else most
        picture = np.repeat(grey / max(white, 1e-9), 3, axis=-1).astype(np.float32)
        note = f"up to {most:.2g}; white: {white:.2g}" if name in MATERIALS else f"white: {most:.2g}"
        if name == "environment":
            figures.append(figure(NAMES[name], resample_environment(picture, LIGHT_SHAPE), note=note, kind="light"))
        else:
            figures.append(figure(NAMES[name], picture, mask, note))
    return row(figures, [f"Standard deviation over {samples} samples: black where they agree."])


def downloads_panel(archives: Mapping[str, bytes], meanings: Mapping[str, str]) -> str:
    """A link to each archive, which is in the page itself."""
    links = [
        f'<li><a download="{name}" href="data:application/zip;base64,{base64.b64encode(data).decode("ascii")}">{name}'
        f"</a> <small>{html.escape(meanings[name])}, {len(data) / 1000:.0f} kB</small></li>"
        for name, data in archives.items()
    ]
    return f'<ul class="downloads">{"".join(links)}</ul>'
