"""The split-sum reflectance against Mitsuba's principled BSDF: the mean Fresnel factor of its specular lobe."""

import numpy as np
import pytest

from unirender.composite import DIELECTRIC_F0, fresnel
from unirender.environment_brdf import environment_brdf, mean_fresnel
from unirender_reference.backend import mitsuba

SAMPLES = 1 << 16


def lobe_albedo(f0: float, metallic: float, roughness: float, n_v: float) -> float:
    """Light that a principled surface of base colour `f0` reflects into one direction from all others, by Mitsuba's own
    importance sampling; a black dielectric (metallic 0, base colour 0) has its specular lobe alone."""
    mi = mitsuba()
    import drjit as dr

    base = {"type": "rgb", "value": f0}
    bsdf = mi.load_dict({"type": "principled", "base_color": base, "metallic": metallic, "roughness": roughness})
    interaction = dr.zeros(mi.SurfaceInteraction3f, SAMPLES)
    interaction.wi = mi.Vector3f(float(np.sqrt(1 - n_v**2)), 0, n_v)
    interaction.sh_frame.n = mi.Normal3f(0, 0, 1)
    interaction.n = mi.Normal3f(0, 0, 1)
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(3, SAMPLES)
    _, weight = bsdf.sample(mi.BSDFContext(), interaction, sampler.next_1d(), sampler.next_2d())
    return float(np.mean(np.array(weight)[0]))


@pytest.mark.parametrize("roughness", [0.2, 0.5, 0.9])
@pytest.mark.parametrize("n_v", [0.15, 0.5, 0.9])
def test_a_metal_reflects_what_the_split_sum_says(roughness: float, n_v: float) -> None:
    """Within 1.5 %; the factor without its angle (F0) is too dark by more at a grazing angle."""
    cosine, rough = np.array([n_v], np.float32), np.array([roughness], np.float32)
    mirror = lobe_albedo(1.0, 1.0, roughness, n_v)
    found = lobe_albedo(0.3, 1.0, roughness, n_v) / mirror
    a, b = environment_brdf(cosine, rough)
    np.testing.assert_allclose(mirror, a[0] + b[0], rtol=0.015)
    np.testing.assert_allclose(found, mean_fresnel(np.array([0.3], np.float32), cosine, rough)[0], rtol=0.015)
    if n_v < 0.2:
        assert found > 1.04 * 0.3


@pytest.mark.parametrize(("roughness", "n_v"), [(0.2, 0.3), (0.5, 0.5), (0.9, 0.9)])
def test_a_dielectric_reflects_about_what_the_split_sum_says(roughness: float, n_v: float) -> None:
    """Mitsuba's dielectric has the exact Fresnel term, Schlick's is up to 0.015 below it; F0 alone is further off."""
    cosine, rough = np.array([n_v], np.float32), np.array([roughness], np.float32)
    found = lobe_albedo(0.0, 0.0, roughness, n_v) / lobe_albedo(1.0, 1.0, roughness, n_v)
    expected = mean_fresnel(np.array([fresnel(0.0, 0.0)], np.float32), cosine, rough)[0]
    assert -0.003 < found - expected < 0.015
    if n_v <= 0.5:
        assert found > DIELECTRIC_F0 + 0.03
