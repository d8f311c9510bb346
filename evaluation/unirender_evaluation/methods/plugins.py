"""Other people's methods: installed ones, and those in a file or module that the command line names.

    entry point      group `unirender.methods` of an installed distribution: a row of every run
    --method SPEC    module:Class, among what is installed or in the current directory; or path/to/file.py:Class

Each names a class, or any callable that returns a method, or a method itself (see `methods`). After a `?` a SPEC has
arguments for the callable, `name=value` with `&` between: `my_method.py:Retinex?sigma=4&name=wide`; in a value `%26` is
an `&` and `%25` a `%`, as in a web address. The current directory and the folder of a file are searched last: a
stranger's `copy.py` never stands in for Python's.
"""

import hashlib
import importlib
import importlib.util
import inspect
import math
import sys
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from importlib import metadata
from pathlib import Path
from types import MappingProxyType, ModuleType, NoneType, UnionType
from typing import Any, Union, get_args, get_origin
from urllib.parse import unquote

from unirender.errors import UnirenderError, UsageError
from unirender_evaluation.methods.kept_defaults import OwnDefaults
from unirender_evaluation.methods.method import CAPABILITIES, capabilities, check_method
from unirender_evaluation.methods.plugin_source import raised_in, shadowed, source_sha256
from unirender_reference.backend import choose_llvm

ENTRY_POINT_GROUP = "unirender.methods"
FORM = "module:Class or path/to/file.py:Class"
ARGUMENTS = "?name=value&name=value"
BOOLEANS = {"true": True, "false": False}
_SET_BY: dict[str, OwnDefaults] = {}  # by name of a module: what its import has set; it is imported once
_READ: dict[tuple[str, ...], str] = {}  # by names of module and class: sha256 of the files, as they were imported


@dataclass(frozen=True)
class Plugin:
    """A stranger's method, and what its records depend on besides its own `config`.

    Attributes:
        method: answers.
        source: sha256 of the files that it is made of (`plugin_source`).
        made_by: its class, by which name it was asked for, and the arguments: a file may have several of one `config`.
        defaults: of the process, as it set them so far.
    """

    method: Any
    source: str
    made_by: Mapping[str, Any] = field(default_factory=dict)
    defaults: OwnDefaults = field(default_factory=OwnDefaults, compare=False, repr=False)


def installed_plugins() -> list[Plugin]:
    """All methods of the entry-point group, also those of several distributions under one name.

    Raises:
        UnirenderError: one cannot be loaded, or what it returns is not a method.
    """
    return [_installed(entry) for entry in metadata.entry_points(group=ENTRY_POINT_GROUP)]


def _installed(entry: metadata.EntryPoint) -> Plugin:
    what = f"plug-in {entry.name!r} ({entry.value})"
    try:
        loaded = _attempt(what, "load it", entry.load, _set_by(entry.module))
        return _plugin(loaded, what, entry.name, sys.modules[entry.module])
    except UnirenderError as error:
        owner = "its package" if entry.dist is None else entry.dist.name
        raise UnirenderError(
            f"{error}; mend or uninstall {owner}, or run without it: leave plugins out of --methods and name the "
            f"others with --method {FORM}"
        ) from error


def named_plugin(spec: str) -> Plugin:
    """The method of one `--method`.

    Raises:
        UnirenderError: the text has another form, there is no such file, module or name, it takes other arguments, its
            import or construction fails, it is not a method, or it imports another's files for its own (`shadowed`).
    """
    what = f"--method {spec}"
    target, has_arguments, query = spec.partition("?")
    place, separator, name = target.rpartition(":")
    if not (separator and place and name.isidentifier()):
        raise UsageError(f"{what}: expected {FORM}, then {ARGUMENTS} if it takes arguments")
    module = _module_of_file(Path(place), what) if _is_file(place) else _module_of_name(place, what)
    if not hasattr(module, name):
        defined = [n for n, value in vars(module).items() if any(hasattr(value, c) for c in CAPABILITIES)]
        raise UnirenderError(
            f"{what}: {module.__file__ or place} has no {name!r}; of what it has, {', '.join(defined) or 'nothing'} "
            f"has one of {', '.join(CAPABILITIES)}; a function that returns a method may be named, too"
        )
    found = getattr(module, name)
    arguments = _arguments(found, query, what) if has_arguments else {}
    return _plugin(found, what, name, module, arguments)


def absolute(spec: str) -> str:
    """The text of a `--method` whose file is found from any folder."""
    target, mark, query = spec.partition("?")
    place, separator, name = target.rpartition(":")
    return f"{Path(place).absolute()}{separator}{name}{mark}{query}" if _is_file(place) else spec


def _is_file(place: str) -> bool:
    return place.endswith(".py") or "/" in place or "\\" in place


def _arguments(found: Any, query: str, what: str) -> dict[str, Any]:
    """The arguments behind the `?`, each of the type that the callable's signature says.

    Raises:
        UsageError: another form, an argument that the callable does not take, twice, or of another type.
    """
    if not callable(found):
        raise UsageError(f"{what}: takes no arguments, expected nothing behind its name")
    signature = _attempt(what, "read its arguments", lambda: inspect.signature(found, eval_str=True), OwnDefaults())
    taken = {n: p for n, p in signature.parameters.items() if p.kind in (p.POSITIONAL_OR_KEYWORD, p.KEYWORD_ONLY)}
    arguments: dict[str, Any] = {}
    for entry in query.split("&"):
        name, separator, text = entry.partition("=")
        if not separator:
            raise UsageError(f"{what}: got {entry!r}, expected {ARGUMENTS}")
        if name in arguments:
            raise UsageError(f"{what}: {name} is given twice, expected once")
        if name not in taken:
            expected = f"some of {', '.join(taken)}" if taken else "nothing behind its name: it takes no arguments"
            raise UsageError(f"{what}: no argument {name!r}, expected {expected}")
        arguments[name] = _value(unquote(text), taken[name].annotation, f"{what}: {name}")
    return arguments


def _needed(found: Any, given: Mapping[str, Any]) -> list[str]:
    """The arguments without a default that a callable is not given."""
    try:
        taken = inspect.signature(found).parameters
    except (TypeError, ValueError):  # one that says nothing of its arguments
        return []
    optional = (inspect.Parameter.VAR_POSITIONAL, inspect.Parameter.VAR_KEYWORD)
    return [n for n, p in taken.items() if p.default is p.empty and p.kind not in optional and n not in given]


def _value(text: str, annotation: Any, what: str) -> Any:
    """A text as the type of an annotation, None apart; as it is where there is no annotation."""
    united = get_args(annotation) if get_origin(annotation) in (Union, UnionType) else (annotation,)
    kinds = [str if kind is inspect.Parameter.empty else kind for kind in united if kind is not NoneType]
    kind = kinds[0] if len(kinds) == 1 else None
    if kind is bool and text in BOOLEANS:
        return BOOLEANS[text]
    if kind in (int, float, str, Path):
        try:
            value = kind(text)
        except ValueError:
            value = None
        if value is not None and not (isinstance(value, float) and not math.isfinite(value)):
            return value
    elif kind is not bool:
        raise UsageError(f"{what} is {annotation}: expected a number, text, path or true/false in a SPEC")
    raise UsageError(f"{what} is {text!r}, expected {'true or false' if kind is bool else f'one {kind.__name__}'}")


def _module_of_file(path: Path, what: str) -> ModuleType:
    """The module of a file, imported once; its neighbours are found, but after what is installed."""
    path = path.resolve()
    if not path.is_file():
        raise UnirenderError(f"{what}: no file {path}, expected {FORM}")
    name = f"unirender_method_{hashlib.sha256(str(path).encode()).hexdigest()[:12]}"
    if name in sys.modules:
        return sys.modules[name]
    spec = importlib.util.spec_from_file_location(name, path)
    if spec is None or spec.loader is None:
        raise UnirenderError(f"{what}: {path} is no Python file, expected {FORM}")
    module = importlib.util.module_from_spec(spec)
    _search_last(path.parent)  # for its neighbours
    sys.modules[name] = module
    try:
        _attempt(what, "import it", lambda: spec.loader.exec_module(module), _set_by(name))  # pyright: ignore[reportOptionalMemberAccess] - checked above
    except UnirenderError:
        del sys.modules[name]
        raise
    return module


def _module_of_name(name: str, what: str) -> ModuleType:
    _search_last(Path.cwd())
    importlib.invalidate_caches()
    try:
        return _attempt(what, "import it", lambda: importlib.import_module(name), _set_by(name))
    except UnirenderError as error:
        missing = error.__cause__
        if isinstance(missing, ModuleNotFoundError) and missing.name and f"{name}.".startswith(f"{missing.name}."):
            raise UnirenderError(
                f"{what}: no module {missing.name!r} in {Path.cwd()} or among the installed ones, expected {FORM}"
            ) from None
        raise


def _search_last(folder: Path) -> None:
    if str(folder) not in sys.path:
        sys.path.append(str(folder))


def _set_by(module: str) -> OwnDefaults:
    return _SET_BY.setdefault(module, OwnDefaults())


def _attempt(what: str, task: str, run: Callable[[], Any], defaults: OwnDefaults) -> Any:
    """Runs foreign code under its own defaults; whatever it raises becomes one clear line.

    It may import Mitsuba before we do: what it loads then is what we render with.
    """
    with suppress(UnirenderError):  # without a usable LLVM our own rows say so
        choose_llvm()
    try:
        with defaults.here():
            return run()
    except UnirenderError as error:  # written to be read: one of ours
        raise UnirenderError(f"{what}: could not {task}: {error}") from error
    except (Exception, SystemExit) as error:
        raise UnirenderError(f"{what}: could not {task}: {type(error).__name__}: {error}{raised_in(error)}") from error


def _plugin(
    found: Any, what: str, name: str, module: ModuleType, arguments: Mapping[str, Any] = MappingProxyType({})
) -> Plugin:
    """The method that `found` of a module is, or that it returns when it is called."""
    is_method = not inspect.isclass(found) and bool(capabilities(found))
    as_it_is = not arguments and (is_method or not callable(found))
    if not as_it_is and (needed := _needed(found, arguments)):
        values = "&".join(f"{argument}=VALUE" for argument in needed)
        raise UnirenderError(
            f"{what}: it takes {', '.join(needed)}, expected a value of each, as in PLACE:{name}?{values}, or a "
            "function without arguments that returns the method"
        )
    defaults = _set_by(module.__name__).copy()
    method: Any = found if as_it_is else _attempt(what, "construct it", lambda: found(**arguments), defaults)
    try:
        check_method(method)
        source = source_sha256(type(method), found, module)
    except UnirenderError as error:
        raise UnirenderError(f"{what}: {error}") from None
    if source != _READ.setdefault((module.__name__, name, type(method).__module__, type(method).__qualname__), source):
        raise UnirenderError(
            f"{what}: its files were edited after this process had imported them, and it may run as it was; start "
            "Python anew (in a notebook: restart the kernel)"
        )
    for beside, other in shadowed(type(method), found, module):
        raise UnirenderError(
            f"{what}: in place of {beside} Python imports {other}; rename one of them, or, where the other is another "
            "method's, score the two in runs of their own, or, where it is a copy that is installed, install it for "
            "editing (pip install -e)"
        )
    said = {argument: str(value) for argument, value in arguments.items()}
    made_by = {"class": type(method).__qualname__, "name": name, "arguments": said}
    return Plugin(method, source, made_by, defaults)
