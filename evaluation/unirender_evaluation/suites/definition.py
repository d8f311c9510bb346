"""Whether a suite's TOML file still says what its truth was made from.

The truth of a suite of one's own has the file's values in its `suite.json`. Where it has none (those of the package's
suites, which `suites.home.found_spec` compares with the package's files) the values are compared that can be told from
what was rendered.
"""

import json
from dataclasses import asdict, fields
from typing import TYPE_CHECKING, Any

from unirender.camera import Camera
from unirender.errors import UnirenderError
from unirender_evaluation.suites.home import home, truth_command
from unirender_evaluation.suites.spec import SuiteSpec, is_bundled, suite_folder
from unirender_evaluation.suites.truth_file import image_member, member_kind, specular_member

if TYPE_CHECKING:
    from unirender_evaluation.suites.suite import Suite

DEFINITION = "definition"  # of `suite.json`
FREE = {  # words, and where things lie
    *("title", "truth_cost", "truth_file", "truth_sha256", "path"),
    *("objects_folder", "lights_folder", "objects_from", "lights_from"),
}
SHOWN = 60  # letters of a value in a message


def recorded(spec: SuiteSpec) -> dict[str, Any]:
    """What `suite.json` says of a suite's file: nothing where `found_spec` compares it with the package's."""
    if is_bundled(spec.path) or (spec.path == home(spec.name) and (suite_folder() / spec.path.name).is_file()):
        return {}
    return {DEFINITION: definition_values(spec)}


def definition_values(spec: SuiteSpec) -> dict[str, Any]:
    """What a truth depends on of a suite's file, by key, as JSON has it."""
    values = {f.name: getattr(spec, f.name) for f in fields(spec) if f.name not in FREE}
    return json.loads(json.dumps(values, default=asdict))


def check_definition(suite: "Suite") -> None:
    """Compares a suite's file with its truth.

    Raises:
        UnirenderError: they differ; all keys that do.
    """
    said, made = definition_values(suite.spec), suite.provenance.get(DEFINITION) or _told(suite)
    different = [
        f"{name} is {_short(said[name])}, the truth's {_short(value)}"
        for name, value in made.items()
        if name in said and said[name] != value
    ]
    if different:
        raise UnirenderError(
            f"{suite.spec.path}: its truth {suite.spec.truth_file} was made from other values: {'; '.join(different)}. "
            f"Put that back, or make the truth anew with {truth_command(suite.spec)}; a copy of the file in another "
            "folder, with a truth of its own, keeps both"
        )


def _told(suite: "Suite") -> dict[str, Any]:
    """The values that can be told from a truth."""
    spec, made, scene, members = suite.spec, suite.provenance, suite.scenes[0], set(suite.members)
    materials = [m for m in (spec.base, *spec.edits) if image_member(scene.key, m) in members]
    roughness = [r for r in spec.specular_roughness if specular_member(scene.key, r) in members]
    every = (*materials, *scene.materials)
    named = {image_member(scene.key, m) for m in every}
    named |= {specular_member(scene.key, r) for r in (*roughness, *(r for _, r in every))}
    others = sorted(name for name in members - named if name.startswith(f"{scene.key}."))
    more = {kind: [name for name in others if member_kind(name) == kind] for kind in ("image", "specular")}
    told = {
        "name": made["suite"],
        "resolution": suite.mask(scene).shape[0],
        "objects": [entry["seed"] for entry in made["objects"].values() if "seed" in entry],
        "lights_per_object": sum(other.object == scene.object for other in suite.scenes),
        "per_scene": len(scene.materials),
        "batches": made["batches"],
        "base": list(spec.base) if spec.base in materials else "another",
        "edits": [*(list(m) for m in spec.edits if m in materials), *more["image"]],
        "specular_roughness": [*roughness, *more["specular"]],
    }
    camera = {"fov_deg": Camera.parse(made["camera"]).fov_deg} if "camera" in made else {}
    return told | camera


def _short(value: Any) -> str:
    text = json.dumps(value, ensure_ascii=False)
    return text if len(text) <= SHOWN else f"{text[:SHOWN]} ..."
