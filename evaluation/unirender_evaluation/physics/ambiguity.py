"""The materials that explain a picture, found by Mitsuba: with the true object and light, they look like the input.

Notation: a material x is (metallic m, roughness r, mean luminance of the albedo), each one number for the object: the
true albedo times a factor a. I(x) is Mitsuba's picture of it and I the input, what a method sees: 8 bits. Differences
are taken in display values, to first order: D' is the slope of the display curve at I, means run over pixels weighted
by coverage, and over channels:

    d(x)^2  = mean D'^2 (I(x) - I)^2, less the part of it that the noise of both pictures makes
    sigma^2 = mean D'^2 var I + 1 / (12 * 255^2) + TOLERANCE^2         noise, rounding, what nobody would see
    S       = {x: d(x) <= 2 sigma}

Light that is reflected once is linear in m and in a, light that is reflected k times a polynomial of degree k: at one
roughness nine renders (three values of m times three of a) give the picture of every m and a, and between two
roughnesses pictures are interpolated. d^2 is then a quadratic form of the renders' weights, and what their noise adds
to it is known. Roughness is walked from the true one both ways, as long as an interval has a material of S: S here is
the connected piece around the truth. A perfect posterior, which knows object and light and allows the same differences,
is uniform on S.
"""

from bisect import bisect_right
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cache, cached_property
from typing import Any

import numpy as np
from jaxtyping import Float

from unirender.color import display_slope, luminance, srgb_decode, unpremultiply
from unirender.errors import UnirenderError
from unirender.intrinsics import Intrinsics
from unirender_evaluation.methods.method import Mask, quantise
from unirender_evaluation.methods.mitsuba import MitsubaScene
from unirender_evaluation.metrics import weighted_mean
from unirender_evaluation.suites.suite import MetallicRoughness
from unirender_evaluation.truth.render import item_seed
from unirender_reference.noise import full_spp
from unirender_reference.sweep import QUADRATIC, lagrange_weights

Points = Float[np.ndarray, "n 3"]  # (metallic, roughness, mean albedo luminance), in the unit cube
TOLERANCE = 0.02  # display values, RMS: 2 sigma is then 28 dB, what one shading point reaches on smooth metals
SIGMAS = 2.0
LEVELS = (*(i / 20 for i in range(10)), *(i / 10 for i in range(5, 11)))  # of roughness; smooth surfaces differ sooner
NODE_SPP, NODE_BATCHES = 64, 2
EXPLANATIONS, POSTERIOR = 8, 19  # materials that are looked for; samples of a posterior: its region holds 0.9 exactly
TRIES = 2_000_000  # materials that are looked at, for each unit of roughness
ROUNDING = 1 / (12 * 255**2)  # variance of what 8 bits leave out


@dataclass(frozen=True)
class Nodes:
    """Mitsuba's pictures at one roughness, of every metallic with every factor of the nodes."""

    radiance: Float[np.ndarray, "k p 3"]  # linear, of the covered part of the object's pixels
    noise: Float[np.ndarray, " k"]  # mean D'^2 var of each


class Explanations:
    """S of one picture.

    Args:
        mitsuba: the object under the picture's light.
        material: (metallic, roughness) of the picture: one that the suite stores.
    """

    def __init__(self, mitsuba: MitsubaScene, material: MetallicRoughness) -> None:
        self.mitsuba, self.material = mitsuba, material
        suite, scene = mitsuba.suite, mitsuba.scene
        mask = suite.mask(scene)
        inside = mask[..., 0] > 0
        self._inside, self._mask = inside, mask
        image = suite.image(scene, material)
        self._seen = srgb_decode(quantise(image, mask))[inside].astype(np.float64)
        self._slope = np.square(display_slope(unpremultiply(image, mask)[inside]))
        self._weight = mask[inside] / (3 * mask.sum(dtype=np.float64))
        variance = suite.image_variance(scene, material)[inside] / np.square(mask[inside])
        self.input_noise = float(np.sum(self._weight * self._slope * variance)) + ROUNDING
        albedo = mitsuba.renderer.obj.albedo
        self.most = 1 / float(np.max(albedo))  # the factor that makes the brightest texel white
        true = suite.intrinsics(scene, material).require("albedo")["albedo"]
        self.true_luminance = weighted_mean(luminance(true)[..., None], mask)

    @property
    def sigma(self) -> float:
        """Display values, RMS."""
        return float(np.sqrt(self.input_noise + TOLERANCE**2))

    @cached_property
    def _renderers(self) -> list[Any]:
        """Of the object with its albedo times the nodes' factors."""
        from unirender_reference.render import Renderer

        own = self.mitsuba.renderer
        return [
            Renderer(replace(own.obj, albedo=own.obj.albedo * np.float32(node * self.most)), own.camera, own.resolution)
            for node in QUADRATIC
        ]

    def nodes(self, roughness: float) -> Nodes:
        """Nine renders."""
        suite, scene = self.mitsuba.suite, self.mitsuba.scene
        light, spp = suite.environment(scene), full_spp(NODE_SPP, NODE_BATCHES, suite.spec.resolution**2)
        mask = self._mask[self._inside]
        radiance, noise = [], []
        for m in QUADRATIC:
            for renderer, share in zip(self._renderers, QUADRATIC, strict=True):
                seed = item_seed("ambiguity", scene.key, f"{roughness:g}", m, share)
                made = renderer.image(light, roughness, m, spp, seed, batches=NODE_BATCHES)
                radiance.append(made.mean[self._inside][:, :3].astype(np.float64) / mask)
                variance = made.variance[self._inside][:, :3] / np.square(mask)
                noise.append(float(np.sum(self._weight * self._slope * variance)))
        return Nodes(np.stack(radiance), np.array(noise))

    def squared_distance(
        self, low: Nodes, high: Nodes, place: Float[np.ndarray, " n"], metallic: Any, share: Any
    ) -> Float[np.ndarray, " n"]:
        """d^2 of materials between two roughnesses; noise can make it a little less than 0.

        Args:
            low, high: pictures at the two.
            place: of each material's roughness, 0 at the lower one, 1 at the higher.
            metallic: of each.
            share: a of each, as a share of the largest factor that the albedo allows.
        """
        pictures, weight = np.concatenate([low.radiance, high.radiance]), self._weight * self._slope
        quadratic = np.einsum("jpc,pc,kpc->jk", pictures, weight, pictures, optimize=True)
        quadratic -= np.diag(np.concatenate([low.noise, high.noise]))
        linear = np.einsum("jpc,pc,pc->j", pictures, weight, self._seen, optimize=True)
        constant = float(np.sum(weight * self._seen**2)) - self.input_noise
        m, a = (lagrange_weights(QUADRATIC, values.tolist()) for values in (metallic, share))
        one = (m[:, :, None] * a[:, None, :]).reshape(len(m), -1)
        w = np.concatenate([(1 - place)[:, None] * one, place[:, None] * one], axis=1)
        return np.einsum("nj,nj->n", w @ quadratic, w) - 2 * w @ linear + constant

    @cached_property
    def _found(self) -> Points:
        """Uniform draws from S."""
        rng = np.random.default_rng(item_seed("ambiguity", self.mitsuba.scene.key))
        points = np.concatenate(list(self._walk(rng)))
        if not len(points):
            raise UnirenderError(
                f"ambiguity of {self.mitsuba.scene.key}: no material explains the picture, not even its own: Mitsuba "
                "renders another scene here; check with `unirender bench check`"
            )
        return points

    def _walk(self, rng: np.random.Generator) -> Iterator[Points]:
        """The materials of S in one interval of roughness after another, as many for each unit of roughness."""
        nodes = cache(self.nodes)
        start = min(bisect_right(LEVELS, self.material[1]), len(LEVELS) - 1)  # upper end of the interval
        for way in (range(start, len(LEVELS)), range(start - 1, 0, -1)):
            for upper in way:
                low, high = LEVELS[upper - 1], LEVELS[upper]
                metallic, place, share = rng.random((3, round(TRIES * (high - low))))
                d2 = self.squared_distance(nodes(low), nodes(high), place, metallic, share)
                points = [metallic, low + place * (high - low), share * self.most * self.true_luminance]
                found = np.stack(points, axis=-1)[d2 <= (SIGMAS * self.sigma) ** 2]
                yield found
                if not len(found):
                    break

    @property
    def volume(self) -> float:
        """Of S, in the unit cube."""
        return len(self._found) / TRIES * self.most * self.true_luminance

    @cached_property
    def materials(self) -> Points:
        """`EXPLANATIONS` of them."""
        return self._draw("materials", EXPLANATIONS)

    @cached_property
    def posterior(self) -> Points:
        """`POSTERIOR` samples of the perfect posterior, others than the materials."""
        return self._draw("posterior", POSTERIOR)

    def _draw(self, what: str, count: int) -> Points:
        rng = np.random.default_rng(item_seed("ambiguity", self.mitsuba.scene.key, what))
        return rng.choice(self._found, count, replace=len(self._found) < count)


def material_point(maps: Intrinsics, mask: Mask) -> Float[np.ndarray, " 3"]:
    """The point of found maps: coverage-weighted means over the object."""
    found = maps.require("metallic", "roughness", "albedo")
    bright = luminance(found["albedo"])[..., None]
    return np.array([weighted_mean(x, mask) for x in (found["metallic"], found["roughness"], bright)])
