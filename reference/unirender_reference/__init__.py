"""Ground truth: Mitsuba 3 renders of principled-BSDF scenes, with a stated noise floor.

    obj, light = load_mesh("mug.glb"), load_light("hall.exr")     or make_object(7, "test"), make_light(3, "test")
    sample = render_sample(SceneSpec(obj, light, roughness=0.3, metallic=0.0), spp=256)    picture, maps, variance
    renderer = Renderer(obj, resolution=128)                      the same object under any light and material
    render_effects(renderer, ...), render_lobes(renderer, ...)    its passes

They are exported lazily (PEP 562), so that `import unirender_reference` loads nothing heavy. `shade` and
`shade_gradients`, which Mitsuba evaluates on given maps, are in the module of the first one's name.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from unirender_reference.effects import render_effects as render_effects
    from unirender_reference.lights import Light as Light
    from unirender_reference.lights import bundled_light as bundled_light
    from unirender_reference.lights import load_light as load_light
    from unirender_reference.lights import make_light as make_light
    from unirender_reference.lobes import render_lobes as render_lobes
    from unirender_reference.meshes import load_mesh as load_mesh
    from unirender_reference.render import Renderer as Renderer
    from unirender_reference.render import Sample as Sample
    from unirender_reference.render import SceneSpec as SceneSpec
    from unirender_reference.render import render_sample as render_sample
    from unirender_reference.shapes import MeshObject as MeshObject
    from unirender_reference.shapes import make_object as make_object

_EXPORTS = {
    "Light": "unirender_reference.lights",
    "MeshObject": "unirender_reference.shapes",
    "Renderer": "unirender_reference.render",
    "Sample": "unirender_reference.render",
    "SceneSpec": "unirender_reference.render",
    "bundled_light": "unirender_reference.lights",
    "load_light": "unirender_reference.lights",
    "load_mesh": "unirender_reference.meshes",
    "make_light": "unirender_reference.lights",
    "make_object": "unirender_reference.shapes",
    "render_effects": "unirender_reference.effects",
    "render_lobes": "unirender_reference.lobes",
    "render_sample": "unirender_reference.render",
}

__all__ = [
    "Light",
    "MeshObject",
    "Renderer",
    "Sample",
    "SceneSpec",
    "bundled_light",
    "load_light",
    "load_mesh",
    "make_light",
    "make_object",
    "render_effects",
    "render_lobes",
    "render_sample",
]


def __getattr__(name: str) -> Any:
    if name not in _EXPORTS:
        raise AttributeError(f"module 'unirender_reference' has no attribute {name!r}")
    return getattr(importlib.import_module(_EXPORTS[name]), name)


def __dir__() -> list[str]:
    return sorted(__all__)
