"""Normals that a silhouette suggests: the mask, inflated like a balloon.

The square of the height h solves Poisson's equation under an even pressure inside the mask, -laplace(h^2) = 4 with
h = 0 on its border (Twarog, Tappen and Adelson, "Playing with Puffball", 2012, describe the family). A disc becomes a
hemisphere: the Laplacian of h^2 = R^2 - x^2 - y^2 is -4. Normals follow from h^2 alone, n ~ (-grad(h^2) / 2, h), so
that they are perpendicular to the view axis along the silhouette.
"""

import numpy as np
from jaxtyping import Bool, Float

from unirender.camera import Camera
from unirender.errors import UnirenderError

INSIDE = 0.5  # coverage from which a pixel counts as the object's


def silhouette_normals(mask: Float[np.ndarray, "h w 1"], camera: Camera) -> Float[np.ndarray, "h w 3"]:
    """Unit normals in camera axes for every covered pixel, 0 elsewhere; parts that stand apart are inflated alone.

    The height is that above the plane through the object's silhouette, perpendicular to the ray through the middle of
    the mask; pixels covered by less than half take the normal of their nearest neighbours inside.

    Raises:
        UnirenderError: the mask covers no pixel by half or more.
    """
    import scipy.sparse as sparse
    from scipy.sparse.linalg import spsolve

    inside = mask[..., 0] >= INSIDE
    if not inside.any():
        raise UnirenderError(
            f"mask: covers no pixel by {INSIDE:.0%} or more, expected the object's silhouette; give its mask"
        )
    padded = np.pad(inside, 1)
    index = np.full(padded.shape, -1)
    index[padded] = np.arange(padded.sum())
    count = int(padded.sum())
    rows, columns = np.nonzero(padded)
    terms = [sparse.diags_array(np.full(count, 4.0))]
    for down, right in ((0, 1), (0, -1), (1, 0), (-1, 0)):
        other = index[rows + down, columns + right]
        near = other >= 0
        ones = np.ones(int(near.sum()))
        terms.append(-sparse.coo_array((ones, (np.flatnonzero(near), other[near])), shape=(count, count)))
    squared = np.zeros(padded.shape)
    squared[padded] = np.asarray(spsolve(sparse.csc_array(sum(terms)), np.full(count, 4.0)))
    slope_down, slope_right = np.gradient(squared)
    height = np.sqrt(np.maximum(squared, 0))
    flat = np.stack([-slope_right / 2, slope_down / 2, height], axis=-1)[1:-1, 1:-1]
    flat = flat[nearest(inside)]
    flat /= np.maximum(np.linalg.norm(flat, axis=-1, keepdims=True), 1e-9)
    turned = flat @ _towards(_middle(inside, camera)).T
    return np.where(mask > 0, turned, 0).astype(np.float32)


def nearest(known: Bool[np.ndarray, "h w"]) -> tuple[np.ndarray, np.ndarray]:
    """For each pixel row and column of the nearest known one."""
    import scipy.ndimage as ndimage

    found = np.asarray(ndimage.distance_transform_edt(~known, return_distances=False, return_indices=True))
    return found[0], found[1]


def _middle(inside: Bool[np.ndarray, "h w"], camera: Camera) -> Float[np.ndarray, " 3"]:
    """Unit direction to the viewer along the ray through the middle of the mask."""
    middle = camera.view_directions(*inside.shape)[inside].mean(axis=0)
    return middle / np.linalg.norm(middle)


def _towards(axis: Float[np.ndarray, " 3"]) -> Float[np.ndarray, "3 3"]:
    """The smallest rotation that takes +z to `axis`."""
    x, y, z = (float(value) for value in axis)
    return np.array(
        [[1 - x * x / (1 + z), -x * y / (1 + z), x], [-x * y / (1 + z), 1 - y * y / (1 + z), y], [-x, -y, z]]
    )
