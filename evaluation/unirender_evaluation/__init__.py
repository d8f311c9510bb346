"""The scorer: metrics, suites, methods, tables and the physics table.

What is asked is in `task` and `tasks`, what a row is in `rows`; `engine` asks, `scoring` scores by `metrics`, `store`
keeps the `records`. Around them are rooms: `suites`, `truth`, `methods`, `predictions`, `adapters`, `multiview`,
`physics`, `tables`, `report`, `results`, and `runs`, which puts a run together.

What a notebook needs is exported lazily (PEP 562), so that `import unirender_evaluation` loads nothing heavy:

    score(prediction, truth)                        one prediction, without a suite
    run(BenchConfig(suite="tiny", ...)).tables      what `unirender bench run` does and prints
    build_tables(results.records, results.run)      the tables of `results = read_results(path)`
    to_markdown(table), to_latex(table)
    load_suite("tiny")                              its truth as arrays; `tasks.tasks` iterates over its questions
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from unirender_evaluation.metrics import Variant as Variant
    from unirender_evaluation.results.file import read_results as read_results
    from unirender_evaluation.runs.benchmark import run as run
    from unirender_evaluation.runs.config import BenchConfig as BenchConfig
    from unirender_evaluation.score_api import score as score
    from unirender_evaluation.suites.suite import load_suite as load_suite
    from unirender_evaluation.tables.build import build_tables as build_tables
    from unirender_evaluation.tables.formats import to_markdown as to_markdown
    from unirender_evaluation.tables.latex import to_latex as to_latex

_EXPORTS = {
    "BenchConfig": "unirender_evaluation.runs.config",
    "Variant": "unirender_evaluation.metrics",
    "build_tables": "unirender_evaluation.tables.build",
    "load_suite": "unirender_evaluation.suites.suite",
    "read_results": "unirender_evaluation.results.file",
    "run": "unirender_evaluation.runs.benchmark",
    "score": "unirender_evaluation.score_api",
    "to_latex": "unirender_evaluation.tables.latex",
    "to_markdown": "unirender_evaluation.tables.formats",
}

__all__ = [
    "BenchConfig",
    "Variant",
    "build_tables",
    "load_suite",
    "read_results",
    "run",
    "score",
    "to_latex",
    "to_markdown",
]


def __getattr__(name: str) -> Any:
    if name not in _EXPORTS:
        raise AttributeError(f"module 'unirender_evaluation' has no attribute {name!r}")
    return getattr(importlib.import_module(_EXPORTS[name]), name)


def __dir__() -> list[str]:
    return sorted(__all__)
