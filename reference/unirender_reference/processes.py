"""Worker processes that end with their parent.

A pool's workers outlive a parent that is killed (`kill -9`): nobody is left to tell them, and each holds Mitsuba, torch
and the memory of its last task. Every pool of this project therefore starts its workers with `exit_with_parent`.
"""

import multiprocessing
import multiprocessing.connection
import os
import threading


def exit_with_parent() -> None:
    """Ends this process at once, with status 1, when the process that started it is gone, however that ended.

    Call it once in a worker: as `initializer` of a `multiprocessing.Pool` or a `ProcessPoolExecutor`, or first in an
    initializer of your own. A daemon thread waits for the parent; nothing of the worker's is cleaned up.

    Raises:
        RuntimeError: this process was not started by `multiprocessing`.
    """
    parent = multiprocessing.parent_process()
    if parent is None:
        raise RuntimeError("exit_with_parent: called in the main process, expected a worker of multiprocessing")

    def follow() -> None:
        multiprocessing.connection.wait([parent.sentinel])
        os._exit(1)

    threading.Thread(target=follow, daemon=True).start()
