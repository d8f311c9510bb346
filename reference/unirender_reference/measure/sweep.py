"""`unirender reference sweep`: what the sweep of metallic x roughness saves, and whether it is the same sweep.

What is compared, and how: `sweep_check`. Brute force and sweep share no random numbers; the sweep's pairs share their
nodes', which Sidak's correction over all values allows.
"""

from dataclasses import dataclass, replace
from typing import Literal

from unirender.errors import UsageError
from unirender_reference.option_checks import require_least

MOST_TIME = 0.3  # of the bare loop
NOISE_SPP = 64  # of the pictures whose differences are compared
CUBIC_ROUGHNESS, CUBIC_FACTOR = 0.9, 8  # of the renders for the cubic term, in samples of the others


@dataclass(frozen=True)
class SweepRow:
    """One line: what was found, the bound it has to keep if it has one, and whether it does."""

    quantity: str
    found: str
    bound: str = ""
    passed: bool | None = None


@dataclass(frozen=True)
class SweepMeasure:
    """Compare the sweep of metallic x roughness with brute force: renders, time, error, z-test.

    An object and a light are drawn by seed. Every pair is rendered by brute force twice: once bare, for the time, and
    once in batches, for the z-test.
    """

    resolution: int = 48
    """Pixels along each side."""
    spp: int = 576
    """Samples per pixel of a brute-force render; the sweep's nodes get what makes the same error."""
    levels: int = 11
    """Values of roughness and of metallic, evenly spaced in [0, 1]."""
    nodes: int = 3
    """Metallic values that are rendered: 3 (quadratic) or 4 (exact at depth 4); 2 (linear) has to fail."""
    batches: int = 8
    """Passes of a render, from which its variance is taken."""
    seed: int = 0
    """Draws object and light."""
    split: Literal["train", "test"] = "train"
    """Of the object and the light."""
    albedo: float | None = None
    """One base colour for the whole object, in [0, 1]: the brighter, the more the bounces count. None: its own."""

    def run(self) -> int:
        """Returns the exit status: 1 where the z-test fails or the time exceeds its bound."""
        from rich.console import Console
        from rich.table import Table

        require_least(self, "", {"levels": 2, "batches": 2, "resolution": 1, "spp": self.batches, "seed": 0})
        if self.nodes not in (2, 3, 4):
            raise UsageError(f"--nodes {self.nodes}: expected 2, 3 or 4")
        if self.albedo is not None and not 0 <= self.albedo <= 1:
            raise UsageError(f"--albedo {self.albedo:g}: expected a value in [0, 1]")
        rows = self.measure()
        table = Table(title=f"Sweep of {self.levels} x {self.levels} pairs, {self.resolution} px, {self.spp} samples")
        for name in ("quantity", "found", "bound", "verdict"):
            table.add_column(name)
        for row in rows:
            verdict = "" if row.passed is None else "ok" if row.passed else "FAILED"
            table.add_row(row.quantity, row.found, row.bound, verdict)
        Console().print(table)
        return int(any(row.passed is False for row in rows))

    def measure(self) -> list[SweepRow]:
        """Renders and compares."""
        import numpy as np

        from unirender_reference import exposure, sweep_check
        from unirender_reference.lights import make_light
        from unirender_reference.noise import full_spp
        from unirender_reference.render import Renderer
        from unirender_reference.shapes import make_object
        from unirender_reference.sweep import CUBIC, QUADRATIC, render_sweep

        grid = [float(x) for x in np.linspace(0, 1, self.levels)]
        nodes = {2: (0.0, 1.0), 3: QUADRATIC, 4: CUBIC}[self.nodes]
        obj, light = make_object(self.seed, self.split), make_light(self.seed, self.split).environment
        if self.albedo is not None:
            obj = replace(obj, albedo=np.full(3, self.albedo, np.float32))
        renderer = Renderer(obj, resolution=self.resolution)
        environment = (light * exposure.scene_exposure(renderer, light, self.seed)).astype(np.float32)
        mask = renderer.geometry(seed=self.seed).require("mask")["mask"]
        bare, ours = sweep_check.row_times(renderer, environment, grid, grid, self.spp, nodes)
        sweep = render_sweep(renderer, environment, grid, grid, self.spp, 1, self.batches, nodes=nodes)
        brute = sweep_check.brute_force(renderer, environment, grid, grid, self.spp, 2, self.batches)
        test = sweep_check.compare(sweep, brute, mask, self.batches)
        linear, shown = sweep_check.error_ratios(sweep, brute, mask)
        common, own = (
            sweep_check.difference_noise(renderer, environment, grid, grid, mask, NOISE_SPP, common_seeds=value)
            for value in (True, False)
        )
        count = full_spp(CUBIC_FACTOR * self.spp, self.batches, self.resolution**2)
        bias, error = sweep_check.cubic_bias(renderer, environment, CUBIC_ROUGHNESS, mask, count, 3, self.batches)
        samples = sum(sweep.node_spp) * len(grid) / (len(grid) ** 2 * self.spp)
        share = test.share_threshold
        return [
            SweepRow("object", f"{obj.name}, {obj.family}"),
            SweepRow("renders", f"{sweep.renders} for {len(grid) ** 2} pairs"),
            SweepRow("samples of the nodes", " ".join(map(str, sweep.node_spp))),
            SweepRow("samples, of brute force's", f"{samples:.3f}"),
            SweepRow("seconds, bare loop", f"{bare:.1f}"),
            SweepRow("seconds, sweep", f"{ours:.1f}"),
            SweepRow("time ratio", f"{ours / bare:.3f}", f"<= {MOST_TIME}", ours / bare <= MOST_TIME),
            SweepRow("variance, of brute force's", f"{linear:.3f}"),
            SweepRow("displayed error, of brute force's", f"{shown:.3f}"),
            SweepRow("values compared", str(test.values)),
            SweepRow("minimum p", f"{test.min_p:.3g}", f">= {test.threshold:.3g}", test.min_p >= test.threshold),
            SweepRow("share of p >= 0.05", f"{test.pass_share:.4f}", f">= {share:.4f}", test.pass_share >= share),
            SweepRow(f"cubic term, of mean radiance (roughness {CUBIC_ROUGHNESS:g})", f"{bias:+.3%} +- {error:.3%}"),
            SweepRow("edit noise with common seeds, of independent ones", f"{common / own:.3f}"),
        ]
