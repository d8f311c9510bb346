"""`unirender reference ...`: the ground truth checked and measured. Light to import."""

from dataclasses import dataclass, field
from typing import Annotated

import tyro

from unirender_reference.checks.command import Check
from unirender_reference.measure.census_command import Census
from unirender_reference.measure.contact_sheet import Sheet
from unirender_reference.measure.cost import Cost
from unirender_reference.measure.noise_floor import NoiseFloor
from unirender_reference.measure.passes import Passes
from unirender_reference.measure.shade_ceiling import ShadeCeiling
from unirender_reference.measure.sweep import SweepMeasure


@dataclass(frozen=True)
class Reference:
    """The ground truth: check it against closed forms, measure what it costs and how noisy it is, look at it."""

    command: tyro.conf.OmitSubcommandPrefixes[
        Annotated[Check, tyro.conf.subcommand("check")]
        | Annotated[Census, tyro.conf.subcommand("census")]
        | Annotated[NoiseFloor, tyro.conf.subcommand("noise-floor")]
        | Annotated[SweepMeasure, tyro.conf.subcommand("sweep")]
        | Annotated[Passes, tyro.conf.subcommand("passes")]
        | Annotated[ShadeCeiling, tyro.conf.subcommand("shade-ceiling")]
        | Annotated[Cost, tyro.conf.subcommand("cost")]
        | Annotated[Sheet, tyro.conf.subcommand("sheet")]
    ] = field()

    def run(self) -> int:
        """Runs the chosen command."""
        return self.command.run()
