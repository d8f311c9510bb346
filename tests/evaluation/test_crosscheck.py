"""Our metrics against other implementations of them, as `bench crosscheck` prints it; a wrong one is found."""

from collections.abc import Callable

import numpy as np
import pytest
from tiny_suites import write_suite

from unirender_evaluation import crosscheck, lpips, metrics
from unirender_evaluation.crosscheck import OFFICIAL, Agreement, agreements, random_pairs, real_pairs
from unirender_evaluation.crosscheck_command import BenchCrosscheck
from unirender_evaluation.suites.suite import load_suite

PAIRS = list(random_pairs(2, seed=3))


def test_every_metric_agrees() -> None:
    found = list(agreements(PAIRS))
    assert [item for item in found if not item.holds] == []
    assert {item.metric for item in found} == {"PSNR", "SSIM", "CIEDE2000", "LPIPS-Alex"}
    assert len({(item.metric, item.against) for item in found}) == len(found) == 7
    assert {side for name, side in OFFICIAL if name == "alex"} == {64, 100}


def _off(by: float, function: Callable[..., float]) -> Callable[..., float]:
    return lambda *arguments: function(*arguments) + by


@pytest.mark.parametrize(
    ("name", "label", "by"), [("psnr", "PSNR", 1e-4), ("ssim", "SSIM", -1e-6), ("ciede2000", "CIEDE2000", 0.02)]
)
def test_a_wrong_metric_is_found(monkeypatch: pytest.MonkeyPatch, name: str, label: str, by: float) -> None:
    where = crosscheck if name == "ssim" else metrics
    monkeypatch.setattr(where, name, _off(by, getattr(where, name)))
    wrong = {item.metric for item in agreements(PAIRS[:2]) if not item.holds}
    assert wrong == {label}


@pytest.mark.parametrize("factor", [0.99, 1.01])
def test_wrong_weights_of_lpips_are_found(factor: float, monkeypatch: pytest.MonkeyPatch) -> None:
    network = lpips.Lpips("alex")
    network.network.heads[0].data *= factor
    monkeypatch.setattr(lpips, "load", lambda _: network)
    assert {item.metric for item in agreements(PAIRS[:1]) if not item.holds} == {"LPIPS-Alex"}


def test_pairs_are_of_every_distance_and_of_a_suite(tmp_path_factory: pytest.TempPathFactory) -> None:
    distances = [float(np.abs(p - t).mean()) for p, t in random_pairs(3, 0)]
    assert len(distances) == 9
    assert max(distances) > 50 * min(distances)
    suite = load_suite(write_suite(tmp_path_factory.mktemp("suite")))
    pairs = list(real_pairs(suite, 2))
    assert len(pairs) == 2 * len(suite.spec.edits)
    assert all(not np.array_equal(p, t) for p, t in pairs)


def test_the_command_fails_where_a_tolerance_is_exceeded(
    monkeypatch: pytest.MonkeyPatch, tmp_path_factory: pytest.TempPathFactory, capsys: pytest.CaptureFixture[str]
) -> None:
    suite = str(write_suite(tmp_path_factory.mktemp("suite")))
    held = [Agreement("PSNR", "other 1.0", 3, 1e-12, 1e-9)]
    for extra, status in (([], 0), ([Agreement("SSIM", "other 1.0", 3, 1e-3, 1e-9)], 1)):
        monkeypatch.setattr("unirender_evaluation.crosscheck.agreements", lambda _, rows=(*held, *extra): iter(rows))
        assert BenchCrosscheck(suite=suite, scenes=1, pairs=1).run() == status
        assert ("EXCEEDED" in capsys.readouterr().out) == bool(status)
