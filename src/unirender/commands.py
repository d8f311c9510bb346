"""The commands that run the model: `decompose`, `render`, `edit`, `relight`. Light to import.

They know nothing of the ground truth: what reads the light files is passed in by the composition root, `unirender.cli`.
"""

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from unirender.errors import UsageError
from unirender.options import InputOptions, ModelOptions, OutputOptions, notice

if TYPE_CHECKING:
    import numpy as np

    from unirender.intrinsics import Intrinsics
    from unirender.pipelines.unirender_pipeline import UniRenderPipeline

MAX_STOPS = 32

ReadLight = Callable[[Path], "np.ndarray"]  # radiance [h w 3] as it stands in a light file


@dataclass(frozen=True)
class Decompose:
    """Inverse rendering: one picture -> albedo, normal, roughness, metallic, s, d and the environment."""

    input: tyro.conf.OmitArgPrefixes[InputOptions]
    out: tyro.conf.OmitArgPrefixes[OutputOptions]
    closed: bool = True
    """Change albedo, s and d so that their rendering is the picture; otherwise the maps are the network's own."""
    model: tyro.conf.OmitArgPrefixes[ModelOptions] = field(default_factory=ModelOptions)

    def run(self) -> int:
        """Returns the exit status."""
        from unirender.files import new_folder, write_png, write_result

        self.model.check()
        picture, camera = self.input.read(), self.model.camera()
        with new_folder(self.out.output, overwrite=self.out.overwrite) as folder:
            pipeline, sampling = self.model.load(), self.model.sampling()
            result = pipeline.decompose(picture.image_srgb, picture.mask, camera=camera, closed=self.closed, **sampling)
            meta = {"command": "decompose", "input": self.input.picture, "clipped": picture.clipped}
            meta |= {"closed": self.closed, **self.model.provenance(pipeline)}
            meta |= {"roughness_mean": result.roughness, "metallic_mean": result.metallic}
            if result.std is not None:
                meta["std_max"] = {name: float(spread.max()) for name, spread in result.std.items()}
            write_result(folder, result.intrinsics, meta)
            for name, spread in (result.std or {}).items():
                write_png(folder / f"{name}.std.png", spread / max(float(spread.max()), 1e-6))
        print(f"{self.out.output}: roughness {result.roughness:.2f}, metallic {result.metallic:.2f}")
        return 0


@dataclass(frozen=True)
class Render:
    """Rendering: maps (as `decompose` writes them) -> picture."""

    maps: Annotated[Path, tyro.conf.Positional]
    """Output of `unirender decompose`; any folder with `intrinsics.exr` and, for light, `environment.exr`; or one EXR
    file of maps."""
    out: tyro.conf.OmitArgPrefixes[OutputOptions]
    environment: Path | None = None
    """Lat-long HDR or EXR light, or a photograph, instead of the folder's; s and d are derived from it."""
    exposure: float | None = None
    """Stops to add to that light as it is in its file. None: it is scaled by the rule of the training data."""
    model: tyro.conf.OmitArgPrefixes[ModelOptions] = field(default_factory=ModelOptions)

    def run(self, read_light: ReadLight) -> int:
        """Returns the exit status."""
        from unirender.files import new_folder, read_result, write_result
        from unirender.pipelines.editing import under_light
        from unirender.pipelines.inputs import with_mask

        self.model.check()
        check_exposure(self.exposure)
        if self.exposure is not None and self.environment is None:
            raise UsageError(f"--exposure {self.exposure:g} is of a new light: expected --environment beside it")
        intrinsics = read_result(self.maps, self.model.fov)
        with new_folder(self.out.output, overwrite=self.out.overwrite) as folder:
            meta: dict[str, Any] = {"command": "render", "input": self.maps}
            if self.environment is not None:
                light = read_light(self.environment) * 2.0 ** (self.exposure or 0.0)
                intrinsics = under_light(with_mask(intrinsics), light, "auto" if self.exposure is None else "keep")
                meta |= {"light": self.environment, "exposure_stops": self.exposure}
            if not {"specular", "diffuse", "environment"} & set(intrinsics.present):
                notice("the maps have no light (no specular, diffuse or environment): the network imagines one")
            pipeline = self.model.load()
            image = pipeline.render(intrinsics, **self.model.sampling())
            meta |= {**self.model.provenance(pipeline), **overflow(pipeline, intrinsics)}
            write_result(folder, intrinsics, meta, image)
        print(f"{self.out.output}")
        return 0


@dataclass(frozen=True)
class Edit:
    """Material edit: decompose a picture, change roughness or metallic, render again."""

    input: tyro.conf.OmitArgPrefixes[InputOptions]
    out: tyro.conf.OmitArgPrefixes[OutputOptions]
    roughness: float | None = None
    """New roughness of the whole object, in [0, 1]."""
    metallic: float | None = None
    """New metallic of the whole object, in [0, 1]."""
    anchored: bool = True
    """Carry over what the decomposition could not explain: the input times render(after) / render(before)."""
    closed: bool = True
    """Change albedo, s and d so that their rendering is the picture; otherwise the maps are the network's own."""
    model: tyro.conf.OmitArgPrefixes[ModelOptions] = field(default_factory=ModelOptions)

    def run(self) -> int:
        """Returns the exit status."""
        from unirender.files import new_folder, write_result

        self.model.check()
        change = {"roughness": self.roughness, "metallic": self.metallic}
        if set(change.values()) == {None}:
            raise UsageError("edit: nothing to change, expected --roughness or --metallic (or both)")
        for name, value in change.items():
            if value is not None and not 0 <= value <= 1:
                raise UsageError(f"--{name} {value}: expected a number in [0, 1]")
        picture, camera = self.input.read(), self.model.camera()
        options = {"anchored": self.anchored, "closed": self.closed}
        with new_folder(self.out.output, overwrite=self.out.overwrite) as folder:
            pipeline, sampling = self.model.load(), self.model.sampling()
            result = pipeline.edit(picture.image_srgb, picture.mask, camera=camera, **change, **options, **sampling)
            meta = {"command": "edit", "input": self.input.picture, "clipped": picture.clipped, **change, **options}
            meta |= {"bounded": result.bounded, **self.model.provenance(pipeline)}
            write_result(folder, result.intrinsics, meta | overflow(pipeline, result.intrinsics), result.image_linear)
        print(f"{self.out.output}")
        return 0


@dataclass(frozen=True)
class Relight:
    """Relighting: decompose a picture, put it under another environment, render again."""

    input: tyro.conf.OmitArgPrefixes[InputOptions]
    environment: Path
    """Lat-long HDR or EXR, or a photograph as a light."""
    out: tyro.conf.OmitArgPrefixes[OutputOptions]
    exposure: float | None = None
    """Stops to add to the light as it is in the file. None: the light is scaled by the rule of the training data."""
    anchored: bool = True
    """Carry over what the decomposition could not explain: the input times render(after) / render(before)."""
    closed: bool = True
    """Change albedo, s and d so that their rendering is the picture; otherwise the maps are the network's own."""
    model: tyro.conf.OmitArgPrefixes[ModelOptions] = field(default_factory=ModelOptions)

    def run(self, read_light: ReadLight) -> int:
        """Returns the exit status."""
        from unirender.files import new_folder, write_result

        self.model.check()
        check_exposure(self.exposure)
        picture, camera = self.input.read(), self.model.camera()
        options = {"anchored": self.anchored, "closed": self.closed}
        with new_folder(self.out.output, overwrite=self.out.overwrite) as folder:
            light = read_light(self.environment) * 2.0 ** (self.exposure or 0.0)
            pipeline, sampling = self.model.load(), self.model.sampling()
            result = pipeline.relight(
                picture.image_srgb,
                light,
                picture.mask,
                exposure="auto" if self.exposure is None else "keep",
                camera=camera,
                **options,
                **sampling,
            )
            meta = {"command": "relight", "input": self.input.picture, "clipped": picture.clipped, **options}
            meta |= {"light": self.environment, "exposure_stops": self.exposure, **self.model.provenance(pipeline)}
            write_result(folder, result.intrinsics, meta | overflow(pipeline, result.intrinsics), result.image_linear)
        print(f"{self.out.output}")
        return 0


def check_exposure(stops: float | None) -> None:
    """Looks at a number of stops.

    Raises:
        UsageError: it is none that a light could be changed by.
    """
    if stops is not None and not abs(stops) <= MAX_STOPS:
        raise UsageError(f"--exposure {stops}: expected stops between -{MAX_STOPS} and {MAX_STOPS}")


def overflow(pipeline: "UniRenderPipeline", intrinsics: "Intrinsics") -> dict[str, Any]:
    """For `meta.json`: which HDR maps exceed the brightest that the network was taught, and by how many values."""
    return {"above_x_max": {name: dataclasses.asdict(over) for name, over in pipeline.overflow(intrinsics).items()}}
