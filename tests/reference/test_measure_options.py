"""Options of the commands that check and measure the ground truth: one outside its range is named with its value."""

from pathlib import Path
from typing import Any

import pytest

from unirender.errors import UsageError
from unirender_reference.checks.command import Check
from unirender_reference.measure.census_command import Census
from unirender_reference.measure.contact_sheet import Sheet
from unirender_reference.measure.cost import Cost
from unirender_reference.measure.noise_floor import NoiseFloor
from unirender_reference.measure.passes import Passes
from unirender_reference.measure.shade_ceiling import ShadeCeiling
from unirender_reference.measure.sweep import SweepMeasure

OUT = {"out": Path("never_written.png")}


@pytest.mark.parametrize(
    ("command", "options", "sentence"),
    [
        (Check, {"seed": -1}, "--seed -1: expected 0 or more"),
        (Census, {"renders": 0}, "--renders 0: expected 1 or more"),
        (Census, {"spp": -1}, "--spp -1: expected 1 or more"),
        (Census, {"workers": -1}, "--workers -1: expected 0 or more"),
        (NoiseFloor, {"images": 0}, "--images 0: expected 1 or more"),
        (NoiseFloor, {"factor": 0}, "--factor 0: expected 1 or more"),
        (NoiseFloor, {"workers": -1}, "--workers -1: expected 0 or more"),
        (NoiseFloor, {"floor": 0.0}, "--floor 0: expected decibels above 0 and below 100"),
        (Cost, {"resolutions": ()}, "--resolutions : expected one or more, each of 1 pixel or more"),
        (Cost, {"resolutions": (64, 0)}, "--resolutions 64 0: expected one or more, each of 1 pixel or more"),
        (Cost, {"scenes": 0}, "--scenes 0: expected 1 or more"),
        (ShadeCeiling, {"objects": 0}, "--objects 0: expected 1 or more"),
        (ShadeCeiling, {"spp": 0}, "--spp 0: expected 1 or more"),
        (ShadeCeiling, {"roughness": (0.5, 1.5)}, "--roughness 0.5 1.5: expected one value or more, all in [0, 1]"),
        (ShadeCeiling, {"metallic": ()}, "--metallic : expected one value or more, all in [0, 1]"),
        (Sheet, OUT | {"objects": 0}, "--objects 0: expected 1 or more"),
        (Sheet, OUT | {"objects": -1, "mesh": (Path("a.glb"),)}, "--objects -1: expected 0 or more"),
        (Sheet, OUT | {"resolution": 8}, "--resolution 8: expected 16 or more"),
        (Sheet, OUT | {"spp": 12}, "--spp 12: expected a multiple of 8"),
        (Passes, OUT | {"resolution": 0}, "--resolution 0: expected 8 or more"),
        (Passes, OUT | {"spp": 4}, "--spp 4: expected 8 or more"),
        (Passes, OUT | {"object": -1}, "--object -1: expected 0 or more"),
        (SweepMeasure, {"levels": 1}, "--levels 1: expected 2 or more"),
        (SweepMeasure, {"nodes": 5}, "--nodes 5: expected 2, 3 or 4"),
        (SweepMeasure, {"batches": 1}, "--batches 1: expected 2 or more"),
        (SweepMeasure, {"spp": 4}, "--spp 4: expected 8 or more"),
        (SweepMeasure, {"albedo": 2.0}, "--albedo 2: expected a value in [0, 1]"),
    ],
)
def test_an_option_outside_its_range_is_named_with_its_value(command: Any, options: dict, sentence: str) -> None:
    with pytest.raises(UsageError) as refused:
        command(**options).run()
    assert str(refused.value) == sentence
