"""What a run was begun with, as its state holds it, so that a resume with something else is noticed.

A plain dict of `option` (that named it), `name` (what was given), `path` and, of a pipeline, `sha256`; {} where it
began with chance.
"""

from pathlib import Path

from unirender.errors import UnirenderError
from unirender.shipped import checkpoint_sha256

Beginning = dict[str, str]
KNOWN_BY = ("path", "sha256")


def beginning(option: str, given: Path, folder: Path, weights: bool = True) -> Beginning:
    """The entry of a folder.

    Args:
        option: that named it.
        given: as it was named.
        folder: that it stands for.
        weights: whether to know the weights again where they are moved; those of Stable Diffusion are gigabytes.
    """
    found = {"option": option, "name": str(given), "path": str(folder.resolve())}
    return found | ({"sha256": checkpoint_sha256(folder)} if weights else {})


def check_beginning(out: Path, begun: Beginning, asked: Beginning) -> None:
    """Looks whether a run that is resumed was begun with what it is now asked to begin with.

    The same place or the same weights will do: one command line goes on whatever becomes of the folder that it names,
    and the folder may be moved. Weights of which no hash is known (`beginning`) may be any, and who asks for nothing
    goes on, too.

    Raises:
        UnirenderError: it was begun with something else.
    """
    if not asked:
        return
    unknown = begun.get("option") == asked["option"] and "sha256" not in asked
    if unknown or any(begun.get(key) == value for key, value in asked.items() if key in KNOWN_BY):
        return
    before = f"{begun['option']} {begun['name']}" if begun else "random weights"
    repeat = f"repeat {begun['option']} {begun['name']}" if begun else f"leave {asked['option']} out"
    raise UnirenderError(
        f"{out}: holds a run that was begun with {before}, not with {asked['option']} {asked['name']}; {repeat} to go "
        "on with it, or pass another --out"
    )
