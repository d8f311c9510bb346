"""Light transport of one picture: matrices from light texels to pixels, for the principled BSDF.

With the points' material held, a picture is linear in the light's texels E. The principled BSDF without clearcoat,
sheen and the like is

    f cos = (1 - metallic) albedo (D0 + roughness D1 + roughness^2 D2) + F0 (G - W) + W,
    F0 = 0.04 (1 - metallic) + albedo metallic

where D0, D1, D2 are the parts of the diffuse lobe (Burley: base, and the retro-reflection that is linear and quadratic
in the roughness), G is the GGX lobe of a mirror-tinted reflector and W the same lobe weighted by Schlick's
(1 - l . h)^5. Each integral over the light's bilinear interpolant becomes a row per pixel; G and W are tabulated at
`NODES` and interpolated in between.

A lobe's integral is estimated by the balance heuristic over two deterministic sets of directions: a fine grid of the
sphere, and `LOBE_SAMPLES` visible normals of a pixel's lobe. Light that the mesh hides from a point is left out.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from unirender.camera import Camera
from unirender.errors import UnirenderError
from unirender.lighting import hat_weights
from unirender_reference.backend import mitsuba
from unirender_reference.scene import mesh_shape, sensor_dict
from unirender_reference.shader import facing
from unirender_reference.shapes import MeshObject

NODES = (0.05, 0.1, 0.2, 0.3, 0.4, 0.55, 0.7, 0.85, 1.0)
GRID = (32, 64)  # directions of the sphere, midpoints of equal steps in theta and phi
LOBE_SAMPLES = 64  # of a pixel and node
POINTS = 4  # of a pixel on a known mesh
LANES = 1 << 22  # point-direction pairs at a time


@dataclass(frozen=True)
class Occluder:
    """What hides light from points.

    Attributes:
        position: (p, 3).
        outward: (p, 3) geometric normals on the viewer's side.
        scene: Mitsuba scene.
    """

    position: Float[np.ndarray, "p 3"]
    outward: Float[np.ndarray, "p 3"]
    scene: Any


@dataclass(frozen=True)
class PicturePoints:
    """The surface points that a picture shows: `count` of them for each of n pixels, in the camera's axes.

    Attributes:
        pixel: (n,) flat indices of the pixels.
        normal: (n count, 3) unit shading normals that face the viewer.
        view: (n count, 3) unit directions to the viewer.
        valid: (n count,) whether there is a point.
        occluder: None: nothing is hidden.
    """

    pixel: Int[np.ndarray, " n"]
    normal: Float[np.ndarray, "p 3"]
    view: Float[np.ndarray, "p 3"]
    valid: Bool[np.ndarray, " p"]
    occluder: Occluder | None = None

    @property
    def count(self) -> int:
        """Points of a pixel."""
        return len(self.normal) // len(self.pixel)

    @property
    def lobe_samples(self) -> int:
        """Visible normals of a point."""
        return LOBE_SAMPLES // self.count


def mapped_points(
    mask: Float[np.ndarray, "h w 1"], normal: Float[np.ndarray, "h w 3"], view: Float[np.ndarray, "h w 3"]
) -> PicturePoints:
    """One point for each covered pixel, with the pixel's normal and direction to the viewer; nothing is hidden.

    Raises:
        UnirenderError: no covered pixel has a normal.
    """
    inside = (mask[..., 0] > 0) & np.any(normal != 0, axis=-1)
    if not inside.any():
        raise UnirenderError("normals: they are 0 wherever the mask covers a pixel; expected a normal for each of them")
    bent = _facing(normal[inside], view[inside])
    return PicturePoints(np.flatnonzero(inside), bent, view[inside], np.ones(len(bent), bool))


def mesh_points(
    mask: Float[np.ndarray, "h w 1"], geometry: MeshObject, camera: Camera, size: tuple[float, float], seed: int = 0
) -> PicturePoints:
    """`POINTS` jittered points of the mesh for each covered pixel that shows it.

    Args:
        mask: coverage; a pixel of it may be a block of pixels of the picture.
        geometry: the object, in the contract's place before the camera.
        camera: of the picture.
        size: height and width of the picture in pixels of the mask; no integers where the last blocks stick out.
        seed: of the points' places within their pixels.

    Raises:
        UnirenderError: no covered pixel shows the mesh.
    """
    mi = mitsuba()
    import drjit as dr  # after Mitsuba's backend is chosen

    width = mask.shape[1]
    sensor = sensor_dict(camera, round(size[0] * 64), round(size[1] * 64))  # only their ratio counts
    scene = mi.load_dict({"type": "scene", "sensor": sensor, "object": mesh_shape(geometry, {"type": "diffuse"})})
    pixel = np.flatnonzero(mask[..., 0] > 0)
    lanes = len(pixel) * POINTS
    sampler = mi.load_dict({"type": "multijitter", "sample_count": POINTS})
    sampler.set_samples_per_wavefront(POINTS)
    sampler.seed(seed, lanes)
    index = dr.gather(mi.UInt32, mi.UInt32(pixel.astype(np.uint32)), dr.arange(mi.UInt32, lanes) // POINTS)
    corner = mi.Point2f(mi.Float(index % width), mi.Float(index // width))
    place = (corner + sampler.next_2d()) / mi.Point2f(size[1], size[0])
    ray, _ = scene.sensors()[0].sample_ray(0.0, 0.5, place, mi.Point2f(0.5))
    hit = scene.ray_intersect(ray)
    valid = np.array(hit.is_valid())
    shown = valid.reshape(-1, POINTS).any(axis=1)
    if not shown.any():
        raise UnirenderError("geometry: the mesh is in no covered pixel; expected the object that the picture shows")
    kept = np.repeat(shown, POINTS)
    position, normal, outward, view = (np.array(x).T[kept] for x in (hit.p, hit.sh_frame.n, hit.n, -ray.d))
    valid = valid[kept]
    normal[~valid] = view[~valid]
    outward = np.where((outward * view).sum(axis=1, keepdims=True) < 0, -outward, outward)
    return PicturePoints(pixel[shown], _facing(normal, view), view, valid, Occluder(position, outward, scene))


def _facing(normal: Float[np.ndarray, "p 3"], view: Float[np.ndarray, "p 3"]) -> Float[np.ndarray, "p 3"]:
    mi = mitsuba()
    columns = (mi.Vector3f(np.ascontiguousarray(x.T, np.float32)) for x in (normal, view))
    return np.array(facing(*columns)).T


@dataclass(frozen=True)
class Transport:
    """Matrices of one picture: n pixels, j = rows x columns light texels.

    Attributes:
        pixel: (n,) flat indices of the pixels.
        white: (n, j): a white Lambertian, cosine / pi.
        diffuse: (3, n, j): D0, D1, D2.
        lobe: (k, n, j): G at the nodes.
        grazing: (k, n, j): W at the nodes.
        shape: rows and columns of the light.
    """

    pixel: Int[np.ndarray, " n"]
    white: Float[np.ndarray, "n j"]
    diffuse: Float[np.ndarray, "3 n j"]
    lobe: Float[np.ndarray, "k n j"]
    grazing: Float[np.ndarray, "k n j"]
    shape: tuple[int, int]


def build_transport(points: PicturePoints, shape: tuple[int, int], seed: int = 0) -> Transport:
    """The matrices for a light of `shape` on the grid of `unirender.lighting`; pixels without a point are rows of 0."""
    n, count, texels = len(points.pixel), points.count, shape[0] * shape[1]
    made = np.zeros((4 + 2 * len(NODES), n, texels), np.float32)
    hats = _grid_hats(shape)
    step = max(1, LANES // (count * len(hats[1])))
    for first in range(0, n, step):
        rows = slice(first, min(n, first + step))
        for out, values in zip(made, _grid_part(points, rows, hats[1], hats[2]), strict=True):
            out[rows] = (hats[0].T @ values.T).T
    step = max(1, LANES // LOBE_SAMPLES)
    for first in range(0, n, step):
        rows = slice(first, min(n, first + step))
        for node in range(len(NODES)):
            lobe, grazing = _lobe_part(points, rows, node, shape, seed)
            made[4 + 2 * node][rows] += lobe
            made[5 + 2 * node][rows] += grazing
    hits = points.valid.reshape(n, count).sum(axis=1)
    made /= np.maximum(hits, 1)[None, :, None]
    return Transport(points.pixel, made[0], made[1:4], made[4::2], made[5::2], shape)


def _grid_hats(shape: tuple[int, int]) -> tuple[Any, Float[np.ndarray, "g 3"], Float[np.ndarray, " g"]]:
    """The light's interpolation weights (g, j) in the grid's directions, the directions, their solid angles."""
    import scipy.sparse as sparse

    height, width = GRID
    theta, phi = np.pi * (np.arange(height) + 0.5) / height, 2 * np.pi * (np.arange(width) + 0.5) / width
    rows = hat_weights(theta * (shape[0] - 1) / np.pi, shape[0])
    columns = hat_weights(phi * shape[1] / (2 * np.pi) - 0.5, shape[1], wrap=True)
    edges = np.cos(np.pi * np.arange(height + 1) / height)
    angle = np.repeat((edges[:-1] - edges[1:]) * 2 * np.pi / width, width)
    theta, phi = (x.ravel() for x in np.meshgrid(theta, phi, indexing="ij"))
    towards = np.stack([np.sin(theta) * np.sin(phi), np.cos(theta), -np.sin(theta) * np.cos(phi)], axis=-1)
    return sparse.csr_array(sparse.kron(rows, columns)), towards.astype(np.float32), angle.astype(np.float32)


class _Lanes:
    """Points of some pixels as Dr.Jit arrays, gathered to lanes."""

    def __init__(self, points: PicturePoints, rows: slice, index: Any) -> None:
        import drjit as dr

        mi = mitsuba()
        lanes = slice(rows.start * points.count, rows.stop * points.count)

        def vector(values: np.ndarray) -> Any:
            return dr.gather(mi.Vector3f, mi.Vector3f(np.ascontiguousarray(values[lanes].T, np.float32)), index)

        self.normal, self.view = vector(points.normal), vector(points.view)
        self.valid = dr.gather(mi.Bool, mi.Bool(points.valid[lanes]), index)
        self.scene = None
        if points.occluder is not None:
            self.scene, self.surface = points.occluder.scene, dr.zeros(mi.SurfaceInteraction3f, dr.width(index))
            self.surface.p, self.surface.n = vector(points.occluder.position), vector(points.occluder.outward)

    def lit(self, towards: Any, active: Any) -> Any:
        """Whether light from `towards` reaches the points."""
        active &= self.valid
        return active if self.scene is None else active & ~self.scene.ray_test(self.surface.spawn_ray(towards), active)


def _grid_part(
    points: PicturePoints, rows: slice, towards: Float[np.ndarray, "g 3"], angle: Float[np.ndarray, " g"]
) -> Any:
    """Sums over the points of each pixel of all lobes in the directions of the grid, times the solid angle."""
    mi = mitsuba()
    import drjit as dr  # after Mitsuba's backend is chosen

    cells, count, n = len(angle), points.count, rows.stop - rows.start
    lane = dr.arange(mi.UInt32, n * cells * count)
    cell = (lane // count) % cells
    at = _Lanes(points, rows, (lane // (count * cells)) * count + lane % count)
    light = dr.gather(mi.Vector3f, mi.Vector3f(np.ascontiguousarray(towards.T)), cell)
    omega = dr.gather(mi.Float, mi.Float(angle), cell)
    cos_view, cos_light = dr.dot(at.normal, at.view), dr.dot(at.normal, light)
    lit = at.lit(light, (cos_view > 0) & (cos_light > 0))
    half = dr.normalize(at.view + light)
    cos_half, cos_difference = dr.dot(at.normal, half), dr.dot(half, light)
    view_5, light_5 = (1 - cos_view) ** 5, (1 - cos_light) ** 5
    retro = 2 * dr.square(cos_difference)
    values = [
        cos_light / dr.pi,
        (1 - 0.5 * view_5) * (1 - 0.5 * light_5) * cos_light / dr.pi,
        retro * (view_5 + light_5 - view_5 * light_5) * cos_light / dr.pi,
        dr.square(retro) * view_5 * light_5 * cos_light / dr.pi,
    ]
    values = [dr.select(lit, value * omega, 0) for value in values]
    for node in NODES:
        weight, density = _ggx(node**2, cos_half, cos_view, cos_light)
        weight = dr.select(lit, weight / (1 / omega + points.lobe_samples * density), 0)
        values += [weight, weight * (1 - cos_difference) ** 5]
    dr.eval(values)
    return (np.array(dr.block_sum(value, count)).reshape(n, cells) for value in values)


def _lobe_part(
    points: PicturePoints, rows: slice, node: int, shape: tuple[int, int], seed: int
) -> tuple[Float[np.ndarray, "n j"], Float[np.ndarray, "n j"]]:
    """Sums over the points of each pixel of G and W in directions drawn from the lobe, spread over the texels."""
    mi = mitsuba()
    import drjit as dr  # after Mitsuba's backend is chosen

    count, n, texels, samples = points.count, rows.stop - rows.start, shape[0] * shape[1], points.lobe_samples
    lane = dr.arange(mi.UInt32, n * count * samples)
    at = _Lanes(points, rows, lane // samples)
    sampler = mi.load_dict({"type": "multijitter", "sample_count": samples})
    sampler.set_samples_per_wavefront(samples)
    sampler.seed(seed * 7919 + rows.start * len(NODES) + node, dr.width(lane))
    frame, alpha = mi.Frame3f(at.normal), NODES[node] ** 2
    view = frame.to_local(at.view)
    half, _ = mi.MicrofacetDistribution(mi.MicrofacetType.GGX, float(alpha), True).sample(view, sampler.next_2d())
    local = mi.reflect(view, half)
    light = frame.to_world(local)
    lit = at.lit(light, (view.z > 0) & (local.z > 0))
    weight, density = _ggx(alpha, half.z, view.z, local.z)
    theta, phi = dr.safe_acos(light.y), dr.atan2(light.x, -light.z)
    row, column = theta / dr.pi * (shape[0] - 1), phi / dr.two_pi * shape[1] - 0.5
    # the solid angle of the grid's direction whose cell this one falls in
    cell = dr.minimum(mi.UInt32(theta / dr.pi * GRID[0]), GRID[0] - 1)
    edge = mi.Float(cell) * (dr.pi / GRID[0])
    omega = (dr.cos(edge) - dr.cos(edge + dr.pi / GRID[0])) * (dr.two_pi / GRID[1])
    weight = dr.select(lit, weight / (1 / omega + samples * density), 0)
    grazing = weight * (1 - dr.dot(half, local)) ** 5
    first = dr.clip(dr.floor(row), 0, shape[0] - 2)
    left = dr.floor(column)
    sums = [dr.zeros(mi.Float, n * texels) for _ in range(2)]
    pixel = lane // (samples * count)
    for down in (0, 1):
        for right in (0, 1):
            hat = (1 - dr.abs(row - first - down)) * (1 - dr.abs(column - left - right))
            x = mi.UInt32(dr.round(left) + (right + shape[1])) % shape[1]
            texel = pixel * texels + (mi.UInt32(first) + down) * shape[1] + x
            for total, value in zip(sums, (weight, grazing), strict=True):
                dr.scatter_reduce(dr.ReduceOp.Add, total, value * hat, texel, lit)
    return np.array(sums[0]).reshape(n, texels), np.array(sums[1]).reshape(n, texels)


def _ggx(alpha: float, cos_half: Any, cos_view: Any, cos_light: Any) -> tuple[Any, Any]:
    """D G / (4 n.v) (the lobe times the light's cosine) and the density of visible-normal sampling."""
    import drjit as dr

    squared = alpha * alpha
    ggx = squared / (dr.pi * dr.square(dr.square(cos_half) * (squared - 1) + 1))

    def smith(cosine: Any) -> Any:
        return 2 * cosine / (cosine + dr.sqrt(squared + (1 - squared) * cosine * cosine))

    visible = ggx * smith(cos_view) / (4 * cos_view)
    return visible * smith(cos_light), visible
