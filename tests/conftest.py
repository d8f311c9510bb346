"""What every test runs under: checked array shapes, no network, a cache of its own.

The import hook comes first: it instruments the three packages as they are imported, so that every jaxtyping
annotation in a signature is checked by beartype at each call. A wrong shape in the code under test fails the test.
"""

import os
import sys
import tempfile
import types

from beartype import BeartypeConf, beartype
from jaxtyping import install_import_hook

PACKAGES = ("unirender", "unirender_reference", "unirender_evaluation")
# An int is a float, as it is to Python and to pyright; the hook wants the checker by its dotted name.
_checker = types.ModuleType("unirender_test_checker")
_checker.check = beartype(conf=BeartypeConf(is_pep484_tower=True))  # type: ignore[attr-defined] - made on the spot
sys.modules[_checker.__name__] = _checker
install_import_hook(PACKAGES, "unirender_test_checker.check")

os.environ["HF_HUB_OFFLINE"] = "1"
# Neither read nor write what the user has in the real cache (checkpoints, converted weights, data).
_CACHE = tempfile.TemporaryDirectory(prefix="unirender-test-cache-")
os.environ["UNIRENDER_CACHE"] = _CACHE.name
os.environ.setdefault("MPLBACKEND", "Agg")
if "PYTEST_XDIST_WORKER" in os.environ:  # one core per worker, or the workers fight for them
    os.environ.setdefault("OMP_NUM_THREADS", "1")

import pytest  # noqa: E402 - after the environment is set


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        "--regenerate",
        action="store_true",
        help="rewrite the stored references (mean and variance EXR) instead of comparing; refused when CI=true",
    )


def pytest_configure(config: pytest.Config) -> None:
    if config.getoption("--regenerate") and os.environ.get("CI", "").lower() in {"1", "true"}:
        raise pytest.UsageError(
            "--regenerate: refused when CI=true: a reference is rewritten by a person, who looks at it"
        )


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Leaves out what is marked `large`, whatever else is deselected: only `-m large` brings it in."""
    if "large" in str(config.getoption("markexpr")):
        return
    left_out = [item for item in items if item.get_closest_marker("large")]
    if left_out:
        items[:] = [item for item in items if item not in left_out]
        config.hook.pytest_deselected(items=left_out)


@pytest.fixture(scope="session")
def regenerate(request: pytest.FixtureRequest) -> bool:
    """True where stored references are to be rewritten."""
    return bool(request.config.getoption("--regenerate"))
