"""`unirender reference check`: the checks as a table."""

import json
import time
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from unirender.errors import UsageError
from unirender.system.wording import one_of
from unirender_reference.option_checks import require_least
from unirender_reference.output_files import check_file, write_file

if TYPE_CHECKING:
    from rich.console import Console

    from unirender_reference.checks.outcome import Check as Outcome

WIDTH = 128  # what the tables need


@dataclass(frozen=True)
class Check:
    """Check Mitsuba's renders against closed forms, our own BSDF and each other; exit status 1 if one fails."""

    seed: int = 0
    """Another seed draws other directions, lights and samples; equal seeds give equal tables."""
    only: tuple[str, ...] = ()
    """Names of the checks to run; all if empty."""
    perturb: str | None = None
    """Break the scenes first: roughness, light-texel, unwrapped, albedo, normals, gamma, fov, metallic or bounces."""
    twins: bool = False
    """Run every check under every perturbation and print which notices which; exit status 1 if one escapes."""
    json: Path | None = None
    """Also write the rows to this file."""

    def run(self) -> int:
        """Returns the exit status: 1 where a check fails (with `twins`: where a perturbation or a check fails)."""
        from unirender_reference.checks.perturbations import PERTURBATIONS
        from unirender_reference.checks.registry import CHECKS

        names = self.only or tuple(CHECKS)
        if unknown := [name for name in names if name not in CHECKS]:
            raise UsageError(f"--only: got {', '.join(unknown)}, expected some of {', '.join(CHECKS)}")
        require_least(self, "", {"seed": 0})
        if self.perturb is not None and self.perturb not in PERTURBATIONS:
            raise UsageError(f"--perturb: got {self.perturb}, {one_of(self.perturb, PERTURBATIONS)}")
        if self.twins and self.perturb is not None:
            raise UsageError("--twins runs every perturbation: leave --perturb out")
        check_file("--json", self.json)
        return self._twins(names) if self.twins else self._table(names)

    def _table(self, names: tuple[str, ...]) -> int:
        """Prints a line for each check; the exit status is 1 if one fails."""
        from rich.table import Column, Table

        start = time.perf_counter()
        outcomes = list(self._outcomes(names, self.perturb))
        columns = (Column("check", no_wrap=True), Column("statistic", no_wrap=True))
        table = Table(*columns, "value", "threshold", "verdict", "s", title=self._title())
        for outcome in outcomes:
            verdict = "pass" if outcome.passed else "[bold red]FAIL[/]"
            limit = f"{outcome.relation} {outcome.threshold:.3g}"
            row = (outcome.name, outcome.statistic, f"{outcome.value:.3g}", limit, verdict, f"{outcome.seconds:.1f}")
            table.add_row(*row)
        console = _console()
        console.print(table)
        for outcome in outcomes:
            console.print(f"{outcome.name}: {outcome.note}", style="dim", highlight=False)
        failed = [outcome.name for outcome in outcomes if not outcome.passed]
        seconds = time.perf_counter() - start
        console.print(f"{len(outcomes) - len(failed)} of {len(outcomes)} checks passed in {seconds:.0f} s", end="")
        console.print(f"; failed: {', '.join(failed)}" if failed else "", highlight=False)
        self._write([asdict(outcome) for outcome in outcomes])
        return 1 if failed else 0

    def _twins(self, names: tuple[str, ...]) -> int:
        """Prints every check under every perturbation; the exit status is 1 if a perturbation or a check passes all."""
        from rich.table import Column, Table

        from unirender_reference.checks.perturbations import PERTURBATIONS

        columns = (None, *PERTURBATIONS)
        passed = {column: {o.name: o.passed for o in self._outcomes(names, column)} for column in columns}
        table = Table(Column("check", no_wrap=True), "as it is", *PERTURBATIONS, title=self._title())
        for name in names:
            cells = ["pass" if passed[column][name] else "FAIL" for column in columns]
            table.add_row(name, *cells)
        escaped = [column for column in PERTURBATIONS if all(passed[column].values())]
        blind = [name for name in names if all(passed[column][name] for column in PERTURBATIONS)]
        wrong = [name for name in names if not passed[None][name]]
        console = _console()
        console.print(table)
        for label, found in (("fails as it is", wrong), ("notices nothing", blind), ("escapes every check", escaped)):
            if found:
                console.print(f"{label}: {', '.join(found)}", highlight=False)
        self._write([{"perturbation": column, **passed[column]} for column in columns])
        return 1 if wrong or blind or escaped else 0

    def _outcomes(self, names: Iterable[str], perturbation: str | None) -> Iterable["Outcome"]:
        from unirender_reference.checks.perturbations import perturbed
        from unirender_reference.checks.registry import run_check

        with perturbed(perturbation):
            for name in names:
                yield run_check(name, self.seed)

    def _title(self) -> str:
        return f"seed {self.seed}" + (f", perturbed: {self.perturb}" if self.perturb else "")

    def _write(self, rows: list[dict[str, object]]) -> None:
        if self.json is not None:
            write_file("--json", self.json, json.dumps(rows, indent=2) + "\n")


def _console() -> "Console":
    """A console that is wide enough for the tables, also where the output goes to a file."""
    from rich.console import Console

    return Console(width=max(Console().width, WIDTH))
