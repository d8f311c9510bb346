"""What meshes are made of: neighbours, edges, normals, pieces without seams."""

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import coo_array, csr_array


def neighbours(count: int, faces: Int[np.ndarray, "m 3"]) -> csr_array:
    """Sparse (count, count): the mean over the vertices that share an edge with a vertex."""
    i, j = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2).T
    link = coo_array((np.ones(2 * len(i)), (np.r_[i, j], np.r_[j, i])), shape=(count, count)).tocsr()
    link.data[:] = 1
    degree = np.maximum(np.asarray(link.sum(1)).ravel(), 1)
    link.data /= np.repeat(degree, np.diff(link.indptr))
    return link


def face_vectors(vertices: Float[np.ndarray, "n 3"], faces: Int[np.ndarray, "m 3"]) -> Float[np.ndarray, "m 3"]:
    """Outward normals of the faces, as long as twice their area."""
    a, b, c = np.moveaxis(vertices[faces], 1, 0)
    return np.cross(b - a, c - a)


def vertex_normals(vertices: Float[np.ndarray, "n 3"], faces: Int[np.ndarray, "m 3"]) -> Float[np.ndarray, "n 3"]:
    """Unit normals: the area-weighted mean over the faces of a vertex."""
    across = face_vectors(vertices, faces)
    total = np.stack([np.bincount(faces.ravel(), np.repeat(across[:, k], 3), len(vertices)) for k in range(3)], axis=1)
    length = np.linalg.norm(total, axis=1, keepdims=True)
    return np.where(length > 1e-20, total / np.maximum(length, 1e-20), [0.0, 0.0, 1.0])


def mesh_edges(faces: Int[np.ndarray, "m 3"]) -> tuple[Int[np.ndarray, "e 2"], Int[np.ndarray, "e 2"]]:
    """Edges that two faces share: their vertices and their faces."""
    sides = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1).astype(np.int64)
    order = np.lexsort((sides[:, 1], sides[:, 0]))
    same = (sides[order[1:]] == sides[order[:-1]]).all(1)
    first, second = order[1:][same], order[:-1][same]
    return sides[first], np.stack([first // 3, second // 3], axis=1)
