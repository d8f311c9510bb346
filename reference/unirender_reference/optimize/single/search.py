"""The descent of a single-view fit: Levenberg-Marquardt steps, the expected misfit falling from stage to stage."""

from collections.abc import Callable, Sequence

from unirender_reference.optimize.single.fit import FINISHED, Fit, Unknowns

Report = Callable[[dict[str, float]], None]


def anneal(fit: Fit, steps: Sequence[int], noise: Sequence[float], factor: float, report: Report) -> Unknowns:
    """Descends from the start; each stage expects its own misfit, or `factor` times what the last one left if more.

    What the model cannot explain is thereby not explained by maps; `fit` keeps the last stage's expectation.
    """
    at = fit.start()
    for stage, (count, least) in enumerate(zip(steps, noise, strict=True)):
        fit.noise = max(least, factor * fit.misfit(fit.model(at))) if stage else least
        at = descend(fit, at, count, (), report)
    return at


def descend(fit: Fit, at: Unknowns, steps: int, fixed: tuple[str, ...], report: Report) -> Unknowns:
    """At most `steps` steps; `fixed` names materials that stay ("metallic", "roughness")."""
    model = fit.model(at)
    cost, damping = fit.cost(at, model), 1e-2
    for _ in range(steps):
        found = fit.step(at, model, cost, damping, fixed)
        if found is None:
            break
        gained = (cost - found[2]) / max(cost, 1.0)
        at, model, cost, damping, at_once = found
        metallic, roughness = fit.materials(at)
        means = {"metallic": float(metallic.mean()), "roughness": float(roughness.mean())}
        report({"cost": cost, "misfit": fit.misfit(model), **means})
        if at_once and gained < FINISHED:
            break
    return at
