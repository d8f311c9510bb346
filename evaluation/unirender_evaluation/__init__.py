"""The scorer: metrics, suites, methods, tables and the physics table.

What is asked is in `task` and `tasks`, what a row is in `rows`; `engine` asks, `scoring` scores by `metrics`, `store`
keeps the `records`. Around them are rooms: `suites`, `truth`, `methods`, `predictions`, `adapters`, `multiview`,
`physics`, `tables`, `report`, `results`, and `runs`, which puts a run together.

`score` and what goes with it are exported lazily (PEP 562), so that `import unirender_evaluation` loads nothing heavy.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from unirender_evaluation.metrics import Variant as Variant
    from unirender_evaluation.results.file import read_results as read_results
    from unirender_evaluation.score_api import score as score

_EXPORTS = {
    "Variant": "unirender_evaluation.metrics",
    "read_results": "unirender_evaluation.results.file",
    "score": "unirender_evaluation.score_api",
}

__all__ = ["Variant", "read_results", "score"]


def __getattr__(name: str) -> Any:
    if name not in _EXPORTS:
        raise AttributeError(f"module 'unirender_evaluation' has no attribute {name!r}")
    return getattr(importlib.import_module(_EXPORTS[name]), name)


def __dir__() -> list[str]:
    return sorted(__all__)
