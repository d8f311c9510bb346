"""What `--holdout` must not divide: files of which one on either side show one object."""

from pathlib import Path

from unirender.errors import UnirenderError
from unirender_reference.mesh_folder import in_split, pattern_base

MIXES = "mix.json"  # marks a folder of `unirender mix-meshes`


def check_sides(pattern: str | Path, holdout: int) -> None:
    """Looks whether holding out every `holdout`-th mesh file holds its object out; nothing is opened.

    Args:
        pattern: a folder or glob with meshes.
        holdout: as of `mesh_folder`; 0: nothing is divided.

    Raises:
        UnirenderError: one object would be on both sides: a part of mixes, or a model in two formats.
    """
    from unirender_reference.meshes import find_meshes

    if not holdout:
        return
    before: Path | None = None
    for index, path in enumerate(find_meshes(pattern, lambda folder, reason: None)):
        divided = in_split(index, "test", holdout) != in_split(index - 1, "test", holdout)
        if divided and before is not None and path.with_suffix("") == before.with_suffix(""):
            raise UnirenderError(
                f"{path.parent}: {before.name} and {path.name} look like one model in two formats, and --holdout "
                f"{holdout} has one on each side; name one format ('{pattern_base(pattern)}/**/*{path.suffix}')"
            )
        before, above = path, path.parent.parent
        if path.parent.name.startswith("mix-") and (above / MIXES).is_file():
            raise UnirenderError(
                f"{above}: --holdout would divide mixes, of which two on either side share meshes; hold meshes out "
                "when they are mixed (`unirender mix-meshes --holdout`), and take their mixes without --holdout"
            )
