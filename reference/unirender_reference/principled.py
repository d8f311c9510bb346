"""Our own principled BSDF, in torch and in double precision: a second opinion on Mitsuba's.

Written from the papers, not from Mitsuba's code: Burley, "Physically-Based Shading at Disney" (2012) and "Extending
the Disney BRDF" (2015); Walter et al., "Microfacet Models for Refraction through Rough Surfaces" (2007, GGX, Smith G1).
It is the subset that the data contract uses: base colour, roughness, metallic, `specular` 0.5.

Notation: wi towards the viewer, wo towards the light, both in the shading frame (z = normal), h = (wi + wo)/|wi + wo|,
alpha = max(roughness^2, 1e-3), eta = 2 / (1 - sqrt(0.08 specular)) - 1 = 1.5, x5 = (1 - cos)^5 Schlick's weight.

    f cos_o = F D(h) G1(wi) G1(wo) / (4 cos_i)                                                      specular lobe
            + (1 - metallic) (base/pi) cos_o (f_lambert + f_retro)                                  diffuse lobe
    F       = (1 - metallic) F_dielectric(wi.h, eta) + metallic (base + (1 - base) x5(wi.h))
    f_lambert = (1 - x5(cos_i)/2) (1 - x5(cos_o)/2)
    f_retro   = R (x5(cos_i) + x5(cos_o) + x5(cos_i) x5(cos_o) (R - 1)),   R = 2 roughness (wo.h)^2

The surface has two sides: directions below it are mirrored to above when both lie there, and it transmits nothing.
"""

import contextlib
import math
from collections.abc import Callable, Iterator

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

MIN_ALPHA = 1e-3
ETA = 1.5
GOLDEN = 0.6180339887498949

Color = tuple[float, float, float]


def evaluate(
    wi: Float[Tensor, "*n 3"],
    wo: Float[Tensor, "*n 3"],
    base_color: Float[Tensor, "*#n 3"],
    roughness: Float[Tensor, "*#n"],
    metallic: Float[Tensor, "*#n"],
) -> Float[Tensor, "*n 3"]:
    """f(wi, wo) |cos_o|, as Mitsuba's `bsdf.eval`; differentiable in all but the side of the surface.

    Args:
        wi, wo: unit directions towards the viewer and the light in the shading frame.
        base_color: linear, [0, 1].
        roughness, metallic: [0, 1], perceptual roughness.
    """
    return specular_lobe(wi, wo, base_color, roughness, metallic) + diffuse_lobe(
        wi, wo, base_color, roughness, metallic
    )


def specular_lobe(
    wi: Float[Tensor, "*n 3"],
    wo: Float[Tensor, "*n 3"],
    base_color: Float[Tensor, "*#n 3"],
    roughness: Float[Tensor, "*#n"],
    metallic: Float[Tensor, "*#n"],
) -> Float[Tensor, "*n 3"]:
    """The GGX lobe times |cos_o|; arguments as `evaluate`."""
    cos_i, cos_o, h, above = _frame(wi, wo)
    alpha = roughness.square().clamp_min(MIN_ALPHA)
    tint = fresnel((_upper(wi) * h).sum(-1), base_color, metallic)
    shape = ggx(h[..., 2], alpha) * smith_g1(cos_i, alpha) * smith_g1(cos_o, alpha) / (4 * cos_i)
    return torch.where(above[..., None], tint * shape[..., None], 0.0)


def diffuse_lobe(
    wi: Float[Tensor, "*n 3"],
    wo: Float[Tensor, "*n 3"],
    base_color: Float[Tensor, "*#n 3"],
    roughness: Float[Tensor, "*#n"],
    metallic: Float[Tensor, "*#n"],
) -> Float[Tensor, "*n 3"]:
    """Disney's diffuse lobe with its retro-reflection, times |cos_o|; arguments as `evaluate`."""
    cos_i, cos_o, h, above = _frame(wi, wo)
    w_i, w_o = _schlick(cos_i), _schlick(cos_o)
    retro = 2 * roughness * (_upper(wo) * h).sum(-1).square()
    lobe = (1 - w_i / 2) * (1 - w_o / 2) + retro * (w_i + w_o + w_i * w_o * (retro - 1))
    shape = (1 - metallic) * cos_o / math.pi * lobe
    return torch.where(above[..., None], base_color * shape[..., None], 0.0)


def fresnel_dielectric(cosine: Float[Tensor, "*n"], eta: float) -> Float[Tensor, "*n"]:
    """Unpolarised reflectance of a smooth dielectric seen from outside (Fresnel); eta: inside over outside index."""
    c = cosine.abs()
    t = torch.sqrt(1 - (1 - c.square()) / eta**2)
    s_polarised = (c - eta * t) / (c + eta * t)
    p_polarised = (t - eta * c) / (t + eta * c)
    return (s_polarised.square() + p_polarised.square()) / 2


def ggx(cos_h: Float[Tensor, "*n"], alpha: Float[Tensor, "*#n"]) -> Float[Tensor, "*n"]:
    """Density of microfacet normals, per solid angle (Trowbridge-Reitz)."""
    a2 = alpha.square()
    return a2 / (math.pi * (cos_h.square() * (a2 - 1) + 1).square())


def smith_g1(cosine: Float[Tensor, "*n"], alpha: Float[Tensor, "*#n"]) -> Float[Tensor, "*n"]:
    """Share of microfacets seen from a direction at this cosine (Smith, GGX)."""
    squared = cosine.square()
    return 2 / (1 + torch.sqrt(1 + alpha.square() * (1 - squared) / squared))


def light_quadrature(
    wi: Float[Tensor, "p 3"],
    base_color: Float[Tensor, "*#p 3"],
    roughness: Float[Tensor, "*#p"],
    metallic: Float[Tensor, "*#p"],
    nodes: int = 32,
) -> tuple[Float[Tensor, "p s 3"], Float[Tensor, "p s 3"]]:
    """Directions wo and weights such that the reflected radiance is sum_s weight_s L(wo_s), for any light L.

    Each lobe has nodes^2 directions that follow its shape, so that the weights are smooth for every alpha: the diffuse
    lobe's are distributed as cos_o / pi, the specular lobe's are wi reflected at visible microfacet normals (the weight
    is then F G1(wo)). The weights of one point sum to its directional albedo.

    Args:
        wi: unit, z > 0, shading frame.
        base_color, roughness, metallic: as `evaluate`.
        nodes: along each of two axes (radius and angle of a disc).
    """
    u, v, weight = _unit_square(nodes)
    rows = wi.shape[:-1]
    base = base_color.expand(*rows, 3)[:, None]
    roughness, metallic = roughness.expand(rows)[:, None], metallic.expand(rows)[:, None]
    angle = 2 * math.pi * v
    diffuse_wo = torch.stack([u.sqrt() * torch.cos(angle), u.sqrt() * torch.sin(angle), (1 - u).sqrt()], -1)
    diffuse_wo = diffuse_wo.expand(*rows, -1, 3)
    many_wi = wi[:, None].expand_as(diffuse_wo)
    diffuse = diffuse_lobe(many_wi, diffuse_wo, base, roughness, metallic) * (math.pi / diffuse_wo[..., 2:])
    alpha = roughness.square().clamp_min(MIN_ALPHA)
    h = visible_normals(wi, alpha[:, 0], u, v)
    i_h = (many_wi * h).sum(-1, keepdim=True)
    specular_wo = 2 * i_h * h - many_wi
    cos_o = specular_wo[..., 2]
    leaving = torch.where(cos_o > 0, smith_g1(cos_o.clamp_min(1e-12), alpha), 0.0)
    specular = fresnel(i_h[..., 0], base, metallic) * leaving[..., None]
    weights = torch.cat([diffuse, specular], -2) * torch.cat([weight, weight])[:, None]
    return torch.cat([diffuse_wo, specular_wo], -2), weights


def fresnel(
    cosine: Float[Tensor, "*n"], base_color: Float[Tensor, "*#n 3"], metallic: Float[Tensor, "*#n"]
) -> Float[Tensor, "*n 3"]:
    """F of the specular lobe: the dielectric's share, and Schlick's tinted share of the metal."""
    dielectric = ((1 - metallic) * fresnel_dielectric(cosine, ETA))[..., None]
    return dielectric + metallic[..., None] * (base_color + (1 - base_color) * _schlick(cosine)[..., None])


def visible_normals(
    wi: Float[Tensor, "p 3"], alpha: Float[Tensor, " p"], u: Float[Tensor, " s"], v: Float[Tensor, " s"]
) -> Float[Tensor, "p s 3"]:
    """Microfacet normals distributed as they are seen from wi (Heitz 2018), from points of the unit square."""
    a = alpha[:, None]
    stretched = torch.stack([alpha * wi[:, 0], alpha * wi[:, 1], wi[:, 2]], -1)
    z = stretched / stretched.norm(dim=-1, keepdim=True)
    across = torch.stack([-z[:, 1], z[:, 0], torch.zeros_like(z[:, 0])], -1)
    length = across.norm(dim=-1, keepdim=True)
    x = torch.where(length > 1e-9, across / length.clamp_min(1e-9), torch.tensor([1.0, 0.0, 0.0], dtype=z.dtype))
    y = torch.linalg.cross(z, x)
    radius, angle = u.sqrt(), 2 * math.pi * v
    t1 = (radius * torch.cos(angle)).expand(len(z), -1)
    blend = ((1 + z[:, 2]) / 2)[:, None]
    t2 = (1 - blend) * torch.sqrt(1 - t1.square()) + blend * (radius * torch.sin(angle))
    t3 = torch.sqrt((1 - t1.square() - t2.square()).clamp_min(0))
    h = t1[..., None] * x[:, None] + t2[..., None] * y[:, None] + t3[..., None] * z[:, None]
    h = torch.stack([a * h[..., 0], a * h[..., 1], h[..., 2].clamp_min(1e-12)], -1)
    return h / h.norm(dim=-1, keepdim=True)


def _unit_square(nodes: int) -> tuple[Tensor, Tensor, Tensor]:
    """Points and weights: Gauss-Legendre in t, u = sin(t)^2, t in [0, pi/2]; equidistant in the periodic v.

    In t directions on the disc of radius sqrt(u) and on the hemisphere above it are smooth up to the border.
    """
    x, w = np.polynomial.legendre.leggauss(nodes)
    t = torch.from_numpy((x + 1) * (math.pi / 4)).repeat_interleave(nodes)
    weight = torch.from_numpy(w * (math.pi / 4)).repeat_interleave(nodes) * torch.sin(2 * t) / nodes
    turn = (torch.arange(nodes, dtype=torch.float64) * GOLDEN) % 1  # rings out of step: kinks average out
    v = ((torch.arange(nodes, dtype=torch.float64) + turn[:, None]) / nodes).ravel()
    return torch.sin(t).square(), v, weight


def evaluate_arrays(
    wi: Float[np.ndarray, "n 3"], wo: Float[np.ndarray, "n 3"], base_color: Color, roughness: float, metallic: float
) -> tuple[Float[np.ndarray, "n 3"], dict[str, Float[np.ndarray, "n 3"]]]:
    """`evaluate` for float32 directions and one material, and its derivatives.

    Directions are made unit in double precision; the material is what float32 holds of it.

    Returns:
        f |cos_o|, and by "base_color" (each channel by its own), "roughness" and "metallic" its derivatives.
    """
    i, o = (torch.from_numpy(w.astype(np.float64)) for w in (wi, wo))
    i, o = i / i.norm(dim=-1, keepdim=True), o / o.norm(dim=-1, keepdim=True)
    base, rough, metal = _material(base_color, roughness, metallic)
    # a leaf for each direction: the gradient of a sum is then each direction's own
    inputs = {"base_color": base.repeat(len(i), 1), "roughness": rough.repeat(len(i)), "metallic": metal.repeat(len(i))}
    for tensor in inputs.values():
        tensor.requires_grad_()
    values = evaluate(i, o, inputs["base_color"], inputs["roughness"], inputs["metallic"])
    slopes = {name: np.empty(values.shape) for name in inputs}
    for c in range(3):
        gradients = torch.autograd.grad(values[:, c].sum(), list(inputs.values()), retain_graph=True)
        for name, gradient in zip(inputs, gradients, strict=True):
            slopes[name][:, c] = gradient[:, c] if gradient.ndim == 2 else gradient
    return values.detach().numpy(), slopes


def lobe_weights(
    base_color: Color, roughness: float, metallic: float, nodes: int
) -> Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]:
    """`light_quadrature` of one material in numpy: cosines [p] of wi = (sin, 0, cos) -> directions, weights [p s 3]."""
    base, rough, metal = _material(base_color, roughness, metallic)

    def weights(cosine: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        wi = np.stack([np.sqrt(np.maximum(1 - cosine**2, 0)), np.zeros_like(cosine), cosine], axis=-1)
        directions, weight = light_quadrature(torch.from_numpy(wi), base, rough, metal, nodes)
        used = weight.abs().amax(dim=(0, 2)) > 0  # a metal has no diffuse lobe
        return directions[:, used].numpy(), weight[:, used].numpy()

    return weights


@contextlib.contextmanager
def one_thread() -> Iterator[None]:
    """Torch on one thread while the block runs: the arrays here are small."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


def _material(base_color: Color, roughness: float, metallic: float) -> tuple[Tensor, Tensor, Tensor]:
    base, rough, metal = (
        torch.tensor(np.float32(x).astype(np.float64)) for x in (np.asarray(base_color), roughness, metallic)
    )
    return base, rough, metal


def _frame(wi: Tensor, wo: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Cosines of both directions, the half vector (all turned to the upper side), and where the surface reflects."""
    above = wi[..., 2] * wo[..., 2] > 0
    upper_i, upper_o = _upper(wi), _upper(wo)
    half = upper_i + upper_o
    return upper_i[..., 2], upper_o[..., 2], half / half.norm(dim=-1, keepdim=True), above


def _upper(w: Tensor) -> Tensor:
    return torch.cat([w[..., :2], w[..., 2:].abs()], -1)


def _schlick(cosine: Tensor) -> Tensor:
    return (1 - cosine).clamp(0, 1) ** 5
