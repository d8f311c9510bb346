"""The commands that run the model: `decompose`, `render`, `edit`, `relight`. Light to import.

They know nothing of the ground truth: what reads the light files is passed in by the composition root, `unirender.cli`.
"""

import contextlib
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from unirender.command_line.input_picture import (
    DERIVED_BYTES_A_PIXEL,
    RELIT_BYTES_A_PIXEL,
    RENDERED_BYTES_A_PIXEL,
    memory_remarks,
)
from unirender.command_line.options import DecompositionOptions, InputOptions, ModelOptions, OutputOptions
from unirender.command_line.remarks import (
    at_white,
    check_stops,
    missing_maps,
    normals_away,
    overflow,
    parts_left_out,
    with_frame_remarks,
)
from unirender.errors import UnirenderError, UsageError
from unirender.system.notices import notice

if TYPE_CHECKING:
    import numpy as np

    from unirender.intrinsics import Intrinsics
    from unirender.pipelines.results import EditResult
    from unirender.pipelines.unirender_pipeline import UniRenderPipeline

MUCH_COARSE = 0.05  # share of the object, from which a notice is due

ReadLight = Callable[[Path], "np.ndarray"]  # radiance [h w 3] as it stands in a light file


def exposed_light(read_light: ReadLight, path: Path, stops: float | None) -> tuple["np.ndarray", str]:
    """Radiance [h w 3] of a light file with stops added, and the pipeline's rule of its exposure."""
    light = read_light(path)
    return (light, "auto") if stops is None else (light * 2.0**stops, "keep")


def write_edited(folder: Path, result: "EditResult", meta: dict[str, Any], pipeline: "UniRenderPipeline") -> None:
    """Writes an edited or relit picture with its maps, and into `meta.json` what lies beyond the network's ranges."""
    from unirender.files import write_result

    image, maps = result.image_linear, result.intrinsics
    write_result(folder, maps, meta | at_white(image, maps.mask) | overflow(pipeline, maps), image)


@dataclass(frozen=True)
class Decompose:
    """Inverse rendering: one picture -> albedo, normal, roughness, metallic, s, d and the environment.

    Of a folder of pictures, each one: into a folder of its own, with a summary beside them."""

    input: tyro.conf.OmitArgPrefixes[InputOptions]
    out: tyro.conf.OmitArgPrefixes[OutputOptions]
    frames: bool = False
    """The folder's pictures are successive frames: report how much each map changes from one to the next."""
    export: Path | None = None
    """Write the maps as a scene for other programs, too: a folder with `scene.xml` for Mitsuba 3 and `card.gltf`. It
    may lie inside the output folder."""
    decomposition: tyro.conf.OmitArgPrefixes[DecompositionOptions] = field(default_factory=DecompositionOptions)
    model: tyro.conf.OmitArgPrefixes[ModelOptions] = field(default_factory=ModelOptions)

    def run(self) -> int:
        """Returns the exit status."""
        from unirender.folders import of_picture, write_decomposition
        from unirender.new_folders import folder_beside, new_folder
        from unirender.scene_export import write_scene

        self.model.check()
        self.decomposition.check(self.model.mode)
        if self.input.picture.is_dir():
            from unirender.command_line.folder_command import run_folder

            return run_folder(self)
        if self.frames:
            raise UnirenderError(f"{self.input.picture}: is no folder, expected a folder of pictures for --frames")
        picture, camera = self.input.read(self.model, self.decomposition.bytes_a_pixel(self.model.samples))
        with contextlib.ExitStack() as folders:
            folder = folders.enter_context(new_folder(self.out.output, overwrite=self.out.overwrite))
            scene: Path | None = None
            if self.export is not None:
                beside = folder_beside(self.export, self.out.output, folder, overwrite=self.out.overwrite)
                scene = folders.enter_context(beside)
            pipeline, sampling = self.model.load(), self.model.sampling()
            picture = with_frame_remarks(picture, self.model.side(pipeline), self.decomposition.tile)
            settings = self.decomposition.settings
            result = pipeline.decompose(picture.image_srgb, picture.mask, camera=camera, **settings, **sampling)
            meta = {"command": "decompose", **self.input.files, **of_picture(picture), **settings}
            meta = write_decomposition(folder, result, meta | self.model.provenance(pipeline))
            if scene is not None:
                write_scene(scene, result.intrinsics, meta)
        print(f"{self.out.output}: roughness {result.roughness:.2f}, metallic {result.metallic:.2f}")
        return 0


@dataclass(frozen=True)
class Render:
    """Rendering: maps (as `decompose` writes them) -> picture."""

    maps: Annotated[Path, tyro.conf.Positional]
    """Output of `unirender decompose`, whose PNGs may have been edited; any folder with `intrinsics.exr` or with a file
    for each map (`albedo.png`, `normal.exr`, ...) and, for light, `environment.exr`; or one EXR file of maps."""
    out: tyro.conf.OmitArgPrefixes[OutputOptions]
    environment: Path | None = None
    """Lat-long HDR or EXR light, or a photograph, instead of the folder's; s and d are derived from it."""
    exposure: float | None = None
    """Stops to add to that light as it is in its file. None: it is scaled by the rule of the training data."""
    shadows: bool = True
    """Where s and d are derived from a light, the surfaces of the picture cast shadows on one another, as far as their
    normals say where they are, and reflect what they hide."""
    model: tyro.conf.OmitArgPrefixes[ModelOptions] = field(default_factory=ModelOptions)

    def run(self, read_light: ReadLight) -> int:
        """Returns the exit status."""
        from unirender.files import read_result, write_result
        from unirender.map_edits import with_edits
        from unirender.new_folders import new_folder
        from unirender.pipelines.edited_light import with_edited_light
        from unirender.pipelines.editing import under_light
        from unirender.pipelines.rendered_maps import ready_to_render, to_derive, told_derived, with_mask

        self.model.check()
        check_stops(self.exposure)
        if self.exposure is not None and self.environment is None:
            raise UsageError(f"--exposure {self.exposure:g} is of a new light: expected --environment beside it")
        remarks = self._memory_remarks()
        stored = read_result(self.maps, self.model.fov, light=self.environment is None, edits=False)
        intrinsics = with_edits(stored, self.maps)
        if self.environment is None:
            intrinsics = with_edited_light(stored, intrinsics)
        self._check_maps(intrinsics)
        with new_folder(self.out.output, overwrite=self.out.overwrite) as folder:
            light = None if self.environment is None else exposed_light(read_light, self.environment, self.exposure)
            pipeline = self.model.load()
            meta: dict[str, Any] = {"command": "render", "input": self.maps}
            changed = [name for name, value in intrinsics.maps.items() if value is not getattr(stored, name)]
            meta |= {"edited": changed, **missing_maps(intrinsics, self.environment is not None)}
            intrinsics = with_mask(intrinsics)
            meta |= normals_away(intrinsics)
            if light is not None:
                intrinsics = under_light(intrinsics, *light, shadows=self.shadows)
                meta |= {"light": self.environment, "exposure_stops": self.exposure}
            of_light = to_derive(intrinsics) if self.environment is None else ("specular", "diffuse")
            if of_light:
                meta["shadows"] = self.shadows  # of what is derived; of maps that are given nobody is asked
            if of_light and self.environment is None:
                of_folder = intrinsics.require("environment")["environment"]
                known = intrinsics.specular, intrinsics.diffuse
                intrinsics = under_light(intrinsics, of_folder, "keep", *known, shadows=self.shadows)
            meta["remarks"] = remarks | parts_left_out(intrinsics.mask, self.model.side(pipeline))
            for remark in meta["remarks"].values():
                notice(remark)
            # What is derived is direct light. Here, so that it is done once.
            ready = ready_to_render(intrinsics, self.shadows, of_light)
            image = pipeline.render(ready, derived=told_derived(of_light, self.shadows), **self.model.sampling())
            meta |= {**self.model.provenance(pipeline), **overflow(pipeline, ready), **at_white(image, ready.mask)}
            write_result(folder, intrinsics, meta, image)
        print(f"{self.out.output}")
        return 0

    def _check_maps(self, intrinsics: "Intrinsics") -> None:
        """Looks at which maps there are.

        Raises:
            UnirenderError: one that every rendering needs is missing.
        """
        from unirender.pipelines.rendered_maps import RENDER_NEEDS

        try:
            intrinsics.require(*RENDER_NEEDS)
        except UnirenderError as error:
            raise UnirenderError(f"{self.maps}: {error}") from None

    def _memory_remarks(self) -> dict[str, str]:
        """As `memory_remarks` has them, of the maps' size in their header."""
        from unirender.exr import channel_names, pixel_count
        from unirender.files import ENVIRONMENT_FILE, INTRINSICS_FILE
        from unirender.map_files import map_files
        from unirender.pictures import header_pixels

        file = self.maps / INTRINSICS_FILE if self.maps.is_dir() else self.maps
        if self.maps.is_dir() and not file.is_file() and (files := map_files(self.maps)):
            size = max(map(header_pixels, files.values()))
            return memory_remarks(self.maps, size, DERIVED_BYTES_A_PIXEL)
        if not file.is_file():  # told by what reads the maps; OpenEXR would print a line of its own
            return {}
        lit = self.maps.is_dir() and (self.maps / ENVIRONMENT_FILE).exists()
        derived = self.environment is not None or (lit and not {"specular.R", "diffuse.R"} <= channel_names(file))
        taken = DERIVED_BYTES_A_PIXEL if derived else RENDERED_BYTES_A_PIXEL
        return memory_remarks(self.maps, pixel_count(file), taken)


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
    decomposition: tyro.conf.OmitArgPrefixes[DecompositionOptions] = field(default_factory=DecompositionOptions)
    model: tyro.conf.OmitArgPrefixes[ModelOptions] = field(default_factory=ModelOptions)

    def run(self) -> int:
        """Returns the exit status."""
        from unirender.folders import of_picture
        from unirender.new_folders import new_folder

        self.model.check()
        self.decomposition.check(self.model.mode)
        change = {"roughness": self.roughness, "metallic": self.metallic}
        if set(change.values()) == {None}:
            raise UsageError("edit: nothing to change, expected --roughness or --metallic (or both)")
        for name, value in change.items():
            if value is not None and not 0 <= value <= 1:
                raise UsageError(f"--{name} {value}: expected a number in [0, 1]")
        picture, camera = self.input.read(self.model, self.decomposition.bytes_a_pixel(self.model.samples))
        options = {"anchored": self.anchored, **self.decomposition.settings}
        with new_folder(self.out.output, overwrite=self.out.overwrite) as folder:
            pipeline, sampling = self.model.load(), self.model.sampling()
            picture = with_frame_remarks(picture, self.model.side(pipeline), self.decomposition.tile)
            result = pipeline.edit(picture.image_srgb, picture.mask, camera=camera, **change, **options, **sampling)
            meta = {"command": "edit", **self.input.files, **of_picture(picture), **change, **options}
            meta |= {"bounded": result.bounded, "coarse": result.coarse_share, **self.model.provenance(pipeline)}
            write_edited(folder, result, meta, pipeline)
        if result.coarse_share > MUCH_COARSE:
            notice(
                f"the predicted light is too coarse to show what roughness {self.roughness:g} reflects on "
                f"{result.coarse_share:.0%} of the object: its highlights stay as wide as they were"
            )
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
    shadows: bool = False
    """The surfaces of the picture cast shadows on one another, as far as the predicted normals say where they are."""
    decomposition: tyro.conf.OmitArgPrefixes[DecompositionOptions] = field(default_factory=DecompositionOptions)
    model: tyro.conf.OmitArgPrefixes[ModelOptions] = field(default_factory=ModelOptions)

    def run(self, read_light: ReadLight) -> int:
        """Returns the exit status."""
        from unirender.folders import of_picture
        from unirender.new_folders import new_folder

        self.model.check()
        self.decomposition.check(self.model.mode)
        check_stops(self.exposure)
        taken = max(RELIT_BYTES_A_PIXEL, self.decomposition.bytes_a_pixel(self.model.samples))
        picture, camera = self.input.read(self.model, taken)
        options = {"anchored": self.anchored, **self.decomposition.settings, "shadows": self.shadows}
        with new_folder(self.out.output, overwrite=self.out.overwrite) as folder:
            light, rule = exposed_light(read_light, self.environment, self.exposure)
            pipeline, sampling = self.model.load(), self.model.sampling()
            picture = with_frame_remarks(picture, self.model.side(pipeline), self.decomposition.tile)
            result = pipeline.relight(
                picture.image_srgb, light, picture.mask, exposure=rule, camera=camera, **options, **sampling
            )
            meta = {"command": "relight", **self.input.files, **of_picture(picture), **options}
            meta |= {"light": self.environment, "exposure_stops": self.exposure, **self.model.provenance(pipeline)}
            write_edited(folder, result, meta, pipeline)
        print(f"{self.out.output}")
        return 0
