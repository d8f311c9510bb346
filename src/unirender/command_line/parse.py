"""A command line as the command that it asks for, or one sentence on what is wrong with it. Light to import."""

import contextlib
import io
import itertools
import re
from collections.abc import Iterable, Iterator, Sequence
from typing import Any

import docstring_parser
import tyro

from unirender.command_line.option_values import WrongValue, registry
from unirender.errors import UnirenderError, UsageError
from unirender.system.ends import causes
from unirender.system.wording import meant, near

OPTION = re.compile(r"(?<![\w.-])--[a-z][\w.-]*")
SYNONYMS = {
    "size": ("resolution",),
    "resolution": ("size",),
    "light": ("environment",),
    "model": ("checkpoint",),
    "output": ("out", "export"),
    "out": ("output", "export"),
}
COMMANDS = re.compile(r"\[-h\] \{([\w,-]+)\}$")  # of a usage line; not the choices of an option
BORDER = "\N{BOX DRAWINGS LIGHT VERTICAL}"  # of the boxes of a help, where a stream can print it
REFUSED = re.compile(r"Error parsing (--[\w.-]+)?")  # tyro, of a wrong value; its option
MISSING = re.compile(r"Missing value for argument '(--[\w.-]+)'")
LINE_BREAK = re.compile(r"(?<!\n)\n[ ]*(?![ \n]|- )")  # of a sentence: no empty line, no item of a list


def parse(commands: Any, argv: Sequence[str], prog: str, description: str) -> Any:
    """The command of a command line.

    Args:
        commands: a union of dataclasses, a subcommand each; one of them may hold a union of its own as `command`.
        argv: the words after the program's name.
        prog: the program's name.
        description: for its help.

    Raises:
        UnirenderError: a group of options refuses its values.
        UsageError: the command has no such option, or a word is empty.
        SystemExit: help was asked for (0), or something else is wrong (2); tyro has printed it.
    """
    _check_empty(argv)
    with _sentences_of_options():
        return _parsed(commands, list(argv), prog, description)


def _check_empty(argv: Sequence[str]) -> None:
    """An empty path would be the folder that one is in.

    Raises:
        UsageError: a word, or what follows an option's =, is empty.
    """
    for number, word in enumerate(argv):
        option, equals, value = word.partition("=")
        if not word or (option.startswith("--") and equals and not value):
            where = f"{option}=" if word else f"after {argv[number - 1]}" if number else "at the beginning"
            raise UsageError(f"{where}: got an empty word, expected a value; is a variable of the shell not set?")


def _parsed(commands: Any, words: list[str], prog: str, description: str) -> Any:
    """The command of the words; of an error, the one of ours that caused it, or else tyro's own message."""
    printed = io.StringIO()
    try:
        with contextlib.redirect_stderr(printed):
            command, unknown = tyro.cli(
                commands, args=words, prog=prog, description=description, registry=registry, return_unknown_args=True
            )
    except SystemExit as stopped:
        for error in causes(stopped):
            if isinstance(error, UnirenderError):
                raise error from None
        if not stopped.code:
            raise
        _check_words(commands, words, prog)
        _check_values(printed.getvalue(), causes(stopped))
        # says what is wrong
        command = tyro.cli(commands, args=words, prog=prog, description=description, registry=registry)
        unknown = []
    if unknown:
        raise UsageError(_unknown_words(commands, words, unknown, prog))
    return command


@contextlib.contextmanager
def _sentences_of_options() -> Iterator[None]:
    """Makes help of options that break where the terminal ends, not also where the source does.

    docstring_parser leaves the indentation in the docstrings of attributes, so tyro takes each of their lines for a
    paragraph and keeps the breaks.
    """
    read = docstring_parser.parse_from_object

    def joined(described: object) -> docstring_parser.Docstring:
        parsed = read(described)
        for option in parsed.params:
            option.description = LINE_BREAK.sub(" ", option.description or "") or None
        return parsed

    docstring_parser.parse_from_object = joined
    try:
        yield
    finally:
        docstring_parser.parse_from_object = read


def _unknown_words(commands: Any, words: Sequence[str], unknown: Sequence[str], prog: str) -> str:
    """The sentence on words that no option takes, with the nearest options of that command."""
    path, known, _ = _asked(commands, words, prog)
    options = [word.partition("=")[0] for word in unknown if word.startswith("--")]
    close = dict.fromkeys(f"--{match}" for option in options for match in _near(option[2:], [n[2:] for n in known]))
    wrong = "no option of" if options else "not expected by"
    hint = meant(close) or ";"
    return f"{', '.join(options or unknown)}: {wrong} `{path}`{hint} `{path} --help` lists what it takes"


def _near(option: str, known: Sequence[str]) -> list[str]:
    """Up to two of the known options that may be meant, without their dashes."""
    synonyms = [name for name in SYNONYMS.get(option, ()) if name in known]
    return synonyms[:1] or near(option, known)


def _check_values(printed: str, errors: Iterable[BaseException]) -> None:
    """Looks for an option whose value is none that it takes, or that has none.

    Args:
        printed: by tyro, which knows the option.
        errors: that tyro met, one of which knows what is expected.

    Raises:
        UsageError: there is one.
    """
    if missing := MISSING.search(printed):
        raise UsageError(f"{missing[1]}: expected a value after it, got none")
    refused = REFUSED.search(printed)
    for error in errors:
        if refused and isinstance(error, WrongValue):
            raise UsageError(f"{f'{refused[1]} ' if refused[1] else ''}{error}") from None


def _check_words(commands: Any, words: Sequence[str], prog: str) -> None:
    """Looks for a command that is not there, and for options that a command does not have, where something is wrong.

    What follows such an option is taken for a value of the command then, and what is said of that is no help.

    Raises:
        UsageError: there are some.
    """
    path, known, names = _asked(commands, words, prog)
    after = words[path.count(" ") :]
    if names and after and not after[0].startswith("-"):
        hint = meant(near(after[0], names)) or ";"
        raise UsageError(f"{after[0]}: no command of `{path}`{hint} `{path} --help` lists them")
    used = [word.partition("=")[0] for word in words if word.startswith("--")]
    unknown = [option for option in used if option.replace("_", "-") not in known]
    if unknown and path != prog:
        raise UsageError(_unknown_words(commands, words, unknown, prog))


def _asked(commands: Any, words: Sequence[str], prog: str) -> tuple[str, list[str], list[str]]:
    """The command that a line begins with, from the program's name on, the options that its help lists, and the
    commands that it has itself."""
    names = list(itertools.takewhile(lambda word: not word.startswith("-"), words))[:2]  # or values of a command
    while True:
        printed, path = io.TextIOWrapper(io.BytesIO(), encoding="utf-8"), " ".join([prog, *names])
        streams = contextlib.redirect_stdout(printed), contextlib.redirect_stderr(io.StringIO())
        with streams[0], streams[1], contextlib.suppress(SystemExit):
            tyro.cli(commands, args=[*names, "--help"], prog=prog, registry=registry)
        printed.seek(0)
        lines = printed.read().splitlines()
        usage = next((line for line in lines if line.startswith(f"usage: {path} ")), "")
        if usage or not names:
            cells = (cell for line in lines for cell in line.split(BORDER))  # several a line, where a terminal is wide
            heads = [cell[1:].split("  ")[0] for cell in cells if cell[1:2] == "-"]  # not the prose
            below = [name for listed in COMMANDS.findall(usage) for name in listed.split(",")]
            return path, sorted({"--help", *OPTION.findall(" ".join(heads))}), below
        names.pop()
