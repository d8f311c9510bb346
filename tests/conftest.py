"""What every test runs under: checked array shapes, no network, a cache of its own.

The import hook comes first: it instruments the three packages as they are imported, so that every jaxtyping
annotation in a signature is checked by beartype at each call. A wrong shape in the code under test fails the test.
"""

import gc
import os
import signal
import tempfile
from collections.abc import Generator, Iterator

import shape_checks

shape_checks.install("unirender", "unirender_reference", "unirender_evaluation")

os.environ["HF_HUB_OFFLINE"] = "1"
# Neither read nor write what the user has in the real cache (checkpoints, converted weights, data).
_CACHE = tempfile.TemporaryDirectory(prefix="unirender-test-cache-")
os.environ["UNIRENDER_CACHE"] = _CACHE.name
os.environ.setdefault("MPLBACKEND", "Agg")
os.environ.pop("COLUMNS", None)  # tables have the width that they have where nobody watches, 80
if "PYTEST_XDIST_WORKER" in os.environ:  # one core per worker, or the workers fight for them
    os.environ.setdefault("OMP_NUM_THREADS", "1")

import pytest  # noqa: E402 - after the environment is set


@pytest.fixture
def a_hangup_counts() -> Iterator[None]:
    """Under `nohup` it is ignored, also by what is tested, as it should be."""
    before = signal.signal(signal.SIGHUP, signal.SIG_DFL)
    yield
    signal.signal(signal.SIGHUP, before)


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        "--regenerate",
        action="store_true",
        help="rewrite the stored references instead of comparing; refused when CI=true",
    )


def pytest_configure(config: pytest.Config) -> None:
    if config.getoption("--regenerate") and os.environ.get("CI", "").lower() in {"1", "true"}:
        raise pytest.UsageError(
            "--regenerate: refused when CI=true: a reference is rewritten by a person, who looks at it"
        )


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Generator[None, object, object]:
    """What is imported stays: Python's search for garbage looks at none of it, while it is made or while tests run."""
    gc.disable()
    try:
        return (yield)
    finally:
        gc.collect()
        gc.freeze()
        gc.enable()


# Markers of what takes long, or needs a program or a machine that not everybody has: such tests never skip; they run by
# their own command alone, and fail there where what they need is missing.
OWN_COMMANDS = {
    "demo": "make test-demo",
    "large": "make test-large",
    "latex": "make test-latex",
    "long": "make test-long",
    "report": "make test-report",
}


def left_out(config: pytest.Config) -> dict[str, str]:
    """Markers that this run leaves out, whatever else is deselected: only `-m` with its name brings one in."""
    expression = str(config.getoption("markexpr"))
    return {marker: command for marker, command in OWN_COMMANDS.items() if marker not in expression}


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Leaves out what has its own command."""
    others = [item for item in items if any(item.get_closest_marker(marker) for marker in left_out(config))]
    if others:
        items[:] = [item for item in items if item not in others]
        config.hook.pytest_deselected(items=others)


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter, config: pytest.Config) -> None:
    """Says by name what was left out."""
    if found := left_out(config):
        names = ", ".join(f"{marker} ({command})" for marker, command in found.items())
        terminalreporter.write_line(f"left out, each has its own command: {names}")


@pytest.fixture(scope="session")
def regenerate(request: pytest.FixtureRequest) -> bool:
    """True where stored references are to be rewritten."""
    return bool(request.config.getoption("--regenerate"))
