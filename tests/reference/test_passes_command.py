"""`unirender reference passes`: its two files, its verdict, what it refuses."""

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from unirender.errors import UnirenderError, UsageError
from unirender.exr import channels_rgb, read_exr
from unirender_reference.effects import EFFECTS
from unirender_reference.lobes import LOBES
from unirender_reference.measure.passes import Passes

DOCS = Path(__file__).parents[2] / "docs" / "passes.md"


def small(out: Path, **options: Any) -> Passes:
    return Passes(out=out, **{"resolution": 16, "spp": 128, **options})


@pytest.mark.long
def test_files_hold_the_passes_and_a_wrong_sum_is_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command = small(tmp_path / "new" / "folder")
    assert command.run() == 0
    printed = capsys.readouterr().out
    assert printed.count("passed") == 2
    channels, attributes = read_exr(command.out / "passes.exr")
    total = np.sum([channels_rgb(channels, name) for name in EFFECTS], axis=0)
    np.testing.assert_allclose(channels_rgb(channels, "effects"), total, atol=1e-6)
    composed = np.zeros_like(total)
    for name in LOBES:
        metallic = 0.5  # of both (1 - m) and m
        composed += metallic * channels_rgb(channels, name) * channels_rgb(channels, f"{name}.weight")
    np.testing.assert_allclose(channels_rgb(channels, "composed"), composed, atol=1e-6)
    assert attributes["object"] == "train-000014"
    documented = DOCS.read_text()
    for name in {channel.rpartition(".")[0] for channel in channels} - {""}:
        assert f"`{name}.R`" in documented, name
    assert (command.out / "passes.png").stat().st_size > 1000

    renders = command.render()
    assert all(result.passed for result in renders.z_tests().values())
    dark = dataclasses.replace(renders.effects.unshadowed, mean=renders.effects.unshadowed.mean * np.float32(0.8))
    wrong = dataclasses.replace(renders, effects=dataclasses.replace(renders.effects, unshadowed=dark))
    assert [result.passed for result in wrong.z_tests().values()] == [False, True]


def test_command_line_is_checked(tmp_path: Path) -> None:
    for wrong in ({"roughness": 1.5}, {"metallic": -0.1}):
        with pytest.raises(UsageError, match="expected"):
            small(tmp_path, **wrong).run()
    with pytest.raises(UnirenderError, match="has none"):
        small(tmp_path, roughness=None).run()
    with pytest.raises(UnirenderError, match=r"missing\.glb"):
        small(tmp_path, mesh=tmp_path / "missing.glb").run()
    with pytest.raises(UsageError, match="--maps: of the procedural object, but --mesh"):
        small(tmp_path, mesh=tmp_path / "missing.glb", maps=True).run()
    assert not list(tmp_path.iterdir())
