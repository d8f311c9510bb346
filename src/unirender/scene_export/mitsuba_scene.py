"""The card for Mitsuba 3: `mi.load_file("scene.xml")` is the picture's object under its predicted light.

Its shading normals are those of the vertices of a grid, not a normal map's. Mitsuba drops the light of a normal map
that comes from behind the surface that carries it; of a card that would be half of all light at the object's rim. The
integrator is `volpath`, which hides the light behind pixels that are covered in part; `path` lets it shine through
there, against `hide_emitters`.
"""

from pathlib import Path

import numpy as np
from jaxtyping import Float

from unirender.exr import image_channels, write_environment, write_exr
from unirender.light.for_mitsuba import drawable, pfm_bytes
from unirender.light.resampling import area_pixels
from unirender.scene_export.card import Card
from unirender.visualization import write_png

FAR_CLIP = 1e4  # Mitsuba's own
MOST_VERTICES = 1024  # along a side of the card's grid
LATLONG_ROWS = 256  # of the finest map that a coarse light is interpolated to


def write_mitsuba(card: Card, folder: Path) -> None:
    """Writes `scene.xml` and what it refers to, but for `base_color.png`, which it shares with `card.gltf`."""
    for name, values in (("roughness", card.roughness), ("metallic", card.metallic), ("opacity", card.opacity)):
        write_png(folder / f"{name}.png", values)
    (folder / "card.ply").write_bytes(ply_bytes(card))
    light = drawable(card.environment)
    write_environment(folder / "environment.exr", light)
    (folder / "environment.pfm").write_bytes(pfm_bytes(light))
    finer = max(1, min(4, LATLONG_ROWS // card.environment.shape[0]))
    write_exr(folder / "latlong.exr", image_channels(area_pixels(card.environment, finer)), half=False)
    (folder / "scene.xml").write_text(scene_xml(card), encoding="utf-8")


def ply_bytes(card: Card) -> bytes:
    """The card as a binary PLY: a vertex with a normal at the centre of every pixel, and one more along each edge."""
    rows, v = _vertices(card.height)
    columns, u = _vertices(card.width)
    normal = card.normal[np.ix_(rows, columns)].reshape(-1, 3)
    u, v = (grid.ravel() for grid in np.meshgrid(u, v))
    vertices = np.concatenate([card.points(u, v), normal, np.stack([u, v], axis=-1)], axis=1)
    index = np.arange(len(vertices), dtype=np.int32).reshape(len(rows), len(columns))
    a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, :-1], index[1:, 1:]
    faces = np.stack([a, c, d, a, d, b], axis=-1).reshape(-1, 3)  # counter-clockwise as seen from +z
    corners = np.zeros(len(faces), dtype=[("count", "u1"), ("index", "<i4", 3)])
    corners["count"], corners["index"] = 3, faces
    header = [
        "ply",
        "format binary_little_endian 1.0",
        f"element vertex {len(vertices)}",
        *(f"property float {name}" for name in ("x", "y", "z", "nx", "ny", "nz", "u", "v")),
        f"element face {len(faces)}",
        "property list uchar int vertex_indices",
        "end_header",
        "",
    ]
    return "\n".join(header).encode() + vertices.astype("<f4").tobytes() + corners.tobytes()


def _vertices(size: int) -> tuple[np.ndarray, Float[np.ndarray, " n"]]:
    """The pixel of each vertex along a side, and its place as a fraction of the frame."""
    pixels = np.round(np.linspace(0, size - 1, min(size, MOST_VERTICES))).astype(np.int64)
    place = np.concatenate([[0], (pixels + 0.5) / size, [1]])
    return np.pad(pixels, 1, mode="edge"), place.astype(np.float32)


def scene_xml(card: Card) -> str:
    """The scene; files by their names, the film at the picture's size."""
    principal = card.camera.principal
    return _SCENE.format(
        fov=repr(float(card.camera.fov_deg)),
        offset_x=repr(0.5 - float(principal[0])),
        offset_y=repr(0.5 - float(principal[1])),
        distance=repr(card.distance),
        far_clip=f'<float name="far_clip" value="{2 * card.distance!r}"/>' if card.distance > FAR_CLIP / 2 else "",
        width=card.width,
        height=card.height,
        base_color=_texture("base_color", raw=False),
        roughness=_texture("roughness"),
        metallic=_texture("metallic"),
        opacity=_texture("opacity"),
    )


def _texture(name: str, raw: bool = True) -> str:
    """A picture of the folder; `raw`: its values are taken as they are stored."""
    flag = '<boolean name="raw" value="true"/>' if raw else ""
    return (
        f'<texture name="{name}" type="bitmap"><string name="filename" value="{name}.png"/>{flag}'
        '<string name="filter_type" value="nearest"/><string name="wrap_mode" value="clamp"/></texture>'
    )


_SCENE = """<scene version="3.0.0">
  <integrator type="volpath">
    <integer name="max_depth" value="4"/><boolean name="hide_emitters" value="true"/>
  </integrator>
  <sensor type="perspective">
    <float name="fov" value="{fov}"/>
    <string name="fov_axis" value="y"/>{far_clip}
    <float name="principal_point_offset_x" value="{offset_x}"/>
    <float name="principal_point_offset_y" value="{offset_y}"/>
    <transform name="to_world"><lookat origin="0, 0, {distance}" target="0, 0, 0" up="0, 1, 0"/></transform>
    <film type="hdrfilm">
      <integer name="width" value="{width}"/><integer name="height" value="{height}"/>
      <string name="pixel_format" value="rgba"/><rfilter type="box"/>
    </film>
    <sampler type="multijitter"><integer name="sample_count" value="64"/></sampler>
  </sensor>
  <emitter type="envmap"><string name="filename" value="environment.pfm"/></emitter>
  <shape type="ply">
    <string name="filename" value="card.ply"/>
    <bsdf type="mask">
      {opacity}
      <bsdf type="principled">
        {base_color}
        {roughness}
        {metallic}
      </bsdf>
    </bsdf>
  </shape>
</scene>
"""
