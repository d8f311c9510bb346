"""The folder of a model: where its buffers, materials and textures are read from, and from nowhere else."""

import os
from pathlib import Path, PurePosixPath
from urllib.parse import unquote, urlparse

from unirender.errors import UnirenderError
from unirender_reference.meshes.limits import check_bytes

TILE_SETS = ("<UDIM>", "<UVTILE>")  # names of one picture for each square of texture coordinates


class ModelFolder:
    """Reads the files that a model names, as long as they lie in its folder or in that of all meshes.

    Args:
        model: path of the model file.
        root: the folder of all meshes, for models that name `../images/wood.png`; None: the model's own folder alone.
    """

    def __init__(self, model: Path, root: Path | None = None) -> None:
        self.folder = model.resolve().parent
        self._roots = [self.folder] if root is None else [self.folder, root.resolve()]
        self._where = "the model's folder" if root is None else "the folder of the meshes"

    def read(self, name: str, what: str, *, uri: bool = False, limit: int | None = None) -> bytes:
        """The bytes of a file that the model names.

        Args:
            name: as the model spells it; backslashes count as slashes. Where there is no such file, one that is spelled
                otherwise in small and capital letters alone is read, as on systems that do not tell them apart.
            what: the file's part in the model, for messages ("texture", "buffer").
            uri: whether `name` is percent-encoded.
            limit: of its bytes; None: `MAX_FILE_BYTES`.

        Raises:
            UnirenderError: the name is absolute, of another machine, or leads out of the folders (also through a link);
                the file is missing, unreadable or too large.
        """
        return self.path(name, what, uri=uri, limit=limit).read_bytes()

    def path(self, name: str, what: str, *, uri: bool = False, limit: int | None = None) -> Path:
        """Where a file lies that the model names; raises as `read` does."""
        spelled = (unquote(name) if uri else name).strip().replace("\\", "/")
        shown = name if len(name) <= 80 else name[:77] + "..."
        scheme = urlparse(name).scheme
        if len(scheme) > 1:
            raise UnirenderError(
                f"{what} {shown!r} is a {scheme} address, expected a file in {self._where}; save it there"
            )
        if spelled.startswith("/") or len(scheme) == 1:
            raise UnirenderError(
                f"{what} {shown!r} is an absolute path, expected a file in {self._where}; name it from there"
            )
        if any(tiles in spelled.upper() for tiles in TILE_SETS):
            raise UnirenderError(f"{what} {shown!r} is a set of tiles, not read here; bake them into one picture")
        try:
            path = _in_any_case(self.folder, spelled).resolve()
            if not any(path.is_relative_to(root) for root in self._roots):
                raise UnirenderError(f"{what} {shown!r} lies outside {self._where}; copy it into the folder")
            if not spelled or not path.is_file():
                raise UnirenderError(f"{what} {shown!r} is missing from the model's folder; restore the file")
            check_bytes(path.stat().st_size, f"{what} {shown!r}", limit)
        except (OSError, ValueError) as error:
            if isinstance(error, UnirenderError):
                raise
            raise UnirenderError(f"{what} {shown!r} cannot be read ({error}); check the name") from error
        return path


def _in_any_case(folder: Path, spelled: str) -> Path:
    """The path as it is spelled, or that of the one file whose name differs from it in case alone."""
    path = folder
    for part in PurePosixPath(spelled).parts:
        if part != ".." and not (path / part).exists() and path.is_dir():
            alike = [name for name in os.listdir(path) if name.casefold() == part.casefold()]
            part = alike[0] if len(alike) == 1 else part
        path = path / part
    return path
