"""`unirender reference cost`: what a data set costs on paper, and the command on a tiny picture."""

import pytest

from unirender_reference.measure.cost import FILES, PARTS, Cost, Figures, plans


def unit(**changed: float) -> Figures:
    """Every part costs nothing and every file is empty, but those named."""
    seconds = {part: changed.get(part, 0.0) for part in PARTS}
    return Figures(seconds, {file: changed.get(f"{file}_bytes", 0.0) for file in FILES}, 0)


def test_the_plans_count_renders_and_files() -> None:
    counts = {
        name: [plan.seconds(unit(**{part: 1})) for part in PARTS]
        + [plan.bytes(unit(**{f"{file}_bytes": 1})) for file in FILES]
        for name, plan in plans().items()
    }
    #                                      image s    d  geo exp  load encode  image  s    d  shared light
    assert counts == {
        "brute force, a light each": [121, 121, 121, 16, 121, 16, 500, 121, 121, 121, 16, 121],
        "brute force, one light": [121, 11, 1, 1, 1, 1, 135, 121, 11, 1, 1, 1],
        "sweep, one light": [33, 11, 1, 1, 1, 1, 135, 121, 11, 1, 1, 1],
    }


@pytest.mark.slow
def test_the_command_prints_what_it_measured(capsys: pytest.CaptureFixture[str]) -> None:
    assert Cost(resolutions=(16,), spp=4, scenes=1, objects=1000).run() == 0
    printed = capsys.readouterr().out
    assert "CPU seconds of one core at 4 spp" in printed
    assert {"image", "specular", "diffuse", "(s)", "(kB)", "(MB)"} <= set(printed.split())
    assert "1,000 objects x 121 pairs, 16 groups a shard" in printed
    assert printed.count("sweep, one light") == 1
