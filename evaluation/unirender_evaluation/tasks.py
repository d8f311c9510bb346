"""The questions (`task.Task`) that a suite asks under every table and protocol.

    table       protocol          given                                   asked
    rendering   from-image        picture (m .5, r .5), new material      the edited picture (the paper's protocol)
    rendering   given             true maps, true s and d of the target   the picture
    rendering   given-light       true maps, true light; no s, no d       the picture
    inverse     single-image      picture                                 maps
    relighting  from-image-sd     picture, s and d under another light    s, d of its own light; the relit picture
                                                                          (the paper's protocol)
    relighting  from-image-hdri   picture, another light                  the relit picture
    light       light-from-image  picture                                 the light, lat-long in camera axes

A picture is what a camera would store: 8-bit sRGB. No other truth reaches a method; the mask and the camera are inputs
everywhere. A row that is told more declares it (`rows.Row.told`).

The folder of an answer has a neutral name (`Suite.neutral_name`), which says neither the object nor the material. The
pictures that are edited and relit, those to be decomposed and the maps to be rendered have folders of their own: else
true maps, or an edit of a known material, would lie beside the same picture to be decomposed.
"""

from collections.abc import Iterable, Iterator
from functools import partial
from typing import Any

import numpy as np
from jaxtyping import Float

from unirender.errors import UnirenderError, UsageError
from unirender.intrinsics import Intrinsics
from unirender_evaluation.methods.method import quantise
from unirender_evaluation.suites.objects import known_mesh
from unirender_evaluation.suites.suite import MetallicRoughness, Scene, Suite, material_key
from unirender_evaluation.task import LIGHT, LIGHT_ANSWER, PROTOCOLS, Asked, Task


def edit_quantity(base: MetallicRoughness, target: MetallicRoughness) -> str:
    """Which column an edit belongs to.

    Raises:
        UnirenderError: it changes both metallic and roughness.
    """
    if base[0] != target[0] and base[1] != target[1]:
        raise UnirenderError(f"edit {base} -> {target} changes metallic and roughness at once: expected one of them")
    return "edit_metallic" if base[0] != target[0] else "edit_roughness"


def picture(suite: Suite, scene: Scene, material: MetallicRoughness) -> dict[str, Any]:
    """What a method sees of an image: 8-bit display values, mask, camera."""
    return {
        "image_srgb": quantise(suite.image(scene, material), suite.mask(scene)),
        "mask": suite.mask(scene),
        "camera": suite.spec.camera,
    }


def _picture_truth(suite: Suite, scene: Scene, material: MetallicRoughness) -> dict[str, Any]:
    """What the scorer keeps of a picture."""
    return {
        "truth_image": suite.image(scene, material),
        "truth_variance": suite.image_variance(scene, material),
        "truth_twin": suite.ceiling_image(scene, material),
    }


def scene_ids(suite: Suite, limit: int | None) -> list[Scene]:
    """The scenes of a run; a limited run takes them evenly spaced.

    Raises:
        UsageError: the limit is below 1.
    """
    scenes = list(suite.scenes)
    if limit is None or limit >= len(scenes):
        return scenes
    if limit < 1:
        raise UsageError(f"limit: got {limit}, expected at least 1 scene")
    return [scenes[i] for i in np.linspace(0, len(scenes) - 1, limit).round().astype(int)]


def tasks(suite: Suite, table: str, protocol: str, scenes: Iterable[Scene]) -> Iterator[Task]:
    """All questions of one protocol, scene by scene.

    Raises:
        UnirenderError: there is no such protocol.
    """
    makers = {
        ("rendering", "from-image"): _edits,
        ("rendering", "given"): _renders,
        ("rendering", "given-light"): _renders,
        ("inverse", "single-image"): _inverse,
        ("relighting", "from-image-sd"): _relights,
        ("relighting", "from-image-hdri"): _relights,
        LIGHT: _light,
    }
    if (table, protocol) not in makers:
        raise UnirenderError(
            f"no protocol {table}/{protocol}: expected one of {', '.join('/'.join(p) for p in PROTOCOLS)}"
        )
    for scene in scenes:
        yield from makers[table, protocol](suite, scene, protocol)


def _edited_folder(suite: Suite, scene: Scene) -> str:
    """Of the picture with the base material, which is edited and relit, and whose light is asked for."""
    return suite.neutral_name(f"edit/{scene.key}")


def _edits(suite: Suite, scene: Scene, protocol: str) -> Iterator[Task]:
    """Questions for the picture with another material."""
    base = suite.spec.base
    for target in suite.spec.edits:
        yield Task(
            table="rendering",
            protocol=protocol,
            sample=f"{scene.key}_{material_key(target)}",
            scene=scene,
            asks=("edit",),
            folder=_edited_folder(suite, scene),
            answer=f"edit_{material_key(target)}",
            read=partial(_read_edit, suite, scene, target),
            geometry=partial(known_mesh, suite, scene),
            quantity=edit_quantity(base, target),
        )


def _read_edit(suite: Suite, scene: Scene, target: MetallicRoughness) -> Asked:
    base = suite.spec.base
    change = {"metallic": target[0]} if target[0] != base[0] else {"roughness": target[1]}
    return Asked(
        suite.mask(scene),
        {"edit": {**picture(suite, scene, base), **change}},
        **_picture_truth(suite, scene, target),
    )


def _renders(suite: Suite, scene: Scene, protocol: str) -> Iterator[Task]:
    """Questions for the picture of true maps."""
    for target in suite.spec.edits:
        yield Task(
            table="rendering",
            protocol=protocol,
            sample=f"{scene.key}_{material_key(target)}",
            scene=scene,
            asks=("render",),
            folder=suite.neutral_name(f"render/{scene.key}_{material_key(target)}"),
            answer=f"render_{protocol}",
            read=partial(_read_render, suite, scene, target, protocol),
            quantity=edit_quantity(suite.spec.base, target),
        )


def _read_render(suite: Suite, scene: Scene, target: MetallicRoughness, protocol: str) -> Asked:
    maps = suite.intrinsics(scene, target)
    maps = maps.replace(environment=None) if protocol == "given" else maps.replace(specular=None, diffuse=None)
    return Asked(
        suite.mask(scene),
        {"render": {"intrinsics": maps}},
        **_picture_truth(suite, scene, target),
    )


def _inverse(suite: Suite, scene: Scene, protocol: str) -> Iterator[Task]:
    """Questions for the maps of a picture, one for each stratified material."""
    for material in scene.materials:
        sample = f"{scene.key}_{material_key(material)}"
        yield Task(
            table="inverse",
            protocol=protocol,
            sample=sample,
            scene=scene,
            asks=("decompose",),
            folder=suite.neutral_name(f"decompose/{sample}"),
            answer="intrinsics",
            read=partial(_read_inverse, suite, scene, material),
            geometry=partial(known_mesh, suite, scene),
        )


def _read_inverse(suite: Suite, scene: Scene, material: MetallicRoughness) -> Asked:
    return Asked(
        suite.mask(scene),
        {"decompose": picture(suite, scene, material)},
        truth_maps=suite.intrinsics(scene, material).replace(specular=None, diffuse=None, environment=None),
    )


def _relights(suite: Suite, scene: Scene, protocol: str) -> Iterator[Task]:
    """The question for the picture under the object's other light."""
    target = suite.other_light(scene)
    given_sd = protocol == "from-image-sd"
    light = target.key.rsplit("_", 1)[1]
    yield Task(
        table="relighting",
        protocol=protocol,
        sample=f"{scene.key}_to_{light}",
        scene=scene,
        asks=("relight", "decompose") if given_sd else ("relight",),
        folder=_edited_folder(suite, scene),
        answer=f"relight_{light}_{'sd' if given_sd else 'hdri'}",
        read=partial(_read_relight, suite, scene, target, given_sd),
        geometry=partial(known_mesh, suite, scene),
        quantity="relit",
    )


def _read_relight(suite: Suite, scene: Scene, target: Scene, given_sd: bool) -> Asked:
    base = suite.spec.base
    seen = picture(suite, scene, base)
    lit = suite.intrinsics(target, base)
    light: dict[str, Float[np.ndarray, "h w 3"] | None]
    light = {"specular": lit.specular, "diffuse": lit.diffuse} if given_sd else {"environment": lit.environment}
    own_light = None
    if given_sd:
        own = suite.intrinsics(scene, base)
        own_light = Intrinsics(specular=own.specular, diffuse=own.diffuse, mask=own.mask, camera=own.camera)
    return Asked(
        suite.mask(scene),
        {"relight": {**seen, **light}, "decompose": seen},
        **_picture_truth(suite, target, base),
        truth_maps=own_light,
    )


def _light(suite: Suite, scene: Scene, protocol: str) -> Iterator[Task]:
    """The question for the light of a picture."""
    sample = f"{scene.key}_{material_key(suite.spec.base)}"
    yield Task(
        table=LIGHT[0],
        protocol=protocol,
        sample=sample,
        scene=scene,
        asks=("decompose",),
        folder=_edited_folder(suite, scene),
        answer=LIGHT_ANSWER,
        read=partial(_read_light, suite, scene),
        geometry=partial(known_mesh, suite, scene),
        quantity="environment",
    )


def _read_light(suite: Suite, scene: Scene) -> Asked:
    base = suite.spec.base
    own = suite.intrinsics(scene, base)
    return Asked(
        suite.mask(scene),
        {"decompose": picture(suite, scene, base)},
        truth_maps=Intrinsics(environment=own.environment, mask=own.mask, camera=own.camera),
    )
