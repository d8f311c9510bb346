"""Where a refinement stands: maps, moments and the iteration, in memory and in a file."""

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from unirender.errors import UnirenderError
from unirender.system.whole_files import whole_file
from unirender_reference.optimize.numerics.descent import PyramidAdam
from unirender_reference.optimize.refine.config import RefineConfig
from unirender_reference.optimize.refine.parameters import NAMES, Name, to_map, to_parameter
from unirender_reference.optimize.solution import Solution


@dataclass
class RefineState:
    """Where a refinement stands; `refine` moves it on in place, so that a caller may save it after any step.

    Attributes:
        iteration: steps made.
        parameters: the maps in the space of steps, by name; roughness and metallic have one channel.
        moments: Adam's, by name.
        first: the parameters of the start.
    """

    iteration: int
    parameters: dict[Name, Float[np.ndarray, "h w c"]]
    moments: dict[Name, PyramidAdam]
    first: dict[Name, Float[np.ndarray, "h w c"]]

    @classmethod
    def begin(cls, start: Solution, config: RefineConfig) -> "RefineState":
        """The state before the first step."""
        assert start.obj.roughness is not None
        assert start.obj.metallic is not None
        maps = (start.obj.albedo, start.obj.roughness[..., None], start.obj.metallic[..., None], start.environment)
        first: dict[Name, np.ndarray] = {
            name: to_parameter(name, values, config.parametrisation) for name, values in zip(NAMES, maps, strict=True)
        }
        levels = (config.albedo_levels, config.material_levels, config.material_levels, config.light_levels)
        moments: dict[Name, PyramidAdam] = {
            name: PyramidAdam(first[name].shape, count, name == "environment", config.uniform, config.beta_2)
            for name, count in zip(NAMES, levels, strict=True)
        }
        return cls(0, {name: values.copy() for name, values in first.items()}, moments, first)

    def maps(self, config: RefineConfig, parameters: Mapping[Name, Any] | None = None) -> dict[str, Any]:
        """What a `TexturedScene` shows: the present parameters, or others, such as `first`."""
        shown = self.parameters if parameters is None else parameters
        maps = {name: to_map(name, shown[name], config.parametrisation) for name in NAMES}
        return {name: values[..., 0] if name in ("roughness", "metallic") else values for name, values in maps.items()}

    def solution(self, start: Solution, config: RefineConfig) -> Solution:
        """The present maps on the start's mesh."""
        maps = self.maps(config)
        textures = {name: maps[name] for name in ("albedo", "roughness", "metallic")}
        return Solution(dataclasses.replace(start.obj, **textures), maps["environment"])

    def save(self, path: Path) -> None:
        """Writes an npz file; a killed run leaves the file that was there, or the new one."""
        with whole_file(path) as file:
            np.savez(file, **self._arrays())

    @classmethod
    def load(cls, path: Path, start: Solution, config: RefineConfig) -> "RefineState":
        """What `save` wrote, for the same start and configuration.

        Raises:
            UnirenderError: the file is unreadable or belongs to another start or configuration.
        """
        state = cls.begin(start, config)
        try:
            with np.load(path) as file:
                arrays = {name: file[name] for name in file.files}
        except Exception as error:  # NumPy raises half a dozen kinds for a damaged file
            raise UnirenderError(
                f"{path}: no readable state of a refinement ({error!s:.200}); delete it to begin anew"
            ) from error
        found, expected = ({name: array.shape for name, array in own.items()} for own in (arrays, state._arrays()))
        for name in sorted({*found, *expected}):
            if found.get(name) != expected.get(name):
                raise UnirenderError(
                    f"{path}: {name} has shape {found.get(name)}, expected {expected.get(name)}; the state belongs to "
                    "another start or configuration: delete it to begin anew"
                )
        state.iteration = int(arrays["iteration"])
        for name in NAMES:
            state.parameters[name], state.first[name] = arrays[f"parameter.{name}"], arrays[f"first.{name}"]
            own = [arrays[f"moment.{name}.{index}"] for index in range(len(state.moments[name].arrays()))]
            state.moments[name].restore(own, state.iteration)
        return state

    def _arrays(self) -> dict[str, Any]:
        """All that a file holds, by name."""
        arrays: dict[str, Any] = {"iteration": np.array(self.iteration)}
        arrays |= {f"parameter.{name}": values for name, values in self.parameters.items()}
        arrays |= {f"first.{name}": values for name, values in self.first.items()}
        for name, moments in self.moments.items():
            arrays |= {f"moment.{name}.{index}": array for index, array in enumerate(moments.arrays())}
        return arrays
