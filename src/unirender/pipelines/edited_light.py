"""s and d after somebody edited the normals or the roughness that they belong to.

s changes with the roughness as for an edit (`unirender.pipelines.editing.specular_for_roughness`); with a new normal
both change by what it receives of the light beside what the old one did,

    d_1 = d_0 clip((D(n_1) + e) / (D(n_0) + e), 1/4, 4)

and s alike. Where nothing was edited, they stay as they are, with all detail of the picture.
"""

import logging

import numpy as np
from jaxtyping import Bool

from unirender.intrinsics import Intrinsics
from unirender.pipelines.derived_light import derived_light
from unirender.pipelines.editing import LOBE_FLOOR, LOBE_RATIO, specular_for_roughness, too_coarse

LIT = ("specular", "diffuse")
MUCH_COARSE = 0.05  # share of the object, from which it is told

logger = logging.getLogger(__name__)


def with_edited_light(stored: Intrinsics, edited: Intrinsics) -> Intrinsics:
    """The edited maps with s and d of their normals and roughness; one that was edited itself, or is gone, stays so.

    Args:
        stored: before the edit.
        edited: after it.
    """
    turned, resurfaced = (_changed(stored, edited, name) for name in ("normal", "roughness"))
    own = [name for name in LIT if getattr(edited, name) is not None and not _changed(stored, edited, name).any()]
    own = [name for name in own if turned.any() or (name == "specular" and resurfaced.any())]
    if not own:
        return edited
    needed = {"albedo", "normal", "roughness", "metallic", "environment", "mask", *LIT}
    if missing := sorted(needed - set(stored.present)):
        logger.warning(
            "%s stay as they were before the normal or the roughness was edited: %s missing",
            " and ".join(own),
            ", ".join(missing),
        )
        return edited
    light = {name: getattr(edited, name) for name in own}
    if "specular" in own and resurfaced.any():
        roughness = edited.require("roughness")["roughness"]
        light["specular"], _ = specular_for_roughness(stored, roughness)
        coarse = too_coarse(stored, roughness).sum() / max((stored.require("mask")["mask"] > 0).sum(), 1)
        if coarse > MUCH_COARSE:
            logger.warning(
                "the light is too coarse to show what the edited roughness reflects on %.0f%% of the object: its "
                "highlights stay as wide as they were",
                100 * coarse,
            )
    if turned.any():
        environment = stored.require("environment")["environment"]
        old, new = (
            derived_light(maps, environment, own, shadows=False)
            for maps in (edited.replace(normal=stored.normal), edited)
        )
        for name in own:
            ratio = np.clip((new[name] + LOBE_FLOOR) / (old[name] + LOBE_FLOOR), 1 / LOBE_RATIO, LOBE_RATIO)
            light[name] = np.where(turned[..., None], light[name] * ratio, light[name])
    return edited.replace(**light)


def _changed(stored: Intrinsics, edited: Intrinsics, name: str) -> Bool[np.ndarray, "h w"]:
    """Where a map is another one; nowhere if it is not known of both."""
    before, after = getattr(stored, name), getattr(edited, name)
    if before is None or after is None or before is after:
        return np.zeros((edited.height, edited.width), bool)
    return (before != after).any(axis=-1)
