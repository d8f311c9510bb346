"""Pictures for the report: display versions of maps and images, FLIP error maps, and PNG data URIs.

All pictures are un-premultiplied sRGB display values in [0, 1], `[h, w, 3]`; the mask becomes the PNG's alpha, so that
they sit on a light and on a dark page. FLIP (Andersson et al. 2020, its reference implementation at 67 pixels per
degree) compares the pictures over white with the true mask pasted on both.
"""

import base64
import io
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field

import numpy as np
import torch
from jaxtyping import Float
from PIL import Image

from unirender.color import image_srgb, srgb_decode
from unirender.errors import UnirenderError
from unirender.intrinsics import Intrinsics
from unirender_evaluation.scoring import over_white, unpremultiply

Picture = Float[np.ndarray, "h w 3"]
AnyPicture = Float[np.ndarray, "_ _ 3"]  # sizes are checked where they are put together


@dataclass(frozen=True)
class GalleryItem:
    """One sample of the gallery.

    Attributes:
        table: as in records.
        protocol: as in records.
        sample: as in records.
        caption: for people: object, light, material.
        mask: true coverage, [0, 1].
        given: what the method saw, name -> picture.
        truth: name -> picture.
        predictions: method key -> name -> picture; names are those of `truth`.
        scores: method key -> name -> text, e.g. "23.1 dB".
        badness: larger is worse; the gallery begins with the worst.
    """

    table: str
    protocol: str
    sample: str
    caption: str
    mask: Float[np.ndarray, "h w 1"]
    given: Mapping[str, AnyPicture]
    truth: Mapping[str, AnyPicture]
    predictions: Mapping[str, Mapping[str, AnyPicture]]
    scores: Mapping[str, Mapping[str, str]] = field(default_factory=dict)
    badness: float = 0.0

    def __post_init__(self) -> None:
        size = self.mask.shape[:2]
        groups = {"given": self.given, "truth": self.truth, **self.predictions}
        for group, pictures in groups.items():
            for name, picture in pictures.items():
                if picture.shape != (*size, 3):
                    raise UnirenderError(
                        f"gallery {self.sample}, {group} {name}: got shape {picture.shape}, expected {(*size, 3)}"
                    )


def map_pictures(intrinsics: Intrinsics) -> dict[str, Picture]:
    """Display pictures of the image-aligned maps that are present, in the report's order.

    Albedo and light as sRGB (clipped), normals as (n + 1) / 2, roughness and metallic as grey values.
    """
    pictures: dict[str, Picture] = {}
    for name in ("albedo", "normal", "roughness", "metallic", "specular", "diffuse"):
        value = getattr(intrinsics, name)
        if value is None:
            continue
        if name == "normal":
            pictures[name] = (value + 1) / 2
        elif name in ("roughness", "metallic"):
            pictures[name] = np.repeat(np.clip(value, 0, 1), 3, axis=-1)
        else:
            pictures[name] = image_srgb(value)
    return pictures


def image_picture(image_linear: Picture, mask: Float[np.ndarray, "h w 1"]) -> Picture:
    """Display picture of a premultiplied linear image."""
    return image_srgb(unpremultiply(image_linear, mask))


def flip_map(prediction: Picture, truth: Picture, mask: Float[np.ndarray, "h w 1"]) -> tuple[Picture, float]:
    """(FLIP error in the magma colours, mean error over the object weighted by coverage)."""
    import flip_evaluator

    frames = [image_srgb(over_white(srgb_decode(np.clip(picture, 0, 1)), mask)) for picture in (truth, prediction)]
    with _one_thread():
        error, _, _ = flip_evaluator.evaluate(frames[0], frames[1], "LDR", applyMagma=False)
    error = np.asarray(error, dtype=np.float32).reshape(*mask.shape[:2], 1)
    mean = float((error * mask).sum() / mask.sum())
    return _magma(error[..., 0]), mean


def data_uri(picture: Picture, mask: Float[np.ndarray, "h w 1"] | None = None) -> str:
    """PNG data URI; the mask becomes the alpha channel."""
    channels = [picture] if mask is None else [picture, mask]
    levels = np.round(np.clip(np.concatenate(channels, axis=-1), 0, 1) * 255).astype(np.uint8)
    buffer = io.BytesIO()
    Image.fromarray(levels).save(buffer, format="PNG")
    return "data:image/png;base64," + base64.b64encode(buffer.getvalue()).decode("ascii")


@contextmanager
def _one_thread() -> Iterator[None]:
    """FLIP's OpenMP threads spin for one another on a busy machine: 170 ms a small picture, 14 ms with one thread.

    torch and flip-evaluator share the OpenMP runtime that was loaded first (torch's, through `scoring`).
    """
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def _magma(error: Float[np.ndarray, "h w"]) -> Picture:
    from matplotlib import colormaps

    return np.asarray(colormaps["magma"](np.clip(error, 0, 1)), dtype=np.float32)[..., :3]
