"""Texture coordinates for any mesh, by xatlas, and meshes without their seams."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from unirender.errors import UnirenderError

SIZE = 256  # texels that the charts are packed for
PADDING = 2  # texels between charts


@dataclass(frozen=True)
class Charts:
    """A mesh cut into charts.

    Attributes:
        source: the vertex of the uncut mesh that each vertex is a copy of.
        faces: the faces of the uncut mesh, in their order, with the new vertices.
        uv: (n, 2) in [0, 1], v from the first row of a texture.
    """

    source: Int[np.ndarray, " n"]
    faces: Int[np.ndarray, "m 3"]
    uv: Float[np.ndarray, "n 2"]


def unwrap(vertices: Float[np.ndarray, "n 3"], faces: Int[np.ndarray, "m 3"], size: int = SIZE) -> Charts:
    """Charts of a mesh, packed into the unit square with `PADDING` texels of a texture of `size` between them.

    Vertices on seams are doubled: `vertices[charts.source]`, `charts.faces` and `charts.uv` make the cut mesh.

    Raises:
        UnirenderError: xatlas cannot cut the mesh (broken coordinates, no area).
    """
    import xatlas

    if not np.isfinite(vertices).all():
        raise UnirenderError("charts: the mesh has infinite or NaN vertices, expected finite ones")
    atlas = xatlas.Atlas()
    try:
        atlas.add_mesh(np.ascontiguousarray(vertices, np.float32), np.ascontiguousarray(faces, np.uint32))
        charting, packing = xatlas.ChartOptions(), xatlas.PackOptions()
        packing.resolution, packing.padding = size, PADDING
        charting.max_iterations = 2
        atlas.generate(charting, packing)
        source, cut, uv = atlas[0]
    except RuntimeError as error:
        raise UnirenderError(
            f"charts: xatlas refused the mesh ({error}); expected a triangle mesh with area"
        ) from error
    uv = np.clip(uv, 0, 1).astype(np.float32)
    return Charts(source.astype(np.int64), cut.astype(np.int32), uv)


def welded(
    vertices: Float[np.ndarray, "n 3"], faces: Int[np.ndarray, "m 3"]
) -> tuple[Float[np.ndarray, "k 3"], Int[np.ndarray, "m 3"], Int[np.ndarray, " n"]]:
    """The mesh with one vertex for each place, and which of them each given vertex is."""
    points, index = np.unique(vertices, axis=0, return_inverse=True)
    index = index.reshape(-1)
    return points, index[faces].astype(np.int32), index
