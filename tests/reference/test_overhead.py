"""The overhead measurement: what it compares, and what it prints."""

import pytest

from unirender.errors import UnirenderError, UsageError
from unirender_reference.measure import overhead
from unirender_reference.measure.overhead import Overhead, measure_overhead


def test_bare_loop_makes_the_calls_of_a_sample(monkeypatch: pytest.MonkeyPatch) -> None:
    config = Overhead(resolutions=(8,), spp=32, repeats=2)
    result = measure_overhead(config, 8)
    assert result.renders == 1 + 3 * 8
    assert min(result.ratios) > 0
    assert set(result.parts) == {"geometry", "averaging", "exposure", "light", "hashing"}
    genuine = overhead.bare_renders
    monkeypatch.setattr(overhead, "bare_renders", lambda *args: list(genuine(*args))[1:])
    with pytest.raises(UnirenderError, match=r"24 mi\.render calls, expected render_sample's 25"):
        measure_overhead(config, 8)


@pytest.mark.long
def test_table_names_both_sides_of_the_ratio(capsys: pytest.CaptureFixture[str]) -> None:
    assert Overhead(resolutions=(4, 8), spp=8, repeats=1).run() == 0
    printed = capsys.readouterr().out
    for word in ("render_sample", "bare mi.render calls", "ratio", "4 px", "8 px", "geometry", "loading the scene"):
        assert word in printed


@pytest.mark.parametrize("config", [Overhead(repeats=0), Overhead(resolutions=()), Overhead(resolutions=(0,))])
def test_nothing_to_measure_is_a_wrong_command_line(config: Overhead) -> None:
    with pytest.raises(UsageError, match="expected at least 1"):
        config.run()
