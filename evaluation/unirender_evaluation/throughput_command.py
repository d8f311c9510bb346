"""`unirender bench throughput`. Light to import."""

from dataclasses import dataclass

from unirender.option_checks import at_least


@dataclass(frozen=True)
class BenchThroughput:
    """Measure how fast scoring is on this machine: pictures per second with all variants, and what the time goes into.

    One process scores as `bench run` does, with every LPIPS backbone that is here; other work on the machine spoils it.
    """

    resolution: int = 128
    """Side of the pictures in pixels: a multiple of the suite's."""
    images: int = 8
    """Answers in a pass."""
    repeats: int = 5
    """Passes; the median is printed, with the slowest and the fastest."""
    suite: str = "tiny"
    """Whose pictures, enlarged: a bundled suite, or the path of a suite's TOML file."""

    def check(self) -> None:
        """Looks at the values; `UsageError` where one is outside its range."""
        at_least(1, resolution=self.resolution, images=self.images, repeats=self.repeats)

    def run(self) -> int:
        """Measures and prints a table."""
        self.check()
        from statistics import median

        import torch
        from rich.console import Console
        from rich.table import Table

        from unirender_evaluation import lpips
        from unirender_evaluation.suites import load_suite
        from unirender_evaluation.throughput import QUESTIONS, measure

        suite, backbones = load_suite(self.suite), lpips.available()
        found = [measure(suite, name, self.resolution, self.images, self.repeats, backbones) for name in QUESTIONS]
        table = Table(title=f"Scoring at {self.resolution} x {self.resolution} pixels", title_justify="left")
        table.add_column("")
        for item in found:
            table.add_column(item.question, justify="right")
        table.add_row("numbers of an answer", *(str(item.values) for item in found))
        for name, choose in (("median", median), ("slowest", min), ("fastest", max)):
            table.add_row(f"answers a second, {name}", *(f"{choose(item.per_second):.2f}" for item in found))
        for part in dict.fromkeys(part for item in found for part in item.shares):
            shares = (f"{item.shares[part]:.0%}" if part in item.shares else "-" for item in found)
            table.add_row(f"share of {part}" if part != "rest" else "the rest", *shares)
        console = Console()
        console.print(table)
        absent = ", ".join(f"LPIPS-{name}" for name in lpips.BACKBONES if name not in backbones)
        console.print(
            f"{self.images} answers, median of {self.repeats} passes, one process, {torch.get_num_threads()} threads "
            f"of torch; without weights here: {absent or 'none'}",
            highlight=False,
        )
        return 0
