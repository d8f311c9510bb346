"""Intrinsics that are to be rendered: what they need, and what is made for them where they lack it.

A mask is made of the normals. s and d are derived from the light: direct light (`derived_light`), what the picture's
own surfaces leave of it (`shadowed_light`), and what these reflect where they hide it (`bounced_light`).
"""

import logging
from collections.abc import Collection
from typing import Any

import numpy as np

from unirender.arguments import as_instance
from unirender.errors import UnirenderError
from unirender.intrinsics import Intrinsics
from unirender.light.environment import as_light, check_sphere
from unirender.pipelines.bounced_light import WHITE_SKY, bounced_light
from unirender.pipelines.derived_light import derived_light
from unirender.pipelines.inputs import as_mask
from unirender.pipelines.shadowed_light import visible_shares_under
from unirender.vectors import dots, nonzero

RENDER_NEEDS = ("normal", "roughness", "metallic")
DERIVABLE = ("specular", "diffuse")  # from a light
MANY_AWAY = 0.2  # share of the object's normals, from which it is told

logger = logging.getLogger(__name__)


def check_rendered(intrinsics: Any, derived: Collection[str]) -> None:
    """Looks at what is to be rendered, and at the names of what was derived from its light.

    Raises:
        UnirenderError: no intrinsics, a light that is not twice as wide as high, or a name of no map that can be
            derived.
    """
    as_instance(intrinsics, Intrinsics, "render")
    if intrinsics.environment is not None:
        check_sphere(intrinsics.environment)
    if unknown := sorted(set(derived) - set(DERIVABLE)):
        raise UnirenderError(f"derived: got {', '.join(unknown)}, expected names out of {', '.join(DERIVABLE)}")


def to_derive(intrinsics: Intrinsics) -> frozenset[str]:
    """Which of specular and diffuse follow from the light where intrinsics are rendered."""
    names = DERIVABLE if intrinsics.environment is not None else ()
    return frozenset(name for name in names if getattr(intrinsics, name) is None)


def told_derived(names: Collection[str], shadows: bool) -> frozenset[str]:
    """Which of the derived maps the network is told to be derived, as `derived`.

    Without shadows all. Of those that have the shadows that the picture shows d alone: chosen by what came out of
    models that never saw such maps, and so it is in training.
    """
    return frozenset(names) - {"specular"} if shadows else frozenset(names)


def ready_to_render(intrinsics: Intrinsics, shadows: bool = True, derived: Collection[str] = ()) -> Intrinsics:
    """Intrinsics that the renderer can use: with a mask, and with s and d derived where a light is given.

    What is derived is direct light, and what the object itself reflects where it hides that
    (`unirender.pipelines.bounced_light`), if its albedo is known. It is meant for this one rendering: with another
    material it is another.

    Args:
        intrinsics: to be rendered.
        shadows: whether what is derived has the shadows that the picture's own surfaces cast, and what they reflect.
        derived: which of its s and d were derived from its light as direct light, with shadows if `shadows`.

    Raises:
        UnirenderError: normal, roughness or metallic is missing; leading axes; a bad size.
    """
    intrinsics.require(*RENDER_NEEDS)
    if intrinsics.roughness is not None and intrinsics.roughness.ndim != 3:
        raise UnirenderError(
            f"render: got maps of shape {intrinsics.roughness.shape}, expected one picture [height, width, channels]"
        )
    intrinsics = with_mask(intrinsics).with_unit_normals()
    as_mask(intrinsics.mask, (intrinsics.height, intrinsics.width))
    if intrinsics.environment is None:
        return intrinsics
    light = as_light(intrinsics.environment)
    names = to_derive(intrinsics)
    direct = derived_light(intrinsics, light, names, shadows=False)
    wanted = names.union(derived)
    if not shadows or not wanted:
        return intrinsics.replace(**direct)
    left, left_of_sky = visible_shares_under(intrinsics, (light, WHITE_SKY), wanted)
    direct = intrinsics.replace(**{name: value * left[name] for name, value in direct.items()})
    if direct.albedo is None:
        return direct
    bounced = bounced_light(direct, left_of_sky)
    return direct.replace(**{name: getattr(direct, name) + value for name, value in bounced.items()})


def with_mask(intrinsics: Intrinsics) -> Intrinsics:
    """The intrinsics with a mask: where none is known, the surface that has a normal, else the whole frame."""
    if intrinsics.mask is not None:
        return intrinsics
    surface = np.zeros(0) if intrinsics.normal is None else nonzero(intrinsics.normal)[..., None]
    if not surface.any():
        surface = np.ones((intrinsics.height, intrinsics.width, 1))
    return intrinsics.replace(mask=surface.astype(np.float32))


def report_facing_away(intrinsics: Intrinsics) -> None:
    """Logs that many of the normals face away from the camera: mostly they have other axes."""
    share = facing_away(with_mask(intrinsics))
    if share > MANY_AWAY:
        logger.warning(
            "%.0f%% of the object's normals face away from the camera: expected camera axes, +z towards the viewer; "
            "maps of other axes have to be turned",
            100 * share,
        )


def facing_away(intrinsics: Intrinsics) -> float:
    """Share of the coverage whose normals face away from the camera; normal and mask have to be known."""
    maps = intrinsics.require("normal", "mask")
    towards = dots(maps["normal"], intrinsics.camera.rays(intrinsics.height, intrinsics.width))[..., 0]
    return float((maps["mask"][..., 0] * (towards > 0)).sum() / max(float(maps["mask"].sum()), 1.0))
