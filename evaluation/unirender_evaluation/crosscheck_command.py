"""`unirender bench crosscheck`. Light to import."""

from dataclasses import dataclass

from unirender.command_line.option_checks import at_least


@dataclass(frozen=True)
class BenchCrosscheck:
    """Compare our metrics with other implementations of them; print the largest difference of each.

    PSNR and SSIM against scikit-image and torchmetrics, CIEDE2000 against scikit-image and colour-science, LPIPS
    against values of the official package. The exit status is 1 where a difference is beyond its tolerance.
    """

    suite: str = "tiny"
    """Whose pictures are compared: a bundled suite, or the path of a suite's TOML file."""
    scenes: int = 4
    """Scenes of the suite, each before and after every edit; evenly spaced."""
    pairs: int = 6
    """Pairs of random pictures of each size, from nearly alike to unrelated."""
    seed: int = 0
    """Seed of the random pictures."""

    def check(self) -> None:
        """Looks at the values; `UsageError` where one is outside its range."""
        at_least(1, scenes=self.scenes, pairs=self.pairs)
        at_least(0, seed=self.seed)

    def run(self) -> int:
        """Prints the table; returns 1 where a tolerance is exceeded."""
        self.check()
        from rich.console import Console
        from rich.table import Table

        from unirender_evaluation import lpips
        from unirender_evaluation.crosscheck import agreements, random_pairs, real_pairs
        from unirender_evaluation.suites.suite import load_suite
        from unirender_evaluation.tables.text import print_whole

        pairs = [*random_pairs(self.pairs, self.seed), *real_pairs(load_suite(self.suite), self.scenes)]
        table = Table(title="Largest difference", title_justify="left")
        table.add_column("metric")
        table.add_column("against")
        for name in ("pairs", "difference", "tolerance", ""):
            table.add_column(name, justify="right")
        found = list(agreements(pairs))
        for item in found:
            values = (str(item.pairs), f"{item.largest:.2g}", f"{item.tolerance:g}", "" if item.holds else "EXCEEDED")
            table.add_row(item.metric, item.against, *values)
        console = Console()
        print_whole(console, table)
        for backbone in lpips.BACKBONES:
            if backbone not in lpips.available():
                console.print(f"LPIPS-{backbone}: no weights on this machine, not compared", highlight=False)
        return 0 if all(item.holds for item in found) else 1
