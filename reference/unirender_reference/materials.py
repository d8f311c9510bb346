"""The surfaces of the contract, as Mitsuba plugins.

    principled       the object itself
    mirror           the perfect mirror-tinted reflector that defines s: principled, base_color 1, metallic 1
    white            the white Lambertian that defines d
    diffuse_lobe     principled, base_color 1, metallic 0, no specular lobe
    dielectric_lobe  principled, base_color 0, metallic 0: the specular lobe with its dielectric Fresnel weight
    schlick_lobe     principled, base_color 0, metallic 1: the specular lobe with Schlick's weight (1 - cos)^5

Roughness is perceptual; Mitsuba squares it. A roughness or metallic is a scalar or a texture; both exist from the start
with a value that is not 0, because Mitsuba leaves out lobes whose parameter is 0 when it loads. All surfaces are
wrapped in `twosided`: `principled` is black from behind. A normal map goes around that (`with_normal_map`), so that
the back of a bump is a dent.
"""

import functools
from typing import Any, Literal

import numpy as np
from jaxtyping import Float

from unirender_reference.backend import mitsuba

INNER = "brdf_0"  # what Mitsuba calls the BSDF inside `twosided`

Surface = Literal["principled", "mirror", "white", "diffuse_lobe", "dielectric_lobe", "schlick_lobe"]
Scalar = float | Float[np.ndarray, "_ _"]


def base_color_bitmap(albedo_linear: Float[np.ndarray, "*size 3"]) -> dict[str, Any]:
    """A base-colour texture; `uv` counts rows from the first one (see `shapes.MeshObject`), as Mitsuba does.

    Args:
        albedo_linear: one colour (3,) or a picture (h, w, 3), linear Rec.709 in [0, 1]. One colour becomes a 2 x 2
            picture, so that every object runs the same compiled kernel.
    """
    return _bitmap(np.broadcast_to(albedo_linear, (2, 2, 3)) if albedo_linear.ndim == 1 else albedo_linear)


def scalar_bitmap(texture: Float[np.ndarray, "h w"]) -> dict[str, Any]:
    """A roughness or metallic texture: one channel (of three channels Mitsuba would take the luminance)."""
    return _bitmap(texture[..., None])


def _bitmap(picture: Float[np.ndarray, "h w c"]) -> dict[str, Any]:
    bitmap = mitsuba().Bitmap(np.require(picture, np.float32, ["C", "W"]))  # writable: Mitsuba takes no other
    return {"type": "bitmap", "bitmap": bitmap, "raw": True, "filter_type": "bilinear", "wrap_mode": "repeat"}


def _parameter(value: Scalar) -> float | dict[str, Any]:
    return scalar_bitmap(value) if isinstance(value, np.ndarray) else value


def principled_bsdf(
    albedo_linear: Float[np.ndarray, "*size 3"], roughness: Scalar = 0.5, metallic: Scalar = 0.5
) -> dict[str, Any]:
    """The principled BSDF of the contract (default `specular` 0.5: ior 1.5, F0 0.04)."""
    inner = {
        "type": "principled",
        "base_color": base_color_bitmap(albedo_linear),
        "roughness": _parameter(roughness),
        "metallic": _parameter(metallic),
    }
    return {"type": "twosided", "surface": inner}


def mirror_bsdf(roughness: Scalar = 0.5) -> dict[str, Any]:
    """What s is defined on: principled, base_color 1, metallic 1."""
    return _uniform(1.0, roughness, metallic=1.0)


def white_bsdf() -> dict[str, Any]:
    """What d is defined on: Lambertian, reflectance 1."""
    return {"type": "twosided", "surface": {"type": "diffuse", "reflectance": {"type": "rgb", "value": 1.0}}}


def surface_bsdf(
    surface: Surface, albedo_linear: Float[np.ndarray, "*size 3"], roughness: Scalar = 0.5, metallic: Scalar = 0.5
) -> dict[str, Any]:
    """The plugin of a surface of an object; what the surface does not have is left aside."""
    match surface:
        case "principled":
            return principled_bsdf(albedo_linear, roughness, metallic)
        case "mirror":
            return mirror_bsdf(roughness)
        case "white":
            return white_bsdf()
        case "diffuse_lobe":
            return _uniform(1.0, roughness, metallic=0.0, specular=0.0)
        case "dielectric_lobe":
            return _uniform(0.0, roughness, metallic=0.0)
        case "schlick_lobe":
            return _uniform(0.0, roughness, metallic=1.0)


def surface_parameters(surface: Surface) -> tuple[str, ...]:
    """The parameters of a surface that a scene edits."""
    return {"principled": ("roughness", "metallic"), "white": ()}.get(surface, ("roughness",))


def _uniform(base_color: float, roughness: Scalar, **parameters: float) -> dict[str, Any]:
    color = {"type": "rgb", "value": base_color}
    inner = {"type": "principled", "base_color": color, "roughness": _parameter(roughness), **parameters}
    return {"type": "twosided", "surface": inner}


def with_normal_map(bsdf: Any, normal_texture: Any) -> Any:
    """A loaded surface seen through a normal map (`normal_texture_of`): `normalmap` around `twosided`.

    Inside `twosided` a bump seen from behind would stay a bump. Mitsuba's shadowing function for bump terminators is
    off: the surface is the nested one at the mapped normal, and d stays Lambertian. Where the mapped normal faces away
    from the viewer, Mitsuba turns it by half a turn about the shading normal (`flip_invalid_normals`);
    `mapped_normal` does the same.
    """
    options = {"use_shadowing_function": False, "flip_invalid_normals": True}
    return mitsuba().load_dict({"type": "normalmap", "normalmap": normal_texture, "surface": bsdf, **options})


def normal_texture_of(normal_map: Float[np.ndarray, "h w 3"]) -> Any:
    """A loaded normal texture (x, y, z + 1) / 2 in Mitsuba's tangent frame; `normal_map` as in `shapes.MeshObject`.

    Mitsuba's frame is always right-handed: y is the cross product of the normal and x. Where the picture lies mirrored
    on the surface, y would point along +v; there this texture turns its sign, so that a texel may be shared by a chart
    and its mirror image.
    """
    mi = mitsuba()
    register_handed_normals(mi.variant())
    return mi.load_dict({"type": HANDED, "tangent": _bitmap((np.asarray(normal_map) + 1) / 2)})


HANDED = "unirender_handed_normals"


@functools.cache
def register_handed_normals(variant: str) -> None:
    """Registers the texture plugin `unirender_handed_normals` with the variant."""
    mi = mitsuba(variant)
    import drjit as dr

    class HandedNormals(mi.Texture):
        """A normal map whose y turns its sign where the texture coordinates lie mirrored on the surface."""

        def __init__(self, props: Any) -> None:
            super().__init__(props)
            self.tangent = props["tangent"]

        def eval_3(self, si: Any, active: Any = True) -> Any:
            x, y, z = self.tangent.eval_3(si, active)
            # v runs down the picture: seen from outside, u x v points inwards.
            mirrored = dr.dot(dr.cross(si.dp_du, si.dp_dv), si.sh_frame.n) > 0
            return mi.Color3f(x, dr.select(mirrored, 1 - y, y), z)

        def traverse(self, callback: Any) -> None:
            callback.put("tangent", self.tangent, mi.ParamFlags.Differentiable)

        def to_string(self) -> str:
            return f"HandedNormals[{self.tangent}]"

    mi.register_texture(HANDED, HandedNormals)


def facing_normal(hit: Any) -> Any:
    """The world-space shading normal, towards the viewer: `twosided` goes by the side of the *shading* normal."""
    import drjit as dr

    return dr.select(hit.wi.z < 0, -hit.sh_frame.n, hit.sh_frame.n)


def mapped_normal(hit: Any, normal_texture: Any, active: Any) -> Any:
    """The world-space normal, towards the viewer, at which `with_normal_map` evaluates its surface.

    Args:
        hit: the surface interaction; `hit.wi` in its shading frame.
        normal_texture: of `normal_texture_of`.
        active: lanes to look up.
    """
    mi = mitsuba()
    import drjit as dr

    n = dr.normalize(mi.Vector3f(normal_texture.eval_3(hit, active)) * 2 - 1)
    away = hit.wi.z * dr.dot(n, hit.wi) < 0
    n = dr.select(away, mi.Vector3f(-n.x, -n.y, n.z), n)
    return hit.to_world(dr.select(dr.dot(n, hit.wi) < 0, -n, n))
