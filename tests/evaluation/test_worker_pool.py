"""Workers do what they are given, and do not outlive who gave it."""

from __future__ import annotations

import subprocess
import sys

import pytest

from gmmtorch.evaluation.worker_pool import end_with_parent, worker_pool

_JOBLIB = """
from joblib import Parallel, delayed

work = (
    "from gmmtorch.evaluation.worker_pool import end_with_parent",
    "end_with_parent()",
    "print('at work', flush=True)",
    "while True: pass",
)
Parallel(n_jobs=2)(delayed(exec)("\\n".join(work)) for _ in range(2))
"""
_POOL = """
from gmmtorch.evaluation.worker_pool import worker_pool

with worker_pool(2) as pool:
    pool.submit(print, "at work", flush=True).result()
    for work in ("while True: pass", "import time; time.sleep(1e6)"):
        pool.submit(exec, work)
    input()
"""


def test_what_workers_answer_is_heard() -> None:
    with worker_pool(2) as pool:
        assert list(pool.map(abs, range(-3, 0))) == [3, 2, 1]


@pytest.mark.skipif(sys.platform == "win32", reason="a pipe is open as long as anybody holds it")
@pytest.mark.parametrize("program", [_POOL, _JOBLIB], ids=["pool", "joblib"])
def test_workers_end_with_a_parent_that_is_killed(program: str) -> None:
    with subprocess.Popen(
        [sys.executable, "-c", program], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as parent:
        assert parent.stdout is not None
        assert parent.stdout.readline() == "at work\n"
        parent.kill()
        parent.communicate(timeout=60)  # to the end of what the parent and all its workers could write


def test_a_process_of_its_own_goes_on() -> None:
    end_with_parent()
