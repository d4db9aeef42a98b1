"""Processes that work for this one, and end when it does, however it ends."""

from __future__ import annotations

import concurrent.futures
import multiprocessing
import os
import threading
import time
from typing import Any

_GLANCE = 0.5  # seconds between looks at whether the parent is there


def worker_pool(workers: int) -> concurrent.futures.ProcessPoolExecutor:
    """A pool of so many processes, spawned: torch's threads do not survive a fork.

    Workers whose parent is killed would wait for its next task for ever, and finish the one they have
    before: these end at once.
    """
    return concurrent.futures.ProcessPoolExecutor(
        workers, mp_context=multiprocessing.get_context("spawn"), initializer=end_with_parent
    )


def end_with_parent() -> None:
    """From now on this process, which multiprocessing or joblib started, ends as soon as its parent has.

    It ends as by a signal, in the midst of whatever it does: files that are to be whole are renamed into
    their place (`gmmtorch.files`). In a process that neither started, nothing happens.
    """
    parent = multiprocessing.parent_process()
    if parent is None:
        return

    sentinel: Any = parent.sentinel

    def wait() -> None:
        if sentinel is not None:
            parent.join()
        else:  # joblib gives its processes none
            while os.getppid() == parent.pid:
                time.sleep(_GLANCE)
        os._exit(1)

    threading.Thread(target=wait, name="end with parent", daemon=True).start()
