"""The unit sphere: as a mesh for Mitsuba, and in closed form for what is expected of it.

A pixel is the box filter's mean over its area. The closed form takes it over a grid of rays in each pixel; rays and
distance come from the contract's camera, the hit point from the quadratic equation.
"""

import functools
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from unirender.camera import Camera
from unirender_reference.shapes import MeshObject

ALBEDO = (0.7, 0.4, 0.2)
SUBDIVISIONS = 6  # the silhouette then lies within 1e-4 radii of the sphere's


@functools.lru_cache(maxsize=4)
def ball(albedo: tuple[float, float, float] = ALBEDO) -> MeshObject:
    """The unit sphere as a fine mesh with exact shading normals and one base colour."""
    import trimesh

    mesh = trimesh.creation.icosphere(subdivisions=SUBDIVISIONS)
    vertices = np.asarray(mesh.vertices, np.float32)
    vertices /= np.linalg.norm(vertices, axis=1, keepdims=True)
    faces = np.asarray(mesh.faces, np.int32)
    return MeshObject("ball", "sphere", vertices, faces, vertices.copy(), None, np.array(albedo, np.float32))


@dataclass(frozen=True)
class BallView:
    """What the rays of a camera meet, s = fine^2 rays in each pixel.

    Attributes:
        hit: where a ray meets the sphere.
        normal: outward, at the `p` hits, camera axes.
        view: towards the viewer, at the hits.
    """

    hit: Bool[np.ndarray, "h w s"]
    normal: Float[np.ndarray, "p 3"]
    view: Float[np.ndarray, "p 3"]

    @property
    def coverage(self) -> Float[np.ndarray, "h w 1"]:
        """The part of each pixel that the sphere covers."""
        return self.hit.mean(axis=-1, keepdims=True)

    @property
    def full(self) -> Bool[np.ndarray, "h w"]:
        """Pixels that the sphere covers wholly."""
        return self.coverage[..., 0] == 1

    @property
    def cosine(self) -> Float[np.ndarray, " p"]:
        """Of view and normal."""
        return np.sum(self.normal * self.view, axis=-1)

    def pixel_mean(self, radiance: Float[np.ndarray, "p c"]) -> Float[np.ndarray, "h w c"]:
        """The box filter: radiance at the hits, 0 elsewhere, averaged over each pixel."""
        values = np.zeros((*self.hit.shape, radiance.shape[-1]))
        values[self.hit] = radiance
        return values.mean(axis=2)

    def reflected(
        self, weights: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]], light: Callable[[np.ndarray], np.ndarray]
    ) -> Float[np.ndarray, "p 3"]:
        """Radiance towards the viewer at each hit.

        Args:
            weights: cosines `[p]` of the view directions -> quadrature directions and weights `[p s 3]` for
                wi = (sin, 0, cos) in the shading frame (`principled.light_quadrature`).
            light: unit directions `[... 3]`, camera axes -> radiance `[... 3]`.
        """
        out = np.empty((len(self.normal), 3))
        for part in np.array_split(np.arange(len(out)), max(1, len(out) // 256)):
            n, cosine = self.normal[part], self.cosine[part]
            x = self.view[part] - cosine[:, None] * n
            x /= np.maximum(np.linalg.norm(x, axis=-1, keepdims=True), 1e-12)
            frame = np.stack([x, np.cross(n, x), n], axis=1)
            directions, weight = weights(cosine)
            out[part] = np.einsum("psc,psc->pc", weight, light(directions @ frame))
        return out


@functools.lru_cache(maxsize=8)
def ball_view(camera: Camera, resolution: int, fine: int) -> BallView:
    """The sphere through `fine * fine` rays on a regular grid in each pixel."""
    size = resolution * fine
    rays = camera.rays(size, size).astype(np.float64)
    rays = rays.reshape(resolution, fine, resolution, fine, 3).swapaxes(1, 2).reshape(resolution, resolution, -1, 3)
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    origin = np.array([0.0, 0.0, camera.distance()])
    half = rays @ origin
    inside = half**2 - (origin @ origin - 1)
    hit = inside > 0
    reach = -half[hit] - np.sqrt(inside[hit])
    return BallView(hit, origin + reach[:, None] * rays[hit], -rays[hit])
