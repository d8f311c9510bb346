"""Mitsuba's principled BSDF, direction by direction, against `unirender_reference.principled`."""

import functools
from collections.abc import Iterator
from typing import Any

import numpy as np
from jaxtyping import Float

from unirender_reference.backend import mitsuba
from unirender_reference.checks.ball import ALBEDO, ball
from unirender_reference.checks.outcome import Check, against_estimate, bounded
from unirender_reference.passes import derive_seed
from unirender_reference.render import Renderer

ROUGHNESS = (0.0, 0.05, 0.1, 0.3, 0.6, 1.0)
METALLIC = (0.0, 0.5, 1.0)
DIRECTIONS = 4000
EPS = 2.0**-23
RTOL = 1e-5
GRADIENT_RTOL = 1e-4
MOST_CONDITION = 3e3  # beyond it float32 knows fewer than four digits of the BSDF
SAMPLES = 1 << 20
BINS = (16, 32)  # polar, azimuth
SUB_BINS = (24, 12)
FEWEST = 1000  # samples in a bin for its mean to be normal


def bsdf_values(seed: int) -> Check:
    """f cos for random pairs of directions and materials, grazing and from behind, too."""
    from unirender_reference import principled

    ratios, median, left_out, count = [], [], 0, 0
    for bsdf, roughness, metallic, (wi, wo) in _materials(seed):
        theirs = _array(bsdf.eval(mitsuba().BSDFContext(), _interaction(wi), _vector(wo)))
        ours, _ = principled.evaluate_arrays(wi, wo, ALBEDO, roughness, metallic)
        condition = _condition(wi, wo, roughness)
        kept = condition < MOST_CONDITION
        error = np.abs(theirs - ours).max(axis=-1)[kept] / np.maximum(ours.max(axis=-1)[kept], 1e-9)
        ratios.append(float((error / (RTOL + 2 * EPS * condition[kept])).max()))
        median.append(float(np.median(error)))
        left_out, count = left_out + int((~kept).sum()), count + len(wi)
    note = f"tolerance {RTOL:g} + 2 eps / (alpha |wi + wo|), median error {np.median(median):.1e}; "
    note += f"{count} pairs, {left_out} left out as ill-conditioned in float32"
    return bounded("bsdf-values", "max error / tolerance", float(np.max(ratios)), 1.0, note)


def bsdf_gradients(seed: int) -> Check:
    """Derivatives of f cos with respect to base colour, roughness and metallic: drjit's against torch's."""
    import drjit as dr

    from unirender_reference import principled

    mi = mitsuba()
    ratios: dict[str, list[float]] = {}
    # inside the cube of materials: on its faces Mitsuba leaves lobes out, and max(roughness^2, 1e-3) has a corner
    for bsdf, roughness, metallic, (wi, wo) in _materials(seed, ROUGHNESS[1:], (0.1, 0.5, 0.9)):
        values, slopes = principled.evaluate_arrays(wi, wo, ALBEDO, roughness, metallic)
        condition = _condition(wi, wo, roughness)
        scale = np.maximum(values.max(axis=-1) / roughness, 1e-9)
        parameters = mi.traverse(bsdf)
        for name, ours in slopes.items():
            key = next(k for k in parameters.keys() if k.split(".")[-2] == name)  # noqa: SIM118 - iterating gives pairs
            parameter = parameters[key]
            dr.enable_grad(parameter)
            dr.set_grad(parameter, 1.0)
            parameters.update()
            value = bsdf.eval(mi.BSDFContext(), _interaction(wi), _vector(wo))
            theirs = _array(dr.forward_to(value))
            dr.disable_grad(parameter)
            parameters.update()
            size = np.maximum(np.abs(ours).max(axis=-1), scale)
            kept = condition < MOST_CONDITION
            error = np.abs(theirs - ours).max(axis=-1) / size
            ratio = error[kept] / (GRADIENT_RTOL + 4 * EPS * condition[kept])
            ratios.setdefault(name, []).append(float(ratio.max()))
    worst = {name: float(np.max(found)) for name, found in ratios.items()}  # NaN, if there is one: it has to fail
    note = f"tolerance {GRADIENT_RTOL:g} + 4 eps / (alpha |wi + wo|) of max(|gradient|, f cos / roughness); "
    note += ", ".join(f"{name} {value:.2g}" for name, value in worst.items())
    return bounded("bsdf-gradients", "max error / tolerance", float(np.max(list(worst.values()))), 1.0, note)


def bsdf_sampler(seed: int) -> Check:
    """Sampled directions, weighted, fill the bins of the hemisphere with the integral of our f cos."""
    mi = mitsuba()
    renderer = Renderer(ball(), resolution=8)
    means, variances, truths, masks = [], [], [], []
    for number, (roughness, metallic, polar) in enumerate(((0.25, 0.9, 0.5), (0.5, 0.3, 1.2), (0.9, 0.0, 0.9))):
        wi = np.array([np.sin(polar), 0.0, np.cos(polar)], np.float32)
        bsdf = _bsdf(renderer, roughness, metallic)
        sampler = mi.load_dict({"type": "independent"})
        sampler.seed(derive_seed(seed, "bsdf-sampler", number), SAMPLES)
        interaction = _interaction(np.broadcast_to(wi, (SAMPLES, 3)))
        drawn, weight = bsdf.sample(mi.BSDFContext(), interaction, sampler.next_1d(), sampler.next_2d())
        wo, weight = _array(drawn.wo), np.asarray(weight).T
        row = np.clip((np.arccos(np.clip(wo[:, 2], -1, 1)) * (2 * BINS[0] / np.pi)).astype(int), 0, BINS[0] - 1)
        column = ((np.arctan2(wo[:, 1], wo[:, 0]) / (2 * np.pi) % 1) * BINS[1]).astype(int) % BINS[1]
        bins = row * BINS[1] + column
        sums, squares = (
            np.stack([np.bincount(bins, weight[:, c] ** k, BINS[0] * BINS[1]) for c in range(3)], -1) for k in (1, 2)
        )
        mean = sums / SAMPLES
        means.append(mean.reshape(*BINS, 3))
        variances.append(((squares / SAMPLES - mean**2) / SAMPLES).reshape(*BINS, 3))
        masks.append((np.bincount(bins, minlength=BINS[0] * BINS[1]) >= FEWEST).reshape(BINS))
        truths.append(_bin_integrals(roughness, metallic, polar))
    mean, variance, truth = (np.stack(arrays) for arrays in (means, variances, truths))
    note = f"{SAMPLES} samples of 3 materials in {BINS[0]} x {BINS[1]} bins"
    exact, batches = np.zeros_like(truth), (SAMPLES, SAMPLES)
    return against_estimate("bsdf-sampler", mean, variance, truth, exact, np.stack(masks), note, batches, 1e-3)


def _materials(
    seed: int, roughnesses: tuple[float, ...] = ROUGHNESS, metallics: tuple[float, ...] = METALLIC
) -> Iterator[tuple[Any, float, float, tuple[np.ndarray, np.ndarray]]]:
    """BSDFs as the reference's scenes hold them, with directions that find their peaks and their edges."""
    rng, renderer = np.random.default_rng(seed), Renderer(ball(), resolution=8)
    for roughness in roughnesses:
        for metallic in metallics:
            yield _bsdf(renderer, roughness, metallic), roughness, metallic, _directions(rng, roughness)


def _bsdf(renderer: Renderer, roughness: float, metallic: float) -> Any:
    return renderer.scene.show("principled", {"roughness": roughness, "metallic": metallic}).shapes()[0].bsdf()


def _directions(rng: np.random.Generator, roughness: float) -> tuple[np.ndarray, np.ndarray]:
    """Pairs (wi, wo): half of them near the mirror direction, some grazing, a tenth behind, a few on two sides."""
    n = DIRECTIONS
    cosine = np.where(rng.random((2, n)) < 0.8, rng.random((2, n)), 10 ** (-4 * rng.random((2, n))))
    phi = 2 * np.pi * rng.random((2, n))
    sine = np.sqrt(1 - cosine**2)
    wi, wo = np.stack([sine * np.cos(phi), sine * np.sin(phi), cosine], axis=-1)
    near = rng.random(n) < 0.5
    lobe = wi * [-1, -1, 1] + rng.normal(size=(n, 3)) * max(roughness**2, 1e-3)
    wo = np.where(near[:, None], lobe, wo)
    flip = rng.random(n) < 0.1
    wi[flip, 2] *= -1
    wo[flip, 2] *= -1
    wo[rng.random(n) < 0.02, 2] *= -1
    wo /= np.linalg.norm(wo, axis=-1, keepdims=True)
    return wi.astype(np.float32), wo.astype(np.float32)


def _condition(wi: np.ndarray, wo: np.ndarray, roughness: float) -> Float[np.ndarray, " n"]:
    """Relative change of D per absolute change of a direction: the half vector divides by |wi + wo|, D by alpha."""
    total = np.linalg.norm(wi.astype(np.float64) + wo, axis=-1)
    return 1 / (max(roughness**2, 1e-3) * np.maximum(total, 1e-12))


def _interaction(wi: np.ndarray) -> Any:
    import drjit as dr

    mi = mitsuba()
    interaction = dr.zeros(mi.SurfaceInteraction3f, len(wi))
    interaction.wi = _vector(wi)
    interaction.n = mi.Normal3f(0, 0, 1)
    interaction.sh_frame = mi.Frame3f(mi.Normal3f(0, 0, 1))
    return interaction


def _vector(array: np.ndarray) -> Any:
    return mitsuba().Vector3f(np.ascontiguousarray(array.T, np.float32))


def _array(value: Any) -> Float[np.ndarray, "n 3"]:
    return np.asarray(value, np.float64).T


@functools.lru_cache(maxsize=4)
def _bin_integrals(roughness: float, metallic: float, polar: float) -> Float[np.ndarray, "rows columns 3"]:
    """Our f cos over each bin of the hemisphere, seen at the polar angle `polar`."""
    from unirender_reference import principled

    directions, solid_angle = _fine_directions()
    wi = np.broadcast_to(np.array([np.sin(polar), 0.0, np.cos(polar)], np.float32), directions.shape)
    values, _ = principled.evaluate_arrays(wi, directions, ALBEDO, roughness, metallic)
    weighted = (values * solid_angle[:, None]).reshape(BINS[0], SUB_BINS[0], BINS[1], SUB_BINS[1], 3)
    return weighted.sum(axis=(1, 3))


def _fine_directions() -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, " n"]]:
    """Midpoints of the sub-bins of the hemisphere and their solid angles."""
    rows, columns = BINS[0] * SUB_BINS[0], BINS[1] * SUB_BINS[1]
    edges = np.cos(np.arange(rows + 1) * (np.pi / 2 / rows))
    theta = (np.arange(rows) + 0.5) * (np.pi / 2 / rows)
    phi = (np.arange(columns) + 0.5) * (2 * np.pi / columns)
    theta, phi = np.meshgrid(theta, phi, indexing="ij")
    directions = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], -1)
    solid_angle = np.repeat((edges[:-1] - edges[1:]) * (2 * np.pi / columns), columns)
    return directions.reshape(-1, 3), solid_angle
