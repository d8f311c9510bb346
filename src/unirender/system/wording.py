"""Pieces of sentences that many messages need. Light to import."""

import difflib
from collections.abc import Iterable


def near(word: str, known: Iterable[str]) -> list[str]:
    """Up to two of the known names that a word may stand for, whatever the case of its letters."""
    names = {name.casefold(): name for name in known}
    return [names[match] for match in difflib.get_close_matches(word.casefold(), names, n=2)]


def meant(names: Iterable[str]) -> str:
    """What ends a sentence on something unknown: the names that may be meant, if there are any."""
    listed = " or ".join(names)
    return f"; did you mean {listed}?" if listed else ""


def one_of(word: str, known: Iterable[str]) -> str:
    """What is expected in place of a word that is none of the known names."""
    names = list(known)
    return f"expected one of {', '.join(names)}{meant(near(word, names))}"


def instead(word: str, known: Iterable[str]) -> str:
    """What ends a sentence on a word that is none of many known names: those that may be meant, else all of them."""
    names = list(known)
    return meant(near(word, names)) or f"; expected one of {', '.join(names)}"


def counted(count: int, noun: str) -> str:
    """So many of something: `1 shard`, `1,200 shards`."""
    return f"{count:,} {noun}{'' if count == 1 else 's'}"
