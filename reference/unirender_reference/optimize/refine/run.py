"""Refinement: Adam on textures and light, by Mitsuba's derivatives, from any start.

Notation: a *parameter* is a map in the space in which steps are made (`parameters`).
"""

import time
from collections.abc import Callable, Mapping

import numpy as np
from jaxtyping import Float

from unirender_reference.optimize.refine.config import RefineConfig
from unirender_reference.optimize.refine.losses import ImageLoss
from unirender_reference.optimize.refine.parameters import NAMES, Name, parameter_gradient, to_map, to_parameter
from unirender_reference.optimize.refine.priors import anchor, smoothness, white_light
from unirender_reference.optimize.refine.scene import TexturedScene
from unirender_reference.optimize.refine.state import RefineState
from unirender_reference.optimize.solution import Solution
from unirender_reference.optimize.views import Step, Views
from unirender_reference.passes import derive_seed

TEXTURE_WIDTH = 0.02  # of the smoothness prior
WEIGHT_SPP = 256  # of the pictures that say what the start explains
HELD_OUT_SPP = 64  # always the same samples: differences between steps are sharper than the figure

Map = Float[np.ndarray, "h w c"]
Maps = Mapping[str, Float[np.ndarray, "..."]]


def refine(
    views: Views,
    start: Solution,
    config: RefineConfig,
    on_step: Callable[[Step], bool] = lambda step: True,
    state: RefineState | None = None,
) -> Solution:
    """Improves textures and light of a solution by gradient descent on the pictures.

    Args:
        views: `seen` is fitted; of `held_out` only the fit is measured (`RefineConfig.held_out_every`).
        start: mesh, first textures and light.
        config: the ingredients.
        on_step: called after every step; False ends the refinement.
        state: where to go on (`RefineState.load`), moved on in place; None: from the start.

    Returns:
        The start's mesh with new textures and light.

    Raises:
        UsageError: the configuration has a value outside its range.
    """
    config.check()
    if not config.enabled:
        return start
    state = RefineState.begin(start, config) if state is None else state
    began = time.perf_counter()
    fit = Fit(views, state.solution(start, config), config)
    if config.robust:
        fit.weigh(state.maps(config, state.first))
    while state.iteration < config.iterations:
        values = fit.step(state)
        if not on_step(Step("refine", state.iteration, time.perf_counter() - began, values)):
            break
    return state.solution(start, config)


class HeldOut:
    """The fit to views that are only watched.

    Args:
        views: `held_out` of them.
        first: any solution of the right mesh and sizes.
        config: of the refinement.
    """

    def __init__(self, views: Views, first: Solution, config: RefineConfig) -> None:
        self.config = config
        self.scene = TexturedScene(first, views.held_out, config.depth)
        self.loss = ImageLoss(views, config.loss, config.one_sided, views.held_out)

    def psnr(self, state: RefineState) -> float:
        """Masked PSNR in dB."""
        images = self.scene.image(state.maps(self.config), HELD_OUT_SPP, derive_seed(self.config.seed, "held out"))
        return self.loss.psnr(images[..., :3])


class Fit:
    """The objective of a refinement, and its steps.

    Args:
        views: the pictures.
        first: any solution of the right mesh and sizes.
        config: the ingredients.
    """

    def __init__(self, views: Views, first: Solution, config: RefineConfig) -> None:
        self.config = config
        self.scene = TexturedScene(first, views.seen, config.depth)
        self.loss = ImageLoss(views, config.loss, config.one_sided)
        self._held_out = HeldOut(views, first, config) if config.held_out_every and views.held_out else None

    def weigh(self, maps: Maps) -> None:
        """Lets pixels count, from now on, by how well these maps explain them."""
        images = self.scene.image(maps, WEIGHT_SPP, derive_seed(self.config.seed, "weights"))
        self.loss.weigh(images[..., :3])

    def step(self, state: RefineState) -> dict[str, float]:
        """One step of Adam; returns the losses by name."""
        config = self.config
        values, gradients = self.pictures(state)
        for label, (name, value, slope) in self.priors(state).items():
            values[label] = value
            gradients[name] = gradients[name] + slope
        remaining = config.decay ** (state.iteration / max(1, config.iterations))
        rates = (config.albedo_rate, config.roughness_rate, config.metallic_rate, config.light_rate)
        for name, rate in zip(NAMES, rates, strict=True):
            if rate:
                moved = state.parameters[name] + state.moments[name].step(gradients[name], rate * remaining)
                within = to_map(name, moved, config.parametrisation)
                state.parameters[name] = to_parameter(name, within, config.parametrisation)
        state.iteration += 1
        if self._held_out and state.iteration % config.held_out_every == 0:
            values["held_out_psnr"] = self._held_out.psnr(state)
        return values

    def pictures(self, state: RefineState) -> tuple[dict[str, float], dict[Name, Map]]:
        """The loss of the pictures with the fit in dB, and derivatives with respect to the parameters."""
        config, maps = self.config, state.maps(self.config)
        seed = derive_seed(config.seed, "refine", state.iteration)
        other = derive_seed(seed, "gradient") if config.decorrelated else seed
        images = self.scene.image(maps, config.spp, seed)
        value, image_gradient = self.loss(images[..., :3])
        found = self.scene.gradients(maps, image_gradient, config.spp_gradient, other)
        values = {"loss": value, "psnr": self.loss.psnr(images[..., :3])}
        gradients = {name: found[name].reshape(state.parameters[name].shape) for name in NAMES}
        return values, {
            name: parameter_gradient(name, state.parameters[name], gradients[name], config.parametrisation)
            for name in NAMES
        }

    def priors(self, state: RefineState) -> dict[str, tuple[Name, float, Map]]:
        """Of every prior that has a weight: the map that it is of, its value, and its weighted derivative."""
        config, now, first = self.config, state.parameters, state.first
        found: dict[str, tuple[Name, float, Map]] = {}
        if config.white_light:
            light, space = now["environment"], config.parametrisation
            value, slope = white_light(to_map("environment", light, space))
            slope = config.white_light * parameter_gradient("environment", light, slope, space)
            found["white_light"] = "environment", value, slope
        if config.albedo_smoothness:
            value, slope = smoothness(now["albedo"], TEXTURE_WIDTH)
            found["albedo_smoothness"] = "albedo", value, config.albedo_smoothness * slope
        anchors = (config.albedo_anchor, config.material_anchor, config.material_anchor, config.light_anchor)
        for name, weight in zip(NAMES, anchors, strict=True):
            if weight:
                value, slope = anchor(now[name], first[name])
                found[f"{name}_anchor"] = name, value, weight * slope
        return found
