"""The objects of a suite: seeds of the generator and files of a folder; and the meshes behind its scenes, made or read
again for rows that are told the true shape.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Literal

import numpy as np

from unirender.errors import UnirenderError
from unirender.system.whole_files import file_sha256
from unirender_evaluation.suites.spec import Files, SuiteSpec
from unirender_evaluation.suites.suite import Scene, Suite
from unirender_reference.mesh_folder import MeshFile, in_split, mesh_folder
from unirender_reference.shapes import MeshObject, make_object

GREY = 0.5  # base colour of a mesh that says nothing of the object's own


@dataclass(frozen=True)
class ObjectSource:
    """Where an object of a suite comes from."""

    split: Literal["train", "test"]  # of the generator's seeds
    origin: int | MeshFile  # a seed of the generator; or a file, named by its path below the folder of objects

    @property
    def name(self) -> int | str:
        """As `ceiling_scenes` of a suite's file has it."""
        return self.origin.name if isinstance(self.origin, MeshFile) else self.origin

    def load(self) -> MeshObject:
        """The object, without roughness and metallic of its own: a suite's scenes give them.

        Raises:
            UnirenderError: the file cannot be used, with the reason.
        """
        if not isinstance(self.origin, MeshFile):
            return make_object(self.origin, self.split)
        from unirender_reference.meshes import load_mesh

        obj = load_mesh(self.origin.path, root=self.origin.folder)
        return replace(obj, name=self.origin.key, roughness=None, metallic=None)

    def provenance(self) -> dict[str, int | str]:
        """What `suite.json` says of where the object is from."""
        if not isinstance(self.origin, MeshFile):
            return {"seed": self.origin}
        return {"file": self.origin.name, "file_sha256": file_sha256(self.origin.path)}


def suite_sources(spec: SuiteSpec) -> list[ObjectSource]:
    """All objects of a suite: the procedural ones, then the meshes of each group in name order.

    Raises:
        UnirenderError: the folder of objects is missing, or has not what the suite's file asks for; all problems.
    """
    sources = [ObjectSource(spec.split, seed) for seed in spec.objects]
    problems: list[str] = []
    folder = spec.folder("objects")
    if spec.meshes and folder is not None:
        listed = _listed(folder)
        for group in spec.meshes:
            try:
                sources += [ObjectSource(spec.split, file) for file in _chosen(listed, group, spec)]
            except UnirenderError as error:
                problems.append(str(error))
    elif spec.meshes:
        problems.append(missing_folder(spec, "objects"))
    names = [source.name for source in sources]
    twice = sorted({str(name) for name in names if names.count(name) > 1})
    if twice:
        problems.append(f"the same mesh in two groups: {', '.join(twice)}")
    strangers = sorted(map(repr, {name for name, _ in spec.ceiling_scenes} - set(names)))
    if strangers and not problems:
        problems.append(f"ceiling_scenes has {', '.join(strangers)}, expected seeds or mesh paths of the suite")
    if problems:
        raise UnirenderError(f"suite {spec.name!r}: {'; '.join(problems)}")
    return sources


def missing_folder(spec: SuiteSpec, kind: Literal["objects", "lights"]) -> str:
    """What to do where a suite needs a folder that nobody has named."""
    what = "meshes" if kind == "objects" else "light files"
    where = spec.objects_from if kind == "objects" else spec.lights_from
    return f"it needs a folder of {what}: name it with --{kind} FOLDER" + (f" ({where})" if where else "")


def broken_meshes(sources: Sequence[ObjectSource], spec: SuiteSpec) -> Iterator[str]:
    """Reads every mesh once and looks whether the suite's camera sees it: the reasons of those that cannot be used."""
    from unirender.light.exposure import MASK_THRESHOLD
    from unirender_reference.render import Renderer

    for source in sources:
        file = source.origin
        if not isinstance(file, MeshFile):
            continue
        try:
            renderer = Renderer(source.load(), camera=spec.camera, resolution=spec.resolution)
        except UnirenderError as error:
            yield f"{source.name}: {file.without_folder(str(error)).removeprefix(f'mesh {file.name}: ')}"
            continue
        if not (renderer.exposure_mask() > MASK_THRESHOLD).any():
            yield f"{source.name}: covers no pixel of the picture by half or more; is it flat and seen edge-on?"


def drawn(names: Sequence[str], group: Files, what: str) -> list[str]:
    """The files of a group, in the order of `names`: those left out taken away, then `count` of them drawn.

    Args:
        names: the files that match the pattern and belong to the split.
        group: what the suite's file says.
        what: they are, for messages.

    Raises:
        UnirenderError: a file that is to be left out is not there, or there are too few.
    """
    absent = sorted(set(group.without) - set(names))
    if absent:
        raise UnirenderError(f"{what}: `without` has {', '.join(absent)}, expected some of the {len(names)} files")
    kept = [name for name in names if name not in group.without]
    if not kept or len(kept) < (group.count or 0):
        raise UnirenderError(f"{what}: got {len(kept)} files, expected {group.count or 'at least 1'}")
    if group.count is None:
        return kept
    indices = np.random.default_rng(group.seed).permutation(len(kept))[: group.count]
    return [kept[index] for index in sorted(indices)]


def _listed(folder: Path) -> list[MeshFile]:
    """All meshes of a folder, in the order of `find_meshes`."""
    found = mesh_folder(folder)
    if found.unreadable:
        name, reason = found.unreadable[0]
        raise UnirenderError(f"meshes {folder / name}: cannot be listed ({reason}); check the permissions")
    return [found[index] for index in range(len(found))]


def _chosen(listed: Sequence[MeshFile], group: Files, spec: SuiteSpec) -> list[MeshFile]:
    """The files of a group of meshes."""
    files = {file.name: file for file in listed if fnmatchcase(file.name, group.files)}
    names = [name for index, name in enumerate(files) if in_split(index, spec.split, group.holdout)]
    held = f", split {spec.split!r} with holdout {group.holdout}" if group.holdout else ""
    what = f"meshes {group.files!r} in {spec.folder('objects')}{held}"
    return [files[name] for name in drawn(names, group, what)]


def object_is_here(suite: Suite, scene: Scene) -> bool:
    """Whether the object of a scene can be made or read; its file may still be another one than the truth's."""
    made, folder = suite.provenance["objects"][scene.object], suite.spec.folder("objects")
    return "seed" in made or (folder is not None and (folder / str(made["file"])).is_file())


def scene_object(suite: Suite, scene: Scene) -> MeshObject:
    """The object of a scene, textures included.

    Raises:
        UnirenderError: it is a mesh whose file is not here, or is another one than the truth was rendered from.
    """
    made = suite.provenance["objects"][scene.object]
    spec = suite.spec
    if "seed" in made:
        return ObjectSource(spec.split, int(made["seed"])).load()
    name, folder = str(made["file"]), spec.folder("objects")
    where = f"suite {spec.name!r}, object {scene.object}, whose shape is needed here"
    if folder is None or not (folder / name).is_file():
        raise UnirenderError(
            f"{where}: its mesh {name} is not in {folder or 'any folder'}; name the folder of objects under [folders] "
            f"in {spec.path}, or restore the file"
        )
    path = (folder / name).absolute()
    if file_sha256(path) != made["file_sha256"]:
        raise UnirenderError(
            f"{where}: {path} is another file than the truth was rendered from; restore it, or make the truth again "
            "with `unirender bench truth`"
        )
    return ObjectSource(spec.split, MeshFile(path, name)).load()


def bare_mesh(obj: MeshObject) -> MeshObject:
    """The object's shape and texture coordinates without anything that it looks like: grey, no maps."""
    grey = np.full(3, GREY, np.float32)
    return replace(obj.without_maps(), albedo=grey, provenance={})


def known_mesh(suite: Suite, scene: Scene) -> MeshObject:
    """The bare mesh of a scene's object."""
    return bare_mesh(scene_object(suite, scene))
