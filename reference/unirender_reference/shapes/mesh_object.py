"""The one shape that the reference renders: a triangle mesh in a unit sphere with its base colour.

Convention of the textures: `uv` lies in [0, 1]^2, u runs along the columns and v along the rows of a texture *from its
first row*, texel (i, j) has its centre at ((j + 0.5) / w, (i + 0.5) / h). (This is how Mitsuba's `bitmap` reads `uv`;
glTF stores it like this too, OBJ upside down.) All textures of an object share its `uv`; their sizes may differ.
"""

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float, Int

from unirender.errors import UnirenderError
from unirender.shown import short_repr

UNIT_TOLERANCE = 1e-3
CONVERT = "repair what is not finite, and convert it by .astype(np.float32)"
NEEDED = ("vertices", "faces", "normals", "albedo")
RECONSTRUCTION = "reconstruction"  # the family of meshes made from pictures, in the world of their cameras
RECONSTRUCTION_TOLERANCE = 0.3  # of their radius: the object's size was guessed from masks before its shape was known


@dataclass(frozen=True)
class MeshObject:
    """A mesh whose bounding sphere is centred at the origin with radius 1 (about 1, for a `RECONSTRUCTION`).

    Attributes:
        name: without dots (dataset keys are cut at the first dot).
        family: the generator family, "mesh" for a loaded file, or `RECONSTRUCTION`.
        vertices: (n, 3) float32.
        faces: (m, 3) int32, counter-clockwise seen from outside.
        normals: (n, 3) float32 unit shading normals.
        uv: (n, 2) float32 or None when `albedo` is one colour.
        albedo: (3,) or (h, w, 3) float32, linear Rec.709 in [0, 1].
        roughness: (h, w) float32, perceptual, [0, 1]; None: the object has no roughness of its own, scenes give it.
        metallic: (h, w) float32, [0, 1]; None as for roughness.
        normal_map: (h, w, 3) float32 unit vectors in tangent space, or None: x along +u, y against +v (up in the
            picture, as glTF and OpenGL have it), z along the shading normal. The renderer sees to charts that lie
            mirrored on the surface (u x v pointing outwards): loaders leave their texels as they are.
        provenance: how the object was made, as text.
    """

    name: str
    family: str
    vertices: Float[np.ndarray, "n 3"]
    faces: Int[np.ndarray, "m 3"]
    normals: Float[np.ndarray, "n 3"]
    uv: Float[np.ndarray, "n 2"] | None
    albedo: Float[np.ndarray, "3"] | Float[np.ndarray, "h w 3"]
    roughness: Float[np.ndarray, "hr wr"] | None = None
    metallic: Float[np.ndarray, "hm wm"] | None = None
    normal_map: Float[np.ndarray, "hn wn 3"] | None = None
    provenance: Mapping[str, str] = field(default_factory=dict, repr=False)

    __repr__ = short_repr

    def __post_init__(self) -> None:
        self._check_types()
        self._check_arrays()
        self._check_albedo()
        self._check_maps()
        self._check_lengths()

    def _check_types(self) -> None:
        if not isinstance(self.name, str):
            raise UnirenderError(f"object name: got {self.name!r:.40}, expected a text")
        for label in ("vertices", "faces", "normals", "uv", "albedo", "roughness", "metallic", "normal_map"):
            array = getattr(self, label)
            if not isinstance(array, np.ndarray) and (array is not None or label in NEEDED):
                raise UnirenderError(f"{self.name}: got {label} {array!r:.40}, expected a numpy array; convert it")
        if "." in self.name or "/" in self.name:
            raise UnirenderError(f"object name: got {self.name!r}, expected no '.' and no '/'; rename the object")

    def _check_arrays(self) -> None:
        """Vertices, normals, texture coordinates and faces: their shapes and what they index."""
        n = len(self.vertices)
        for label, array, shape in (
            ("vertices", self.vertices, (n, 3)),
            ("normals", self.normals, (n, 3)),
            ("uv", self.uv, (n, 2)),
        ):
            if array is None:
                continue
            if array.shape != shape or array.dtype != np.float32 or not np.isfinite(array).all():
                raise UnirenderError(
                    f"{self.name}: {label} must be finite float32 of shape {shape}, got {array.dtype} {array.shape}; "
                    f"{CONVERT}"
                )
        if self.faces.ndim != 2 or self.faces.shape[1:] != (3,) or self.faces.dtype != np.int32 or not len(self.faces):
            raise UnirenderError(
                f"{self.name}: faces must be int32 (m, 3) with m > 0, got {self.faces.dtype} {self.faces.shape}; "
                "split polygons, and convert them by .astype(np.int32)"
            )
        if self.faces.min() < 0 or self.faces.max() >= n:
            raise UnirenderError(f"{self.name}: faces index outside the {n} vertices; the mesh is broken")

    def _check_albedo(self) -> None:
        if self.albedo.shape != (3,) and (self.albedo.ndim != 3 or self.albedo.shape[2] != 3 or self.uv is None):
            raise UnirenderError(
                f"{self.name}: albedo must be (3,), or (h, w, 3) with uv; got {self.albedo.shape}, "
                f"uv {'absent' if self.uv is None else 'present'}"
            )
        if self.albedo.dtype != np.float32 or not (self.albedo.min() >= 0 and self.albedo.max() <= 1):
            raise UnirenderError(
                f"{self.name}: albedo must be float32, linear, within [0, 1], got {self.albedo.dtype} in "
                f"[{self.albedo.min():.4g}, {self.albedo.max():.4g}]; divide 8-bit values by 255 and decode them "
                "(unirender.color.srgb_decode)"
            )

    def _check_maps(self) -> None:
        """Roughness, metallic and normal map, where there are any."""
        for label, texture in (("roughness", self.roughness), ("metallic", self.metallic)):
            if texture is not None:
                self._check_texture(label, texture, 2)
                if not (texture.min() >= 0 and texture.max() <= 1):
                    raise UnirenderError(
                        f"{self.name}: {label} must lie within [0, 1], got "
                        f"[{texture.min():.4g}, {texture.max():.4g}]; divide 8-bit values by 255"
                    )
        if self.normal_map is not None:
            self._check_texture("normal_map", self.normal_map, 3)
            if np.abs(np.linalg.norm(self.normal_map, axis=-1) - 1).max() > UNIT_TOLERANCE:
                raise UnirenderError(f"{self.name}: normal_map must hold unit vectors; normalise it")

    def _check_lengths(self) -> None:
        """Normals are unit vectors, and the vertices lie in the unit sphere and touch it."""
        length = np.linalg.norm(self.normals, axis=1)
        if np.abs(length - 1).max() > UNIT_TOLERANCE:
            raise UnirenderError(
                f"{self.name}: normals must be unit vectors, got lengths from {length.min():.4f} to "
                f"{length.max():.4f}; divide them by these"
            )
        radius = float(np.linalg.norm(self.vertices, axis=1).max())
        tolerance = RECONSTRUCTION_TOLERANCE if self.family == RECONSTRUCTION else UNIT_TOLERANCE
        if abs(radius - 1) > tolerance:
            raise UnirenderError(
                f"{self.name}: bounding sphere must have radius 1, got {radius:.4f}; "
                "move the vertices there (unirender_reference.shapes.bounding_sphere(vertices).to_unit(vertices))"
            )

    def _check_texture(self, label: str, texture: np.ndarray, dimensions: int) -> None:
        """A texture of the right type, on an object that has texture coordinates."""
        finite = texture.dtype == np.float32 and texture.ndim == dimensions and np.isfinite(texture).all()
        if not finite or texture.size == 0 or (dimensions == 3 and texture.shape[2] != 3) or self.uv is None:
            size = "(h, w, 3)" if dimensions == 3 else "(h, w)"
            raise UnirenderError(
                f"{self.name}: {label} must be finite float32 {size} with uv, got {texture.dtype} {texture.shape}, "
                f"uv {'absent' if self.uv is None else 'present'}; {CONVERT}"
            )

    def without_maps(self) -> "MeshObject":
        """The object without roughness, metallic and normal maps; base colour and texture coordinates stay."""
        return dataclasses.replace(self, roughness=None, metallic=None, normal_map=None)

    def turned(self, rotation: Float[np.ndarray, "3 3"]) -> "MeshObject":
        """The object turned about the origin; its bounding sphere stays.

        Args:
            rotation: p -> rotation @ p, of determinant 1.

        Raises:
            UnirenderError: the matrix is no rotation.
        """
        rotation = np.asarray(rotation)
        unmoved = rotation @ rotation.T if rotation.shape == (3, 3) else np.zeros((3, 3))
        if not np.allclose(unmoved, np.eye(3), atol=1e-6) or np.linalg.det(rotation) < 0:
            raise UnirenderError(
                f"{self.name}: got {rotation.tolist()}, expected the matrix of a rotation, 3 x 3, no mirror image"
            )

        def turn(vectors: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
            return (vectors.astype(np.float64) @ rotation.T).astype(np.float32)

        return dataclasses.replace(self, vertices=turn(self.vertices), normals=turn(self.normals))


def signed_volume(vertices: Float[np.ndarray, "n 3"], faces: Int[np.ndarray, "m 3"]) -> float:
    """Volume enclosed by the faces, positive when they are oriented outwards: the sum of the tetrahedra between the
    origin and each face (divergence theorem); exact for a closed mesh."""
    a, b, c = np.moveaxis(vertices[faces].astype(np.float64), 1, 0)
    return float(np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6)


@dataclass(frozen=True)
class Sphere:
    """Where an object stands in its own units: points p of the world lie at (p - center) / radius in the unit sphere.

    Attributes:
        center: (3,) float64.
        radius: more than 0.
    """

    center: Float[np.ndarray, "3"]
    radius: float

    def to_unit(self, points: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3"]:
        """Points of the world in the unit sphere's coordinates (float64)."""
        return (points - self.center) / self.radius


def bounding_sphere(vertices: Float[np.ndarray, "n 3"]) -> Sphere:
    """A sphere around points.

    The centre is found with Badoiu and Clarkson's farthest-point steps (within 1 % of the smallest sphere after 100);
    the radius is then exact for that centre.

    Raises:
        UnirenderError: there are none, they have no extent, or are not finite.
    """
    points = vertices.astype(np.float64)
    if not points.size or not np.isfinite(points).all():
        raise UnirenderError(f"mesh: got {len(points)} vertices, expected some, all of them finite; repair the mesh")
    center = (points.min(0) + points.max(0)) / 2
    for step in range(100):
        offset = points - center
        center = center + offset[np.argmax(np.einsum("ij,ij->i", offset, offset))] / (step + 2)
    radius = float(np.linalg.norm(points - center, axis=1).max())
    if not radius > 1e-12:
        raise UnirenderError(f"mesh has zero extent: its {len(vertices)} vertices are one point; give another mesh")
    return Sphere(center, radius)


def unit_sphere(vertices: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """Moves and scales points so that their bounding sphere has radius 1 about the origin.

    Raises:
        UnirenderError: the points have no extent.
    """
    return bounding_sphere(vertices).to_unit(vertices).astype(np.float32)
