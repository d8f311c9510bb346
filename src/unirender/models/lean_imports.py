"""A quick start of the command line: diffusers without the parts of it that `unirender` never runs.

Importing one class of diffusers runs the code of every autoencoder, U-Net and transformer that it knows, and
through them `transformers` and `scipy.stats`; and it loads PyTorch's compiler. Together they take longer than torch
itself. Inside `lean_imports`

- the packages of `DEFERRED` are there, but their own code runs when a name that it defines is first asked for, not when
  one of their modules is imported. Nothing is missing afterwards;
- the packages of `HIDDEN` look as if they were not installed, and diffusers does without them. Afterwards they can be
  imported, but diffusers keeps to what it saw;
- diffusers does not load the compiler only to tell it what not to compile (`_WithoutCompiler`). Whoever asks for
  `torch.compile` gets it at any time;
- diffusers does not list the files of all that is installed, a quarter of a second, before it asks whose they are.

For processes of our own alone: whoever imports `unirender` as a library has all of diffusers. What was imported before
stays as it is. Where diffusers or torch is built otherwise than expected here, the start is slower, nothing else.
"""

import contextlib
import functools
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec, PathFinder
from types import FunctionType, ModuleType
from typing import Any

HIDDEN = ("transformers",)  # text encoders: the prompt's embedding is stored
DEFERRED = (
    "diffusers.models.autoencoders",
    "diffusers.models.transformers",
    "diffusers.models.unets",
    "scipy.integrate",  # of schedulers that are not ours, like the next
    "scipy.stats",
)
COMPILER = "torch._dynamo"
LISTS_FILES = "diffusers.utils.import_utils"  # asks at once for `importlib.metadata.packages_distributions`
ASKS_FOR_COMPILER = "diffusers.utils.torch_utils"  # the first module of diffusers that does, and all others' way to it


@contextlib.contextmanager
def lean_imports() -> Iterator[None]:
    """Inside it, diffusers is imported without what this module names; itself it imports nothing."""
    with _hidden(*HIDDEN), contextlib.ExitStack() as undo:
        finder = _Finder(undo)
        sys.meta_path.insert(0, finder)
        undo.callback(sys.meta_path.remove, finder)
        yield


@contextlib.contextmanager
def _hidden(*names: str) -> Iterator[None]:
    """Inside it, importing those modules fails as if they were not installed, but for those imported already."""
    hidden = [name for name in names if name not in sys.modules]
    for name in hidden:
        sys.modules[name] = None  # pyright: ignore[reportArgumentType] - Python's way to say that a module cannot be imported
    try:
        yield
    finally:
        for name in hidden:
            if name in sys.modules and sys.modules[name] is None:
                del sys.modules[name]


class _Finder(MetaPathFinder):
    """Finds modules where they are, and gives those that this file is about another loader."""

    def __init__(self, undo: contextlib.ExitStack) -> None:
        self.undo = undo

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        if fullname not in (*DEFERRED, ASKS_FOR_COMPILER, LISTS_FILES):
            return None
        spec = PathFinder.find_spec(fullname, path, target)
        if spec is not None and spec.loader is not None:
            if fullname == ASKS_FOR_COMPILER:
                spec.loader = _WithoutCompiler(spec.loader, self.undo)
            else:
                spec.loader = (_Deferred if fullname in DEFERRED else _WithoutListing)(spec.loader)
        return spec


class _Around(Loader):
    """A module's own loader, which answers all that it is asked (for sources, for data files) but to run the code."""

    def __init__(self, loader: Loader) -> None:
        self.loader = loader

    def __getattr__(self, name: str) -> Any:
        return getattr(vars(self)["loader"], name)

    def create_module(self, spec: ModuleSpec) -> ModuleType | None:
        return self.loader.create_module(spec)


class _Deferred(_Around):
    """Runs a package's code when a name is asked for that the package does not have yet.

    That is for one thread to do, as at the start of a process of our own: another one would find half of the package.
    """

    def exec_module(self, module: ModuleType) -> None:
        def run(attribute: str) -> Any:
            # Python itself asks a module for names like __path__; for __all__ only where all names are imported
            if attribute.startswith("__") and attribute != "__all__":
                raise AttributeError(f"module {module.__name__!r} has no attribute {attribute!r}")
            del vars(module)["__getattr__"]
            try:
                self.loader.exec_module(module)
            except BaseException:
                vars(module)["__getattr__"] = run  # who asks next gets the same error, not an empty package
                raise
            return getattr(module, attribute)

        vars(module)["__getattr__"] = run  # PEP 562


class _WithoutListing(_Around):
    """Runs the code of `diffusers.utils.import_utils`, which keeps what it is given for the list of packages."""

    def exec_module(self, module: ModuleType) -> None:
        import importlib.metadata  # as that module does

        listing = importlib.metadata.packages_distributions
        importlib.metadata.packages_distributions = lambda: _Packages(listing)
        try:
            self.loader.exec_module(module)
        finally:
            importlib.metadata.packages_distributions = listing


class _Packages(Mapping[str, list[str]]):
    """Which distributions a package is of, listed when that is first asked for."""

    def __init__(self, listing: Callable[[], Mapping[str, list[str]]]) -> None:
        self._listed = functools.cache(listing)

    def __getitem__(self, package: str) -> list[str]:
        return self._listed()[package]

    def __iter__(self) -> Iterator[str]:
        return iter(self._listed())

    def __len__(self) -> int:
        return len(self._listed())


class _WithoutCompiler(_Around):
    """Runs the code of `diffusers.utils.torch_utils`, and answers for the compiler as long as nobody loads it.

    Until then nothing is compiled, and what diffusers wants of the compiler has a plain answer:

    - `allow_in_graph` (which classes are not to be looked into): diffusers' own way without a compiler, a class as it
      is. It stays so: compiled later, such a class is looked into, with the same result;
    - `is_compiled_module`: no;
    - `torch.compiler.disable` (which functions are not to be compiled): the function as it is, and the compiler's own
      word on it once it is loaded.
    """

    def __init__(self, loader: Loader, undo: contextlib.ExitStack) -> None:
        super().__init__(loader)
        self.undo = undo

    def exec_module(self, module: ModuleType) -> None:
        import torch  # as that module does: it must not be imported for the first time while its compiler is hidden

        with _hidden(COMPILER):
            self.loader.exec_module(module)
        if (is_compiled := vars(module).get("is_compiled_module")) is not None:
            vars(module)["is_compiled_module"] = lambda network: COMPILER in sys.modules and is_compiled(network)
        compiler: Any = torch.compiler
        self.undo.callback(setattr, compiler, "disable", compiler.disable)
        compiler.disable = _when_loaded(compiler.disable)


def _when_loaded(disable: Callable[..., Any]) -> Callable[..., Any]:
    """`torch.compiler.disable` as a decorator that asks the compiler at a call, and only if somebody has loaded it."""

    def decorate(fn: Callable[..., Any] | None = None, recursive: bool = True, *, reason: str | None = None) -> Any:
        if fn is None:
            return functools.partial(decorate, recursive=recursive, reason=reason)
        if not isinstance(fn, FunctionType):  # a class or a network has to stay one
            return disable(fn, recursive, reason=reason)
        disabled = functools.cache(lambda: disable(fn, recursive, reason=reason))

        @functools.wraps(fn)
        def call(*args: Any, **kwargs: Any) -> Any:
            return (disabled() if COMPILER in sys.modules else fn)(*args, **kwargs)

        return call

    return decorate
