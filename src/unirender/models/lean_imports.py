"""A quick start of the command line: diffusers without the parts of it that `unirender` never runs.

Importing one class of diffusers runs the code of every autoencoder, U-Net and transformer that it knows, and
through them `transformers` and `scipy.stats`, which takes longer than torch itself. Inside
`lean_imports`

- the packages of `DEFERRED` are there, but their own code runs when a name that it defines is first asked for, not when
  one of their modules is imported. Nothing is missing afterwards;
- the packages of `HIDDEN` look as if they were not installed, and diffusers does without them. Afterwards they can be
  imported, but diffusers keeps to what it saw.

For processes of our own alone: whoever imports `unirender` as a library has all of diffusers. What was imported before
stays as it is.
"""

import contextlib
import sys
from collections.abc import Iterator, Sequence
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec, PathFinder
from types import ModuleType
from typing import Any

HIDDEN = ("transformers",)  # text encoders: the prompt's embedding is stored
DEFERRED = (
    "diffusers.models.autoencoders",
    "diffusers.models.transformers",
    "diffusers.models.unets",
    "scipy.integrate",  # of schedulers that are not ours, like the next
    "scipy.stats",
)


@contextlib.contextmanager
def lean_imports() -> Iterator[None]:
    """Inside it, diffusers is imported without what `HIDDEN` and `DEFERRED` name; itself it imports nothing."""
    hidden = [name for name in HIDDEN if name not in sys.modules]
    for name in hidden:
        sys.modules[name] = None  # type: ignore[assignment] - Python's way to say that a module cannot be imported
    finder = _Finder()
    sys.meta_path.insert(0, finder)
    try:
        yield
    finally:
        sys.meta_path.remove(finder)
        for name in hidden:
            if name in sys.modules and sys.modules[name] is None:
                del sys.modules[name]


class _Finder(MetaPathFinder):
    """Finds the packages of `DEFERRED` where they are, with a loader that waits."""

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        spec = PathFinder.find_spec(fullname, path, target) if fullname in DEFERRED else None
        if spec is not None and spec.loader is not None:
            spec.loader = _Deferred(spec.loader)
        return spec


class _Deferred(Loader):
    """Runs a package's code when a name is asked for that the package does not have yet."""

    def __init__(self, loader: Loader) -> None:
        self.loader = loader

    def create_module(self, spec: ModuleSpec) -> ModuleType | None:
        return self.loader.create_module(spec)

    def exec_module(self, module: ModuleType) -> None:
        def run(attribute: str) -> Any:
            if attribute.startswith("__"):  # what Python itself asks a module for
                raise AttributeError(f"module {module.__name__!r} has no attribute {attribute!r}")
            del vars(module)["__getattr__"]
            self.loader.exec_module(module)
            return getattr(module, attribute)

        vars(module)["__getattr__"] = run  # PEP 562
