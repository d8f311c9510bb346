"""Denoising of training pictures with Intel Open Image Denoise, guided by albedo and normal; never for truth.

A denoised picture is biased: its error is no longer Monte Carlo noise, it has no variance and no noise floor. Whoever
stores one adds `marking()` to its header.

The package `mitsuba-oidn` is an optional extra: `pip install 'unirender[denoise]'`.
"""

import importlib.metadata
import importlib.util
from typing import Any

import numpy as np
from jaxtyping import Float

from unirender.color import unpremultiply
from unirender.errors import UnirenderError
from unirender_reference.backend import mitsuba

PACKAGE = "mitsuba-oidn"


def denoise(
    image_linear: Float[np.ndarray, "h w c"],
    albedo_linear: Float[np.ndarray, "h w 3"] | None,
    normal: Float[np.ndarray, "h w 3"],
    mask: Float[np.ndarray, "h w 1"],
    premultiplied: bool = True,
) -> Float[np.ndarray, "h w c"]:
    """The picture without its noise, as far as a network can tell the two apart.

    Args:
        image_linear: RGB, or RGBA whose last channel is kept; linear, not negative, rendered with a box filter (as all
            of this package's are: a wider filter correlates the noise of neighbours, and it stays).
        albedo_linear: base colour, [0, 1]; None for the white surfaces of s and d.
        normal: shading normals.
        mask: coverage. The guides are multiplied by it, as the image is (measured: 3 dB better than without).
        premultiplied: whether the image is; s and d are not.

    Raises:
        UnirenderError: the package is missing, or a picture is not finite or of another size.
    """
    size = image_linear.shape[:2]
    given = {"albedo": albedo_linear, "normal": normal, "mask": mask}
    sizes = {name: guide.shape[:2] for name, guide in given.items() if guide is not None}
    if set(sizes.values()) != {size}:
        raise UnirenderError(f"denoise: got a picture of {size} pixels and guides of {sizes}, expected one size")
    oidn = _package()
    radiance = image_linear[..., :3] if premultiplied else image_linear[..., :3] * mask
    if image_linear.shape[-1] not in (3, 4) or not np.isfinite(radiance).all() or radiance.min() < 0:
        raise UnirenderError(
            f"denoise: got {image_linear.shape[-1]} channels in [{radiance.min():.4g}, {radiance.max():.4g}], expected "
            "finite RGB or RGBA radiance >= 0"
        )
    albedo = mask * (np.ones(3) if albedo_linear is None else albedo_linear)
    pictures = [np.ascontiguousarray(picture, np.float32) for picture in (radiance, albedo, normal * mask)]
    clean = np.maximum(oidn.denoise(*pictures, hdr=True, clean_aux=True), 0)
    if not premultiplied:
        clean = unpremultiply(clean, mask)
    return np.concatenate([clean, image_linear[..., 3:]], axis=-1).astype(np.float32)


def marking() -> dict[str, str]:
    """Header entries of a denoised picture."""
    return {"denoised": version()}


def version() -> str:
    """What denoises, with its versions.

    Raises:
        UnirenderError: the package is missing.
    """
    library = _package().oidn_version()
    return f"{PACKAGE} {importlib.metadata.version(PACKAGE)}, Open Image Denoise {library}"


def _package() -> Any:
    if importlib.util.find_spec("mitsuba_oidn") is None:
        raise UnirenderError(f"denoising: {PACKAGE} is not installed, expected it; pip install 'unirender[denoise]'")
    mitsuba()  # the package shares Dr.Jit's thread pool
    import mitsuba_oidn

    return mitsuba_oidn
