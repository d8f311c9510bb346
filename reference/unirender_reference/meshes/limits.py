"""What a model may cost and how large it may be: every bound that `load_mesh` enforces, in one place.

The bounds keep the memory of one load below about 3 GiB, the file included, and are checked by arithmetic before
anything of the claimed size is allocated. (A million faces with vertex colours and three pictures take 1.4 GiB.)
Vertices have no sum of their own: a piece keeps those that its faces use, three times `MAX_FACES` at most.
"""

import numpy as np
from jaxtyping import Float

from unirender.errors import UnirenderError

MAX_FILE_BYTES = 2**30  # a model, a texture file, or all buffers of a model together
MAX_TEXT_BYTES = 2**26  # of JSON or of an MTL
MAX_LINE_BYTES = 2**20  # of an OBJ, continuations included
MAX_FACES = 1_000_000  # of all instances together, after triangulation
MAX_VERTICES = 3 * MAX_FACES  # of one array
MAX_CORNERS = 100_000  # of a concave polygon: to fill it takes a time that grows with their square
MAX_NODES = 100_000
MAX_PIECES = 50_000  # primitives of all instances together
MAX_MATERIALS = 10_000
MAX_IMAGE_PIXELS = 8192**2  # of one image
MAX_IMAGE_SIDE = 65_536
MAX_MODEL_PIXELS = 512_000_000  # of all images of a model together
MAX_TEXTURE = 1024  # larger textures are reduced to this side
MAX_ATLAS_TEXELS = 2048**2  # of all textures of a model together
MAX_REPEATS = 8  # tiles of a repeating texture; beyond, its mean
MIN_EXTENT, MAX_EXTENT = 1e-8, 1e8  # units of the file
MAX_STEP = 1e-3  # distance of neighbouring float32 coordinates, as a share of the extent


def texture_side(textured: int) -> int:
    """Largest side of each texture in pixels, when `textured` materials share the atlas."""
    return min(MAX_TEXTURE, int(np.sqrt(MAX_ATLAS_TEXELS / max(textured, 1))))


def check_bytes(count: int, what: str, limit: int | None = None) -> None:
    """Refuses too many bytes: more than `MAX_FILE_BYTES`, or than another limit."""
    limit = MAX_FILE_BYTES if limit is None else limit
    if count > limit:
        unit, name = (2**30, "GiB") if limit >= 2**30 else (2**20, "MiB")
        raise UnirenderError(
            f"{what} has {count / unit:.2f} {name}, expected at most {limit / unit:.0f} {name}; reduce it"
        )


def check_faces(count: int) -> None:
    """Refuses a mesh of too many faces."""
    if count > MAX_FACES:
        raise UnirenderError(f"has {count:,} faces, expected at most {MAX_FACES:,}; decimate the mesh")


def check_corners(count: int) -> None:
    """Refuses a concave polygon of too many corners."""
    if count > MAX_CORNERS:
        raise UnirenderError(
            f"has a concave polygon of {count:,} corners, expected at most {MAX_CORNERS:,}; export it as triangles"
        )


def check_pieces(count: int) -> None:
    """Refuses a scene of too many primitives."""
    if count > MAX_PIECES:
        raise UnirenderError(f"has more than {MAX_PIECES:,} primitives in all instances; merge its meshes")


def check_materials(count: int) -> None:
    """Refuses a model of too many materials."""
    if count > MAX_MATERIALS:
        raise UnirenderError(f"has more than {MAX_MATERIALS:,} materials, expected fewer; merge them")


def check_geometry(corners: Float[np.ndarray, "m 3 3"], step: float) -> None:
    """Refuses geometry that no scaling makes renderable.

    Args:
        corners: the corner points of all faces.
        step: the distance between neighbouring representable coordinates in the file, in units of the file.

    Raises:
        UnirenderError: NaN or infinite points; no extent, or one outside [`MIN_EXTENT`, `MAX_EXTENT`]; no area;
            coordinates too far from the origin for their precision.
    """
    bad = int((~np.isfinite(corners)).any(-1).sum())
    if bad:
        raise UnirenderError(f"{bad} of {corners.shape[0] * 3} corner points are NaN or infinite; repair the mesh")
    extent = float(np.ptp(corners.reshape(-1, 3), axis=0).max())
    if not extent > 0:
        raise UnirenderError("has zero extent, all its vertices are one point; give another mesh")
    if not MIN_EXTENT <= extent <= MAX_EXTENT:
        raise UnirenderError(
            f"extent {extent:.3g} units, expected {MIN_EXTENT:g} to {MAX_EXTENT:g}: a broken transform? Scale the model"
        )
    a, b, c = np.moveaxis(corners / extent, 1, 0)
    if not np.linalg.norm(np.cross(b - a, c - a), axis=1).max() > 1e-14:
        raise UnirenderError(f"zero area: all {len(corners)} faces are points or lines; give another mesh")
    if step > MAX_STEP * extent:
        raise UnirenderError(
            f"its float32 coordinates are {step:.3g} units apart, for an extent of {extent:.3g} units: precision is "
            "lost so far from the origin; centre the model before it is exported"
        )


def float32_step(points: Float[np.ndarray, "*n 3"]) -> float:
    """Distance between neighbouring float32 numbers at the largest of the coordinates; 0 where there is none."""
    finite = np.abs(points[np.isfinite(points)])
    return float(np.spacing(np.float32(min(finite.max(), 3e38)))) if finite.size else 0.0
