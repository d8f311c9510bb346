"""Independent checks of the ground truth: closed forms, our own BSDF, invariants, and errors that they must notice.

`CHECKS` lists them by name; `run_check` runs one; `perturbed` breaks the scenes on purpose. `docs/checks.md` gives the
formulas. `checks.command` is `unirender reference check`.
"""
