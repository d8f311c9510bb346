"""Wavefront MTL: colours and textures of the classic format and of its PBR extension (Pr, Pm, map_Pr, map_Pm, norm).

Kd counts only without a map_Kd, as Blender reads it; both are sRGB. Of a map's options `-clamp`, `-o` and `-s` are
read (`-bm` of `norm`, `-imfchan` of map_Pr and map_Pm, too); bump maps (`map_Bump`) are heights and are ignored.
"""

import io
import re
from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from unirender.color import luminance, srgb_decode
from unirender.errors import UnirenderError
from unirender_reference.meshes.folder import ModelFolder
from unirender_reference.meshes.images import Decode, ImageBudget, linear, texels_of
from unirender_reference.meshes.limits import MAX_TEXT_BYTES, check_materials, texture_side
from unirender_reference.meshes.surface import Channel, Material, Texture, tangent_normals

DEFAULT_ALBEDO = 0.5
DEFAULT_ROUGHNESS, DEFAULT_METALLIC = 0.5, 0.0  # beside materials that have them
OPTIONS = {"-blendu": 1, "-blendv": 1, "-cc": 1, "-clamp": 1, "-imfchan": 1, "-texres": 1, "-type": 1, "-bm": 1}
OPTIONS |= {"-boost": 1, "-mm": 2, "-o": 3, "-s": 3, "-t": 3}
UNHEEDED = {"-mm": (0.0, 1.0), "-t": (0.0, 0.0, 0.0)}  # options that would change a map, with what changes nothing
COLOURED = 0.1  # mean difference of the channels, from which a picture is no grey one
MAPS = {"map_kd": "albedo", "map_pr": "roughness", "map_pm": "metallic", "norm": "normal"}
IGNORED = {"map_d": "alpha", "map_bump": "bump", "bump": "bump", "map_ke": "emission", "disp": "displacement"}
IGNORED |= {"map_pc": "clearcoat", "map_ps": "sheen", "map_ks": "specular", "map_ns": "gloss"}
IGNORED |= {"refl": "reflection", "map_refl": "reflection"}
NO_LOSS = ("map_ka", "map_aat")  # of ambient light, which a render has none of, and antialiasing
BEYOND = {"ke": "emission", "pc": "clearcoat", "ps": "sheen", "aniso": "anisotropy"}  # numbers, ignored where not 0


@dataclass
class MtlEntry:
    """One `newmtl`: numbers by lower-case keyword, maps as (file, options)."""

    numbers: dict[str, list[float]] = field(default_factory=dict)
    maps: dict[str, tuple[str, dict[str, list[str]]]] = field(default_factory=dict)
    ignored: set[str] = field(default_factory=set)


def parse_mtl(text: str) -> dict[str, MtlEntry]:
    """The materials of a file by name; lines that are not understood are left out.

    Raises:
        UnirenderError: there are too many materials.
    """
    entries: dict[str, MtlEntry] = {}
    entry = MtlEntry()
    for line in io.StringIO(text.removeprefix("\ufeff"), newline=None):  # LF, CR LF or CR
        words = line.split(None, 1)
        keyword = words[0].lower() if words else ""
        rest = words[1].strip() if len(words) > 1 else ""
        if keyword == "newmtl":
            entry = entries.setdefault(rest, MtlEntry())
            check_materials(len(entries))
        elif keyword in MAPS:
            entry.maps[MAPS[keyword]] = _map(rest)
        elif keyword in IGNORED or (keyword.startswith("map_") and keyword not in NO_LOSS):
            entry.ignored.add(IGNORED.get(keyword, keyword))
        elif keyword in ("kd", "pr", "pm", "d", "tr", *BEYOND):
            try:
                entry.numbers[keyword] = [float(value) for value in rest.split()]
            except ValueError:  # "Kd spectral file.rfl" and the like
                entry.ignored.add(f"{keyword} {rest[:20]}")
    return entries


def read_libraries(folder: ModelFolder, names: Iterable[str], used: set[str]) -> dict[str, MtlEntry]:
    """The materials of several files by name; none where none is used.

    Raises:
        UnirenderError: a file cannot be read and a material that is used stands in no other, or there are too many.
    """
    entries: dict[str, MtlEntry] = {}
    missing: UnirenderError | None = None
    for name in names if used else ():
        texts, lost = _library_texts(folder, name)
        missing = missing or lost
        for text in texts:
            entries |= parse_mtl(text.decode("utf-8", "surrogateescape"))
            check_materials(len(entries))
    if missing is not None and used - entries.keys():
        raise missing
    return entries


def _library_texts(folder: ModelFolder, name: str) -> tuple[list[bytes], UnirenderError | None]:
    """A file, whose name may hold spaces, or else several in a line; and why the last one that is lost is so."""
    parts, texts, missing = name.split(), [], None
    for some in ([name], parts) if len(parts) > 1 else ([name],):
        missing = None
        for part in some:
            try:
                texts.append(folder.read(part, "material library", limit=MAX_TEXT_BYTES))
            except UnirenderError as error:
                missing = error
        if texts:
            break
    return texts, missing


def _map(rest: str) -> tuple[str, dict[str, list[str]]]:
    """A file name, which may hold spaces, behind options of known length (`-o`, `-s`, `-t` take one to three)."""
    words, options = re.split(r"[ \t]", rest), {}
    while words and words[0].lower() in OPTIONS:
        name = words.pop(0).lower()
        values: list[str] = []
        while words and len(values) < OPTIONS[name] and (_is_number(words[0]) or OPTIONS[name] == 1 or not words[0]):
            value = words.pop(0)
            values += [value] if value else []
        options[name] = values
    return rest[len(rest) - len(" ".join(words)) :].strip(), options


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


class MtlMaterials:
    """The materials that a model uses, made when first asked for.

    Args:
        folder: where textures lie.
        entries: the parsed library.
        used: names of the materials that have faces.
    """

    def __init__(self, folder: ModelFolder, entries: dict[str, MtlEntry], used: list[str | None]) -> None:
        self._folder, self._images = folder, ImageBudget()
        self._entries = entries
        self._texels: dict[tuple[str, Decode], Float[np.ndarray, "h w c"]] = {}  # materials share pictures
        here = [entries[name] for name in used if name in entries]
        self._pbr = any(
            {"pr", "pm"} & set(entry.numbers) or {"roughness", "metallic"} & set(entry.maps) for entry in here
        )
        self._side = texture_side(sum(bool(entry.maps) for entry in here))
        self.ignored = {what for entry in here for what in entry.ignored}
        if any(_opacity(entry) < 1 for entry in here):
            self.ignored.add("alpha")
        for keyword, what in BEYOND.items():
            if any(max(entry.numbers.get(keyword, [0.0]), default=0.0) > 0 for entry in here):
                self.ignored.add(what)

    def make(self, name: str | None, textured: bool, colored: bool) -> Material:
        """A material on faces that have texture coordinates or not, and colours of their own or not.

        A texture on faces without coordinates counts as its mean.
        """
        entry = self._entries.get(name or "", MtlEntry())
        color = entry.numbers.get("kd", [])
        plain = np.full(3, DEFAULT_ALBEDO if not colored else 1.0, np.float32)
        if len(color) in (1, 3) and not colored:
            plain = srgb_decode(np.clip(np.nan_to_num(np.resize(color, 3)), 0, 1))
        channels: dict[str, Channel] = {"albedo": plain}
        if self._pbr:
            for channel, key, default in (("roughness", "pr", DEFAULT_ROUGHNESS), ("metallic", "pm", DEFAULT_METALLIC)):
                value = (entry.numbers.get(key) or [default])[0]
                channels[channel] = np.clip(np.nan_to_num(np.array([value], np.float32)), 0, 1)
        for channel, (file, options) in entry.maps.items():
            texture = self._texture(channel, file, options)
            channels[channel] = texture if textured else texture.texels.mean((0, 1))
        if not textured:
            channels.pop("normal", None)
        return Material(channels)

    def _read(self, file: str) -> bytes:
        try:
            return self._folder.read(file, "texture")
        except UnirenderError as error:
            option, *more = file.split()
            if not re.match("-[a-zA-Z]", option) or not more:
                raise
            raise UnirenderError(
                f"texture {file[:80]!r}: got the option {option!r}, which is not known here, expected one of "
                f"{', '.join(sorted(OPTIONS))} or a file name; take it out of the MTL"
            ) from error

    def _texture(self, channel: str, file: str, options: dict[str, list[str]]) -> Texture:
        if not file:
            raise UnirenderError(f"its MTL has a map without a file name for {channel}; write the name")
        curve = srgb_decode if channel == "albedo" else linear
        if (file, curve) not in self._texels:
            image = self._images.open(self._read(file), repr(file))
            self._texels[file, curve] = texels_of(image, repr(file), self._side, "RGB", curve)
        texels = self._texels[file, curve]
        if channel == "normal":
            texels, buried = tangent_normals(texels, _number(options.get("-bm"), 1.0))
            self.ignored |= buried
        elif channel != "albedo":
            which = (options.get("-imfchan") or [""])[0].lower()
            if not which and float(np.ptp(texels, axis=-1).mean()) > COLOURED:
                which = "l"  # as the format has it where nothing is said
                self.ignored.add(f"colour of a map of {channel}")
            texels = _one_channel(texels, which, f"texture {file!r} of {channel}")
        self.ignored |= {f"{name} of a map" for name in UNHEEDED if _is_unheeded(name, options.get(name, []))}
        # OBJ counts v from below: v_down = 1 - (s v_up + o), in terms of the 1 - v_up that the reader stores
        (su, sv), (ou, ov) = _pair(options.get("-s"), 1.0), _pair(options.get("-o"), 0.0)
        transform = np.array([[su, 0, ou], [0, sv, 1 - sv - ov]])
        wrap = "clamp" if options.get("-clamp") == ["on"] else "repeat"
        return Texture(texels, 0, transform, (wrap, wrap))


def _opacity(entry: MtlEntry) -> float:
    """`d`, else 1 - `Tr`."""
    if entry.numbers.get("d"):
        return entry.numbers["d"][0]
    return 1 - (entry.numbers.get("tr") or [0.0])[0]


def _one_channel(texels: Float[np.ndarray, "h w 3"], which: str, what: str) -> Float[np.ndarray, "h w 1"]:
    """The values of a texture of numbers, from the channel that `-imfchan` names; "" where all are alike.

    Raises:
        UnirenderError: another one than r, g, b and l (luminance) is named.
    """
    if which in ("r", "g", "b"):
        return texels[..., ["r", "g", "b"].index(which)][..., None]
    if which == "l":
        return luminance(texels)[..., None]
    if which:
        raise UnirenderError(f"{what}: got -imfchan {which}, expected r, g, b or l; correct the MTL")
    return texels[..., :1]


def _is_unheeded(name: str, words: list[str]) -> bool:
    """Whether an option that is not read would change its map."""
    values = [float(word) for word in words if _is_number(word)]
    return (*values, *UNHEEDED[name][len(values) :]) != UNHEEDED[name]


def _number(words: list[str] | None, default: float) -> float:
    return float(words[0]) if words and _is_number(words[0]) else default


def _pair(words: list[str] | None, default: float) -> tuple[float, float]:
    values = [float(word) for word in words or [] if _is_number(word)]
    return (values + [default] * 2)[0], (values + [default] * 2)[1]
