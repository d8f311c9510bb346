"""glTF 2.0 materials: which channel of which picture means what (glTF 2.0, sections 3.8.3 and 3.9).

Base colour is sRGB in its texture and linear in its factor; metallic-roughness textures are linear, roughness in G and
metallic in B; normal textures are linear with y up in the picture (section 3.9.3).
"""

from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Float

from unirender.color import srgb_decode
from unirender.errors import UnirenderError
from unirender_reference.meshes.gloss import metallic_roughness
from unirender_reference.meshes.gltf_document import Document
from unirender_reference.meshes.images import Decode, ImageBudget, linear, nearest, texels_of
from unirender_reference.meshes.limits import check_materials, texture_side
from unirender_reference.meshes.surface import BARE, IDENTITY, Channel, Material, Texture, Wrap, tangent_normals

WRAPS: dict[int, Wrap] = {10497: "repeat", 33648: "mirror", 33071: "clamp"}
IMAGE_EXTENSIONS = ("EXT_texture_webp", "EXT_texture_avif")
NEAREST = 9728
SHARP_TEXELS = "sharp texels of textures"  # between which renders interpolate
GLOSS, UNLIT, TRANSFORM = "KHR_materials_pbrSpecularGlossiness", "KHR_materials_unlit", "KHR_texture_transform"
GLOSS_TEXTURE = "specularGlossinessTexture"


def vector(owner: dict[str, Any], key: str, default: list[float]) -> Float[np.ndarray, " n"]:
    """A list of finite numbers of a JSON object, as long as its default.

    Raises:
        UnirenderError: it is something else.
    """
    value = owner.get(key, default)
    try:
        array = np.asarray(value, np.float64).reshape(-1)
    except (TypeError, ValueError):
        array = np.full(0, np.nan)
    if array.shape != (len(default),) or not np.isfinite(array).all():
        raise UnirenderError(f"has {key} {str(value)[:60]}, expected {len(default)} finite numbers; export it again")
    return array


def _scalar(owner: dict[str, Any], key: str, default: float) -> float:
    return float(vector({key: [owner[key]]} if key in owner else {}, key, [default])[0])


class Materials:
    """The materials of a document, made when first asked for.

    Args:
        document: the file.
        used: indices of the materials that its scene uses; None stands for the default material.

    Attributes:
        ignored: what the materials have that our contract has not.
    """

    def __init__(self, document: Document, used: set[Any]) -> None:
        self._document = document
        self._images = ImageBudget()
        self._texels: dict[tuple[Any, Decode], Float[np.ndarray, "h w c"]] = {}  # materials share images
        self._made: dict[tuple[Any, frozenset[int]], Material] = {}
        self.ignored: set[str] = set()
        check_materials(len(used))
        self._side = texture_side(sum(bool(_texture_infos(self._json(index))) for index in used))

    def sets(self, index: int | None) -> set[int]:
        """The sets of texture coordinates that a material looks up."""
        return {_texcoord(info) for info in _texture_infos(self._json(index))}

    def of(self, index: int | None, sets: frozenset[int]) -> Material:
        """A material on a piece that has these sets of texture coordinates.

        A texture whose set is missing counts as its mean.
        """
        if (index, sets) not in self._made:
            channels = self._channels(self._json(index))
            if any(isinstance(channel, Texture) and channel.texcoord not in sets for channel in channels.values()):
                self.ignored.add(BARE)
            self._made[index, sets] = Material({name: _placed(channel, sets) for name, channel in channels.items()})
        return self._made[index, sets]

    def _json(self, index: int | None) -> dict[str, Any]:
        return {} if index is None else self._document.item("materials", index)

    def _channels(self, material: dict[str, Any]) -> dict[str, Channel]:
        """The material's channels, of whichever of its models the file has."""
        extensions = material.get("extensions", {})
        self._note_ignored(material, extensions)
        if GLOSS in extensions:
            channels = self._gloss(extensions[GLOSS])
        else:
            channels = self._metallic_roughness(material.get("pbrMetallicRoughness", {}))
        if UNLIT in extensions:
            channels |= {"roughness": np.ones(1, np.float32), "metallic": np.zeros(1, np.float32)}
        if "normalTexture" in material:
            info = material["normalTexture"]
            scale = _scalar(info, "scale", 1.0)
            texture = self._texture(info, "RGB", linear)
            texels, buried = tangent_normals(texture.texels, scale)
            channels["normal"] = replace(texture, texels=texels)
            self.ignored |= buried
        return channels

    def _metallic_roughness(self, pbr: dict[str, Any]) -> dict[str, Channel]:
        """Albedo, roughness and metallic by the metallic-roughness model: factor times texture, linear."""
        color = np.clip(vector(pbr, "baseColorFactor", [1, 1, 1, 1]), 0, 1).astype(np.float32)
        roughness = np.clip(_scalar(pbr, "roughnessFactor", 1.0), 0, 1)
        metallic = np.clip(_scalar(pbr, "metallicFactor", 1.0), 0, 1)
        if color[3] < 1:
            self.ignored.add("alpha")
        channels: dict[str, Channel] = {
            "albedo": color[:3],
            "roughness": np.array([roughness], np.float32),
            "metallic": np.array([metallic], np.float32),
        }
        if "baseColorTexture" in pbr:
            channels["albedo"] = self._texture(pbr["baseColorTexture"], "RGB", srgb_decode).scaled(color[:3])
        if "metallicRoughnessTexture" in pbr:
            factors = np.array([0, roughness, metallic], np.float32)
            both = self._texture(pbr["metallicRoughnessTexture"], "RGB", linear).scaled(factors)
            for name, k in (("roughness", 1), ("metallic", 2)):
                channels[name] = replace(both, texels=both.texels[..., k : k + 1])
        return channels

    def _gloss(self, gloss: dict[str, Any]) -> dict[str, Channel]:
        """Specular-glossiness, converted; its two textures count as sharing the diffuse texture's coordinates."""
        diffuse = np.clip(vector(gloss, "diffuseFactor", [1, 1, 1, 1]), 0, 1)[:3].astype(np.float32)
        specular = np.clip(vector(gloss, "specularFactor", [1, 1, 1]), 0, 1).astype(np.float32)
        factors = np.append(specular, np.float32(_scalar(gloss, "glossinessFactor", 1.0)))
        first: Texture | None = None
        values = [diffuse.reshape(1, 1, 3), factors.reshape(1, 1, 4)]
        if GLOSS_TEXTURE in gloss:
            first = self._texture(gloss[GLOSS_TEXTURE], "RGBA", _specular_linear).scaled(factors)
            values[1] = first.texels
        if "diffuseTexture" in gloss:
            first = self._texture(gloss["diffuseTexture"], "RGB", srgb_decode).scaled(diffuse)
            values[0] = first.texels
        height, width = np.maximum(values[0].shape[:2], values[1].shape[:2])
        color, shine = (nearest(texels, int(height), int(width)) for texels in values)
        albedo, roughness, metallic = metallic_roughness(color, shine[..., :3], shine[..., 3:])
        maps = {"albedo": albedo, "roughness": roughness, "metallic": metallic}
        if first is None:
            return {name: texels[0, 0] for name, texels in maps.items()}
        return {name: replace(first, texels=texels) for name, texels in maps.items()}

    def _texture(self, info: dict[str, Any], mode: str, curve: Decode) -> Texture:
        texture = self._document.item("textures", info.get("index"))
        sampler = self._document.item("samplers", texture["sampler"]) if "sampler" in texture else {}
        source = next(
            (
                texture["extensions"][name]["source"]
                for name in IMAGE_EXTENSIONS
                if name in texture.get("extensions", {})
            ),
            texture.get("source"),
        )
        if source is None:
            only = ", ".join(sorted(texture.get("extensions", {}))) or "no picture at all"
            raise UnirenderError(
                f"textures[{info.get('index')}] has {only}, expected a PNG, JPEG, WebP or AVIF; export it as one"
            )
        transform = info.get("extensions", {}).get(TRANSFORM, {})
        if sampler.get("magFilter") == NEAREST:
            self.ignored.add(SHARP_TEXELS)
        return Texture(
            texels=self._linear(source, mode, curve),
            texcoord=_texcoord(info),
            transform=_affine(transform) if transform else IDENTITY,
            wrap=(_wrap(sampler, "wrapS"), _wrap(sampler, "wrapT")),
        )

    def _linear(self, source: Any, mode: str, curve: Decode) -> Float[np.ndarray, "h w c"]:
        """The texels of an image, no more than are needed."""
        if (source, curve) not in self._texels:
            image, name = self._document.item("images", source), self._name(source)
            if "uri" in image:
                data = self._document.resource(image["uri"], "texture")
            else:
                data = bytes(self._document.view(image.get("bufferView")))
            self._texels[source, curve] = texels_of(self._images.open(data, name), name, self._side, mode, curve)
        return self._texels[source, curve]

    def _name(self, source: Any) -> str:
        image = self._document.item("images", source)
        uri = image.get("uri", "")
        return repr(image.get("name") or (uri if uri and not uri.startswith("data:") else f"images[{source}]"))

    def _note_ignored(self, material: dict[str, Any], extensions: dict[str, Any]) -> None:
        if material.get("alphaMode", "OPAQUE") != "OPAQUE":
            self.ignored.add("alpha")
        if np.any(vector(material, "emissiveFactor", [0, 0, 0]) > 0):
            self.ignored.add("emission")
        if "occlusionTexture" in material:
            self.ignored.add("occlusion")
        for name in extensions:
            if name not in (GLOSS, UNLIT):
                self.ignored.add(name.removeprefix("KHR_materials_"))


def _texture_infos(material: dict[str, Any]) -> list[dict[str, Any]]:
    """The texture references of the channels that are read."""
    gloss = material.get("extensions", {}).get(GLOSS)
    owner = material.get("pbrMetallicRoughness", {}) if gloss is None else gloss
    names = ("baseColorTexture", "metallicRoughnessTexture") if gloss is None else ("diffuseTexture", GLOSS_TEXTURE)
    infos = [owner[name] for name in names if name in owner]
    return infos + ([material["normalTexture"]] if "normalTexture" in material else [])


def _texcoord(info: dict[str, Any]) -> int:
    return int(info.get("extensions", {}).get(TRANSFORM, {}).get("texCoord", info.get("texCoord", 0)))


def _wrap(sampler: dict[str, Any], key: str) -> Wrap:
    return WRAPS.get(sampler.get(key, 10497), "repeat")


def _specular_linear(stored: Float[np.ndarray, "h w 4"]) -> Float[np.ndarray, "h w 4"]:
    """Specular colour is sRGB, glossiness (alpha) is linear."""
    return np.concatenate([srgb_decode(stored[..., :3]), stored[..., 3:]], axis=-1)


def _affine(transform: dict[str, Any]) -> Float[np.ndarray, "2 3"]:
    """KHR_texture_transform: scale, then turn counter-clockwise as seen with v down, then shift.

    (The extension's GLSL listing turns the other way; its examples, its test model, three.js, Blender and Babylon
    agree on this one: glTF issue 1563.)
    """
    offset, scale = vector(transform, "offset", [0, 0]), vector(transform, "scale", [1, 1])
    angle = _scalar(transform, "rotation", 0.0)
    turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    return np.concatenate([turn * scale, offset[:, None]], axis=1)


def _placed(channel: Channel, sets: frozenset[int]) -> Channel:
    if isinstance(channel, Texture) and channel.texcoord not in sets:
        return channel.texels.mean((0, 1)).astype(np.float32)
    return channel
