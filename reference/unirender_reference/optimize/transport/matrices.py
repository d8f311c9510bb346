r"""Direct light as matrices: how much each column of the light adds to each pixel, for every lobe and roughness.

The radiance of a pixel under a light whose columns (cells or texels, `light_basis`) have radiance E_j is

    I = sum_j [ (1-m) b D_j + (1-m) F_j + m (b G_j + (1-b) W_j) ] E_j          b: base colour, m: metallic

    D_j = D0_j + r D1_j + r^2 D2_j     Disney's diffuse lobe, a polynomial in the roughness r
    G_j(r), W_j(r)                     GGX with reflectance 1, and with Schlick's weight (1 - cos)^5
    F_j = F0 G_j + (1 - F0) W_j        the dielectric Fresnel term as Schlick approximates it, F0 = 0.04

Each entry is an integral over the light of lobe x cosine x visibility, averaged over the pixel's points. It is
estimated with two kinds of samples under the balance heuristic: up to `CELL_SAMPLES` directions in each cell of the
sphere for a pixel, in turn from its points, and `LOBE_SAMPLES` of the GGX lobe's visible normals, as many from every
point, so that narrow lobes are sharp and wide ones smooth. Visibility is Mitsuba's. What the matrices leave out
(interreflection, the exact Fresnel term, what is smaller than a column) is what a path-traced image corrects.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from unirender_reference.arrays import aligned, components
from unirender_reference.backend import mitsuba
from unirender_reference.optimize.surface.points import SurfacePoints
from unirender_reference.optimize.transport.bsdf_lobes import diffuse_lobes, gloss_lobe, schlick, visible_density
from unirender_reference.optimize.transport.light_basis import Cells, LightBasis, Texels
from unirender_reference.optimize.transport.light_grid import LightGrid
from unirender_reference.optimize.transport.roughness_nodes import NODES
from unirender_reference.passes import derive_seed
from unirender_reference.samplers import stratified_sampler

CELL_SAMPLES = 4  # directions in each cell for a pixel, at most
LOBE_SAMPLES = 64  # directions of the GGX lobe for a pixel and each roughness node
LANES = 1 << 22

Matrix = Float[np.ndarray, "n j"]


@dataclass(frozen=True)
class Transport:
    """The matrices of N pixels and J columns of the light, coverage included.

    Attributes:
        grid: of the columns.
        white: a white Lambertian, cosine / pi.
        diffuse: D0, D1, D2.
        gloss: G at each of `NODES`.
        schlick: W at each of `NODES`.
    """

    grid: LightGrid
    white: Matrix
    diffuse: tuple[Matrix, ...]
    gloss: tuple[Matrix, ...]
    schlick: tuple[Matrix, ...]

    def coarse(self) -> "Transport":
        """For a light of blocks of 2 x 2 columns with one radiance: half the rows, half the columns."""
        rows, columns = self.grid.rows, self.grid.columns

        def merged(matrix: Matrix) -> Float[np.ndarray, "n j4"]:
            return matrix.reshape(len(matrix), rows // 2, 2, columns // 2, 2).sum(axis=(2, 4)).reshape(len(matrix), -1)

        return Transport(
            LightGrid(rows // 2, columns // 2),
            merged(self.white),
            *(tuple(merged(matrix) for matrix in part) for part in (self.diffuse, self.gloss, self.schlick)),
        )


def refined(cells: Float[np.ndarray, "j 3"], grid: LightGrid) -> Float[np.ndarray, "j4 3"]:
    """The light of a `coarse` grid on the grid of twice its rows and columns."""
    light = cells.reshape(grid.rows, grid.columns, 3)
    return light.repeat(2, axis=0).repeat(2, axis=1).reshape(-1, 3)


def light_transport(
    scene: Any,
    points: SurfacePoints,
    grid: LightGrid,
    seed: int,
    coverage: Float[np.ndarray, " n"] | None = None,
    bilinear: bool = False,
    cell_samples: int = CELL_SAMPLES,
) -> Transport:
    """The matrices of surface points.

    Args:
        scene: what blocks light (`surface.points.blocker`); None: nothing does.
        points: a square number of them in each pixel, at most `LOBE_SAMPLES`.
        grid: of the columns.
        seed: equal seeds draw equal directions.
        coverage: of the pixels, where it is known better than from the points' own hits: a row is the mean over the
            points that hit, times it.
        bilinear: the light is Mitsuba's `envmap` of the grid (`Texels`); else constant in each cell (`Cells`).
        cell_samples: directions in each cell of the sphere for a pixel, at most.
    """
    basis = Texels(grid) if bilinear else Cells(grid)
    matrices = [np.zeros((len(points), grid.count), np.float32) for _ in range(4 + 2 * len(NODES))]
    samples = points.hit.shape[1]
    for rows in _parts(len(points), min(samples, cell_samples) * basis.count):
        surface = _Surface(scene, points, rows, cell_samples)
        own = derive_seed(seed, "cells", rows.start)
        for matrix, part in zip(matrices, _by_cell(surface, basis, own), strict=True):
            matrix[rows] = part
    for rows in _parts(len(points), LOBE_SAMPLES):
        surface = _Surface(scene, points, rows, cell_samples)
        for node, roughness in enumerate(NODES):
            own = derive_seed(seed, "lobes", rows.start, node)
            gloss, schlick_weighted = _by_lobe(surface, basis, grid, roughness, own)
            matrices[4 + 2 * node][rows] += gloss
            matrices[5 + 2 * node][rows] += schlick_weighted
    if coverage is not None:
        for matrix in matrices:
            matrix *= (coverage / points.coverage)[:, None]
    return Transport(grid, matrices[0], tuple(matrices[1:4]), tuple(matrices[4::2]), tuple(matrices[5::2]))


def _parts(count: int, lanes: int) -> Iterator[slice]:
    """Pixels that fit into one launch, of `lanes` each."""
    step = max(1, LANES // lanes)
    return (slice(start, min(start + step, count)) for start in range(0, count, step))


class _Surface:
    """Some pixels' points on the device."""

    def __init__(self, scene: Any, points: SurfacePoints, rows: slice, cell_samples: int) -> None:
        mi = mitsuba()

        def vectors(array: Float[np.ndarray, "n s 3"]) -> Any:
            return mi.Vector3f(*components(array[rows].reshape(-1, 3)))

        self.scene = scene
        self.hit = mi.Bool(aligned(points.hit[rows].ravel()))
        self.position, self.normal = vectors(points.position), vectors(points.normal)
        self.side, self.to_viewer = vectors(points.side), vectors(points.to_viewer)
        self.samples = points.hit.shape[1]
        self.pixels = len(points.view[rows])
        self.cell_samples = min(self.samples, cell_samples)
        self.share = self.cell_samples / self.samples  # of the points that a cell is seen from
        self.lobe_samples = LOBE_SAMPLES // self.samples

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

    def weight(self, basis: LightBasis, cell: Any, density: Any) -> Any:
        """The balance heuristic's 1 / (sum of densities) for a point, `density` being that of the lobe's samples."""
        import drjit as dr

        return dr.rcp(self.share * dr.rcp(basis.solid_angle(cell)) + self.lobe_samples * density)


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
        return above if self.scene is None else above & ~self.scene.ray_test(self.point.spawn_ray(towards), above)


def _by_cell(surface: _Surface, basis: LightBasis, seed: int) -> Iterator[Matrix]:
    """What one direction in each cell adds, for every point: white, diffuse lobes, then G and W of every node."""
    import drjit as dr

    mi = mitsuba()
    cells, samples, turns = basis.count, surface.cell_samples, surface.samples // surface.cell_samples
    lane = dr.arange(mi.UInt32, surface.pixels * cells * samples)
    cell = (lane // samples) % cells
    turn = (lane % samples) * turns + cell % turns
    lanes = surface.lanes(lane // (samples * cells) * surface.samples + turn)
    random = mi.PCG32(size=dr.width(lane), initstate=dr.opaque(mi.UInt64, seed))
    towards = basis.direction(cell, random.next_float32(), random.next_float32())
    seen = lanes.unblocked(towards)
    facing, incident = lanes.frame.to_local(lanes.to_viewer).z, lanes.frame.to_local(towards).z
    half = dr.normalize(lanes.to_viewer + towards)
    normal, angle = lanes.frame.to_local(half).z, dr.dot(half, towards)
    area = basis.solid_angle(cell) / surface.share
    values = [lobe * area for lobe in (incident / dr.pi, *diffuse_lobes(facing, incident, angle))]
    for roughness in NODES:
        weight = surface.weight(basis, cell, visible_density(roughness, normal, facing))
        gloss = gloss_lobe(roughness, normal, facing, incident) * weight
        values += [gloss, gloss * schlick(angle)]
    values = [dr.select(seen, value, 0) for value in values]
    dr.eval(values)
    sums = (np.array(dr.block_sum(value, samples)).reshape(surface.pixels, cells) for value in values)
    return (basis.columns(total) / surface.samples for total in sums)


def _by_lobe(surface: _Surface, basis: LightBasis, grid: LightGrid, roughness: float, seed: int) -> list[Matrix]:
    """What directions drawn from the GGX lobe of one roughness add: to G and to W."""
    import drjit as dr

    mi = mitsuba()
    lane = dr.arange(mi.UInt32, surface.pixels * surface.samples * surface.lobe_samples)
    index = lane // surface.lobe_samples
    lanes = surface.lanes(index)
    sampler = stratified_sampler(surface.lobe_samples, dr.width(lane), seed)
    viewer = lanes.frame.to_local(lanes.to_viewer)
    alpha = mi.Float(dr.opaque(mi.Float, roughness**2))
    normals = mi.MicrofacetDistribution(mi.MicrofacetType.GGX, alpha, sample_visible=True)
    half, _ = normals.sample(viewer, sampler.next_2d())
    local = mi.reflect(viewer, half)
    towards = lanes.frame.to_world(local)
    seen = lanes.unblocked(towards)
    own = dr.opaque(mi.Float, roughness)
    weight = surface.weight(basis, basis.cell_of(towards), visible_density(own, half.z, viewer.z))
    gloss = dr.select(seen, gloss_lobe(own, half.z, viewer.z, local.z) * weight, 0) / surface.samples
    pixel = index // surface.samples * grid.count
    shares = basis.shares(towards)
    parts = []
    for value in (gloss, gloss * schlick(dr.dot(half, local))):
        total = dr.zeros(mi.Float, surface.pixels * grid.count)
        for column, share in shares:
            # No copies for each thread, as small arrays have by default: their size would be part of the kernel.
            dr.scatter_reduce(dr.ReduceOp.Add, total, value * share, pixel + column, seen, dr.ReduceMode.Local)
        parts.append(np.array(total).reshape(surface.pixels, grid.count))
    return parts
