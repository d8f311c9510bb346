"""`unirender figures`. Light to import; the command loads what it needs when it runs."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Literal, get_args

import tyro

from unirender.command_line.option_checks import at_least
from unirender.command_line.options import Device
from unirender.errors import UnirenderError, UsageError
from unirender.system.notices import notice
from unirender.system.writing import check_out

if TYPE_CHECKING:
    from unirender.pictures import Picture
    from unirender_evaluation.figures.grid import Grid
    from unirender_evaluation.figures.panels import MitsubaTruth, Subject
    from unirender_evaluation.suites.suite import Scene, Suite

Asked = Literal["metallic", "roughness", "relighting", "comparison", "overview", "light"]  # of checkpoints and methods
Contract = Literal["maps", "camera"]  # of the documentation of the data contract; of nobody
Kind = Literal[Asked, Contract]  # and no union of the two, whose choices would be listed in no order
ASKED: tuple[Asked, ...] = get_args(Asked)
KINDS = ASKED[:-1]  # where none is named: few methods find the light
STRIPS: tuple[Asked, ...] = ("metallic", "roughness")  # which pictures of one's own have, too
CONTRACT: tuple[Contract, ...] = get_args(Contract)
SCENES = 2  # that are shown where none is named


@dataclass(frozen=True)
class Figures:
    """Draw the paper's kinds of figure from any checkpoint, beside Mitsuba's truth: PNG files with labels and PSNR.

    Strips of edited metallic and roughness, a grid of relightings, a sheet that compares checkpoints and methods, and
    an overview of what is found in one picture. Of pictures of your own, whose truth is not known: maps, edits,
    relightings.
    """

    out: Path = Path("figures")
    """Folder of the pictures, one PNG for each of `--kinds`."""
    checkpoint: tyro.conf.UseAppendAction[tuple[Path, ...]] = ()
    """Folder of a checkpoint of ours, or a shipped one by name; repeatable. None: the shipped one for
    pictures of the suite's size, unless there is a --method."""
    method: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    """Somebody else's method: module:Class or path/to/file.py:Class, as in `unirender bench run`; repeatable."""
    suite: str = "tiny"
    """A bundled suite, or the path of a suite's TOML file."""
    scenes: tuple[str, ...] = ()
    """Keys of scenes of the suite. None: two, from its first and second half."""
    pictures: tuple[Path, ...] = ()
    """Pictures of your own instead of the suite's, with an alpha channel that cuts the object out: `pictures.png`, or,
    with --kinds metallic roughness, strips of them."""
    kinds: tuple[Kind, ...] = KINDS
    """metallic, roughness: the input edited over `--values`. relighting: under other lights of the suite. comparison: a
    column for each checkpoint and method. overview: maps, edits and relighting of one picture. light: balls under the
    light that is found. maps, camera: what the data contract says, without a method. These three only where they are
    named. With --pictures metallic and roughness alone."""
    values: tuple[float, ...] = (0.0, 0.25, 0.5, 0.75, 1.0)
    """Values of metallic and roughness in the strips, in [0, 1]."""
    lights: int = 4
    """How many lights the relighting grid and the sheet of --pictures show."""
    spp: int = 1024
    """Samples per pixel of the truth that is rendered for strips and relighting."""
    device: Device = "cpu"
    """Where our model runs. auto: cuda, then mps, then cpu, whichever is there."""

    def check(self) -> None:
        """Looks at the values; `UsageError` where one is outside its range, or named twice."""
        at_least(1, lights=self.lights, spp=self.spp)
        for name in ("scenes", "pictures", "kinds", "values", "checkpoint", "method"):
            given = getattr(self, name)
            if len(set(given)) < len(given):
                raise UsageError(f"--{name} {' '.join(map(str, given))}: expected none of them twice")
        outside = [value for value in self.values if not 0 <= value <= 1]
        if outside or not self.values:
            shown = " ".join(f"{value:g}" for value in self.values)
            raise UsageError(f"--values {shown}: expected at least one number, all in [0, 1]")
        if not self.kinds:
            raise UsageError(f"--kinds: expected at least one of {', '.join([*ASKED, *CONTRACT])}")
        if self.pictures:
            self.check_pictures()

    def check_pictures(self) -> None:
        """Looks at what stands beside --pictures."""
        strips, fields = self.strips(), type(self).__dataclass_fields__
        if self.kinds != KINDS and set(strips) != set(self.kinds):
            raise UsageError(
                f"--kinds {' '.join(self.kinds)}: got it beside --pictures, expected metallic, roughness or both; "
                "pictures.png, without --kinds, has maps, edits and relightings"
            )
        beside = {
            "scenes": "scenes are the suite's",
            "spp": "no truth is rendered",
            "lights": "a strip has none" if strips else "",
            "values": "" if strips else "name --kinds metallic or roughness, too, whose values they are",
        }
        for name, reason in beside.items():
            if reason and getattr(self, name) != fields[name].default:
                raise UsageError(f"--{name}: got it beside --pictures, expected it without: {reason}")

    def strips(self) -> tuple[Asked, ...]:
        """The strips that were asked for by name."""
        return tuple(kind for kind in STRIPS if kind in self.kinds and self.kinds != KINDS)

    def run(self) -> int:
        """Draws, and prints a line for each figure; returns the exit status."""
        self.check()
        check_out(self.out)
        from rich.console import Console

        from unirender_evaluation.figures.grid import Grid, save
        from unirender_evaluation.figures.panels import MitsubaTruth, Subject
        from unirender_evaluation.suites.suite import load_suite

        suite = load_suite(self.suite)
        scenes = [suite.scene(key) for key in self.scenes] or default_scenes(suite)
        truth = MitsubaTruth(suite, self.spp)
        grids: dict[str, Callable[[list[Subject]], Grid]] = {
            kind: partial(self.draw, kind, suite=suite, scenes=scenes, truth=truth)
            for kind in ASKED
            if kind in self.kinds
        }
        if self.pictures:
            grids = self.of_pictures(suite)
        console = Console()

        def say(path: Path) -> None:
            console.print(f"{path} ({path.stat().st_size / 1000:.0f} kB)", highlight=False, markup=False)

        for kind in CONTRACT:
            if kind in self.kinds:
                say(self.explain(kind, suite, scenes[0]))
        subjects = self.subjects() if grids else []
        for name, grid in grids.items():
            say(save(grid(subjects), self.out / f"{name}.png"))
        return 0

    def of_pictures(self, suite: "Suite") -> "dict[str, Callable[[list[Subject]], Grid]]":
        """Name of a figure of the user's pictures -> what draws it."""
        from unirender_evaluation.figures.pictures import pictures_strip

        pictures, camera = self.read(), suite.spec.camera
        if not self.strips():
            return {"pictures": partial(self.sheet, suite=suite, pictures=pictures)}
        return {
            what: partial(pictures_strip, pictures=pictures, what=what, values=self.values, camera=camera)
            for what in self.strips()
        }

    def explain(self, kind: Contract, suite: "Suite", scene: "Scene") -> Path:
        """A figure of the data contract."""
        from unirender.system.whole_files import replace_file
        from unirender_evaluation.figures import contract

        drawn = contract.maps_figure(suite, scene) if kind == "maps" else contract.camera_figure(suite.spec.camera)
        return replace_file(self.out / f"{kind}.png", contract.png(drawn))

    def read(self) -> "list[Picture]":
        """The user's pictures, framed.

        Raises:
            UnirenderError: some of them cannot be used; all are named.
        """
        from unirender_evaluation.figures.pictures import framed, read_cut_out

        found, problems = [], []
        for path in self.pictures:
            try:
                found.append(framed(read_cut_out(path)))
            except UnirenderError as error:
                problems.append(str(error))
        if problems:
            raise UnirenderError("; ".join(problems))
        return found

    def sheet(self, subjects: "list[Subject]", suite: "Suite", pictures: "list[Picture]") -> "Grid":
        """The figure of the user's pictures, relit by lights of the suite."""
        from unirender_evaluation.figures.pictures import pictures_sheet

        lights = {scene.light: suite.environment(scene) for scene in self.relit_by(suite, [])}
        return pictures_sheet(subjects, pictures, lights, suite.spec.camera)

    def relit_by(self, suite: "Suite", scenes: "Sequence[Scene]") -> "list[Scene]":
        """Scenes of the suite with the lights of relightings; a notice where there are fewer than were asked for."""
        from unirender_evaluation.figures.panels import other_lights

        found = other_lights(suite, scenes, self.lights)
        if len(found) < self.lights:
            has = f"suite {suite.spec.name} has {len(found)} that light no input"
            notice(f"--lights {self.lights}: {has}, and all of them are drawn")
        return found

    def subjects(self) -> "list[Subject]":
        """The checkpoints and methods that were named, checkpoints first.

        Raises:
            UnirenderError: a checkpoint or a method is not there.
        """
        from unirender.command_line.options import ModelOptions
        from unirender.models.precision import resolve_device
        from unirender.shipped import checkpoint_folder, checkpoint_sha256, shipped_for
        from unirender_evaluation.figures.panels import Subject
        from unirender_evaluation.methods.pipeline import PipelineMethod
        from unirender_evaluation.methods.plugins import named_plugin
        from unirender_evaluation.rows import make_row, plugin_rows
        from unirender_evaluation.suites.spec import read_spec

        found, device = [], str(resolve_device(self.device))
        folders = tuple(map(checkpoint_folder, self.checkpoint))
        if not folders and not self.method:
            folders = (shipped_for(read_spec(self.suite).resolution),)
        for folder, label in zip(folders, labels(folders), strict=True):
            pipeline = ModelOptions(folder, self.device, "float32", progress=False).load()
            weights = checkpoint_sha256(folder)
            method = PipelineMethod(pipeline, label, weights, anchored=True, device=device)
            found.append(Subject(label, make_row(method, "ours")))
        for row in plugin_rows([named_plugin(spec) for spec in self.method]):
            found.append(Subject(row.info.label, row))
        return found

    def draw(
        self, kind: Asked, subjects: "list[Subject]", suite: "Suite", scenes: "list[Scene]", truth: "MitsubaTruth"
    ) -> "Grid":
        """One figure."""
        from unirender_evaluation.figures import light, overview, panels

        if kind == "light":
            return light.light_figure(subjects, suite, scenes)
        if kind == "overview":
            return overview.overview(subjects, suite, scenes)
        if kind == "comparison":
            return panels.comparison_sheet(subjects, suite, scenes)
        if kind == "relighting":
            return panels.relighting_grid(subjects, suite, scenes, len(self.relit_by(suite, scenes)), truth)
        return panels.material_strip(subjects, suite, scenes, kind, self.values, truth)


def labels(folders: tuple[Path, ...]) -> list[str]:
    """Names of checkpoints: their folders', or their paths where two folders have one name."""
    names = [folder.resolve().name for folder in folders]
    return names if len(set(names)) == len(names) else [str(folder) for folder in folders]


def default_scenes(suite: "Suite") -> "list[Scene]":
    """`SCENES` scenes from the middle of equal parts of the suite: neither picked by eye nor the first ones."""
    parts = min(SCENES, len(suite.scenes))
    return [suite.scenes[(2 * part + 1) * len(suite.scenes) // (2 * parts)] for part in range(parts)]
