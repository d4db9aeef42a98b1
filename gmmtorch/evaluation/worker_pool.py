"""Processes that work for this one, and end when it does, however it ends."""

from __future__ import annotations

import concurrent.futures
import multiprocessing
import os
import threading


def worker_pool(workers: int) -> concurrent.futures.ProcessPoolExecutor:
    """A pool of so many processes, spawned: torch's threads do not survive a fork.

    Workers whose parent is killed would wait for its next task for ever, and finish the one they have
    before: these end at once.
    """
    return concurrent.futures.ProcessPoolExecutor(
        workers, mp_context=multiprocessing.get_context("spawn"), initializer=end_with_parent
    )


def end_with_parent() -> None:
    """From now on this process, which multiprocessing started, ends as soon as its parent has ended.

    It ends as by a signal, in the midst of whatever it does: files that are to be whole are renamed into
    their place (`gmmtorch.files`). In a process that multiprocessing did not start, nothing happens.
    """
    parent = multiprocessing.parent_process()
    if parent is None:
        return

    def wait() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=wait, name="end with parent", daemon=True).start()
