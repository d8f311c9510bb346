"""Derivative of smooth vertex normals by the vertices, as a sparse matrix."""

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import coo_array, csr_array

from unirender_reference.optimize.shape.topology import face_vectors


def normal_matrix(vertices: Float[np.ndarray, "n 3"], faces: Int[np.ndarray, "m 3"]) -> csr_array:
    """d(unit area-weighted vertex normals) / d(vertices): (3n, 3n), coordinates of a vertex consecutive.

    With a face's vector A = (b - a) x (c - a), dA/da = [c - b]x and so on around; a vertex adds up the vectors of its
    faces, N, and dn = (1 - n n^T) dN / |N|.
    """
    count = len(vertices)
    opposite = np.stack([vertices[faces[:, (k + 2) % 3]] - vertices[faces[:, (k + 1) % 3]] for k in range(3)], axis=1)
    turn = np.zeros((*opposite.shape[:2], 3, 3))  # the cross product with it, as a matrix
    x, y, z = np.moveaxis(opposite, -1, 0)
    turn[..., 0, 1], turn[..., 0, 2], turn[..., 1, 2] = -z, y, -x
    turn -= np.swapaxes(turn, -1, -2)
    total = np.stack(
        [np.bincount(faces.ravel(), np.repeat(face_vectors(vertices, faces)[:, k], 3), count) for k in range(3)], 1
    )
    length = np.maximum(np.linalg.norm(total, axis=1), 1e-12)
    normal = total / length[:, None]
    across = (np.eye(3) - normal[:, :, None] * normal[:, None]) / length[:, None, None]
    blocks = across[faces][:, :, None] @ turn[:, None]  # (faces, corner that turns, corner that moves, 3, 3)
    row = faces[:, :, None, None, None] * 3 + np.arange(3)[:, None]
    column = faces[:, None, :, None, None] * 3 + np.arange(3)
    indices = [np.broadcast_to(index, blocks.shape).ravel() for index in (row, column)]
    return coo_array((blocks.ravel(), indices), shape=(3 * count,) * 2).tocsr()
