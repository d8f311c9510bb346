"""What a benchmark run is asked for: its settings, and the rows that follow from them."""

import inspect
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from unirender.errors import UnirenderError, UsageError
from unirender.shipped import checkpoint_folder, checkpoint_sha256, shipped_for
from unirender_evaluation import bounds
from unirender_evaluation.claims import OURS
from unirender_evaluation.methods.mitsuba import MITSUBA
from unirender_evaluation.methods.optimized_rows import optimized_rows
from unirender_evaluation.methods.pipeline import LazyPipeline
from unirender_evaluation.methods.plugins import absolute, installed_plugins, named_plugin
from unirender_evaluation.metrics import Variant
from unirender_evaluation.multiview.methods import NAMES as MULTIVIEW_NAMES
from unirender_evaluation.physics import rows as physics_rows
from unirender_evaluation.rows import Row, check_rows, our_rows, plugin_rows, prediction_rows, slug, trivial_rows
from unirender_evaluation.subsets import STANDARD, Subsets
from unirender_evaluation.suites.spec import read_spec

GROUPS = ("ours", "optimisation", "trivial", "plugins")
BOUNDS = (  # keys that no row of a stranger may have
    bounds.CEILING_KEY,
    bounds.REFERENCE_KEY,
    slug(bounds.Shade.name),
    *(info.key for info in (bounds.TRUE_LIGHT, MITSUBA, *physics_rows.INFOS)),
    *map(slug, MULTIVIEW_NAMES),
)


@dataclass(frozen=True)
class BenchConfig:
    """A benchmark run: the options of `bench run` (`runs.command.BenchRun` describes them), taken apart.

    Raises:
        UnirenderError: one is of another type.
    """

    suite: str = "tiny"
    out: Path = Path("results")
    checkpoint: Path | None = None
    methods: tuple[str, ...] = GROUPS  # a stranger's row always brings the trivial ones
    method: tuple[str, ...] = ()
    predictions: dict[str, Path] = field(default_factory=dict)  # name -> folder
    limit: int | None = None
    seed: int = 0
    check_scenes: int = 4
    check_seed: int | None = None
    recheck: bool = False
    jobs: int = 2  # worker processes, each with one thread; 0 = all in this one
    cluster: str | None = None  # `unirender_reference.cluster.connect`; truth check and multi-view table stay here
    device: str = "cpu"
    subsets: Subsets = STANDARD  # scenes of the slow parts
    variants: tuple[Variant, ...] | None = None  # of the tables (`build_tables`); records have all of them

    def __post_init__(self) -> None:
        fits = {
            "suite": isinstance(self.suite, str),
            "out": isinstance(self.out, Path),
            "checkpoint": isinstance(self.checkpoint, Path | None),
            "methods": _are(self.methods, str),
            "method": _are(self.method, str),
            "predictions": isinstance(self.predictions, dict) and _are((*self.predictions.values(),), Path),
            "variants": self.variants is None or _are(self.variants, Variant),
        }
        for name, fit in fits.items():
            if not fit:
                expected = inspect.formatannotation(type(self).__annotations__[name])
                hint = "; name a class by its file: 'my_method.py:MyMethod'" if name == "method" else ""
                raise UnirenderError(f"benchmark: got {name}={getattr(self, name)!r:.60}, expected {expected}{hint}")

    def weights(self) -> Path:
        """The folder of our model."""
        if self.checkpoint is None:
            return shipped_for(read_spec(self.suite).resolution)
        return checkpoint_folder(self.checkpoint)


def _are(values: Any, kind: type) -> bool:
    return isinstance(values, tuple) and all(isinstance(value, kind) for value in values)


def build_rows(config: BenchConfig) -> list[Row]:
    """The rows that a configuration asks for.

    Raises:
        UnirenderError: unknown group, plug-ins alone and none is there, no checkpoint, a device that is not there,
            broken plug-in or predictions folder, two rows of one name, or one with that of a bound.
    """
    unknown = sorted(set(config.methods) - set(GROUPS))
    if unknown:
        raise UsageError(f"methods: got {', '.join(unknown)}, expected some of {', '.join(GROUPS)}")
    rows: list[Row] = []
    if "ours" in config.methods:
        from unirender.models.precision import resolve_device

        folder, device = config.weights(), str(resolve_device(config.device))
        pipeline = LazyPipeline(lambda: load_pipeline(folder, device))
        rows += our_rows(pipeline, checkpoint_sha256(folder), config.seed, config.subsets.sample, device)
    if "optimisation" in config.methods and config.subsets.optimise != 0:
        main = next((row.method for row in rows if row.info.key == OURS), None)
        rows += optimized_rows(config.subsets.optimise, config.subsets.pictures, main)
    plugins = [*(installed_plugins() if "plugins" in config.methods else ()), *map(named_plugin, config.method)]
    strangers = [*plugin_rows(plugins), *prediction_rows(config.predictions)]
    if set(config.methods) == {"plugins"} and not strangers:
        raise UsageError(
            "--methods plugins: got no row, since no plug-in is installed; name a method by --method FILE.py:CLASS or "
            f"--predictions NAME=FOLDER, or one more group of {', '.join(GROUPS[:3])}"
        )
    if "trivial" in config.methods or strangers:
        rows += trivial_rows()
    if "trivial" in config.methods:
        rows.append(bounds.shade_row(config.subsets.shade))
    return check_rows(rows + strangers, BOUNDS)


def load_pipeline(folder: Path, device: str) -> Any:
    """Our model from its folder, silent, on that device."""
    import diffusers

    from unirender.pipelines.unirender_pipeline import UniRenderPipeline

    diffusers.utils.logging.disable_progress_bar()  # of loading: two small files, and a bar for each worker
    pipeline = UniRenderPipeline.from_pretrained(folder).to(device)
    pipeline.set_progress_bar_config(disable=True)
    return pipeline


def anywhere(config: BenchConfig) -> BenchConfig:
    """The same with absolute paths of what is read, since a cluster's workers may run in another folder."""
    named = config.checkpoint
    return replace(
        config,
        suite=str(Path(config.suite).resolve()) if config.suite.endswith(".toml") else config.suite,
        checkpoint=named.resolve() if named is not None and named.is_dir() else named,
        method=tuple(map(absolute, config.method)),
        predictions={name: folder.resolve() for name, folder in config.predictions.items()},
    )
