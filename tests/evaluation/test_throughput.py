"""How fast scoring is: the shares add up, each part is where its time went, and bad sizes are refused."""

import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tiny_suites import SIZE, make_suite

from unirender.errors import UsageError
from unirender_evaluation import metrics
from unirender_evaluation.suites import Suite
from unirender_evaluation.throughput import LEAST, Clock, measure
from unirender_evaluation.throughput_command import BenchThroughput


@pytest.fixture(scope="module")
def suite(tmp_path_factory: pytest.TempPathFactory) -> Suite:
    return make_suite(tmp_path_factory.mktemp("throughput"))


@pytest.mark.parametrize(("question", "parts"), [("picture", {"SSIM"}), ("maps", {"SSIM", "CIEDE2000"})])
def test_shares_add_up(suite: Suite, question: str, parts: set[str]) -> None:
    found = measure(suite, question, SIZE, LEAST, 1, ("alex",))
    assert set(found.shares) == parts | {"LPIPS-alex", "rest"}
    assert sum(found.shares.values()) == pytest.approx(1)
    assert min(found.shares.values()) > 0
    assert found.median == found.per_second[0] > 0
    assert "LPIPS-alex" not in measure(suite, question, SIZE, LEAST, 1, ()).shares
    assert found.values > measure(suite, question, SIZE, LEAST, 1, ()).values, "without LPIPS there are fewer numbers"


def test_a_slow_part_is_seen(suite: Suite, monkeypatch: pytest.MonkeyPatch) -> None:
    """The twin: SSIM made slow takes nearly all of the time, and the speed drops."""
    before = measure(suite, "picture", SIZE, LEAST, 1, ())
    original = metrics.ssim_map

    def slow(*arguments: Any) -> np.ndarray:
        time.sleep(0.2)
        return original(*arguments)

    monkeypatch.setattr(metrics, "ssim_map", slow)
    after = measure(suite, "picture", SIZE, LEAST, 1, ())
    assert after.shares["SSIM"] > max(0.8, before.shares["SSIM"])
    assert after.median < before.median
    assert metrics.ssim_map is slow, "what was watched is put back"


def test_pictures_have_the_resolution(suite: Suite, monkeypatch: pytest.MonkeyPatch) -> None:
    sizes = set()
    original = metrics.ssim_map
    monkeypatch.setattr(metrics, "ssim_map", lambda p, t: sizes.add(p.shape[-3:-1]) or original(p, t))
    measure(suite, "maps", 2 * SIZE, LEAST, 1, ())
    assert sizes == {(2 * SIZE, 2 * SIZE)}


def test_the_command_prints_a_column_for_each_question(suite: Suite, capsys: pytest.CaptureFixture[str]) -> None:
    assert BenchThroughput(SIZE, LEAST, 1, str(suite.spec.path)).run() == 0
    shown = capsys.readouterr().out
    for text in ("picture", "maps", "answers a second, median", "share of SSIM", "share of LPIPS-alex", "the rest"):
        assert text in shown
    assert "without weights here: LPIPS-vgg" in " ".join(shown.split())


def test_a_clock_stops_where_a_function_fails() -> None:
    class Owner:
        def fail(self) -> None:
            raise ValueError("broken")

    clock = Clock()
    with clock.watch(Owner, "fail", lambda _: "part"), pytest.raises(ValueError, match="broken"):
        Owner().fail()
    assert clock.seconds["part"] >= 0


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"resolution": 100}, "expected a multiple of the suite's, 32"),
        ({"images": LEAST - 1}, f"expected {LEAST} to"),
        ({"images": 10_000}, "--images 10000"),
        ({"repeats": 0}, "repeats"),
    ],
)
def test_bad_sizes_are_refused(suite: Suite, options: dict[str, int], message: str) -> None:
    sizes = {"resolution": SIZE} | options
    with pytest.raises(UsageError, match=message):
        BenchThroughput(suite=str(Path(suite.spec.path)), **sizes).run()
