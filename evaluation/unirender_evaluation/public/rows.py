"""The rows of a run on a public test set: our model, the trivial ones, other people's methods and folders."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from unirender.command_line.options import Device, ModelOptions
from unirender.errors import UsageError
from unirender.shipped import checkpoint_folder, checkpoint_sha256
from unirender_evaluation.methods.decompositions import Decompositions
from unirender_evaluation.methods.pipeline import LazyPipeline, PipelineMethod
from unirender_evaluation.methods.plugins import installed_plugins, named_plugin
from unirender_evaluation.methods.trivial import InputAsAlbedo, MeanAlbedo, MeanNormal, SphereNormal, UneditedInput
from unirender_evaluation.public.sets import PublicSet
from unirender_evaluation.rows import Row, check_rows, make_row, plugin_rows, prediction_rows
from unirender_evaluation.versions import MODEL

GROUPS = ("ours", "trivial", "plugins")


def public_rows(
    public: PublicSet,
    groups: Sequence[str] = GROUPS,
    methods: Sequence[str] = (),
    predictions: Mapping[str, Path] | None = None,
    checkpoint: Path | None = None,
    device: Device = "cpu",
) -> list[Row]:
    """The rows that a run asks for.

    Args:
        public: the set.
        groups: ours, trivial, plugins (installed ones). A stranger's row always brings the trivial ones.
        methods: further methods, each `module:Class` or `path/to/file.py:Class`.
        predictions: name -> folder of somebody's predictions.
        checkpoint: folder of our model, or the name of a shipped one; None = `tiny`.
        device: where our model runs.

    Raises:
        UsageError: unknown group, or nothing to score.
        UnirenderError: no checkpoint, broken plug-in or folder, or two rows of one name.
    """
    unknown = sorted(set(groups) - set(GROUPS))
    if unknown:
        raise UsageError(f"--methods {' '.join(unknown)}: expected some of {', '.join(GROUPS)}")
    rows = our_rows(public, checkpoint, device) if "ours" in groups else []
    plugins = [*(installed_plugins() if "plugins" in groups else ()), *map(named_plugin, methods)]
    strangers = [*plugin_rows(plugins), *prediction_rows(predictions or {})]
    if "trivial" in groups or strangers:
        rows += trivial_rows(public)
    if not rows + strangers:
        raise UsageError("--methods: nothing to score, expected a group with rows, --method or --predictions")
    return check_rows(rows + strangers)


def our_rows(public: PublicSet, checkpoint: Path | None, device: Device) -> list[Row]:
    """Our model's mean prediction; where relighting is asked, also anchored: with what it could not explain."""
    from unirender.models.precision import resolve_device

    pipeline = LazyPipeline(ModelOptions(checkpoint, device, "float32", progress=False).load)
    weights, place = checkpoint_sha256(checkpoint_folder(checkpoint)), str(resolve_device(device))
    shared = Decompositions[Any]()
    rows = []
    for name, anchored in (("Ours (mean)", False), ("Ours (mean, anchored)", True)):
        method = PipelineMethod(pipeline, name, weights, anchored=anchored, device=place, decompositions=shared)
        only = relighting(public) if anchored else None
        rows.append(make_row(method, "ours", steps=1, samples=1, uses=frozenset({MODEL}), protocols=only))
    return rows if relighting(public) else rows[:1]


def trivial_rows(public: PublicSet) -> list[Row]:
    """What a method must beat: those that answer one of the set's questions."""
    constant = "constant: mean of display values over training objects"
    albedo = [make_row(InputAsAlbedo(), "trivial"), make_row(MeanAlbedo(), "trivial", note=constant)]
    if not relighting(public):
        return albedo
    shapes = [make_row(MeanNormal(), "trivial"), make_row(SphereNormal(), "trivial", note="from the silhouette alone")]
    return [make_row(UneditedInput(), "trivial"), *albedo, *shapes]


def relighting(public: PublicSet) -> frozenset[tuple[str, str]]:
    """(table, protocol) of the set's relighting, if it has one."""
    asked = "from-image-hdri"
    return frozenset((spec.name, asked) for spec in public.tables if asked in spec.protocols)
