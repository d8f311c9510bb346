"""What the commands' options refuse alike: errors of usage, with the option's name. Light to import."""

import contextlib
from collections.abc import Iterator

from unirender.errors import UnirenderError, UsageError


@contextlib.contextmanager
def usage() -> Iterator[None]:
    """Whatever is refused inside was asked for in a wrong way: a `UnirenderError` becomes a `UsageError`."""
    try:
        yield
    except UnirenderError as error:
        raise UsageError(str(error)) from error


def check_seed(seed: int) -> None:
    """Looks at the seed of a training.

    Raises:
        UsageError: PyTorch or NumPy does not take it.
    """
    if not 0 <= seed < 2**63:
        raise UsageError(f"--seed {seed}: expected an integer from 0 to 2^63 - 1")


def at_least(low: int, **options: int | None) -> None:
    """Looks at options that have a least value; None is one that was not given.

    Raises:
        UsageError: one is below `low`.
    """
    for name, value in options.items():
        if value is not None and value < low:
            raise UsageError(f"--{name.replace('_', '-')} {value}: expected at least {low}")
