"""The closed-form image of an `Intrinsics`: what the paper's s and d give without tracing a ray.

    L(x, v) = integral of f(x, v, l) E(x, l) max(n . l, 0) dl                          (Eq. 1)
    I = (1 - metallic) * albedo * d + F(albedo, metallic) * s,    F = 0.04 * (1 - metallic) + albedo * metallic

I stands for L, the paper's rendering equation: d and s are its integral over the light for two surfaces that know
neither albedo nor metallic, which weigh them here. It leaves out interreflection, the angle in the Fresnel term and the
retro-reflection of the principled diffuse lobe: about 4 % of a pixel's radiance. The functions are plain arithmetic and
take numpy arrays and torch tensors alike, as long as single-channel maps broadcast against three-channel ones.

The *split-sum* composite (numpy only) puts the angle back. Schlick's reflectance is F0 + (1 - F0)(1 - v.h)^5; its mean
over the lobe, by the environment-BRDF terms A and B of Karis ("Real Shading in Unreal Engine 4", 2013), is

    F = (F0 A + B) / (A + B),    A = integral (1 - (1 - v.h)^5) f n.l dl,    B = integral (1 - v.h)^5 f n.l dl

with f = D G / (4 n.v n.l) the GGX lobe of a reflector of F = 1, whose radiance under the light is s. A + B is its
albedo in the direction v; the sum is split because the light and F are averaged over the lobe one by one.
"""

import functools
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from unirender.arguments import as_instance
from unirender.blocks import by_rows
from unirender.errors import UnirenderError
from unirender.intrinsics import Intrinsics, unit_normals
from unirender.light.surface_light import MIN_ALPHA
from unirender.vectors import dots

DIELECTRIC_F0 = 0.04  # reflectance at normal incidence of the principled BSDF's default ior, 1.5
COSINES, ROUGHNESSES = 64, 32  # nodes of the tables of A and B, evenly spaced over [0, 1]
LOBE_SAMPLES = (64, 32)  # of a lobe, over its two coordinates
LOBES = 4  # at a time: their samples stay in the processor's cache
GRAZING = 1e-3  # the least n.v: at 0 a visible lobe does not exist
BLOCK = 2**16  # pixels whose split sum is made at a time: some 200 bytes each
TABLES = Path(__file__).with_name("environment_brdf.npy")  # what `integrate_environment_brdf` gives, [2 n r], float64


def fresnel(albedo: Any, metallic: Any) -> Any:
    """Reflectance at normal incidence, F."""
    return DIELECTRIC_F0 * (1 - metallic) + albedo * metallic


def composite(albedo: Any, metallic: Any, diffuse: Any, specular: Any) -> Any:
    """Radiance from maps in linear units; not multiplied by the mask."""
    return lobes(albedo, metallic, diffuse, specular, fresnel(albedo, metallic))


def lobes(albedo: Any, metallic: Any, diffuse: Any, specular: Any, reflectance: Any) -> Any:
    """The diffuse and the specular lobe at a given reflectance of the latter; not multiplied by the mask."""
    return (1 - metallic) * albedo * diffuse + reflectance * specular


def composite_image(intrinsics: Intrinsics) -> Float[np.ndarray, "h w 3"]:
    """The composite of an `Intrinsics`, linear and premultiplied by its mask.

    Raises:
        UnirenderError: one of albedo, metallic, diffuse, specular or mask is unknown.
    """
    maps = _maps(intrinsics, "albedo", "metallic", "diffuse", "specular", "mask")
    return by_rows(_composite, *maps.values())


def _composite(*maps: Float[np.ndarray, "h w _"]) -> Float[np.ndarray, "h w 3"]:
    """The premultiplied composite of some rows; the last of the maps is the mask."""
    return (composite(*maps[:-1]) * maps[-1]).astype(np.float32)


def split_sum_image(intrinsics: Intrinsics) -> Float[np.ndarray, "h w 3"]:
    """The split-sum composite of an `Intrinsics`, linear and premultiplied by its mask; n.v along the true view rays.

    Raises:
        UnirenderError: one of albedo, normal, roughness, metallic, diffuse, specular or mask is unknown.
    """
    maps = _maps(intrinsics, "albedo", "normal", "roughness", "metallic", "diffuse", "specular", "mask")
    view = intrinsics.camera.view_directions(intrinsics.height, intrinsics.width)
    covered = np.flatnonzero(maps["mask"])
    image = np.zeros((maps["mask"].size, 3), np.float32)
    for start in range(0, len(covered), BLOCK):
        which = covered[start : start + BLOCK]
        seen = {name: _pixels(value, which) for name, value in maps.items()}
        image[which] = _split_sum(**seen, view=_pixels(view, which))
    return image.reshape(view.shape)


def _split_sum(
    albedo: Float[np.ndarray, "n 3"],
    normal: Float[np.ndarray, "n 3"],
    roughness: Float[np.ndarray, "n 1"],
    metallic: Float[np.ndarray, "n 1"],
    diffuse: Float[np.ndarray, "n 3"],
    specular: Float[np.ndarray, "n 3"],
    mask: Float[np.ndarray, "n 1"],
    view: Float[np.ndarray, "n 3"],
) -> Float[np.ndarray, "n 3"]:
    """The split-sum composite of some pixels; `view`: directions towards the viewer."""
    reflectance = mean_fresnel(fresnel(albedo, metallic), dots(unit_normals(normal), view), roughness)
    return lobes(albedo, metallic, diffuse, specular, reflectance) * mask


def _pixels(picture: Float[np.ndarray, "h w c"], which: Int[np.ndarray, " n"]) -> Float[np.ndarray, "n c"]:
    """Those pixels, by their place in the flat picture."""
    flat = picture.reshape(-1, picture.shape[-1])
    return flat if len(which) == len(flat) else flat.take(which, axis=0)


def mean_fresnel(
    f0: Float[np.ndarray, "*size c"], n_v: Float[np.ndarray, "*size 1"], roughness: Float[np.ndarray, "*size 1"]
) -> Float[np.ndarray, "*size c"]:
    """Schlick's reflectance averaged over the lobe, (F0 A + B) / (A + B), in [F0, 1]."""
    a, b = environment_brdf(n_v, roughness)
    return (f0 * a + b) / (a + b)


def environment_brdf(
    n_v: Float[np.ndarray, "*size"], roughness: Float[np.ndarray, "*size"]
) -> tuple[Float[np.ndarray, "*size"], Float[np.ndarray, "*size"]]:
    """Karis's scale A and bias B of F0, interpolated (bilinearly) in a table.

    Args:
        n_v: cosine between normal and view direction; clipped to [0, 1].
        roughness: perceptual, clipped to [0, 1]; alpha = roughness^2.
    """
    x = np.clip(n_v, 0, 1) * (COSINES - 1)
    y = np.clip(roughness, 0, 1) * (ROUGHNESSES - 1)
    i, j = (np.minimum(p.astype(np.int64), n - 2) for p, n in ((x, COSINES), (y, ROUGHNESSES)))
    fx, fy = x - i, y - j
    first = i * ROUGHNESSES + j  # in the flat table; the other corners follow it by a row, by one, and by both
    weights = ((1 - fx) * (1 - fy), fx * (1 - fy), (1 - fx) * fy, fx * fy)
    corners = list(zip(weights, (first, first + ROUGHNESSES, first + 1, first + ROUGHNESSES + 1), strict=True))
    a, b = (sum(weight * table.take(at) for weight, at in corners) for table in environment_brdf_tables())
    return np.asarray(a, np.float32), np.asarray(b, np.float32)


@functools.cache
def environment_brdf_tables() -> tuple[Float[np.ndarray, "n r"], Float[np.ndarray, "n r"]]:
    """A and B at evenly spaced n.v (rows) and roughnesses (columns), both from 0 to 1, from the file that ships."""
    a, b = np.load(TABLES)
    return a, b


def integrate_environment_brdf() -> Float[np.ndarray, "2 n r"]:
    """What `TABLES` holds. It ships since to integrate takes a quarter of a second, in every process that renders."""
    n_v = np.maximum(np.linspace(0, 1, COSINES), GRAZING)
    alpha = np.maximum(np.square(np.linspace(0, 1, ROUGHNESSES)), MIN_ALPHA)
    blocks = [[_integrate_lobes(rows, float(r)) for r in alpha] for rows in np.split(n_v, COSINES // LOBES)]
    return np.array(blocks).transpose(2, 0, 3, 1).reshape(2, COSINES, ROUGHNESSES)


def _integrate_lobes(
    n_v: Float[np.ndarray, " n"], alpha: float
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """A and B of lobes: the midpoint rule over visible normals (Dupuy & Benyoub 2023), n = +z, v in the xz plane.

    A visible normal h is drawn with the density D G1(v) max(v.h, 0) / n.v, so that f n.l over the density of l is
    G1(l), Smith's shadowing of the light.
    """
    u = (np.arange(LOBE_SAMPLES[0]) + 0.5) / LOBE_SAMPLES[0]
    cos_phi = np.cos(np.pi * (np.arange(LOBE_SAMPLES[1]) + 0.5) / LOBE_SAMPLES[1])[:, None]  # the rest: mirror images
    v_z = n_v[:, None, None]
    v_x = np.sqrt(1 - v_z**2)
    length = np.sqrt((alpha * v_x) ** 2 + v_z**2)
    x, z = alpha * v_x / length, v_z / length  # v stretched to the configuration of alpha 1
    h_z = (1 - u) * (1 + z)  # a point of the cap of the sphere that v sees, moved by v; stretched back below
    radius = np.sqrt(np.maximum(1 - (h_z - z) ** 2, 0))
    h_x = radius * cos_phi + x
    length = np.sqrt(alpha**2 * (h_x**2 + radius**2 * (1 - cos_phi**2)) + h_z**2)
    v_h = (alpha * h_x * v_x + h_z * v_z) / length
    n_l = 2 * v_h * h_z / length - v_z
    squared = np.square(np.maximum(n_l, 1e-6))
    g1 = np.where(n_l > 0, 2 / (1 + np.sqrt(1 + alpha**2 * (1 - squared) / squared)), 0)
    away = np.clip(1 - v_h, 0, 1)
    schlick = np.square(np.square(away)) * away  # the 5th power; `**` is slower
    return np.mean((1 - schlick) * g1, axis=(1, 2)), np.mean(schlick * g1, axis=(1, 2))


def _maps(intrinsics: Intrinsics, *names: str) -> dict[str, np.ndarray]:
    as_instance(intrinsics, Intrinsics, "composite")
    maps = {name: getattr(intrinsics, name) for name in names}
    missing = [name for name, value in maps.items() if value is None]
    if missing:
        raise UnirenderError(
            f"composite: maps {', '.join(missing)} are missing, expected {', '.join(names[:-1])} and {names[-1]}; "
            "derive specular and diffuse from an environment with unirender.light.surface_light"
        )
    return maps
