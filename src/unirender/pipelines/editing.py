"""The picture operations of an edit: s of a new roughness, s and d of another light, and anchoring to the input.

Notation: s specular and d diffuse light, I the input, R_0 and R_1 the renders of the decomposition before and after the
edit.
"""

import numpy as np
from jaxtyping import Bool, Float

from unirender.blocks import by_rows
from unirender.composite import composite_image
from unirender.errors import UnirenderError
from unirender.intrinsics import Intrinsics
from unirender.light.exposure import exposure_factor
from unirender.light.lobes import LOBE_WIDTH
from unirender.pipelines.derived_light import derived_light, derived_specular
from unirender.pipelines.revealed_light import revealed_light

LOBE_RATIO = 4.0  # bound on the change of s by an edit, either way: beyond it the predicted light is too coarse to say
TRUST_WIDER = 0.9  # of that change's logarithm, where the lobe becomes wider
TRUST_SHARP, TRUST_PER_ROUGHNESS = 0.2, 3.0  # c: the same where it becomes sharper, per share of s in the picture
LEAST_TRUST, MOST_TRUST = 0.5, 1.7  # bounds of c
SMALL_CHANGE = 0.1  # of roughness: made by half, since the old one is a guess
LOBE_FLOOR = 0.02  # radiance added to both lobes, so that dark light does not decide the ratio
RELIGHT_TARGET = 0.75  # brightness of white under a light whose exposure is chosen here: the gauge's middle
ANCHOR_GAIN = 2.0  # bound on the input over its own re-rendering, either way
ANCHOR_FLOOR = 0.02  # radiance added to both: where the old render is dark, the change is added as it is


def specular_for_roughness(
    before: Intrinsics, roughness: Float[np.ndarray, "h w 1"]
) -> tuple[Float[np.ndarray, "h w 3"], float]:
    """s of a decomposition at a new roughness: the old s times what the lobes of its light change by.

        s_1 = s_0 * clip((S(L, r_1) / S(L, r_0))^t, 1/4, 4)

    L is the light that s_0 reveals (`unirender.pipelines.revealed_light`) and S its lobes. Both L and r_0 are
    estimates, so that the change is believed in part (`trust`). Shadowing and what that light misses stay in s_0.

    Returns:
        s_1, and the share of the covered values where the bound held the ratio.

    Raises:
        UnirenderError: a map is unknown; albedo, metallic and diffuse are needed too (`specular_share`).
    """
    maps = before.require("normal", "roughness", "specular", "environment", "mask")
    light = revealed_light(before)
    old = derived_specular(before, light)
    new = derived_specular(before.replace(roughness=roughness), light)
    ratio = ((new + LOBE_FLOOR) / (old + LOBE_FLOOR)) ** trust(maps["roughness"], roughness, specular_share(before))
    bounded = np.clip(ratio, 1 / LOBE_RATIO, LOBE_RATIO)
    inside = np.broadcast_to(maps["mask"] > 0, ratio.shape)
    held = float((ratio != bounded)[inside].mean()) if inside.any() else 0.0
    return (maps["specular"] * bounded).astype(np.float32), held


def trust(old: Float[np.ndarray, "h w 1"], new: Float[np.ndarray, "h w 1"], share: float) -> Float[np.ndarray, "h w 1"]:
    """t of `specular_for_roughness`: how much of a change of s to believe; 0 where the roughness is the old one.

        t = k (r_1 - r_0)^2 / ((r_1 - r_0)^2 + e^2),    k = 0.9 if r_1 > r_0, else min(c(r_1) q, 1)

    A wider lobe asks for no detail, and reflects less whatever the light is: its change is believed. A sharper lobe
    shows detail that the light lacks, the more the sharper it is: c(r) = clip(0.2 + 3 r, 0.5, 1.7). q is the share of
    the picture that s makes: the less of it shows, the less is known of it. A change of e is made by half.
    """
    square = np.square(new - old)
    per_share = np.clip(TRUST_SHARP + TRUST_PER_ROUGHNESS * new, LEAST_TRUST, MOST_TRUST)
    most = np.where(new > old, np.float32(TRUST_WIDER), np.minimum(per_share * np.float32(share), 1))
    return (most * square / (square + SMALL_CHANGE**2)).astype(np.float32)


def specular_share(intrinsics: Intrinsics) -> float:
    """The share of an object's radiance that is its specular light's, by the composite; 0 where all is black.

    Raises:
        UnirenderError: one of albedo, metallic, specular, diffuse or mask is unknown.
    """
    whole = composite_image(intrinsics).sum()
    without = composite_image(intrinsics.replace(specular=np.zeros_like(intrinsics.require("specular")["specular"])))
    return float(1 - without.sum() / whole) if whole > 0 else 0.0


def too_coarse(before: Intrinsics, roughness: Float[np.ndarray, "h w 1"]) -> Bool[np.ndarray, "h w 1"]:
    """Where the light of a decomposition is too coarse to say what a new roughness shows.

    There a texel of the light is wider than the sharper of the two lobes, the old or the new one: what they reflect
    differs in detail that the light does not have, and s hardly changes.

    Args:
        before: with roughness, environment and mask.
        roughness: the new one; where it is the old one there is nothing to say.
    """
    maps = before.require("roughness", "environment", "mask")
    texel = np.pi / (maps["environment"].shape[0] - 1)
    width = LOBE_WIDTH * np.square(np.minimum(maps["roughness"], roughness))
    return (maps["mask"] > 0) & (maps["roughness"] != roughness) & (width < texel)


def anchor(
    image_linear: Float[np.ndarray, "h w 3"],
    before: Float[np.ndarray, "h w 3"],
    after: Float[np.ndarray, "h w 3"],
) -> Float[np.ndarray, "h w 3"]:
    """Carries over what the decomposition could not explain of the input.

        out = I + g (R_1 - R_0),    g = clip((I + e) / (R_0 + e), 1/2, 2)

    Where g is not bounded and R_0 is well above e = 0.02 this is I R_1 / R_0; where R_0 is dark it is the difference
    form. Without a change the input comes back as it was. All premultiplied and linear.
    """
    return by_rows(_anchored, image_linear, before, after)


def _anchored(
    image_linear: Float[np.ndarray, "h w 3"], before: Float[np.ndarray, "h w 3"], after: Float[np.ndarray, "h w 3"]
) -> Float[np.ndarray, "h w 3"]:
    gain = np.clip((image_linear + ANCHOR_FLOOR) / (before + ANCHOR_FLOOR), 1 / ANCHOR_GAIN, ANCHOR_GAIN)
    return np.maximum(image_linear + gain * (after - before), 0).astype(np.float32)


def under_light(
    intrinsics: Intrinsics,
    environment: Float[np.ndarray, "eh ew 3"],
    exposure: str,
    specular: Float[np.ndarray, "h w 3"] | None = None,
    diffuse: Float[np.ndarray, "h w 3"] | None = None,
    mirrors: bool = True,
    shadows: bool = False,
) -> Intrinsics:
    """The intrinsics under another light: s and d from its own resolution, unless they are given.

    Args:
        intrinsics: with normal, roughness and mask.
        environment: lat-long radiance in camera axes.
        exposure: `auto` scales the light by the rule of the training data, to the middle of its range; `keep` does not.
        specular: s under that light, if known; not scaled.
        diffuse: the same for d.
        mirrors: as for `derived_specular`; not worth its time for predicted maps.
        shadows: whether what is derived has the shadows that the picture's own surfaces cast.

    Raises:
        UnirenderError: another exposure, a map is missing, or the object receives no light.
    """
    check_exposure(exposure)
    maps = intrinsics.require("normal", "roughness", "mask")
    given = {name: value for name, value in (("specular", specular), ("diffuse", diffuse)) if value is not None}
    names = {"specular", "diffuse"} - set(given) | ({"diffuse"} if exposure == "auto" else set())
    derived = derived_light(intrinsics, environment, names, mirrors=mirrors, shadows=shadows)
    factor = exposure_factor(derived["diffuse"], maps["mask"], RELIGHT_TARGET) if exposure == "auto" else 1.0
    scaled = {name: value * np.float32(factor) for name, value in derived.items()}
    return intrinsics.replace(environment=(environment * factor).astype(np.float32, copy=False), **(scaled | given))


def check_exposure(exposure: str) -> None:
    """Looks at a rule of exposure.

    Raises:
        UnirenderError: there is no such rule.
    """
    if exposure not in ("auto", "keep"):
        raise UnirenderError(f"exposure: got {exposure!r}, expected 'auto' or 'keep'")
