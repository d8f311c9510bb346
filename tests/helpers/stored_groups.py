"""An executor whose groups are there at once, as bytes that depend on the plan: for tests of what is recorded."""

from collections.abc import Callable
from concurrent.futures import Future
from typing import Any

from inline_executor import Inline

from unirender_reference.dataset import render_group
from unirender_reference.dataset_config import DatasetConfig
from unirender_reference.faults import FileFailure, FileNotSeen
from unirender_reference.plan import GroupPlan
from unirender_reference.shards import RenderedGroup

PICTURE = bytes(1 << 16)  # more than a file keeps back before it writes


class Stored(Inline):
    """Renders nothing; a mesh file without faces fails."""

    def submit(self, function: Callable[..., Any], /, *arguments: Any) -> Future:
        return super().submit(_stored if function is render_group else function, *arguments)


def _stored(_: DatasetConfig, plan: GroupPlan) -> RenderedGroup:
    if plan.mesh is not None and plan.mesh.path.is_symlink():
        raise FileNotSeen(f"mesh {plan.mesh.name}: no such file")
    if plan.mesh is not None and b"f " not in plan.mesh.path.read_bytes():
        raise FileFailure("has no faces")
    members = {"json": str(plan.render_seed).encode(), "l0.exr": PICTURE}
    return RenderedGroup(f"object{plan.index}_g0", members, plan.samples, 0, 0.1, 0.1)
