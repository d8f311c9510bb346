"""s and d from an environment with the shadows that the picture's own surfaces cast (`self_shadow`).

    d = d_0 (integral of V L n.l) / (integral of L n.l),    s = s_0 (integral of V L D n.l) / (integral of L D n.l)

Notation: d_0, s_0 without shadows (`light.surface_light`); L the light; V how likely a direction is free, by what
masks say of it and what a network has learned of them (`unirender.models.visibility`); D the GGX distribution at the
half vector, of a roughness of `LEAST_ROUGHNESS` or more. Up to `SHADOW_SIDE` pixels d is linear in the light; s is only
as far as a lobe has one light.
"""

from collections.abc import Collection, Sequence

import numpy as np
from jaxtyping import Bool, Float, UInt8
from scipy.ndimage import distance_transform_edt

from unirender.intrinsics import Intrinsics
from unirender.light.lobes import texel_directions, texels
from unirender.light.surface_light import QUADRATURE_SHAPE
from unirender.models.visibility import BINS, bin_weights, direction_bins, hidden_chance
from unirender.pipelines.framing import Frame
from unirender.pipelines.remembered import MapsKey, remembered
from unirender.pipelines.self_shadow import SelfShadow, of_rows

SHADOW_SIDE = 128  # pixels along the longer side at which shadows of larger pictures are found
KEPT = 2  # pictures; what is hidden in one takes tens of megabytes and seconds
LEAST_ROUGHNESS = 0.3  # below it a lobe is narrower than the texels over which shadows are integrated
_ROWS = 32  # pixels at a time: many passes go over their directions, so they stay in the processor's cache


def visible_shares(
    intrinsics: Intrinsics,
    environment: Float[np.ndarray, "eh ew 3"],
    names: Collection[str] = ("specular", "diffuse"),
) -> dict[str, Float[np.ndarray, "h w 3"]]:
    """What of s and d without shadows is left where the picture's own surfaces stand in the light's way; [0, 1].

    Args:
        intrinsics: with normal and mask, and roughness where s is wanted.
        environment: lat-long radiance in camera axes, any resolution.
        names: of specular and diffuse, those that are wanted.
    """
    return visible_shares_under(intrinsics, [environment], names)[0]


def visible_shares_under(
    intrinsics: Intrinsics, environments: Sequence[Float[np.ndarray, "eh ew 3"]], names: Collection[str]
) -> list[dict[str, Float[np.ndarray, "h w 3"]]]:
    """`visible_shares` under each of several lights, in less time than one by one."""
    roughness = intrinsics.require("roughness")["roughness"] if "specular" in names else None
    return seen_shadows(intrinsics).shares(environments, names, roughness)


def seen_shadows(intrinsics: Intrinsics) -> "SeenShadows":
    """What is hidden in a picture. The last pictures' are kept, since one is mostly rendered with several materials.

    Args:
        intrinsics: as for `SeenShadows`.
    """
    surface = Intrinsics(**intrinsics.require("normal", "mask"), camera=intrinsics.camera)
    return _looked_at(MapsKey(surface.with_unit_normals()))


class SeenShadows:
    """What is hidden in one picture, found once for any lights and roughnesses."""

    def __init__(self, intrinsics: Intrinsics) -> None:
        """Looks where surfaces hide one another.

        Args:
            intrinsics: with normal and mask; the camera gives the pixels' rays.
        """
        surface = Intrinsics(**intrinsics.require("normal", "mask"), camera=intrinsics.camera).with_unit_normals()
        self._mask = surface.require("mask")["mask"].copy()  # it outlives this call, and the caller's array is his
        self._frame = None
        if max(surface.height, surface.width) > SHADOW_SIDE:
            self._frame = Frame.reduced(self._mask, SHADOW_SIDE)
            surface = self._frame.enter_intrinsics(surface)
        normal, mask = surface.require("normal", "mask").values()
        shadow = SelfShadow.of(normal, mask, surface.camera)
        self._edge, self._nearest = _edge(shadow.where, mask[..., 0] > 0)
        self._where, self._size = shadow.where, normal.shape
        self._n = normal[shadow.where]
        self._view = -shadow.ray / np.linalg.norm(shadow.ray, axis=1, keepdims=True)
        self._directions = texel_directions(QUADRATURE_SHAPE)
        self._parts = _percent_hidden(shadow, normal, self._directions)

    def diffuse_share(self, environment: Float[np.ndarray, "eh ew 3"]) -> Float[np.ndarray, "h w 3"]:
        """What is left of d; [0, 1]."""
        return self.shares([environment], ["diffuse"])[0]["diffuse"]

    def specular_share(
        self, roughness: Float[np.ndarray, "h w 1"], environment: Float[np.ndarray, "eh ew 3"]
    ) -> Float[np.ndarray, "h w 3"]:
        """What is left of s; [0, 1]."""
        return self.shares([environment], ["specular"], roughness)[0]["specular"]

    def shares(
        self,
        environments: Sequence[Float[np.ndarray, "eh ew 3"]],
        names: Collection[str],
        roughness: Float[np.ndarray, "h w 1"] | None = None,
    ) -> list[dict[str, Float[np.ndarray, "h w 3"]]]:
        """What is left under each of the lights; [0, 1].

        Args:
            environments: lat-long radiance in camera axes, any resolution.
            names: of specular and diffuse, those that are wanted.
            roughness: needed for specular.
        """
        wanted = [name for name in ("specular", "diffuse") if name in names]
        alpha = self._alpha(roughness) if roughness is not None else None
        radiances = [texels(environment, QUADRATURE_SHAPE)[1] for environment in environments]
        found = [{name: np.ones_like(self._n) for name in wanted} for _ in environments]
        for part, percent in self._parts:
            for name, weight in self._weights(part, wanted, alpha).items():
                totals = [weight @ radiance for radiance in radiances]
                weight *= percent
                for of_light, radiance, total in zip(found, radiances, totals, strict=True):
                    lost = weight @ radiance / 100
                    share = np.divide(lost, total, out=np.zeros_like(total), where=total > 0)
                    of_light[name][part] -= np.clip(share, 0, 1)
        return [{name: self._picture(share) for name, share in of_light.items()} for of_light in found]

    def _alpha(self, roughness: Float[np.ndarray, "h w 1"]) -> Float[np.ndarray, "p 1"]:
        """Of the lobes over which shadows are integrated."""
        if self._frame is not None:
            entered = self._frame.enter_intrinsics(Intrinsics(roughness=roughness, mask=self._mask))
            roughness = entered.require("roughness")["roughness"]
        return np.square(np.maximum(roughness[self._where], LEAST_ROUGHNESS))

    def _weights(
        self, part: slice, names: Collection[str], alpha: Float[np.ndarray, "p 1"] | None
    ) -> dict[str, Float[np.ndarray, "q m"]]:
        """By how much directions count for some of the pixels: by their cosine, and for s by the lobe."""
        n, view, weights = self._n[part], self._view[part], {}
        cosine = n @ self._directions
        if alpha is not None and "specular" in names:
            weights["specular"] = lobe = view @ self._directions
            n_v = (n * view).sum(axis=1, keepdims=True)
            for rows in (slice(i, i + _ROWS) for i in range(0, len(n), _ROWS)):
                lobe[rows] = _distribution(cosine[rows], n_v[rows], lobe[rows], alpha[part][rows])
                lobe[rows] *= np.maximum(cosine[rows], 0)
        if "diffuse" in names:
            weights["diffuse"] = np.maximum(cosine, 0, out=cosine)
        return weights

    def _picture(self, found: Float[np.ndarray, "p 3"]) -> Float[np.ndarray, "h w 3"]:
        """What is left, from the pixels of a surface to the whole picture."""
        share = np.ones(self._size, found.dtype)
        share[self._where] = found
        share[self._edge] = share[self._nearest]
        if self._frame is None:
            return share
        # what is lost, and not what is left: where the small size has no coverage nothing is known to be
        return 1 - self._frame.leave_map(1 - share, self._mask)


def _percent_hidden(
    shadow: SelfShadow, normal: Float[np.ndarray, "h w 3"], directions: Float[np.ndarray, "3 m"]
) -> list[tuple[slice, UInt8[np.ndarray, "q m"]]]:
    """1 - V of directions in percent, for parts of the pixels: there are many, and a byte is enough."""
    if not shadow.where.any():
        return []
    n = normal[shadow.where]
    parts = list(shadow.parts(directions.shape[1]))
    classes = [shadow.classes(part, directions) for part in parts]
    weight = [
        bin_weights(np.maximum(n[part] @ directions, 0), of_part, directions)
        for part, of_part in zip(parts, classes, strict=True)
    ]
    chance = hidden_chance(normal, shadow.where, shadow.depth, np.concatenate(weight))
    percent = np.round(100 * chance).astype(np.uint8)
    bins = direction_bins(directions)
    column = (of_part * np.uint8(BINS) + bins.astype(np.uint8) for of_part in classes)  # of classes times bins: a byte
    return [
        (part, of_rows(percent[part].reshape(len(index), -1), index)) for part, index in zip(parts, column, strict=True)
    ]


def _edge(
    surface: Bool[np.ndarray, "h w"], inside: Bool[np.ndarray, "h w"]
) -> tuple[tuple[np.ndarray, ...], tuple[np.ndarray, ...]]:
    """Indices of the pixels that are covered by less than a surface, and of the surface's pixel nearest to each."""
    if not surface.any():
        nowhere = np.nonzero(surface)
        return nowhere, nowhere
    edge = np.nonzero(inside & ~surface)
    indices = np.asarray(distance_transform_edt(~surface, return_distances=False, return_indices=True))
    return edge, (indices[0][edge], indices[1][edge])


def _distribution(
    n_l: Float[np.ndarray, "q m"],
    n_v: Float[np.ndarray, "q 1"],
    v_l: Float[np.ndarray, "q m"],
    alpha: Float[np.ndarray, "q 1"],
) -> Float[np.ndarray, "q m"]:
    """GGX at the half vectors between view and light, but for a factor of each pixel, from the cosines."""
    d = n_l + n_v  # times the length of the half vector, n.h
    np.square(d, out=d)
    d /= np.maximum(2 + 2 * v_l, 1e-6)
    np.minimum(d, 1, out=d)
    d *= 1 - np.square(alpha)
    np.subtract(1, d, out=d)
    np.square(d, out=d)
    return np.divide(1, d, out=d)


@remembered(most=KEPT)
def _looked_at(surface: MapsKey) -> SeenShadows:
    return SeenShadows(surface.intrinsics)
