"""Generates a data set: renders groups in worker processes and stores them as shards.

Mitsuba scales badly over threads at 64 pixels (a wavefront lasts tens of milliseconds), so every worker is one process
with one thread that renders whole groups and encodes its EXR files; the parent only writes tars, in the order of the
plan. It never loads a mesh or Mitsuba itself, and knows at most `AHEAD` groups per worker at a time, however many there
are. A mesh file that cannot be loaded or rendered is listed, and its groups are left out.
"""

import contextlib
import dataclasses
import itertools
import os
import time
from collections import Counter, deque
from collections.abc import Callable, Generator, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from unirender.errors import UnirenderError
from unirender_reference import backend
from unirender_reference.dataset_config import DatasetConfig
from unirender_reference.faults import FileFailure, FileNotSeen
from unirender_reference.folder_lock import locked, made_folder
from unirender_reference.journal import Journal
from unirender_reference.plan import SHARD_GROUPS, GroupPlan, Plan, plan_groups
from unirender_reference.resume import check_sources, finished_shards, sources_hash
from unirender_reference.shards import (
    Failure,
    FloorCount,
    RenderedGroup,
    ShardRecord,
    all_failures,
    shard_name,
    total_floor,
    write_shard,
)
from unirender_reference.versions import versions
from unirender_reference.workers import LocalWorkers, WorkerDied

AHEAD = 3  # groups under way per worker

Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class GenerateReport:
    """What a call of `generate` did (shards of earlier calls are counted where it says so).

    Attributes:
        groups, samples: rendered and stored now.
        skipped_shards: found complete.
        seconds: wall time.
        render_seconds: sum of the seconds inside `mi.render`, over all workers.
        workers: processes that rendered.
        overhead: `seconds * workers / render_seconds`: 1 is a generator that does nothing but render.
        manifest_sha256: of the manifest written.
        failures: mesh files, and folders, that the whole data set lacks, those of earlier calls included.
        floor: what was reached of the noise floor asked for, in the whole data set; None without one.
        negative_pixels: of interpolated pictures, with a channel below 0, in the whole data set.
        unreadable_lights: files of the user's that are no lights and were passed over, a line each, in the whole data
            set.
    """

    groups: int
    samples: int
    skipped_shards: int
    seconds: float
    render_seconds: float
    workers: int
    overhead: float
    nan_pixels: int
    manifest_sha256: str
    failures: tuple[Failure, ...] = ()
    floor: FloorCount | None = None
    negative_pixels: int = 0
    unreadable_lights: tuple[str, ...] = ()


def generate(
    config: DatasetConfig, progress: Progress | None = None, executor: Any = None, verify: bool = False
) -> GenerateReport:
    """Writes the data set, or what is missing of it.

    Args:
        config: what to generate.
        progress: called with (groups done, groups in all) whenever a group is finished.
        executor: renders instead of `config.workers` processes of this machine or `config.cluster`: anything with the
            `submit` of `concurrent.futures` and a number of `workers`.
        verify: read every byte of the shards that are there; else of the last few, and of the others the size.

    Raises:
        UnirenderError: the folder is unusable, in use, or holds another data set; there are no meshes; or a render
            failed and no file is to blame. A folder that this call made is gone again if nothing got into it.
    """
    start = time.perf_counter()
    _prepare(config)
    plan = plan_groups(config)
    content = {**config.content(), "shard_groups": SHARD_GROUPS}
    config = dataclasses.replace(config, lights_digest=content["lights"])
    with made_folder(config.out), locked(config.out):
        return _generate(config, plan, content, progress, executor, start, verify)


def _generate(
    config: DatasetConfig,
    plan: Plan,
    content: dict[str, Any],
    progress: Progress | None,
    executor: Any,
    start: float,
    verify: bool,
) -> GenerateReport:
    """Renders the groups that no complete shard has, in the order of the plan, and writes shards and manifest."""
    shards = _shards(len(plan))
    header: dict[str, Any] = {"config": content, "versions": versions(config.denoise)}
    if unreadable := _unreadable_folders(plan):
        header["unreadable"] = [{"file": failure.file, "reason": failure.reason} for failure in unreadable]
    sizes = {name: len(part) for name, part in shards.items()}
    done, stale = finished_shards(config.out, header, sizes, verify=verify)
    for name, record in done.items():
        check_sources(config, record, [plan[i] for i in shards[name]])
    todo = {name: part for name, part in shards.items() if name not in done}
    found, count = len(done), sum(len(shards[name]) for name in done)
    workers, render_seconds = 0, 0.0
    if progress:
        progress(count, len(plan))

    def arriving(part: range) -> Iterator[RenderedGroup | Failure]:
        nonlocal count
        try:
            for outcome in itertools.islice(results, len(part)):
                count += 1
                if progress:
                    progress(count, len(plan))
                yield outcome
        except OSError as error:  # of a worker's; the shard that it comes to is not to blame
            raise UnirenderError(f"dataset: a render failed ({error}); run the same command again") from error

    with contextlib.ExitStack() as stack:
        if todo:
            executor = executor or stack.enter_context(_executor(config, len(plan) - count))
            workers = executor.workers
        results = _results(config, (plan[i] for part in todo.values() for i in part), executor)
        stack.callback(results.close)
        journal = stack.enter_context(Journal(config.out, header, done, stale))
        for name, part in todo.items():
            done[name], spent = _write_shard(config, name, arriving(part), [plan[i] for i in part])
            journal.add(done[name])
            render_seconds += spent
        manifest_sha256 = journal.complete()
    return _report(
        list(done.values()),
        found,
        unreadable,
        seconds=time.perf_counter() - start,
        render_seconds=render_seconds,
        workers=workers,
        manifest_sha256=manifest_sha256,
    )


def _shards(groups: int) -> dict[str, range]:
    """The name of each shard, and the numbers of its groups; the last one may have fewer."""
    starts = range(0, groups, SHARD_GROUPS)
    return {shard_name(i // SHARD_GROUPS): range(i, min(i + SHARD_GROUPS, groups)) for i in starts}


def _report(
    records: Sequence[ShardRecord],
    found: int,
    unreadable: Sequence[Failure],
    *,
    seconds: float,
    render_seconds: float,
    workers: int,
    manifest_sha256: str,
) -> GenerateReport:
    """The report of a run whose first `found` shards were there before.

    `unreadable` are the folders that could not be listed.
    """
    new = records[found:]
    return GenerateReport(
        groups=sum(record.groups for record in new),
        samples=sum(record.samples for record in new),
        skipped_shards=found,
        seconds=seconds,
        render_seconds=render_seconds,
        workers=workers,
        overhead=seconds * workers / render_seconds if render_seconds else float("nan"),
        nan_pixels=sum(record.nan_pixels for record in new),
        manifest_sha256=manifest_sha256,
        failures=(*unreadable, *all_failures(records)),
        floor=total_floor(record.floor for record in records),
        negative_pixels=sum(record.negative_pixels for record in records),
        unreadable_lights=tuple(sorted({line for record in records for line in record.unreadable_lights})),
    )


def render_group(config: DatasetConfig, plan: GroupPlan) -> RenderedGroup:
    """`group.render`, which is imported where it runs: the parent needs neither shapes nor Mitsuba."""
    from unirender_reference import group

    return group.render(config, plan)


def start_worker() -> None:
    """One thread per worker and everything imported."""
    backend.set_threads(1)
    from unirender_reference import group  # noqa: F401 - warms up


def _prepare(config: DatasetConfig) -> None:
    """Finds out early what would stop every worker."""
    if config.out.exists() and not config.out.is_dir():
        raise UnirenderError(f"{config.out}: is a file, expected a folder to write shards to; choose another --out")
    if config.cluster is None:
        backend.find_llvm()
    if config.denoise:
        from unirender_reference import denoise

        denoise.version()


def _executor(config: DatasetConfig, groups: int) -> contextlib.AbstractContextManager[Any]:
    """What renders when the caller brings nothing: a cluster, or at most `groups` processes of this machine."""
    if config.cluster is not None:
        from unirender_reference import cluster

        return cluster.connect(config.cluster, denoise=config.denoise)
    return LocalWorkers(min(config.workers or os.cpu_count() or 1, groups), start_worker)


def _results(
    config: DatasetConfig, plans: Iterator[GroupPlan], executor: Any
) -> Generator[RenderedGroup | Failure, None, None]:
    """Renders groups and yields them in order; a bounded number is under way."""
    under_way: deque[tuple[GroupPlan, Any]] = deque()
    try:
        for plan in plans:
            under_way.append((plan, executor.submit(render_group, config, plan)))
            if len(under_way) >= AHEAD * max(executor.workers, 1):
                yield _outcome(*under_way.popleft())
        while under_way:
            yield _outcome(*under_way.popleft())
    finally:
        for _, future in under_way:
            future.cancel()


def _outcome(plan: GroupPlan, future: Any) -> RenderedGroup | Failure:
    """The group, or why its file has none.

    Raises:
        UnirenderError: the group failed, and no file is to blame.
    """
    try:
        return future.result()
    except (FileFailure, WorkerDied) as error:
        if plan.mesh is not None:
            return Failure(plan.mesh.name, str(error), machine=isinstance(error, WorkerDied) or error.machine)
        raise UnirenderError(f"dataset: {error}; complete shards are kept, run the same command again") from error
    except FileNotSeen as error:
        assert plan.mesh is not None
        if os.path.isfile(plan.mesh.path):
            raise UnirenderError(
                f"{error}; the command sees it: --meshes has to be at the same path on every machine"
            ) from error
        if os.path.lexists(plan.mesh.path):
            return Failure(plan.mesh.name, "is no regular file, or a link to nowhere")
        raise UnirenderError(
            f"{error}; it is gone since the command began: put it back and run the same command again"
        ) from error


def _write_shard(
    config: DatasetConfig, name: str, outcomes: Iterator[RenderedGroup | Failure], plans: list[GroupPlan]
) -> tuple[ShardRecord, float]:
    """Stores the groups as they come (without any, an empty tar); the record, and the seconds of renders."""
    groups: list[RenderedGroup] = []
    failures: Counter[Failure] = Counter()

    def stored() -> Iterator[tuple[str, dict[str, bytes]]]:
        for outcome in outcomes:
            if isinstance(outcome, Failure):
                failures[outcome] += 1
            else:
                groups.append(dataclasses.replace(outcome, members={}))
                yield outcome.key, outcome.members

    sha256 = write_shard(config.out / name, stored())
    record = ShardRecord(
        name=name,
        sha256=sha256,
        bytes=(config.out / name).stat().st_size,
        groups=len(groups),
        samples=sum(group.samples for group in groups),
        nan_pixels=sum(group.nan_pixels for group in groups),
        sources=sources_hash(plans),
        failures=tuple(dataclasses.replace(failure, groups=number) for failure, number in failures.items()),
        floor=total_floor(group.floor for group in groups),
        negative_pixels=sum(group.negative_pixels for group in groups),
        unreadable_lights=tuple(sorted({line for group in groups for line in group.unreadable_lights})),
    )
    return record, sum(group.render_seconds for group in groups)


def _unreadable_folders(plan: Plan) -> list[Failure]:
    """Folders of meshes that cannot be listed: nobody knows what is missing from the data set."""
    folders = [] if plan.meshes is None else plan.meshes.unreadable
    return [Failure(f"{name}/", f"folder cannot be listed ({reason})", groups=0) for name, reason in folders]
