"""`unirender optimize`. Light to import: what renders is loaded when the command runs."""

import dataclasses
import json
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from unirender.errors import UnirenderError, UsageError
from unirender.system.wording import counted
from unirender.system.writing import writing
from unirender_reference.optimize.machine import require_cores
from unirender_reference.optimize.multiview.config import OptimizeConfig
from unirender_reference.optimize.single.config import SingleConfig, kept_note
from unirender_reference.option_checks import require_least
from unirender_reference.output_files import ELSEWHERE, full_disk

if TYPE_CHECKING:
    import numpy as np

    from unirender.camera import Camera
    from unirender.intrinsics import Intrinsics
    from unirender_reference.optimize.show.report import OnReport
    from unirender_reference.optimize.solution import Solution
    from unirender_reference.optimize.views import Step, Views
    from unirender_reference.shapes import MeshObject, Sphere

Predict = Callable[["np.ndarray", "np.ndarray", "Camera"], "Intrinsics"]  # display values, mask, camera -> maps

OF_FOLDERS = ("up", "hold_out", "most_views", "threads", "pictures")
OF_PICTURES = ("mask", "fov", "normal", "overwrite")


@dataclass(frozen=True)
class Optimize:
    """Inverse rendering by optimisation through Mitsuba's derivatives: pictures in; mesh, textures and light out.

    A folder of posed pictures gives `mesh.glb` with its textures and `environment.exr`; it resumes by running the same
    command again. One picture gives maps, as `unirender decompose` does.
    """

    input: Annotated[Path, tyro.conf.Positional]
    """A folder with `transforms.json` and pictures (PNG with alpha, or EXR), or one picture."""
    out: Path
    """Folder of the result."""
    mesh: Path | None = None
    """The object's mesh (GLB, glTF, OBJ, PLY, STL, OFF), in the units and axes of the poses. None: it is reconstructed
    from the masks. Of one picture: a mesh that faces the camera."""
    init: Literal["none", "unirender"] = "none"
    """unirender: begin with what the learned model predicts."""
    size: int | None = None
    """Larger pictures are reduced to this many pixels along their longer side."""
    up: Literal["y", "z"] = "y"
    """Which way is up in the poses; z: as in Blender and NeRF's synthetic scenes (a glTF or GLB mesh is y up all the
    same)."""
    hold_out: int = 0
    """Every N-th picture is only watched, for the early stop. 0: those that the folder holds out."""
    most_views: int | None = None
    """Where there are more pictures, this many are taken, evenly spread."""
    threads: int = 0
    """Threads of the renderer. 0: one for each core. 1: equal runs give equal bytes."""
    mask: Path | None = None
    """Of one picture: its coverage (white: object). None: the alpha channel, else the whole frame."""
    fov: float | None = None
    """Of one picture: vertical field of view in degrees. None: as the header of an EXR of ours or the maps of --normal
    say, else 36."""
    normal: Path | None = None
    """Of one picture: normals in camera axes: the output of `unirender decompose`, an EXR with normal.X/Y/Z, or a
    picture of (n + 1) / 2. None: those of --mesh, of --init, or a guess from the silhouette."""
    overwrite: bool = False
    """Of one picture: replace an earlier result."""
    pictures: bool = True
    """Of a folder: render strips to look at: given beside found, a turntable, other lights."""
    progress: bool = True
    """Show progress."""
    config: Annotated[OptimizeConfig, tyro.conf.arg(name="")] = field(default_factory=OptimizeConfig)
    single: tyro.conf.AvoidSubcommands[SingleConfig] = field(default_factory=SingleConfig)
    """Of one picture."""

    def check(self) -> None:
        """Looks at the values.

        Raises:
            UsageError: one is outside its range, or options contradict each other.
            UnirenderError: one asks for more than the machine has.
        """
        require_least(self, "", {"size": 8, "most_views": 1, "threads": 0})
        if self.hold_out < 0 or self.hold_out == 1:
            raise UsageError(f"--hold-out {self.hold_out}: expected 2 or more, or 0 (those that the folder holds out)")
        if self.fov is not None and not 0 < self.fov < 180:
            raise UsageError(f"--fov {self.fov:g}: expected degrees between 0 and 180")
        self.config.check()
        folder = self.input.is_dir()
        wrong, kind = (OF_PICTURES, "one picture") if folder else (OF_FOLDERS, "a folder of pictures")
        defaults = {entry.name: entry.default for entry in dataclasses.fields(self)}
        given = [_option(name) for name in wrong if getattr(self, name) != defaults[name]]
        given += _changed(self.single, SingleConfig(), "single.") if folder else _changed(self.config, OptimizeConfig())
        if given:
            raise UsageError(
                f"{', '.join(given)}: of {kind}, but {self.input} is {'a folder' if folder else 'none'}; "
                f"leave {'it' if len(given) == 1 else 'them'} out"
            )
        if folder and self.mesh is not None:
            changed = _changed(self.config, OptimizeConfig())
            given = [option for option in changed if option.startswith("--shape")]
            if given:
                raise UsageError(
                    f"{', '.join(given)}: of the reconstruction, but --mesh gives the shape; leave one of both out"
                )
        require_cores(self.threads)

    def run(self, predict: Predict | None = None) -> int:
        """Optimises, or goes on; returns the exit status.

        Args:
            predict: the learned model, for `--init unirender`.
        """
        if not self.input.exists():
            raise UnirenderError(
                f"{self.input}: no such file or folder, expected posed pictures or one picture; is the path right?"
            )
        if self.input.suffix.lower() == ".json" and self.input.is_file():
            raise UsageError(f"{self.input}: is a file of poses, expected its folder, {self.input.parent}")
        self.check()
        if self.init == "unirender" and predict is None:
            raise UnirenderError("--init unirender: no model at hand, expected the command line to bring one")
        chosen = predict if self.init == "unirender" else None
        return self._run_folder(chosen) if self.input.is_dir() else self._run_picture(chosen)

    def _run_folder(self, predict: Predict | None) -> int:
        """Optimises a folder of posed pictures and prints the figures of the result; the exit status."""
        from rich.console import Console

        from unirender_reference.optimize.files.export import SOLUTION_FILE
        from unirender_reference.optimize.multiview.run import optimize
        from unirender_reference.optimize.show.live import live_report
        from unirender_reference.optimize.show.report import refinement_note, views_note

        views, obj, place = self.read()
        with live_report(Console(stderr=True, quiet=not self.progress)) as report:
            began = time.perf_counter()
            start = None if predict is None else self._start(views, obj, predict, report)
            with full_disk(self.out):
                optimize(
                    views,
                    obj if start is None else None,
                    self.config,
                    self.out,
                    start,
                    report,
                    place,
                    pictures=self.pictures,
                    threads=self.threads,
                    began=began,
                )
        record = json.loads((self.out / SOLUTION_FILE).read_text(encoding="utf-8"))
        figures = ", ".join(f"{name.removesuffix('_psnr_db')} {db:.2f} dB" for name, db in record["figures"].items())
        print(
            f"{self.out}: {counted(len(views.seen), 'view')}, {record['seconds']:.1f} s; masked PSNR of the pictures: "
            f"{figures}; IoU of the masks: {record['mask_iou']:.3f}"
        )
        for note in (refinement_note(record["stages"]), views_note(record["figures"])):
            if note is not None:
                print(note)
        return 0

    def read(self) -> "tuple[Views, MeshObject | None, Sphere]":
        """The views with their world in the unit sphere, the mesh, and where it stood."""
        from unirender_reference.meshes import load_mesh_placed
        from unirender_reference.optimize.files.folder import read_views
        from unirender_reference.optimize.shape.placement import check_alignment, placed, sphere_of_masks

        views = read_views(
            self.input, up=self.up, hold_out=self.hold_out, most_views=self.most_views, longest_side=self.size
        )
        if self.mesh is None:
            place = sphere_of_masks(views)
            return placed(views, place), None, place
        obj, place = load_mesh_placed(self.mesh)
        views = placed(views, place)
        check_alignment(views, obj, place, self.up)
        return views, obj, place

    def _start(self, views: "Views", obj: "MeshObject | None", predict: Predict, show: "OnReport") -> "Solution":
        """What the model predicts for every view, on the mesh."""
        from unirender_reference.optimize.multiview.warm import solution_from_predictions
        from unirender_reference.optimize.show.report import Report
        from unirender_reference.optimize.views import Step

        if obj is None:
            raise UsageError("--init unirender: expected --mesh beside it, to put the predicted maps on")
        if views.hdr:
            raise UsageError(
                "--init unirender: the model sees display pictures, and these are linear (EXR); leave it out"
            )
        predictions, began, count = [], time.perf_counter(), len(views.seen)
        for done, view in enumerate(views.seen, 1):
            predictions.append(predict(view.image, view.mask, view.camera))
            seconds = time.perf_counter() - began
            show(Report(Step("prediction", done, seconds, {}), 1, 1, count, seconds * (count - done) / done))
        return solution_from_predictions(views, obj, predictions, self.config.texture_size, self.config.light_rows)

    def _run_picture(self, predict: Predict | None) -> int:
        """Optimises one picture and writes a result folder; the exit status."""
        from rich.console import Console

        from unirender.files import write_result
        from unirender.new_folders import new_folder
        from unirender_reference.optimize.files.state import history_line
        from unirender_reference.optimize.show.live import live_report
        from unirender_reference.optimize.show.report import Report
        from unirender_reference.optimize.single.picture import read_picture_input
        from unirender_reference.optimize.single.render import rerendered
        from unirender_reference.optimize.single.run import optimize_image

        obj = None
        if self.mesh is not None:
            from unirender_reference.meshes import load_mesh

            obj = load_mesh(self.mesh)
        steps: list[Step] = []
        console = Console(stderr=True, quiet=not self.progress)
        with new_folder(self.out, overwrite=self.overwrite) as folder:
            given = read_picture_input(self.input, self.mask, self.fov, self.normal, self.size)
            if predict is not None and given.hdr:
                raise UsageError(
                    "--init unirender: the model sees display pictures, and this one is linear (EXR); leave it out"
                )
            with live_report(console) as report:

                def on_step(step: "Step") -> None:
                    steps.append(step)
                    report(Report(step, 1, 1, None, None))

                began = time.perf_counter()
                start = None if predict is None else predict(given.image, given.mask, given.camera)
                priors, trust = self.single.resolved(obj is not None, start is not None)
                config = dataclasses.replace(self.single, priors=priors, trust=trust)
                found = optimize_image(
                    given.image,
                    given.mask,
                    given.camera,
                    config,
                    normal=given.normal,
                    geometry=obj,
                    init=start,
                    hdr=given.hdr,
                    clipped=given.clipped,
                    on_step=on_step,
                )
            seconds = time.perf_counter() - began
            again = rerendered(given, found, obj, self.input.name)
            meta = {"command": "optimize", "input": self.input, "init": self.init, "hdr": given.hdr, "mesh": self.mesh}
            meta |= {"psnr_db": again.psnr_db, "config": dataclasses.asdict(config)}
            with writing(self.out, ELSEWHERE):
                write_result(folder, found, meta, again.image_linear)
                again.strip.save(folder / "views.png")
                (folder / "history.jsonl").write_text("".join(map(history_line, steps)), encoding="utf-8")
        print(f"{self.out}: {seconds:.1f} s; masked PSNR of the picture, rendered again: {again.psnr_db:.2f} dB")
        print(kept_note(trust, start is not None))
        return 0


def _option(name: str) -> str:
    return f"--{name.replace('_', '-')}"


def _changed(value: Any, default: Any, prefix: str = "") -> list[str]:
    """The options of a group that are not as they are by default."""
    found = []
    for entry in dataclasses.fields(default):
        own, usual = getattr(value, entry.name), getattr(default, entry.name)
        if dataclasses.is_dataclass(usual):
            found += _changed(own, usual, f"{prefix}{entry.name}.")
        elif own != usual:
            found.append(_option(prefix + entry.name))
    return found
