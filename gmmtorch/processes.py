"""Worker processes that end with the process that started them."""

from __future__ import annotations

import multiprocessing
import os
import sys
import threading
import time
from typing import Any

_PERIOD = 0.5  # seconds between checks whether the parent process is alive


def has_lost_parent(process: str) -> bool:
    """Whether the process with this number, which started this one, has ended. Always false on Windows."""
    # There os.getppid names the launcher of a virtual environment, and does not change when a parent ends.
    return sys.platform != "win32" and str(os.getppid()) != process


def end_with_parent() -> None:
    """From now on, this worker process of multiprocessing or joblib ends as soon as its parent has ended.

    It ends as if killed, in the middle of its work: files that must be whole are renamed into place
    (`gmmtorch.files`). In any other process nothing happens.
    """
    parent = multiprocessing.parent_process()
    if parent is None:
        return

    sentinel: Any = parent.sentinel

    def wait() -> None:
        if sentinel is not None:
            parent.join()
        else:  # joblib's processes have no sentinel
            while os.getppid() == parent.pid:
                time.sleep(_PERIOD)
        os._exit(1)

    threading.Thread(target=wait, name="end with parent", daemon=True).start()
