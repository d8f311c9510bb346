"""The outlines of a mesh in all views, and how the coverage of the pixels changes with the vertices.

The coverage C of a pixel is the share of it that the object covers. It changes where the outline crosses the pixel:
with the outline's points p (pixel coordinates), outward normal n and length s

    dC / d(vertex) = integral over the outline inside the pixel of n . dp/d(vertex) ds,

the boundary term that Mitsuba's projective integrators estimate for one camera at a time. Here all cameras share one
launch of rays: edges between a front and a back face are sampled, and those samples count whose neighbours just
outside see nothing. The derivative is an explicit sparse matrix, which `fit` solves with.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import coo_array, csr_array

from unirender_reference.optimize.shape.cameras import Cameras
from unirender_reference.optimize.shape.topology import face_vectors, mesh_edges
from unirender_reference.optimize.shape.tracer import MeshTracer

EDGE_SAMPLES = 3  # along each edge of the outline, about a pixel long
ASIDE = 0.02  # pixels from the outline to the ray that has to see nothing


@dataclass(frozen=True)
class Outline:
    """Samples of the outlines of all views.

    Attributes:
        pixel: flat index (view, row, column) of each sample.
        edge: (s, 2) the vertices between which it lies.
        at: its place between them, [0, 1].
        derivative: (s, 3) of the pixel's coverage, if the sample's point of the mesh moves.
    """

    pixel: Int[np.ndarray, " s"]
    edge: Int[np.ndarray, "s 2"]
    at: Float[np.ndarray, " s"]
    derivative: Float[np.ndarray, "s 3"]

    def matrix(self, pixels: int, vertices: int) -> csr_array:
        """dC / d(vertices): (pixels, 3 vertices), coordinates of a vertex consecutive."""
        share = np.stack([1 - self.at, self.at], axis=1)
        values = share[:, :, None] * self.derivative[:, None, :]
        column = self.edge[:, :, None] * 3 + np.arange(3)
        row = np.broadcast_to(self.pixel[:, None, None], values.shape)
        return coo_array((values.ravel(), (row.ravel(), column.ravel())), shape=(pixels, 3 * vertices)).tocsr()


def outline(
    vertices: Float[np.ndarray, "n 3"],
    faces: Int[np.ndarray, "m 3"],
    cameras: Cameras,
    tracer: MeshTracer,
    samples: int = EDGE_SAMPLES,
) -> Outline:
    """The visible outlines of a mesh against the background, in all views.

    Args:
        vertices: world positions.
        faces: counter-clockwise seen from outside.
        cameras: of all views.
        tracer: of this mesh.
        samples: along each edge of the outline; each counts for the pixel that it lies in.
    """
    edges, sides = mesh_edges(faces)
    normals, anchor = face_vectors(vertices, faces), vertices[faces[:, 0]]
    facing = cameras.center @ normals.T > np.einsum("mi,mi->m", anchor, normals)  # (views, faces)
    first, second = facing[:, sides[:, 0]], facing[:, sides[:, 1]]
    view, edge = np.nonzero(first != second)
    front = np.where(first[view, edge], sides[edge, 0], sides[edge, 1])
    ends = edges[edge]
    opposite = faces[front].sum(1) - ends.sum(1)
    a, b, c = (cameras.project(vertices[index], view) for index in (ends[:, 0], ends[:, 1], opposite))
    length = np.linalg.norm(b - a, axis=1)
    normal = np.stack([b[:, 1] - a[:, 1], a[:, 0] - b[:, 0]], axis=1) / np.maximum(length, 1e-12)[:, None]
    normal *= -np.sign(np.einsum("ni,ni->n", normal, c - a))[:, None]

    at = np.tile((np.arange(samples) + 0.5) / samples, len(view))
    view, ends, length, normal = (np.repeat(x, samples, axis=0) for x in (view, ends, length, normal))
    points = vertices[ends[:, 0]] * (1 - at)[:, None] + vertices[ends[:, 1]] * at[:, None]
    pixels = cameras.project(points, view)
    seen = ~tracer.meets(cameras.center[view], cameras.rays(pixels + ASIDE * normal, view))
    column, row = np.floor(pixels).astype(np.int64).T
    seen &= (column >= 0) & (column < cameras.width) & (row >= 0) & (row < cameras.height)
    moved = np.einsum("ni,nij->nj", normal, cameras.jacobian(points, view))
    derivative = moved * (length / samples)[:, None]
    index = (view * cameras.height + row) * cameras.width + column
    return Outline(index[seen], ends[seen], at[seen], derivative[seen])
