"""What many tests of the benchmark score."""

import pytest
from tiny_suites import make_suite

from unirender_evaluation.suites.suite import Suite


@pytest.fixture(scope="module")
def suite(tmp_path_factory: pytest.TempPathFactory) -> Suite:
    """Two balls of 32 pixels under two lights each."""
    return make_suite(tmp_path_factory.mktemp("suite"))
