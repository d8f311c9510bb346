"""`unirender dataset`. Light to import: what renders is loaded when the command runs."""

import logging
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from unirender.errors import UnirenderError, UsageError
from unirender.system.wording import counted

if TYPE_CHECKING:
    from unirender_reference.dataset import GenerateReport
    from unirender_reference.dataset_config import DatasetConfig

SHOWN_FAILURES = 20
SHOWN_LIGHTS = 5
DEFAULT_PAIRS = {"paper": 121, "sweep": 121, "visibility": 1}
OTHER_PAIRS, PAIRS_OF_MAPS = 36, 8

_log = logging.getLogger("unirender.dataset")


@dataclass(frozen=True)
class Dataset:
    """Render a training set with Mitsuba: WebDataset shards, resumable by running the same command again.

    The exit status is 1 where mesh files failed: each is listed with its reason, and the others are there.
    """

    out: Path
    """Folder for the shards and `manifest.json`; of a recipe, for a folder of each part."""
    recipe: str | None = None
    """A training set in parts: train-64, train-128, visibility, or a TOML file. It takes the place of all options but
    --assets, --workers, --cluster and --verify."""
    assets: Path | None = None
    """Folder of the mesh and light folders that a recipe names."""
    objects: int | None = None
    """How many objects. None: 20 procedural ones, or all meshes."""
    meshes: str | None = None
    """A folder of .glb, .gltf, .obj or .ply files (searched recursively) or a quoted glob, instead of procedural
    objects."""
    holdout: int = 0
    """Every N-th mesh file, in order of name, belongs to `--split test`, the others to `--split train`. 0: all files
    belong to the split asked for."""
    turn_objects: bool = False
    """See each object from a side and a height drawn at random, another for each seed, instead of from the front."""
    pairs: int | None = None
    """Pairs an object. basis: 3 x lights x roughness values, so a multiple of 3. None: 36; 121 with paper and sweep, 8
    with --materials maps."""
    resolution: int = 64
    """Pixels along each side."""
    vary: Literal["basis", "independent", "one-at-a-time", "paper", "sweep", "visibility"] | None = None
    """What changes inside a group. paper: metallic x roughness on an 11 x 11 grid, a light each; sweep: the same grid
    under one light, from 33 renders; visibility: no pictures, but which directions objects hide from themselves, for
    `unirender train-visibility`. None: basis; independent with --materials maps."""
    materials: Literal["scalar", "maps"] = "scalar"
    """scalar: one roughness and metallic per picture, whatever the object has; maps: the object's own maps, each pair
    under another light."""
    split: Literal["train", "test"] = "train"
    """Seeds, object families and lights of this side only."""
    seed: int = 0
    """First seed."""
    spp: int = 64
    """Samples per pixel of an image; with --noise-floor, to begin with."""
    noise_floor: float | None = None
    """Add samples to each image, s and d until a noise-free prediction would score this many dB against it (masked
    sRGB PSNR). Not with --vary sweep."""
    denoise: bool = False
    """Denoise images, s and d with Open Image Denoise. They are marked; not with --split test."""
    lights: Path | None = None
    """A folder of your HDR maps and photographs to draw lights from."""
    light_share: float = 0.5
    """Share of the lights drawn from --lights, the others are built in; 1: only yours."""
    light_holdout: int = 8
    """Every N-th place in --lights, in order of name, belongs to --split test, the others to --split train."""
    turn_lights: bool = True
    """Turn, mirror and sometimes tilt what is drawn from --lights at random. Off: as the files are."""
    light_height: int = 64
    """Rows of the maps drawn from --lights. More shows in mirror-like materials from 256 pixels on."""
    workers: int = 0
    """Processes; 0: one for each core."""
    cluster: str | None = None
    """Render on a cluster instead: tcp://HOST:PORT of a dask scheduler, slurm, or slurm:JOBS."""
    verify: bool = False
    """Compare every byte of the shards that are there with its sha256; else of the last four, and of the others the
    size."""

    def check(self) -> "DatasetConfig":
        """Looks at the values.

        Raises:
            UsageError: one is outside its range, or options contradict each other.
        """
        from unirender_reference.dataset_config import DatasetConfig

        if self.cluster is not None and self.workers:
            raise UsageError(
                f"--workers {self.workers}: expected none with --cluster, whose workers are its own; leave it out"
            )
        vary = self.vary or ("independent" if self.materials == "maps" else "basis")
        pairs = DEFAULT_PAIRS.get(vary, PAIRS_OF_MAPS if self.materials == "maps" else OTHER_PAIRS)
        try:
            if self.cluster is not None:
                from unirender_reference.cluster import check_address

                check_address(self.cluster)
            asked = {f.name: getattr(self, f.name) for f in fields(DatasetConfig) if f.name != "lights_digest"}
            asked |= {"pairs": pairs if self.pairs is None else self.pairs, "vary": vary}
            return DatasetConfig(**asked)
        except UnirenderError as error:
            raise UsageError(str(error)) from error

    def parts(self) -> dict[str, "Dataset"]:
        """The data sets of a recipe, by name.

        Raises:
            UsageError: an option beside the recipe that it decides, or one of its own that is refused.
            UnirenderError: no such recipe, a broken one, or folders that it names are not there.
        """
        from unirender_reference.recipe import read_recipe

        assert self.recipe is not None
        kept = {"out", "recipe", "assets", "workers", "cluster", "verify"}
        given = [f.name for f in fields(self) if f.name not in kept and getattr(self, f.name) != f.default]
        if given:
            raise UsageError(
                f"--{given[0].replace('_', '-')}: got it beside --recipe, which decides it; expected none; copy the "
                "recipe, change it, and pass its path"
            )
        recipe = read_recipe(self.recipe)
        machine = {"workers": self.workers, "cluster": self.cluster, "verify": self.verify}
        made = {}
        for name, options in recipe.options(self.assets).items():
            if "lights" in options:
                options["lights"] = Path(options["lights"])
            made[name] = Dataset(out=self.out / name, **machine, **options)
            try:
                made[name].check()
            except UsageError as error:
                raise UsageError(f"{recipe.path}, part {name}: {error}") from error
        return made

    def run(self) -> int:
        """Renders what is missing; returns the exit status: 1 if mesh files failed, now or earlier."""
        if self.recipe is not None:
            return max([part.run() for part in self.parts().values()])
        if self.assets is not None:
            raise UsageError(
                "--assets: got it without --recipe, expected a recipe that names folders in it; leave it out"
            )
        from rich.console import Console

        from unirender.system.run_progress import progress_bar
        from unirender_reference.dataset import generate
        from unirender_reference.dataset_config import MOST_SPP

        config = self.check()
        if (config.split, config.seed, config.meshes) == ("test", 0, None):
            _log.warning("--split test --seed 0: has the objects of the bundled suites; another --seed has others")
        with progress_bar(Console(stderr=True), transient=True) as bar:
            task = bar.add_task("groups", total=None, visible=False)  # until there is something to do
            report = generate(
                config,
                lambda done, total: bar.update(task, completed=done, total=total, visible=True),
                verify=self.verify,
            )
        print(self._summary(report))
        self._tell_noise(report, MOST_SPP)
        self._tell_lights(report)
        self._tell_failures(report)
        return 1 if report.failures else 0

    def _tell_noise(self, report: "GenerateReport", most_spp: int) -> None:
        """What was reached of --noise-floor, and what noise leaves below 0 in a sweep."""
        if (floor := report.floor) is not None:
            print(
                f"noise floor {self.noise_floor:g} dB: reached by {floor.reached} of {floor.buffers} images, s and d; "
                f"the lowest is at {floor.minimum_db:.1f} dB"
            )
            if floor.reached < floor.buffers:
                _log.warning(
                    "%d images, s and d did not reach the noise floor with the %d samples per pixel at which sampling "
                    "ends; the json of each group says which, and what they reached",
                    floor.buffers - floor.reached,
                    most_spp,
                )
        if self.vary == "sweep":
            print(
                f"{report.negative_pixels} pixels of interpolated pictures have a channel below 0: their noise is "
                "unbiased and not clipped"
            )

    def _tell_lights(self, report: "GenerateReport") -> None:
        """Which files of --lights are none."""
        for line in report.unreadable_lights[:SHOWN_LIGHTS]:
            _log.warning("no light: %s", line)
        if report.unreadable_lights:
            _log.warning(
                "%d files of --lights are no lights, and others were drawn instead; all are listed with reasons in %s",
                len(report.unreadable_lights),
                self.out / "manifest.json",
            )

    def _tell_failures(self, report: "GenerateReport") -> None:
        """Which mesh files failed, and which of them another run may bring."""
        for failure in report.failures[:SHOWN_FAILURES]:
            _log.warning("%s: %s", failure.file, failure.reason)
        if report.failures:
            files = counted(len({failure.file for failure in report.failures}), "file")
            _log.warning("%s failed; all are listed with reasons in %s", files, self.out / "failures.jsonl")
        if again := {failure.file for failure in report.failures if failure.machine}:
            _log.warning(
                "%d of them lacked time or memory, or their worker died; the same command tries these again",
                len(again),
            )

    def _summary(self, report: "GenerateReport") -> str:
        if report.workers == 0:
            there = counted(report.skipped_shards, "shard")
            return f"{self.out}: complete already, {there}; manifest {report.manifest_sha256[:12]}"
        rendered = f"{1 / report.overhead:.0%} of it spent rendering" if report.render_seconds else "nothing rendered"
        return (
            f"{self.out}: {counted(report.samples, 'pair')} in {counted(report.groups, 'group')}, "
            f"{report.seconds:.1f} s on {counted(report.workers, 'worker')}, {rendered}; "
            f"shards that were there: {report.skipped_shards}; NaN pixels rendered again: {report.nan_pixels}; "
            f"manifest {report.manifest_sha256[:12]}"
        )
