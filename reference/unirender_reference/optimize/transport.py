r"""Direct light as matrices: how much each light cell adds to each pixel, for every lobe and roughness.

The radiance of a pixel under a light of cells with radiance E_j is

    I = sum_j [ (1-m) b D_j + (1-m) F_j + m (b G_j + (1-b) W_j) ] E_j          b: base colour, m: metallic

    D_j = D0_j + r D1_j + r^2 D2_j     Disney's diffuse lobe, a polynomial in the roughness r
    G_j(r), W_j(r)                     GGX with reflectance 1, and with Schlick's weight (1 - cos)^5
    F_j = F0 G_j + (1 - F0) W_j        the dielectric Fresnel term as Schlick approximates it, F0 = 0.04

Each entry is an integral over the cell of lobe x cosine x visibility, averaged over the pixel's points. It is estimated
with two kinds of samples under the balance heuristic: `CELL_SAMPLES` directions in each cell for a pixel, in turn from
its points, and `BSDF_SAMPLES` of the GGX lobe's visible normals from every point, so that narrow lobes are sharp and
wide ones smooth. Visibility is Mitsuba's. What the matrices leave
out (interreflection, the exact Fresnel term, what is smaller than a cell) is what a path-traced image corrects.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from unirender_reference.backend import mitsuba
from unirender_reference.optimize.light_grid import LightGrid
from unirender_reference.optimize.roughness_nodes import NODES
from unirender_reference.optimize.surface_points import SurfacePoints
from unirender_reference.passes import derive_seed

F0 = 0.04
CELL_SAMPLES = 4  # directions in each cell for a pixel
BSDF_SAMPLES = 4  # directions of the GGX lobe at each point, for each roughness node
LANES = 1 << 22

Matrix = Float[np.ndarray, "n j"]


@dataclass(frozen=True)
class Transport:
    """The matrices of N pixels and J light cells, coverage included.

    Attributes:
        diffuse: D0, D1, D2.
        gloss: G at each of `NODES`.
        schlick: W at each of `NODES`.
    """

    grid: LightGrid
    diffuse: tuple[Matrix, ...]
    gloss: tuple[Matrix, ...]
    schlick: tuple[Matrix, ...]

    def coarse(self) -> "Transport":
        """For a light of blocks of 2 x 2 cells with one radiance: half the rows, half the columns."""
        rows, columns = self.grid.rows, self.grid.columns

        def merged(matrix: Matrix) -> Float[np.ndarray, "n j4"]:
            return matrix.reshape(len(matrix), rows // 2, 2, columns // 2, 2).sum(axis=(2, 4)).reshape(len(matrix), -1)

        return Transport(
            LightGrid(rows // 2, columns // 2),
            *(tuple(merged(matrix) for matrix in part) for part in (self.diffuse, self.gloss, self.schlick)),
        )


def refined(cells: Float[np.ndarray, "j 3"], grid: LightGrid) -> Float[np.ndarray, "j4 3"]:
    """The light of a `coarse` grid on the grid of twice its rows and columns."""
    light = cells.reshape(grid.rows, grid.columns, 3)
    return light.repeat(2, axis=0).repeat(2, axis=1).reshape(-1, 3)


def light_transport(
    scene: Any, points: SurfacePoints, grid: LightGrid, seed: int, coverage: Float[np.ndarray, " n"] | None = None
) -> Transport:
    """The matrices of surface points in a scene that blocks light (`surface_points.blocker`).

    Args:
        coverage: of the pixels, where it is known better than from the points' own hits: a row is the mean over the
            points that hit, times it.
    """
    lobes = 3 + 2 * len(NODES)
    matrices = [np.zeros((len(points), grid.count), np.float32) for _ in range(lobes)]
    samples = points.hit.shape[1]
    step = max(1, LANES // (min(samples, CELL_SAMPLES) * grid.count))
    for start in range(0, len(points), step):
        rows = slice(start, min(start + step, len(points)))
        surface = _Surface(scene, points, rows)
        for matrix, part in zip(matrices, _by_cell(surface, grid, derive_seed(seed, "cells", start)), strict=True):
            matrix[rows] = part
    step = max(1, LANES // (samples * BSDF_SAMPLES))
    for start in range(0, len(points), step):
        rows = slice(start, min(start + step, len(points)))
        surface = _Surface(scene, points, rows)
        for node, roughness in enumerate(NODES):
            own = derive_seed(seed, "lobes", start, node)
            for matrix, part in zip(matrices[3 + 2 * node :], _by_lobe(surface, grid, roughness, own), strict=False):
                matrix[rows] += part
    if coverage is not None:
        for matrix in matrices:
            matrix *= (coverage / points.coverage)[:, None]
    return Transport(grid, tuple(matrices[:3]), tuple(matrices[3::2]), tuple(matrices[4::2]))


class _Surface:
    """Some pixels' points on the device."""

    def __init__(self, scene: Any, points: SurfacePoints, rows: slice) -> None:
        mi = mitsuba()

        def vectors(array: Float[np.ndarray, "n s 3"]) -> Any:
            return mi.Vector3f(np.ascontiguousarray(array[rows].reshape(-1, 3).T))

        self.scene = scene
        self.hit = mi.Bool(points.hit[rows].ravel())
        self.position, self.normal = vectors(points.position), vectors(points.normal)
        self.side, self.to_viewer = vectors(points.side), vectors(points.to_viewer)
        self.samples = points.hit.shape[1]
        self.pixels = len(points.view[rows])

    def lanes(self, index: Any) -> "_Lanes":
        import drjit as dr

        mi = mitsuba()
        point = dr.zeros(mi.SurfaceInteraction3f, dr.width(index))
        point.p, point.n = (dr.gather(mi.Vector3f, vectors, index) for vectors in (self.position, self.side))
        return _Lanes(
            self.scene,
            point,
            mi.Frame3f(dr.gather(mi.Vector3f, self.normal, index)),
            dr.gather(mi.Vector3f, self.to_viewer, index),
            dr.gather(mi.Bool, self.hit, index),
        )


@dataclass(frozen=True)
class _Lanes:
    """One surface point for each lane."""

    scene: Any
    point: Any
    frame: Any
    to_viewer: Any
    hit: Any

    def unblocked(self, towards: Any) -> Any:
        """Whether a direction above the surface leaves the scene."""
        above = self.hit & (self.frame.to_local(towards).z > 0) & (self.frame.to_local(self.to_viewer).z > 0)
        return above & ~self.scene.ray_test(self.point.spawn_ray(towards), above)


def _by_cell(surface: _Surface, grid: LightGrid, seed: int) -> list[Matrix]:
    """What one direction in each cell adds, for every point: diffuse lobes, then G and W of every node."""
    import drjit as dr

    mi = mitsuba()
    cells, samples = grid.count, min(surface.samples, CELL_SAMPLES)
    share = samples / surface.samples  # of the points that a cell is seen from
    lane = dr.arange(mi.UInt32, surface.pixels * cells * samples)
    cell = (lane // samples) % cells
    turn = (lane % samples) * (surface.samples // samples) + cell % (surface.samples // samples)
    lanes = surface.lanes(lane // (samples * cells) * surface.samples + turn)
    random = mi.PCG32(size=dr.width(lane), initstate=dr.opaque(mi.UInt64, seed))
    towards = grid.direction(cell, random.next_float32(), random.next_float32())
    seen = lanes.unblocked(towards)
    area = dr.gather(mi.Float, mi.Float(grid.solid_angles.astype(np.float32)), cell // grid.columns)
    facing, incident = lanes.frame.to_local(lanes.to_viewer).z, lanes.frame.to_local(towards).z
    half = dr.normalize(lanes.to_viewer + towards)
    normal, angle = lanes.frame.to_local(half).z, dr.dot(half, towards)
    values = [lobe * area / share for lobe in _diffuse_lobes(facing, incident, angle)]
    schlick = (1 - angle) ** 5
    for roughness in NODES:
        density = share * dr.rcp(area) + BSDF_SAMPLES * _density(roughness, normal, facing)
        gloss = _ggx(roughness, normal, facing, incident) / density
        values += [gloss, gloss * schlick]
    values = [dr.select(seen, value, 0) for value in values]
    dr.eval(values)
    sums = [np.array(dr.block_sum(value, samples)).reshape(surface.pixels, cells) for value in values]
    return [total / surface.samples for total in sums]


def _by_lobe(surface: _Surface, grid: LightGrid, roughness: float, seed: int) -> list[Matrix]:
    """What directions drawn from the GGX lobe of one roughness add: to G and to W."""
    import drjit as dr

    mi = mitsuba()
    lane = dr.arange(mi.UInt32, surface.pixels * surface.samples * BSDF_SAMPLES)
    index = lane // BSDF_SAMPLES
    lanes = surface.lanes(index)
    random = mi.PCG32(size=dr.width(lane), initstate=dr.opaque(mi.UInt64, seed))
    viewer = lanes.frame.to_local(lanes.to_viewer)
    normals = mi.MicrofacetDistribution(mi.MicrofacetType.GGX, mi.Float(dr.opaque(mi.Float, roughness**2)), True)
    half, _ = normals.sample(viewer, mi.Point2f(random.next_float32(), random.next_float32()))
    local = mi.reflect(viewer, half)
    towards = lanes.frame.to_world(local)
    seen = lanes.unblocked(towards)
    cell = grid.cell_of(towards)
    area = dr.gather(mi.Float, mi.Float(grid.solid_angles.astype(np.float32)), cell // grid.columns)
    alpha = dr.opaque(mi.Float, roughness)
    share = min(surface.samples, CELL_SAMPLES) / surface.samples
    weight = share * dr.rcp(area) + BSDF_SAMPLES * _density(alpha, half.z, viewer.z)
    gloss = dr.select(seen, _ggx(alpha, half.z, viewer.z, local.z) / weight, 0) / surface.samples
    entry = index // surface.samples * grid.count + cell
    parts = []
    for value in (gloss, gloss * (1 - dr.dot(half, local)) ** 5):
        total = dr.zeros(mi.Float, surface.pixels * grid.count)
        dr.scatter_reduce(dr.ReduceOp.Add, total, value, entry, seen)
        parts.append(np.array(total).reshape(surface.pixels, grid.count))
    return parts


def _diffuse_lobes(facing: Any, incident: Any, angle: Any) -> tuple[Any, Any, Any]:
    """Disney's diffuse lobe times the cosine, as coefficients of 1, r and r^2; see `unirender_reference.principled`."""
    import drjit as dr

    viewer, light = (1 - facing) ** 5, (1 - incident) ** 5
    retro = 2 * angle**2
    lambert = (1 - 0.5 * viewer) * (1 - 0.5 * light)
    cosine = incident / dr.pi
    return cosine * lambert, cosine * retro * (viewer + light - viewer * light), cosine * retro**2 * viewer * light


def _ggx(roughness: Any, normal: Any, facing: Any, incident: Any) -> Any:
    """D G1 G1 / (4 cos), the specular lobe of reflectance 1 times the cosine."""
    return (
        _distribution(roughness, normal)
        * _shadowing(roughness, facing)
        * _shadowing(roughness, incident)
        / (4 * facing)
    )


def _density(roughness: Any, normal: Any, facing: Any) -> Any:
    """Probability density of directions reflected at visible normals."""
    return _distribution(roughness, normal) * _shadowing(roughness, facing) / (4 * facing)


def _distribution(roughness: Any, normal: Any) -> Any:
    import drjit as dr

    squared = roughness**4
    return squared / (dr.pi * (normal**2 * (squared - 1) + 1) ** 2)


def _shadowing(roughness: Any, cosine: Any) -> Any:
    import drjit as dr

    squared = roughness**4
    return 2 * cosine / (cosine + dr.sqrt(squared + (1 - squared) * cosine**2))
