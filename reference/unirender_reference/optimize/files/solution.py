"""Objects and solutions as npz files: every array bit for bit, for runs that go on."""

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np

from unirender.errors import UnirenderError
from unirender.system.whole_files import whole_file
from unirender_reference.optimize.solution import Solution
from unirender_reference.shapes import MeshObject

ARRAYS = tuple(
    field.name for field in dataclasses.fields(MeshObject) if field.name not in ("name", "family", "provenance")
)
_TEXT, _ENVIRONMENT = "text", "environment"


def write_solution_file(path: Path, found: Solution | MeshObject) -> None:
    """Writes a solution, or an object alone; a killed run leaves no part of a file."""
    obj = found.obj if isinstance(found, Solution) else found
    arrays = {name: getattr(obj, name) for name in ARRAYS if getattr(obj, name) is not None}
    arrays |= {_ENVIRONMENT: found.environment} if isinstance(found, Solution) else {}
    text = json.dumps({"name": obj.name, "family": obj.family, "provenance": dict(obj.provenance)})
    with whole_file(path) as file:
        np.savez(file, **arrays, text=np.array(text))


def read_solution_file(path: Path) -> Solution | MeshObject:
    """What `write_solution_file` wrote.

    Raises:
        UnirenderError: the file is missing or broken.
    """
    try:
        with np.load(path) as file:
            arrays: dict[str, Any] = {name: file[name] for name in file.files}
        text = json.loads(str(arrays.pop(_TEXT)))
        environment = arrays.pop(_ENVIRONMENT, None)
        obj = MeshObject(**text, **arrays)
    except Exception as error:  # NumPy raises half a dozen kinds for a damaged file
        raise UnirenderError(f"{path}: no readable state ({error!s:.200}); delete the folder to begin anew") from error
    return obj if environment is None else Solution(obj, environment)
