"""Runs a suite's scenes on a cluster (`unirender_reference.cluster`), whose workers build the rows for themselves.

They write nothing: records and pictures travel back, and the process that was started is the only writer.
"""

import tempfile
import time
from collections import deque
from collections.abc import Callable, Generator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from uuid import uuid4

from unirender.errors import UnirenderError
from unirender.system.whole_files import replace_file
from unirender_evaluation.records import Record
from unirender_evaluation.rows import Row
from unirender_evaluation.runs.workers import Run
from unirender_evaluation.subsets import Subsets
from unirender_evaluation.suites.suite import load_suite
from unirender_evaluation.versions import Versions, versions
from unirender_reference.cluster import ClusterFuture

AHEAD = 2  # scenes under way for each worker
PAUSE = 0.1  # seconds between two looks at what is under way; a scene takes many


@dataclass(frozen=True)
class Order:
    """What a cluster's worker needs to make a `Run` like the caller's; it pickles."""

    name: str  # of the run: a worker that has made it keeps it
    build: Callable[[], Sequence[Row]]  # makes the rows; paths in it are absolute
    suite: str  # name of a bundled suite, or absolute path of its TOML file
    suite_sha256: str  # of its truth
    scenes: tuple[str, ...]  # their keys
    versions: Versions
    backbones: tuple[str, ...]
    subsets: Subsets

    @classmethod
    def of(cls, run: Run, build: Callable[[], Sequence[Row]], suite: str) -> "Order":
        """The order for a run."""
        keys = tuple(scene.key for scene in run.scenes)
        return cls(uuid4().hex, build, suite, run.suite.sha256, keys, run.versions, run.backbones, run.subsets)

    def make(self) -> Run:
        """The run, in a worker; its pictures have no folder yet.

        Raises:
            UnirenderError: other code or another suite than the caller's, or rows that cannot be made here.
        """
        import torch

        if versions(self.backbones) != self.versions:
            raise UnirenderError("cluster: a worker has other code than this machine; install the same on all machines")
        suite = load_suite(self.suite)
        if suite.sha256 != self.suite_sha256:
            raise UnirenderError(f"cluster: a worker has another truth of {self.suite}; copy the file to all machines")
        torch.set_num_threads(1)
        scenes = [suite.scene(key) for key in self.scenes]
        return Run(suite, self.build(), scenes, self.versions, self.backbones, Path(), self.subsets)


_made: dict[str, Run] = {}  # at most one run, by the name of its order


def cluster_scene(order: Order, scene: str, wanted: frozenset[str]) -> tuple[list[Record], dict[str, bytes]]:
    """The records of a scene that have the wanted content keys, and the pictures that belong to them, by file name.

    Raises:
        UnirenderError: this worker's methods, suite or code are others than those of who asks.
    """
    if order.name not in _made:
        _made.clear()
        _made[order.name] = order.make()
    with tempfile.TemporaryDirectory() as folder:
        run = replace(_made[order.name], pictures=Path(folder))
        records = [job.make() for job in run.jobs(run.suite.scene(scene)) if job.key in wanted]
        if missing := len(wanted - {record.key for record in records}):
            raise UnirenderError(
                f"cluster: a worker does not know {missing} of the records of {scene}: it has other methods than this "
                "machine; install the same on all machines, and name files by absolute paths"
            )
        return records, {path.name: path.read_bytes() for path in Path(folder).iterdir()}


def run_on_cluster(
    run: Run, build: Callable[[], Sequence[Row]], suite: str, wanted: Mapping[str, frozenset[str]], address: str
) -> Generator[list[Record], None, None]:
    """Records of scenes from a cluster's workers, a scene at a time as they come; pictures are written here.

    `wanted` has the content keys of each scene's records.

    Raises:
        UnirenderError: as `connect`; a worker cannot do it, or several died over a scene.
    """
    from unirender_reference.cluster import connect

    order = Order.of(run, build, suite)
    with connect(address) as executor:
        under_way: list[ClusterFuture] = []
        waiting = deque(wanted.items())
        while waiting or under_way:
            while waiting and len(under_way) < AHEAD * max(executor.workers, 1):
                under_way.append(executor.submit(cluster_scene, order, *waiting.popleft()))
            records, pictures = _take_done(under_way).result()
            for name, data in pictures.items():
                replace_file(run.pictures / name, data)
            yield records


def _take_done(under_way: list[ClusterFuture]) -> ClusterFuture:
    """Removes the first future that is done, after waiting for one: a slow scene holds up no other."""
    while True:
        for place, future in enumerate(under_way):
            if future.done():
                return under_way.pop(place)
        time.sleep(PAUSE)
