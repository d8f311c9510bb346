"""The parts of the speed study by name. Light to import; what they are: `timing`."""

from typing import Literal

PartName = Literal["network", "mitsuba", "start", "training", "overfit"]
PARTS: tuple[PartName, ...] = ("network", "mitsuba", "start", "training", "overfit")
NEED_DATA: frozenset[PartName] = frozenset({"training", "overfit"})
