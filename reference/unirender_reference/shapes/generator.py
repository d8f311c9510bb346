"""`make_object(seed, split)`: the endless set of procedural objects.

Every draw comes from `numpy.random.default_rng([SPLIT[split], seed])`, so the two splits share no random stream.
The train split never draws a held-out family; in the test split even seeds are held-out families, odd seeds are train
families. Material maps have a stream of their own, `[SPLIT[split], seed, MAPS]`. Meshes repeat from machine to machine
up to floating-point rounding.
"""

from collections.abc import Callable
from dataclasses import replace
from numbers import Integral
from typing import Literal

import numpy as np
from jaxtyping import Float

from unirender.errors import UnirenderError
from unirender_reference import textures  # which imports `shapes.noise`: whoever comes first finds the other begun
from unirender_reference.shapes import implicit, parametric
from unirender_reference.shapes.material_maps import BakedMaps, SolidMaterial, random_material
from unirender_reference.shapes.mesh_object import MeshObject, unit_sphere
from unirender_reference.shapes.surface import AtlasPlace, Part, corner_normals, pack_textures, split_corners

Split = Literal["train", "test"]
SPLIT = {"train": 0x7421, "test": 0x7E57}
TEXTURED = 0.62
MAPS = 0x3A95

ASSEMBLED = ("rounded_box", "cylinder", "capsule", "superquadric", "turned")

Family = Callable[[np.random.Generator], Part | list[Part]]


def assembly(rng: np.random.Generator) -> list[Part]:
    """Two to four solids standing in each other, each with its own colours: furniture, machines, toys."""
    builders = [parametric.TRAIN_FAMILIES[name] for name in ASSEMBLED]
    parts, center = [], np.zeros(3)
    for _ in range(int(rng.integers(2, 5))):
        part = builders[int(rng.integers(len(builders)))](rng)
        stretch = rng.uniform(0.25, 1, 3) * rng.uniform(0.5, 1)
        turn = np.eye(3)[rng.permutation(3)] if rng.random() < 0.6 else implicit.random_rotation(rng)
        turn = turn * np.sign(np.linalg.det(turn))
        vertices = unit_sphere(part.vertices) * stretch @ turn.T + center
        parts.append(replace(part, vertices=vertices.astype(np.float32)))
        anchor = parts[int(rng.integers(len(parts)))].vertices
        center = anchor[int(rng.integers(len(anchor)))] * rng.uniform(0.6, 1)
    return parts


TRAIN_FAMILIES: dict[str, Family] = {**parametric.TRAIN_FAMILIES, **implicit.TRAIN_FAMILIES, "assembly": assembly}
HELD_OUT_FAMILIES: dict[str, Family] = {**parametric.HELD_OUT_FAMILIES, **implicit.HELD_OUT_FAMILIES}
FAMILIES = {**TRAIN_FAMILIES, **HELD_OUT_FAMILIES}
# Several-part and implicit families hold more shapes than one formula does, so they are drawn more often.
WEIGHT = {"assembly": 3, "smooth_union": 3, "smooth_difference": 2, "displaced_union": 1.5, "displaced_sphere": 1.5}


def deform(rng: np.random.Generator, part: Part) -> Part:
    """Bends, twists or tapers along y and squeezes one axis; the texture follows the surface."""
    p = unit_sphere(part.vertices).astype(np.float64)
    kind = rng.choice(["bend", "twist", "taper"])
    y = p[:, 1]
    if kind == "taper":
        p[:, [0, 2]] *= (1 + rng.uniform(0.2, 0.6) * y)[:, None]
    else:
        turn = rng.uniform(0.3, 1.0) * y
        c, s = np.cos(turn), np.sin(turn)
        a, b = (0, 2) if kind == "twist" else (0, 1)
        p[:, a], p[:, b] = c * p[:, a] - s * p[:, b], s * p[:, a] + c * p[:, b]
    p *= rng.uniform(0.7, 1, 3)
    return replace(part, vertices=p.astype(np.float32))


def draw_family(seed: int, split: Split) -> tuple[str, np.random.Generator]:
    """The family of object number `seed`, and the generator that goes on to draw the object.

    Raises:
        UnirenderError: unknown split or negative seed.
    """
    if split not in SPLIT or not isinstance(seed, Integral) or seed < 0:
        raise UnirenderError(f"make_object: got seed {seed!r}, split {split!r}; expected seed >= 0, 'train' or 'test'")
    rng = np.random.default_rng([SPLIT[split], seed])
    names = list(HELD_OUT_FAMILIES if split == "test" and seed % 2 == 0 else TRAIN_FAMILIES)
    weights = np.array([WEIGHT.get(name, 1.0) for name in names])
    return str(rng.choice(names, p=weights / weights.sum())), rng


def make_object(seed: int, split: Split, maps: bool = False) -> MeshObject:
    """Makes procedural object number `seed` of a split.

    Args:
        seed: 0 or more; every seed is another object.
        split: "train" or "test".
        maps: give it roughness, metallic and normal maps, drawn from a random stream of their own: shape and base
            colour are those of the object without maps.

    Returns:
        An object named like "train-000123".

    Raises:
        UnirenderError: unknown split or negative seed.
    """
    family, rng = draw_family(seed, split)
    made = FAMILIES[family](rng)
    parts = made if isinstance(made, list) else [deform(rng, made) if rng.random() < 0.3 else made]
    textured = bool(rng.random() < TEXTURED)
    materials = []
    if maps:
        own = np.random.default_rng([SPLIT[split], seed, MAPS])
        materials = [random_material(own) for _ in parts]
    return _finish(rng, f"{split}-{seed:06d}", family, parts, textured, materials)


def _finish(
    rng: np.random.Generator,
    name: str,
    family: str,
    parts: list[Part],
    textured: bool,
    materials: list[SolidMaterial],
) -> MeshObject:
    """Colours the parts, joins and turns them, and gives them normals; `materials` is empty or has one a part."""
    normals = [corner_normals(part.vertices, part.faces, part.crease_deg) for part in parts]
    pattern, albedo, uvs = "constant", textures.random_color(rng), None
    if textured or len(parts) > 1:
        kinds, planes = zip(*[_part_texture(rng, part, textured) for part in parts], strict=True)
        albedo, places = pack_textures(planes)
        uvs = [place.move(part.corner_uv) for place, part in zip(places, parts, strict=True)]
        pattern = "+".join(kinds)
    maps = [material.bake(part.position_map) for material, part in zip(materials, parts, strict=False)]
    packed, places = pack_maps(maps)
    if maps:
        uvs = [place.move(part.corner_uv) for place, part in zip(places, parts, strict=True)]
    starts = np.cumsum([0] + [len(part.vertices) for part in parts[:-1]])
    vertices, faces, shading, uv = split_corners(
        unit_sphere(np.concatenate([part.vertices for part in parts])),
        np.concatenate([part.faces + start for part, start in zip(parts, starts, strict=True)]),
        np.concatenate(normals),
        None if uvs is None else np.concatenate(uvs),
    )
    turn = implicit.random_rotation(rng)
    shading = shading @ turn.T
    provenance = {"source": "procedural", "family": family, "parts": str(len(parts)), "texture": pattern}
    if maps:
        provenance["materials"] = "+".join(material.kind for material in materials)
    return MeshObject(
        name=name,
        family=family,
        vertices=(vertices @ turn.T).astype(np.float32),
        faces=faces,
        normals=(shading / np.linalg.norm(shading, axis=1, keepdims=True)).astype(np.float32),
        uv=uv,
        albedo=albedo.astype(np.float32),
        **packed,
        provenance=provenance,
    )


def pack_maps(maps: list[BakedMaps]) -> tuple[dict[str, np.ndarray], list[AtlasPlace]]:
    """The maps of all parts side by side, as fields of `MeshObject`, and where each part's lie."""
    if not maps:
        return {}, []
    roughness, places = pack_textures([part.roughness[..., None] for part in maps])
    metallic, _ = pack_textures([part.metallic[..., None] for part in maps])
    normal_map, _ = pack_textures([part.normal_map for part in maps])
    return {"roughness": roughness[..., 0], "metallic": metallic[..., 0], "normal_map": normal_map}, places


def _part_texture(rng: np.random.Generator, part: Part, textured: bool) -> tuple[str, Float[np.ndarray, "h w 3"]]:
    """Bakes a texture on a part's position map, scaled to its extent."""
    if not textured or rng.random() < 0.15:
        return "constant", np.broadcast_to(textures.random_color(rng), part.position_map.shape).astype(np.float32)
    kind, texture = textures.random_texture(rng)
    low, high = part.position_map.min((0, 1)), part.position_map.max((0, 1))
    return kind, texture((part.position_map - (low + high) / 2) / (np.linalg.norm(high - low) / 2))
