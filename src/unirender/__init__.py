"""unirender: a physics-checked renderer and inverse renderer.

Names are exported lazily (PEP 562), so that `import unirender` loads neither torch nor mitsuba.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from unirender.camera import Camera as Camera
    from unirender.errors import UnirenderError as UnirenderError
    from unirender.intrinsics import Intrinsics as Intrinsics
    from unirender.pipelines.results import Decomposition as Decomposition
    from unirender.pipelines.results import EditResult as EditResult
    from unirender.pipelines.unirender_pipeline import UniRenderPipeline as UniRenderPipeline

__version__ = "0.1.0"

_EXPORTS = {
    "Camera": "unirender.camera",
    "Decomposition": "unirender.pipelines.results",
    "EditResult": "unirender.pipelines.results",
    "Intrinsics": "unirender.intrinsics",
    "UniRenderPipeline": "unirender.pipelines.unirender_pipeline",
    "UnirenderError": "unirender.errors",
}

__all__ = [
    "Camera",
    "Decomposition",
    "EditResult",
    "Intrinsics",
    "UniRenderPipeline",
    "UnirenderError",
    "__version__",
]


def __getattr__(name: str) -> Any:
    if name not in _EXPORTS:
        raise AttributeError(f"module 'unirender' has no attribute {name!r}")
    return getattr(importlib.import_module(_EXPORTS[name]), name)


def __dir__() -> list[str]:
    return sorted(__all__)
