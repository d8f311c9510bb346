"""The versions that decide the bytes of a data set; its manifest names them."""

import importlib.metadata
from collections.abc import Mapping
from pathlib import Path

from unirender.errors import UnirenderError
from unirender_reference import backend


def versions(denoise: bool) -> dict[str, str]:
    """Of this process, without loading Mitsuba.

    Args:
        denoise: name the denoiser, too.

    Raises:
        UnirenderError: the denoiser is asked for and not installed.
    """
    found = {name: importlib.metadata.version(name) for name in ("unirender", "mitsuba", "drjit")}
    found["variant"] = backend.variant_name()
    if denoise:
        from unirender_reference import denoise as denoiser

        found["denoiser"] = denoiser.version()
    return found


def check_versions(folder: Path, found: Mapping[str, str], wanted: Mapping[str, str]) -> None:
    """Compares the versions that a data set was made with to those that would continue it.

    Raises:
        UnirenderError: they differ; the message says in what.
    """
    differs = [
        f"{name} {found.get(name, 'none')} (now {wanted.get(name, 'none')})"
        for name in sorted({*found, *wanted})
        if found.get(name) != wanted.get(name)
    ]
    if differs:
        raise UnirenderError(
            f"{folder}: was begun with {', '.join(differs)}, expected the same versions: one data set would hold "
            "pictures of both; install those again, choose another --out or delete it"
        )
