"""Who is to blame when a group fails: the object, the machine, or the run.

A file that is broken stays broken: its failure is stored, and the file is not tried again. A machine that runs out of
memory or of time says nothing about the file: that is listed too, and tried again by the next run. Whatever else goes
wrong (a missing library, a folder that a worker does not see) would fail the next file as well: it ends the run.
"""

import contextlib
import errno
from collections.abc import Iterator

from unirender.errors import UnirenderError
from unirender_reference.mesh_folder import MeshFile
from unirender_reference.processes import TimeLimitPassed

MACHINE_ERRORS = {
    getattr(errno, name)
    for name in ("EACCES", "EIO", "EMFILE", "ENFILE", "ENOMEM", "ENOSPC", "EPERM", "ESTALE", "ETIMEDOUT")
    if hasattr(errno, name)
}


class ObjectFault(UnirenderError):
    """An object cannot be rendered, wherever that is tried."""


class LightFault(UnirenderError):
    """A light does not reach an object that an even light reaches."""


class FileNotSeen(UnirenderError):
    """A mesh file is not there for the process that was to load it."""


class FileFailure(UnirenderError):
    """A mesh file cannot be loaded or rendered; the message is the reason.

    Attributes:
        machine: it may succeed elsewhere or later.
    """

    def __init__(self, reason: str, machine: bool = False) -> None:
        super().__init__(reason)
        self.machine = machine


@contextlib.contextmanager
def blamed_on(mesh: MeshFile | None, *kinds: type[Exception]) -> Iterator[None]:
    """Turns errors of `kinds`, and a lack of time or memory, into a failure of the file; all others end the run.

    Args:
        mesh: None: the object is no file, and nothing is changed.
        kinds: what is said of the file alone inside the block.

    Raises:
        FileFailure: the file failed.
        UnirenderError: the renderer failed; the message names the file that it had.
    """
    try:
        yield
    except Exception as error:
        if mesh is None or isinstance(error, FileFailure | FileNotSeen):
            raise
        causes = list(_causes(error))
        if isinstance(error, (*kinds, TimeLimitPassed, MemoryError)) and not any(
            isinstance(cause, ImportError) for cause in causes
        ):
            raise FileFailure(_reason(error, mesh), any(map(_of_machine, causes))) from error
        if isinstance(error, RuntimeError | OSError):
            said = f"{type(error).__name__}: {' '.join(str(error).split())}"
            raise UnirenderError(
                f"dataset: the renderer failed at {mesh.name} ({said}), which is not listed as a fault of the file; "
                "complete shards are kept, run the same command again"
            ) from error
        raise


def _causes(error: BaseException) -> Iterator[BaseException]:
    """The error and what it was raised from."""
    found: BaseException | None = error
    while found is not None:
        yield found
        found = found.__cause__


def _of_machine(error: BaseException) -> bool:
    return isinstance(error, MemoryError | TimeLimitPassed) or (
        isinstance(error, OSError) and error.errno in MACHINE_ERRORS
    )


def _reason(error: Exception, mesh: MeshFile) -> str:
    """What went wrong, in one line that does not say where the folder is."""
    reason = " ".join(str(error).split())
    if not isinstance(error, UnirenderError):
        reason = f"{type(error).__name__}: {reason}"
    return mesh.without_folder(reason).removeprefix(f"mesh {mesh.name}: ")
