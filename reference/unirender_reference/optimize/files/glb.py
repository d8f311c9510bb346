"""A textured object as binary glTF 2.0: one mesh, one material, its pictures inside.

Base colour is stored as sRGB, roughness in G and metallic in B of one linear picture, a normal map as (n + 1) / 2, all
in 8 bits a channel. Texture coordinates count from the first row here and in glTF alike.
"""

import io

import numpy as np
import trimesh
from jaxtyping import UInt8
from PIL import Image
from trimesh.exchange.gltf import export_glb
from trimesh.transformations import scale_and_translate
from trimesh.visual import TextureVisuals
from trimesh.visual.material import PBRMaterial

from unirender.color import eight_bits, srgb_encode
from unirender.errors import UnirenderError
from unirender_reference.meshes.tiles import refined
from unirender_reference.shapes import MeshObject, Sphere


def glb_bytes(obj: MeshObject, place: Sphere | None = None) -> bytes:
    """A GLB file; equal objects give equal bytes.

    Args:
        obj: with roughness and metallic; vertices are stored as they are, in the unit sphere.
        place: where the object stands in its own units: the node that holds the mesh moves it there.

    Raises:
        UnirenderError: the object lacks texture coordinates or a texture.
    """
    pictures = {name: Image.fromarray(pixels) for name, pixels in texture_pixels(obj).items()}
    assert obj.uv is not None  # texture_pixels has looked
    material = PBRMaterial(
        name=obj.name,
        doubleSided=True,
        baseColorTexture=pictures["base_color"],
        metallicRoughnessTexture=pictures["metallic_roughness"],
        normalTexture=pictures.get("normal"),
    )
    visual = TextureVisuals(obj.uv * [1, -1] + [0, 1], material=material)  # trimesh: v from below
    mesh = trimesh.Trimesh(obj.vertices, obj.faces, vertex_normals=obj.normals, visual=visual, process=False)
    scene = trimesh.Scene()
    transform = None if place is None else scale_and_translate(place.radius, place.center)
    scene.add_geometry(mesh, node_name="object", geom_name=obj.name, transform=transform)  # "world" is trimesh's own
    return export_glb(scene, include_normals=True, unitize_normals=False)


def texture_pixels(obj: MeshObject) -> dict[str, UInt8[np.ndarray, "_ _ 3"]]:
    """The pictures of the material: `base_color`, `metallic_roughness` and, where there is one, `normal`.

    Roughness and metallic share a picture: the smaller of them is interpolated to the size of the larger.

    Raises:
        UnirenderError: the object lacks texture coordinates or a texture.
    """
    if obj.uv is None or obj.albedo.ndim != 3 or obj.roughness is None or obj.metallic is None:
        raise UnirenderError(
            f"{obj.name}: has no uv, or no albedo, roughness or metallic texture; expected all of them"
        )
    height, width = np.max([obj.roughness.shape, obj.metallic.shape], axis=0).tolist()
    roughness, metallic = (refined(plane[..., None], height, width) for plane in (obj.roughness, obj.metallic))
    pixels = {
        "base_color": eight_bits(srgb_encode(obj.albedo)),
        "metallic_roughness": eight_bits(np.concatenate([np.zeros_like(roughness), roughness, metallic], axis=-1)),
    }
    if obj.normal_map is not None:
        pixels["normal"] = eight_bits((obj.normal_map + 1) / 2)
    return pixels


def png_bytes(pixels: UInt8[np.ndarray, "h w *c"]) -> bytes:
    """An 8-bit PNG."""
    stream = io.BytesIO()
    Image.fromarray(pixels).save(stream, format="PNG", optimize=False)
    return stream.getvalue()
