"""A run of `unirender bench unknown-mesh`: measures with progress, prints, writes."""

import contextlib
from collections.abc import Sequence

from rich.console import Console

from unirender_evaluation.multiview.scenes import scene_material
from unirender_evaluation.records import Record
from unirender_evaluation.studies.about import description
from unirender_evaluation.studies.folder import open_folder, write_study
from unirender_evaluation.studies.unknown_mesh import tables
from unirender_evaluation.studies.unknown_mesh.measure import UnknownMesh, measure
from unirender_evaluation.suites.stratification import MetallicRoughness
from unirender_evaluation.suites.suite import Scene
from unirender_reference.optimize.show.live import live_report
from unirender_reference.optimize.show.report import OnReport

NAME = "unknown_mesh"


def run(what: UnknownMesh, scenes: Sequence[Scene], console: Console, progress: bool = True) -> list[Record]:
    """Measures what is missing and writes `unknown_mesh.md` and `unknown_mesh.json`."""
    names = {scene.key: scene_name(scene, scene_material(what.suite, scene)) for scene in scenes}
    with open_folder(what.out):
        records, computed = [], 0
        with contextlib.ExitStack() as shown:

            def listener(scene: Scene) -> OnReport | None:
                shown.close()
                console.print(f"{names[scene.key]}: {what.folder(scene)}", highlight=False, markup=False)
                return shown.enter_context(live_report(console)) if progress else None

            for record, new in measure(what, scenes, listener):
                shown.close()
                records.append(record)
                computed += new
        made = tables.tables(records, names, what.settings)
        about = description(what.suite, what.code)
        counts = f"{computed} new records of {len(records)}"
        content = tables.to_json(records, names, about)
        write_study(what.out / NAME, made, about, content, counts, console)
        return records


def scene_name(scene: Scene, material: MetallicRoughness) -> str:
    """Object, family and material."""
    return f"{scene.object} ({scene.family}, metallic {material[0]:g}, roughness {material[1]:g})"
