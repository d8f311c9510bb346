"""Our own principled BSDF: closed forms first, then Mitsuba's sampler by chi-square."""

import math

import numpy as np
import pytest
import torch

from unirender_reference import principled
from unirender_reference.backend import mitsuba
from unirender_reference.scene import parameter_name

DOUBLE = torch.float64


def material(*values: float | tuple[float, float, float]) -> tuple[torch.Tensor, ...]:
    return tuple(torch.tensor(value, dtype=DOUBLE) for value in values)


def directions(count: int, seed: int) -> torch.Tensor:
    """Uniform on the upper hemisphere, not too grazing."""
    rng = np.random.default_rng(seed)
    cosine, phi = rng.uniform(0.02, 1, count), rng.uniform(0, 2 * np.pi, count)
    sine = np.sqrt(1 - cosine**2)
    return torch.from_numpy(np.stack([sine * np.cos(phi), sine * np.sin(phi), cosine], -1))


def towards(cosine: float) -> torch.Tensor:
    return torch.tensor([[math.sqrt(1 - cosine**2), 0.0, cosine]], dtype=DOUBLE)


def test_fresnel_is_known_at_normal_and_brewster_angles() -> None:
    """((1.5 - 1) / (1.5 + 1))^2 head on; at Brewster's angle only s-polarised light, half of 0.1479; 1 when grazing."""
    brewster, s_polarised = math.cos(math.atan(1.5)), ((1 - 1.5**2) / (1 + 1.5**2)) ** 2
    found = principled.fresnel_dielectric(torch.tensor([1.0, brewster, 1e-9], dtype=DOUBLE), 1.5)
    expected = [0.04, s_polarised / 2, 1.0]
    np.testing.assert_allclose(found, expected, atol=1e-7)


@pytest.mark.parametrize("alpha", [0.05, 0.3, 1.0])
def test_ggx_is_normalised_and_smith_is_its_projection(alpha: float) -> None:
    """Integral of D cos = 1, and of D G1 max(0, v.h) / cos_v = 1: what is seen of the microfacets is all of them."""
    theta = (torch.arange(2000, dtype=DOUBLE) + 0.5) * (math.pi / 4000)
    weight = torch.sin(theta) * (math.pi / 4000)
    density = principled.ggx(torch.cos(theta), torch.tensor(alpha, dtype=DOUBLE))
    assert abs(float((density * torch.cos(theta) * weight).sum()) * 2 * math.pi - 1) < 1e-4
    phi = (torch.arange(64, dtype=DOUBLE) + 0.5) * (2 * math.pi / 64)
    v = towards(0.4)[0]
    v_h = v[0] * torch.sin(theta)[:, None] * torch.cos(phi) + v[2] * torch.cos(theta)[:, None]
    seen = (v_h.clamp_min(0).mean(dim=1) * 2 * math.pi * density * weight).sum()
    g1 = float(principled.smith_g1(v[2:], torch.tensor([alpha], dtype=DOUBLE)))
    assert abs(g1 * float(seen) / float(v[2]) - 1) < 1e-4
    wrong = float(principled.smith_g1(v[2:], torch.tensor([1.12 * alpha], dtype=DOUBLE)))
    assert alpha < 0.1 or abs(wrong * float(seen) / float(v[2]) - 1) > 1e-3


def test_bsdf_is_reciprocal() -> None:
    """f(wi, wo) = f(wo, wi), and not with the cosine left in."""
    wi, wo, values = directions(500, 0), directions(500, 1), material((0.7, 0.4, 0.2), 0.4, 0.6)
    forth, back = principled.evaluate(wi, wo, *values), principled.evaluate(wo, wi, *values)
    torch.testing.assert_close(forth / wo[:, 2:], back / wi[:, 2:], rtol=1e-12, atol=0)
    assert (forth - back).abs().max() > 0.01


def test_both_sides_reflect_alike_and_nothing_passes_through() -> None:
    wi, wo, values = directions(200, 2), directions(200, 3), material((0.7, 0.4, 0.2), 0.4, 0.6)
    below = torch.tensor([1.0, 1.0, -1.0], dtype=DOUBLE)
    above = principled.evaluate(wi, wo, *values)
    torch.testing.assert_close(principled.evaluate(wi * below, wo * below, *values), above)
    assert not principled.evaluate(wi, wo * below, *values).any()
    assert (above > 0).all()


@pytest.mark.parametrize("metallic", [0.0, 1.0])
@pytest.mark.parametrize("roughness", [0.3, 0.9])
def test_quadrature_is_the_integral_of_the_bsdf(roughness: float, metallic: float) -> None:
    """Nodes that follow the lobes against a plain grid over the hemisphere; another roughness differs."""
    values, wi = material((0.8, 0.5, 0.3), roughness, metallic), towards(0.6)
    _, weights = principled.light_quadrature(wi, *values, nodes=64)
    steps = 400
    theta = (torch.arange(steps, dtype=DOUBLE) + 0.5) * (math.pi / 2 / steps)
    phi = (torch.arange(steps, dtype=DOUBLE) + 0.5) * (2 * math.pi / steps)
    t, p = torch.meshgrid(theta, phi, indexing="ij")
    wo = torch.stack([torch.sin(t) * torch.cos(p), torch.sin(t) * torch.sin(p), torch.cos(t)], -1).reshape(-1, 3)
    solid_angle = (torch.sin(t) * (math.pi / 2 / steps) * (2 * math.pi / steps)).reshape(-1, 1)
    plain = (principled.evaluate(wi.expand_as(wo), wo, *values) * solid_angle).sum(dim=0)
    torch.testing.assert_close(weights.sum(dim=1)[0], plain, rtol=1e-3, atol=0)
    _, rougher = principled.light_quadrature(wi, values[0], 1.25 * values[1], values[2], nodes=64)
    assert (rougher.sum(dim=1)[0] / plain - 1).abs().max() > 1.5e-3


def test_a_metal_never_makes_light_and_a_smooth_one_loses_none() -> None:
    cosine = torch.linspace(0.05, 1, 20, dtype=DOUBLE)
    wi = torch.stack([torch.sqrt(1 - cosine**2), torch.zeros_like(cosine), cosine], -1)

    def albedo(roughness: float) -> torch.Tensor:
        base, rough, metal = material((1.0, 1.0, 1.0), roughness, 1.0)
        return principled.light_quadrature(wi, base, rough, metal)[1].sum(dim=1)

    assert (albedo(0.0) - 1).abs().max() < 1e-3
    assert (albedo(0.6) < 0.9).all()
    assert (albedo(1.0) < albedo(0.6)).all()


def test_gradients_are_those_of_finite_differences() -> None:
    wi, wo = directions(20, 4), directions(20, 5)
    inputs = [torch.rand(20, *shape, dtype=DOUBLE, requires_grad=True) for shape in ((3,), (), ())]
    assert torch.autograd.gradcheck(lambda b, r, m: principled.evaluate(wi, wo, b, 0.1 + 0.8 * r, m), inputs)


@pytest.mark.parametrize("density_roughness", [0.5, 0.56])
def test_mitsubas_sampler_follows_its_density(density_roughness: float) -> None:
    """Mitsuba's chi-square test of its own sampler; the density of a material 12 % rougher is refused."""
    mi = mitsuba()
    from mitsuba import chi2

    def text(roughness: float) -> str:
        return f'<float name="roughness" value="{roughness}"/><float name="metallic" value="0.8"/>'

    wi = mi.Vector3f(0.6, 0.0, 0.8)
    sample, _ = chi2.BSDFAdapter("principled", text(0.5), wi=wi)
    _, density = chi2.BSDFAdapter("principled", text(density_roughness), wi=wi)
    test = chi2.ChiSquareTest(chi2.SphericalDomain(), sample, density, sample_dim=3, sample_count=400_000, res=51)
    assert test.run(significance_level=1e-4, quiet=True) == (density_roughness == 0.5)


@pytest.mark.parametrize("roughness", [0.05, 0.1])
def test_mitsubas_derivative_by_a_small_roughness_is_exact_and_a_difference_is_not(roughness: float) -> None:
    """For the same directions, in double precision: what differs in finite differences is their step."""
    mi = mitsuba()
    import drjit as dr

    count, values = 1 << 14, {"base_color": {"type": "rgb", "value": [0.6, 0.4, 0.2]}, "metallic": 0.3}
    bsdf = mi.load_dict({"type": "principled", "roughness": roughness, **values})
    point = dr.zeros(mi.SurfaceInteraction3f, count)
    point.wi, random = mi.Vector3f(0.6, 0, 0.8), mi.PCG32(size=count)
    drawn, _ = bsdf.sample(mi.BSDFContext(), point, random.next_float32(), mi.Point2f(random.next_float32()))
    parameters = mi.traverse(bsdf)
    parameter = mi.Float(roughness)
    dr.enable_grad(parameter)
    parameters[parameter_name(parameters, "roughness.value")] = parameter
    parameters.update()
    shown = bsdf.eval(mi.BSDFContext(), point, drawn.wo)[0]
    dr.forward(parameter)
    wo = torch.from_numpy(np.array(drawn.wo).T).double()
    wi = torch.tensor([[0.6, 0, 0.8]], dtype=DOUBLE).expand_as(wo)
    density = torch.from_numpy(np.array(drawn.pdf)).double()
    weight = torch.where(density > 0, (1 + torch.sin(7 * wo[:, 0])) / density.clamp_min(1e-30), 0)  # light / density

    def reflected(rough: torch.Tensor) -> torch.Tensor:
        base, metal = material((0.6, 0.4, 0.2), 0.3)
        return (principled.evaluate(wi, wo, base, rough, metal)[:, 0] * weight).sum()

    rough = torch.tensor(roughness, dtype=DOUBLE)
    exact = float(torch.func.grad(reflected)(rough))
    found = float((torch.from_numpy(np.array(dr.grad(shown))).double() * weight).sum())
    assert abs(found / exact - 1) < 1e-4
    step = roughness / 5
    central = float(reflected(rough + step) - reflected(rough - step)) / (2 * step)
    assert abs(central / exact - 1) > 0.01
