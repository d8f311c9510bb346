"""The methods of the multi-view table.

A method has a `name`, a JSON-able `config` (part of the cache key) and

    solve(views, mesh) -> Solution     pictures with cameras, the bare mesh -> the object with textures, and its light
"""

from dataclasses import asdict, replace
from typing import Any

import numpy as np

from unirender.color import srgb_decode
from unirender_evaluation.training_statistics import training_statistics
from unirender_reference.optimize.multiview.config import OptimizeConfig
from unirender_reference.optimize.refine.config import RefineConfig
from unirender_reference.optimize.solution import Solution
from unirender_reference.optimize.views import Views
from unirender_reference.shapes import MeshObject

CONSTANT_MATERIAL = 0.5
LIGHT_SHAPE = (16, 32)
TEXTURE = (2, 2)  # texels of a constant map
PLAIN_ITERATIONS, PLAIN_TEXTURE = 100, 128
OPTIMISED, PLAIN, CONSTANT = "NvDiffRec (Mitsuba), multi-view", "plain Mitsuba loop", "constant object"
NAMES = (OPTIMISED, PLAIN, CONSTANT)


class ConstantObject:
    """The training objects' mean albedo, metallic and roughness 0.5, in uniform light as bright as the pictures."""

    name = CONSTANT

    @property
    def config(self) -> dict[str, Any]:
        return {
            "trivial": "constant-object",
            "albedo_srgb": training_statistics()["albedo_srgb"],
            "material": CONSTANT_MATERIAL,
        }

    def solve(self, views: Views, mesh: MeshObject) -> Solution:
        albedo = srgb_decode(np.array(training_statistics()["albedo_srgb"], np.float32))
        covered = sum(float(view.mask.sum()) for view in views.seen)
        mean = sum(views.linear(view).sum(axis=(0, 1), dtype=np.float64) for view in views.seen) / covered
        # In uniform light L a surface sends out nearly albedo x L: white light, of the pictures' energy.
        radiance = float(np.mean(mean) / np.mean(albedo))
        uv = np.zeros((len(mesh.vertices), 2), np.float32) if mesh.uv is None else mesh.uv
        half = np.full(TEXTURE, CONSTANT_MATERIAL, np.float32)
        texture = np.broadcast_to(albedo, (*TEXTURE, 3)).astype(np.float32)
        obj = replace(mesh, uv=uv, albedo=texture, roughness=half, metallic=half)
        return Solution(obj, np.full((*LIGHT_SHAPE, 3), radiance, np.float32))


class Optimized:
    """Our optimiser, all stages and ingredients."""

    name = OPTIMISED

    def __init__(self, config: OptimizeConfig | None = None) -> None:
        self.settings = OptimizeConfig() if config is None else config

    @property
    def config(self) -> dict[str, Any]:
        return {"optimize": asdict(self.settings)}

    def solve(self, views: Views, mesh: MeshObject) -> Solution:
        from unirender_reference.optimize.multiview.run import optimize

        return optimize(views, mesh, self.settings)


class PlainLoop:
    """The loop of Mitsuba's tutorials from a grey start in uniform light: Adam, 16 samples, no ingredient."""

    name = PLAIN

    def __init__(self) -> None:
        self.settings = RefineConfig.plain(PLAIN_ITERATIONS)

    @property
    def config(self) -> dict[str, Any]:
        return {"refine": asdict(self.settings), "texture": PLAIN_TEXTURE, "light_rows": LIGHT_SHAPE[0]}

    def solve(self, views: Views, mesh: MeshObject) -> Solution:
        from unirender_reference.optimize.refine.run import refine
        from unirender_reference.optimize.shape.uv import charted
        from unirender_reference.optimize.transport.solve import start_solution

        start = start_solution(views, charted(mesh, PLAIN_TEXTURE), PLAIN_TEXTURE, LIGHT_SHAPE[0])
        return refine(views, start, self.settings, lambda step: True)
